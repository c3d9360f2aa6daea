"""How far edges go: free ends move on as far as the images show the edge, and no farther."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from taichi_edges.fitting.model_selection import PixelAt
from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline, middles_of
from taichi_edges.refinement.continuation import GAP_SEEN, LEAST_GAP_VIEWS

AHEAD_PX = 40.0  # looked beyond an end; a longer way takes another round
LOST_PX = 4.0  # an edge that the images do not show for so long has ended
ROUNDS = 4

Question = tuple[Shape, np.ndarray]  # a shape, and (n,) parameters of places on it


def extended(
    shapes: Sequence[Shape],
    sides: Sequence[Sequence[int]],
    seen: Callable[[list[int], list[Question]], list[np.ndarray]],
    pixel_at: PixelAt,
) -> list[Shape]:
    """Lines and arcs, their ends on the given sides moved outwards as far as the images show them; others as they are.

    sides: those of each shape. seen: function of the indices of some shapes and [(shape, parameters)] as these are by
    now: how many views see an edge there that is nobody else's. One step of all shapes at a time is asked about.
    """
    found = list(shapes)
    steps = {n: _steps(shape, own, pixel_at) for n, (shape, own) in enumerate(zip(shapes, sides, strict=True)) if own}
    answers: dict[int, Any] = dict.fromkeys(steps)
    while steps:
        questions: dict[int, Question] = {}
        for number, generator in list(steps.items()):
            try:
                questions[number] = generator.send(answers[number])
            except StopIteration as done:
                found[number] = done.value
                del steps[number]
        asked = seen(list(questions), list(questions.values())) if questions else []
        answers = dict(zip(questions, asked, strict=True))
    return found


def _steps(shape: Shape, sides: Sequence[int], pixel_at: PixelAt) -> Generator[Question, Any, Shape]:
    """Generator that asks how many views see places, (shape, parameters), and returns the extended shape."""
    if isinstance(shape, Spline) or shape.kind not in ("line", "arc"):
        return shape
    inside = np.linspace(0.05, 0.95, max(int(shape.length / pixel_at(middles_of([shape]))[0]), 5))
    least = max(GAP_SEEN * np.median((yield shape, inside)), LEAST_GAP_VIEWS)
    for side in sides:
        for _ in range(ROUNDS):
            pixel = float(pixel_at(shape.ends[[side]])[0])
            ways = np.arange(1.0, AHEAD_PX + 1.0) * pixel
            views = yield shape, side + (2 * side - 1) * ways / shape.length
            ahead = shown(ways, views >= least, pixel)
            if ahead <= 0 or turned_round(shape, ahead):
                break
            shape = grown(shape, side, ahead)
            if ahead < 0.5 * AHEAD_PX * pixel:
                break
    return shape


def shown(ways: np.ndarray, good: np.ndarray, pixel: float) -> float:
    """Length beyond an end that the images show. ways: (n,) from it, a pixel apart. good: (n,) bool, seen there?"""
    last, lost = 0.0, 0.0
    for way, seen_here in zip(ways, good, strict=True):
        lost = 0.0 if seen_here else lost + pixel
        if lost >= LOST_PX * pixel:
            break
        last = way if seen_here else last
    return last


def turned_round(shape: Line | EllipticArc, ahead: float) -> bool:
    """Would an arc run into itself?"""
    return isinstance(shape, EllipticArc) and shape.length + ahead >= 2 * np.pi * shape.radii[0]


def grown(shape: Line | EllipticArc, side: int, ahead: float) -> Line | EllipticArc:
    """A line or an arc, longer by `ahead` on one side."""
    parameter = side + (2 * side - 1) * ahead / shape.length
    if isinstance(shape, Line):
        points = shape.points.copy()
        points[side] = shape.at(parameter)
        return Line(points)
    angle = float(shape.angles(parameter))
    return replace(shape, high=angle) if side else replace(shape, low=angle)
