"""Small whole circles: the rims of bolt holes and pins, a few pixels wide.

A rim of three pixels is found in pieces of two or three points, and to BIC each of these is a line: so short a stretch
is hardly one observation. But the points of all its pieces lie on one circle, and their directions run along it, all
the way round. A circle is proposed by the points of one stroke, whose directions tell where its centre is, and takes
what lies on it, of whatever stroke.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.fitting.arcs import Arc
from taichi_edges.fitting.model_selection import Yardstick

LEAST_PX, MOST_PX = 1.0, 8.0  # radius; the pieces of larger circles are long enough to be told from lines
FEWEST = 6  # points of a circle
PROPOSING = 3  # points of a stroke that proposes one
ROUNDS = 4  # of taking points and fitting anew
ON_NOISES = 2.0  # of the points: so near they are on the circle
ALONG = np.cos(np.radians(30.0))  # between a point's direction and the circle's
SECTORS = 12  # of the circle
COVERED = 0.6  # of them, that have a point
LARGEST_GAP = 4  # sectors without a point beside each other
CLEAN = 0.7  # of the points of small strokes in and about a circle, that lie on it


@dataclass(frozen=True)
class Circle:
    """centre: (3,). axes: (2, 3) unit vectors of its plane. radius: unit-cube units."""

    centre: np.ndarray
    axes: np.ndarray
    radius: float

    def local(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) coordinates of (n, 3) points in the plane, from the centre; and (n,) heights above it."""
        offsets = points - self.centre
        return offsets @ self.axes.T, offsets @ np.cross(*self.axes)

    def arc(self) -> Arc:
        """The same as a closed Arc."""
        half = np.pi * self.radius
        start = self.centre + self.radius * self.axes[0]
        return Arc(start, self.axes[1], -self.axes[0] / self.radius, -half, half, True)


def small_circles(
    points: np.ndarray, directions: np.ndarray, strokes: np.ndarray, pixels: np.ndarray, yardstick: Yardstick
) -> list[tuple[Arc, np.ndarray]]:
    """Small circles on which oriented points lie, each as a closed Arc and the indices of its points, each on one.

    points, directions: (n, 3) unit cube, unit vectors. strokes: (n,) int, rising: points of a stroke are in order.
    pixels: (n,) size of a pixel at each point, unit-cube units. yardstick: Yardstick where a pixel has any size; a
    circle has the median pixel of the points that propose it.
    """
    members = np.flatnonzero(of_short_strokes(points, strokes, pixels, 2 * np.pi * MOST_PX))
    if len(members) < FEWEST:
        return []
    points, directions, strokes, pixels = (array[members] for array in (points, directions, strokes, pixels))
    tree, found = cKDTree(points), []
    for proposal in proposals(points, directions, strokes):
        here = yardstick.at(float(np.median(pixels[proposal])))
        circle = fitted(points, directions, proposal, here)
        for _ in range(ROUNDS):
            if circle is None:
                break
            near, on = about(circle, points, directions, tree, here)
            circle = fitted(points, directions, near[on], here) if on.sum() >= FEWEST else None
        if circle is not None:
            near, on = about(circle, points, directions, tree, here)
            if on.sum() >= FEWEST and on.mean() >= CLEAN and goes_round(circle, points[near[on]]):
                found.append((circle, near[on]))
    found.sort(key=lambda one: -len(one[1]))
    free, chosen = np.ones(len(points), bool), []
    for circle, own in found:
        if free[own].mean() >= CLEAN and goes_round(circle, points[own[free[own]]]):
            chosen.append((circle.arc(), members[own[free[own]]]))
            free[own] = False
    return chosen


def of_short_strokes(points: np.ndarray, strokes: np.ndarray, pixels: np.ndarray, longest_px: float) -> np.ndarray:
    """(n,) bool: which points belong to a stroke that is no longer than `longest_px`. pixels: (n,) their sizes."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1) / pixels[1:] * (np.diff(strokes) == 0)
    number = np.cumsum(np.diff(strokes, prepend=strokes[:1]) != 0)
    return np.bincount(number[1:], steps, number[-1] + 1)[number] <= longest_px if len(points) > 1 else strokes >= 0


def proposals(points: np.ndarray, directions: np.ndarray, strokes: np.ndarray) -> Iterator[np.ndarray]:
    """The points of each stroke that turns, as index arrays."""
    for some in np.split(np.arange(len(points)), np.flatnonzero(np.diff(strokes)) + 1):
        if len(some) >= PROPOSING and np.abs(directions[some] @ directions[some[len(some) // 2]]).min() < ALONG:
            yield some


def fitted(points: np.ndarray, directions: np.ndarray, some: np.ndarray, yardstick: Yardstick) -> Circle | None:
    """The Circle through some of the points, along their directions; None where it is no small one.

    Least squares. Its plane is that of the points and of the directions, a direction for a step of LEAST_PX. In the
    plane (x - c)^2 = r^2, and directions are at right angles to the radius: linear in the centre c and in r^2 - c^2.
    """
    places, ways, lever = points[some], directions[some], LEAST_PX * yardstick.pixel
    middle = places.mean(axis=0)
    vectors = np.concatenate([places - middle, lever * ways])
    axes = np.linalg.svd(vectors, full_matrices=False)[2][:2]
    flat, along = (places - middle) @ axes.T, ways @ axes.T
    rows = np.concatenate([np.column_stack([2 * flat, np.full(len(flat), lever)]) / (2 * lever), _padded(along)])
    right = np.concatenate([(flat**2).sum(axis=1) / (2 * lever), (along * flat).sum(axis=1)])
    solution, _, rank, _ = np.linalg.lstsq(rows, right, rcond=1e-9)
    if rank < 3:
        return None
    radius = np.sqrt(max(solution[2] * lever + solution[:2] @ solution[:2], 0.0))
    if not LEAST_PX <= radius / yardstick.pixel <= MOST_PX:
        return None
    return Circle(middle + solution[:2] @ axes, axes, float(radius))


def _padded(along: np.ndarray) -> np.ndarray:
    """(n, 2) with a column of zeros behind."""
    return np.column_stack([along, np.zeros(len(along))])


def about(
    circle: Circle, points: np.ndarray, directions: np.ndarray, tree: cKDTree, yardstick: Yardstick
) -> tuple[np.ndarray, np.ndarray]:
    """(m,) indices of the points in and about a Circle near its plane, and (m,) bool: which lie on it, along it."""
    tolerance = ON_NOISES * yardstick.noise
    near = np.sort(tree.query_ball_point(circle.centre, circle.radius + 2 * tolerance)).astype(np.int64)
    flat, height = circle.local(points[near])
    near, flat, height = (array[np.abs(height) <= 2 * tolerance] for array in (near, flat, height))
    far = np.maximum(np.linalg.norm(flat, axis=1), 1e-12)
    tangents = np.column_stack([-flat[:, 1], flat[:, 0]]) / far[:, None]
    along = np.abs((tangents * (directions[near] @ circle.axes.T)).sum(axis=1))
    return near, (np.hypot(far - circle.radius, height) <= tolerance) & (along >= ALONG)


def goes_round(circle: Circle, points: np.ndarray) -> bool:
    """Are (n, 3) points of a Circle all around it?"""
    flat, _ = circle.local(points)
    turns = np.arctan2(flat[:, 1], flat[:, 0]) / (2 * np.pi)
    shown = np.zeros(SECTORS, bool)
    shown[np.floor(turns * SECTORS).astype(np.int64) % SECTORS] = True
    if shown.mean() < COVERED:
        return False
    at = np.flatnonzero(shown)
    gaps = np.diff(np.append(at, at[0] + SECTORS)) - 1
    return bool(gaps.max() <= LARGEST_GAP)
