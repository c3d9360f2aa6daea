"""The shapes an edge can have: a line segment, an arc of a circle or an ellipse, a smooth chain of cubic Beziers.

They all answer to the same names. `at`, `tangents`: (n,) parameters, 0 at the start and 1 at the end -> (n, 3) points,
unit tangents; an arc and a line go on beyond their ends. `ends`: (2, 3). `closed`, `length`, `cubics`. `transformed`:
moved by `function`, a similarity (n, 3) -> (n, 3).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.geometry.bezier import bernstein, bezier_lengths, evaluate_bezier

QUARTER = 0.5 * np.pi
ROUND = 1e-6  # relative difference of the half axes below which an ellipse is a circle
LENGTH_CHORDS = 256  # for each ellipse: its length to a few parts in a million


@dataclass(frozen=True)
class Line:
    """A line segment. points: (2, 3) its ends."""

    points: np.ndarray
    kind = "line"
    closed = False

    @property
    def ends(self) -> np.ndarray:
        """(2, 3)."""
        return self.points

    @property
    def length(self) -> float:
        """Of the frame's units."""
        return float(np.linalg.norm(self.points[1] - self.points[0]))

    def at(self, parameters: ArrayLike) -> np.ndarray:
        """Points, see above."""
        return self.points[0] + np.asarray(parameters)[..., None] * (self.points[1] - self.points[0])

    def tangents(self, parameters: ArrayLike) -> np.ndarray:
        """Unit tangents, see above."""
        along = (self.points[1] - self.points[0]) / max(self.length, 1e-300)
        return np.broadcast_to(along, (*np.shape(parameters), 3))

    def cubics(self) -> np.ndarray:
        """(1, 4, 3) the same segment as a cubic."""
        return self.at(np.linspace(0, 1, 4))[None]

    def transformed(self, function: Callable[[np.ndarray], np.ndarray]) -> "Line":
        """Moved, see above."""
        return Line(function(self.points))


@dataclass(frozen=True)
class EllipticArc:
    """An arc of an ellipse or a circle, centre + cos(t) axes[0] + sin(t) axes[1] for t from low to high.

    centre: (3,). axes: (2, 3) the half axes, orthogonal, the longer one first; of a circle, of equal length.
    low, high: radians, low < high; a whole round apart where the edge is closed.
    """

    centre: np.ndarray
    axes: np.ndarray
    low: float
    high: float

    @staticmethod
    def conjugate(centre: ArrayLike, diameters: ArrayLike, low: float, high: float) -> "EllipticArc":
        """The arc centre + cos(t) diameters[0] + sin(t) diameters[1], t from low to high, for any two half diameters.

        Their principal axes are found by rotating t (Rytz).
        """
        first, second = np.asarray(diameters, dtype=np.float64)
        turn = 0.5 * np.arctan2(2 * first @ second, first @ first - second @ second)
        if abs(first @ second) <= 1e-12 * (first @ first + second @ second) and first @ first >= second @ second:
            turn = 0.0  # they are the axes already
        cosine, sine = np.cos(turn), np.sin(turn)
        axes = np.array([cosine * first + sine * second, cosine * second - sine * first])
        return EllipticArc(np.asarray(centre, dtype=np.float64), axes, float(low - turn), float(high - turn))

    @cached_property
    def radii(self) -> np.ndarray:
        """(2,) lengths of the half axes."""
        return np.linalg.norm(self.axes, axis=1)

    @property
    def circular(self) -> bool:
        """Is it part of a circle?"""
        return bool(abs(self.radii[0] - self.radii[1]) <= ROUND * self.radii[0])

    @property
    def kind(self) -> str:
        """'circle', 'arc', 'ellipse' or 'elliptic_arc'."""
        if self.circular:
            return "circle" if self.closed else "arc"
        return "ellipse" if self.closed else "elliptic_arc"

    @property
    def closed(self) -> bool:
        """A whole round?"""
        return self.high - self.low >= 2 * np.pi * (1 - 1e-9)

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit normal of its plane; t turns counter-clockwise about it."""
        normal = np.cross(*self.axes)
        return normal / np.linalg.norm(normal)

    @property
    def ends(self) -> np.ndarray:
        """(2, 3)."""
        return self.at(np.array([0.0, 1.0]))

    @cached_property
    def length(self) -> float:
        """Of the frame's units."""
        if self.circular:
            return float((self.high - self.low) * self.radii.mean())
        chords = np.diff(self.at(np.linspace(0, 1, LENGTH_CHORDS + 1)), axis=0)
        return float(np.linalg.norm(chords, axis=1).sum())

    def angles(self, parameters: ArrayLike) -> np.ndarray:
        """Parameters 0..1 -> t, radians."""
        return self.low + np.asarray(parameters) * (self.high - self.low)

    def at(self, parameters: ArrayLike) -> np.ndarray:
        """Points, see above."""
        t = self.angles(parameters)[..., None]
        return self.centre + np.cos(t) * self.axes[0] + np.sin(t) * self.axes[1]

    def tangents(self, parameters: ArrayLike) -> np.ndarray:
        """Unit tangents, see above."""
        t = self.angles(parameters)[..., None]
        along = np.cos(t) * self.axes[1] - np.sin(t) * self.axes[0]
        return along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-300)

    def over(self, low: float, high: float) -> "EllipticArc":
        """The same ellipse between other angles, radians."""
        return replace(self, low=float(low), high=float(high))

    def cubics(self) -> np.ndarray:
        """(c, 4, 3) cubic Beziers, each over a quarter round at most: 3e-4 of the radius off."""
        count = max(int(np.ceil((self.high - self.low) / QUARTER - 1e-9)), 1)
        joints = np.linspace(0, 1, count + 1)
        t = self.angles(joints)[:, None]
        places, slopes = self.at(joints), np.cos(t) * self.axes[1] - np.sin(t) * self.axes[0]
        if self.closed:
            places[-1], slopes[-1] = places[0], slopes[0]
        handle = 4 / 3 * np.tan((self.high - self.low) / count / 4)
        starts, ends = places[:-1], places[1:]
        return np.stack([starts, starts + handle * slopes[:-1], ends - handle * slopes[1:], ends], axis=1)

    def transformed(self, function: Callable[[np.ndarray], np.ndarray]) -> "EllipticArc":
        """Moved, see above."""
        moved = function(np.concatenate([self.centre[None], self.centre + self.axes]))
        return EllipticArc(moved[0], moved[1:] - moved[0], self.low, self.high)


@dataclass(frozen=True)
class Spline:
    """A smooth chain of cubic Beziers. curves: (c, 4, 3) control points; closed: its end is its start."""

    curves: np.ndarray
    closed: bool = False
    kind = "spline"

    @property
    def ends(self) -> np.ndarray:
        """(2, 3)."""
        return np.stack([self.curves[0, 0], self.curves[-1, 3]])

    @cached_property
    def length(self) -> float:
        """Of the frame's units."""
        return float(bezier_lengths(self.curves).sum())

    def _pieces(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) the cubic and (n,) the parameter in it."""
        scaled = np.clip(parameters, 0.0, 1.0) * len(self.curves)
        piece = np.minimum(scaled.astype(int), len(self.curves) - 1)
        return piece, scaled - piece

    def at(self, parameters: ArrayLike) -> np.ndarray:
        """Points, see above; parameters count the cubics evenly."""
        piece, t = self._pieces(np.atleast_1d(parameters))
        points = np.einsum("nb,nbk->nk", bernstein(t), self.curves[piece])
        return points.reshape(*np.shape(parameters), 3)

    def tangents(self, parameters: ArrayLike) -> np.ndarray:
        """Unit tangents, see above."""
        piece, t = self._pieces(np.atleast_1d(parameters))
        legs, t = np.diff(self.curves[piece], axis=1), t[:, None]
        along = (1 - t) ** 2 * legs[:, 0] + 2 * t * (1 - t) * legs[:, 1] + t**2 * legs[:, 2]
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        return along.reshape(*np.shape(parameters), 3)

    def cubics(self) -> np.ndarray:
        """(c, 4, 3)."""
        return self.curves

    def transformed(self, function: Callable[[np.ndarray], np.ndarray]) -> "Spline":
        """Moved, see above."""
        return Spline(function(self.curves.reshape(-1, 3)).reshape(-1, 4, 3), self.closed)


Shape = Line | EllipticArc | Spline


def polyline(shape: Shape, chords: int = 32) -> np.ndarray:
    """(m, 3) points along a shape, `chords` chords for each cubic; the two ends of a line."""
    if isinstance(shape, Line):
        return shape.points
    if isinstance(shape, Spline):
        pieces = evaluate_bezier(shape.curves, np.linspace(0, 1, chords + 1))
        return np.concatenate([pieces[0, :1], *pieces[:, 1:]])
    return shape.at(np.linspace(0, 1, chords * len(shape.cubics()) + 1))


def bounds_of(shapes: Sequence[Shape]) -> np.ndarray:
    """(S, 2, 3) least and greatest coordinates, of boxes that hold the shapes: of whole ellipses, of control points."""
    corners = np.zeros((len(shapes), 2, 3))
    for corner, shape in zip(corners, shapes, strict=True):
        if isinstance(shape, EllipticArc):
            half = np.linalg.norm(shape.axes, axis=0)
            corner[:] = shape.centre - half, shape.centre + half
        else:
            places = shape.cubics().reshape(-1, 3)
            corner[:] = places.min(axis=0), places.max(axis=0)
    return corners


def middles_of(shapes: Sequence[Shape]) -> np.ndarray:
    """(S, 3) places halfway along shapes."""
    return np.array([shape.at(0.5) for shape in shapes]).reshape(-1, 3)


def near_bounds(bounds: np.ndarray, points: np.ndarray, margin: float) -> np.ndarray:
    """Indices of the boxes (S, 2, 3) that come nearer than `margin` to the box of (n, 3) points."""
    apart = np.maximum(bounds[:, 0] - points.max(axis=0), points.min(axis=0) - bounds[:, 1]).max(axis=1)
    return np.flatnonzero(apart <= margin)
