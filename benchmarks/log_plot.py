"""Panels of curves on logarithmic axes, drawn with OpenCV."""

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from benchmarks.markdown import significant

PANEL = (460, 340)  # width and height of a panel, pixels
MARGINS = (78, 54, 18, 62)  # left, top, right, bottom of the axes inside a panel
FINE = 2  # everything is drawn so many times larger and then reduced
COLOURS = ((180, 90, 20), (40, 110, 220), (80, 150, 60))  # BGR
INK, GRID, BLACK = (60, 60, 60), (225, 225, 225), (0, 0, 0)
TEXT, SMALL_TEXT = 0.47, 0.4
STEPS = (1, 2, 5)  # ticks of a decade


@dataclass(frozen=True)
class Curve:
    """A line with marks. xs, ys: positive."""

    label: str
    xs: tuple
    ys: tuple


@dataclass(frozen=True)
class Panel:
    """Curves over a common axis, whose ticks stand at the measured values."""

    title: str
    x_label: str
    curves: tuple


def draw_panels(path, rows):
    """Write a PNG of panels. rows: rows of Panels."""
    width, height = PANEL
    picture = np.full((height * len(rows) * FINE, width * len(rows[0]) * FINE, 3), 255, np.uint8)
    for row, panels in enumerate(rows):
        for column, panel in enumerate(panels):
            _draw_panel(_Canvas(picture, column * width, row * height), panel)
    reduced = cv2.resize(picture, None, fx=1 / FINE, fy=1 / FINE, interpolation=cv2.INTER_AREA)
    if not cv2.imwrite(str(path), reduced):
        raise OSError(f"{path} cannot be written")


class _Canvas:
    """Lines, marks and text in the pixels of one panel, drawn FINE times larger."""

    def __init__(self, picture, left, top):
        self.picture, self.origin = picture, np.array([left, top], float)

    def _fine(self, point):
        return tuple(int(x) for x in np.rint((self.origin + point) * FINE))

    def line(self, start, end, colour, width=1):
        cv2.line(self.picture, self._fine(start), self._fine(end), colour, width * FINE, cv2.LINE_AA)

    def mark(self, point, colour):
        cv2.circle(self.picture, self._fine(point), 4 * FINE, colour, cv2.FILLED, cv2.LINE_AA)

    def text(self, point, text, scale, across=0.0, colour=BLACK):
        """across: 0, 0.5 or 1: the point is the left end, the middle or the right end of the baseline.

        Returns the length.
        """
        font, thickness = cv2.FONT_HERSHEY_SIMPLEX, FINE
        (length, _), _ = cv2.getTextSize(text, font, scale * FINE, thickness)
        left = np.array(point, float) - [across * length / FINE, 0.0]
        cv2.putText(self.picture, text, self._fine(left), font, scale * FINE, colour, thickness, cv2.LINE_AA)
        return length / FINE


def _draw_panel(canvas, panel):
    left, top, right, bottom = MARGINS
    low, high = np.array([left, PANEL[1] - bottom]), np.array([PANEL[0] - right, top])  # corners of the axes
    xs = sorted({x for curve in panel.curves for x in curve.xs})
    x_limits, y_ticks = _widened(xs), log_ticks([y for curve in panel.curves for y in curve.ys])
    y_limits = y_ticks[0], y_ticks[-1]

    def place(x, y):
        fractions = [_fraction(x, x_limits), _fraction(y, y_limits)]
        return low + np.array(fractions) * (high - low)

    for y in y_ticks:
        here = place(x_limits[0], y)
        canvas.line(here, place(x_limits[1], y), GRID)
        canvas.text(here + [-8, 4], tick_text(y), SMALL_TEXT, 1.0)
    for x in xs:
        here = place(x, y_limits[0])
        canvas.line(here, place(x, y_limits[1]), GRID)
        canvas.text(here + [0, 18], tick_text(x), SMALL_TEXT, 0.5)
    canvas.line(low, (low[0], high[1]), INK)
    canvas.line(low, (high[0], low[1]), INK)
    canvas.text((left, 20), panel.title, TEXT)
    label_at = left
    canvas.text(((low[0] + high[0]) / 2, PANEL[1] - 22), panel.x_label, TEXT, 0.5)
    for curve, colour in zip(panel.curves, COLOURS, strict=False):
        points = [place(x, y) for x, y in zip(curve.xs, curve.ys, strict=True)]
        for one, other in pairwise(points):
            canvas.line(one, other, colour, 2)
        for point in points:
            canvas.mark(point, colour)
        label_at += canvas.text((label_at, 40), curve.label, SMALL_TEXT, colour=colour) + 20


def _fraction(value, limits):
    """Where a value lies between two limits on a logarithmic axis, 0..1."""
    return math.log(value / limits[0]) / math.log(limits[1] / limits[0])


def _widened(values):
    """Limits that leave some room beside the smallest and the largest."""
    span = max(values[-1] / values[0], 2.0) ** 0.08
    return values[0] / span, values[-1] * span


def log_ticks(values):
    """1, 2, 5 times powers of ten that enclose the values; over more than three decades powers of ten alone."""
    low, high = math.floor(math.log10(min(values)) - 0.02), math.ceil(math.log10(max(values)) + 0.05)
    steps = STEPS if high - low <= 3 else (1,)
    ticks = [step * 10.0**power for power in range(low, high + 1) for step in steps]
    first = max(i for i, tick in enumerate(ticks) if tick <= min(values))
    last = min(i for i, tick in enumerate(ticks) if tick >= max(values) * 1.1)
    return ticks[first : last + 1]


def tick_text(value):
    """0.5, 20, 800, 1k, 1600, 500k."""
    if value >= 1000 and value % 1000 == 0:
        return f"{value / 1000:.0f}k"
    return f"{value:.0f}" if value >= 1 else significant(value, 1)
