"""How shapes move when the vertices they end in do, and by what of their own: the unknowns of a joint adjustment.

A shape stays what it is: a line a line, an arc circular, a chain of cubics smooth. Beside its two ends it has

line            nothing
arc             2: its middle, relative to that of its chord, along the sagitta and across the arc's plane
circle          6: centre, two tilts of its plane, radius
elliptic arc    4: its middle, and how far round it goes
ellipse         9: centre and two conjugate half diameters
spline          3 for each inner control point next to a joint or an end; joints lie on the legs between these

all of them 0 where the shape is, and in units of length: a unit moves the shape about as far.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline

STEP = 1e-6  # unit-cube units, of the differences that derivatives are; the square of 1e-5 of a pixel
LEAST_HALF = 0.05  # radians: half of what an arc spans stays between this, a parabola to 1e-4, and a half turn
FLATTEST = 1e-7  # sagitta of an arc over half its chord
CHORDS, NEWTON = 32, 8  # of each cubic, where the nearest place is looked for first; and rounds until it is found

Described = TypeVar("Described")


def own_unknowns(shape: Shape) -> int:
    """How many unknowns a shape has beside its ends."""
    if isinstance(shape, Spline):
        return 6 * len(shape.curves)
    return {"line": 0, "arc": 2, "circle": 6, "elliptic_arc": 4, "ellipse": 9}[shape.kind]


def moved(shape: Shape, ends: np.ndarray | None, own: np.ndarray) -> Shape:
    """The shape that ends in (2, 3) `ends` (a closed one: None), with its own unknowns at (k,) `own`."""
    if shape.kind == "line":
        return Line(np.array(ends))
    return MOVES[shape.kind](shape, ends, own)


def neighbors(shape: Shape, ends: np.ndarray | None) -> list[tuple[Shape, Shape]]:
    """A shape with each of its unknowns a STEP ahead and a STEP behind: list of pairs of shapes.

    ends: (2, 3), the first six unknowns; None for a closed shape.
    """
    fixed = 0 if ends is None else 6
    start = np.concatenate([np.zeros(0) if ends is None else np.ravel(ends), np.zeros(own_unknowns(shape))])

    def at(unknowns: np.ndarray) -> Shape:
        return moved(shape, unknowns[:6].reshape(2, 3) if fixed else None, unknowns[fixed:])

    return [(at(start + step), at(start - step)) for step in STEP * np.eye(len(start))]


def derivatives(
    pairs: Sequence[tuple[Described, Described]], evaluated: Callable[[Described], np.ndarray]
) -> np.ndarray:
    """Derivatives (..., k) by the unknowns of what `evaluated`, a function of a shape, gives. pairs: the neighbors."""
    return np.stack([(evaluated(ahead) - evaluated(behind)) / (2 * STEP) for ahead, behind in pairs], axis=-1)


def nearest_parameters(shape: Shape, points: np.ndarray) -> np.ndarray:
    """(n,) parameters, 0 to 1, of the places on a shape that are nearest to (n, 3) points."""
    grid = np.linspace(0.0, 1.0, CHORDS * len(shape.cubics()) + 1)
    apart = np.linalg.norm(points[:, None] - shape.at(grid), axis=2)
    parameters, step = grid[np.argmin(apart, axis=1)], 1e-5
    for _ in range(NEWTON):
        before, after = np.maximum(parameters - step, 0.0), np.minimum(parameters + step, 1.0)
        speed = (shape.at(after) - shape.at(before)) / (after - before)[:, None]
        along = ((points - shape.at(parameters)) * speed).sum(axis=1)
        parameters = parameters + along / np.maximum((speed**2).sum(axis=1), 1e-300)
        parameters = parameters % 1.0 if shape.closed else np.clip(parameters, 0.0, 1.0)
    return parameters


def _moved_arc(arc: EllipticArc, ends: np.ndarray, own: np.ndarray) -> EllipticArc:
    """Through the ends, with a sagitta that is orthogonal to their chord."""
    (start, end), middle = ends, 0.5 * (arc.low + arc.high)
    outward = np.cos(middle) * arc.axes[0] + np.sin(middle) * arc.axes[1]
    outward /= np.linalg.norm(outward)
    sagitta = arc.radii.mean() * (1.0 - np.cos(0.5 * (arc.high - arc.low))) * outward
    sagitta = sagitta + own[0] * outward + own[1] * arc.normal
    chord = end - start
    half = 0.5 * np.sqrt(chord @ chord)
    along = chord / (2 * half)
    sagitta = sagitta - (sagitta @ along) * along
    rise = np.sqrt(sagitta @ sagitta)
    outward = sagitta / rise
    rise = max(rise, FLATTEST * half)
    radius = (half**2 + rise**2) / (2 * rise)
    centre, turn = 0.5 * (start + end) + (rise - radius) * outward, 2 * np.arctan2(rise, half)
    return EllipticArc(centre, radius * np.array([outward, along]), -turn, turn)


def _moved_circle(circle: EllipticArc, ends: None, own: np.ndarray) -> EllipticArc:
    """Moved, tilted about its two axes and scaled."""
    radius = circle.radii.mean()
    rotation = _rotation((own[3:5] / radius) @ circle.axes / radius)
    return EllipticArc(
        circle.centre + own[:3], np.exp(own[5] / radius) * circle.axes @ rotation.T, circle.low, circle.high
    )


def _rotation(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about `vector` by its length, radians (Rodrigues)."""
    angle = np.sqrt(vector @ vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _moved_elliptic_arc(arc: EllipticArc, ends: np.ndarray, own: np.ndarray) -> EllipticArc:
    """With half the angle it spans h: centre + u cos t + v sin t, t from -h to h, through ends and middle."""
    half, (first, middle, last) = 0.5 * (arc.high - arc.low), arc.at(np.array([0.0, 0.5, 1.0]))
    rise = np.linalg.norm(middle - 0.5 * (first + last))
    # A small angle shows by its square alone, as 1 - cos^2 of its half does, and by little: hence the 4.
    squared = min(np.cos(0.5 * half) ** 2 * np.exp(-4.0 * own[3] / rise), 1.0)
    half = float(np.clip(2 * np.arccos(np.sqrt(squared)), LEAST_HALF, np.pi - LEAST_HALF))
    start, end = ends
    middle = middle + own[:3]
    across = (end - start) / (2 * np.sin(half))
    outward = (middle - 0.5 * (start + end)) / (1 - np.cos(half))
    return EllipticArc.conjugate(middle - outward, (outward, across), -half, half)


def _moved_ellipse(ellipse: EllipticArc, ends: None, own: np.ndarray) -> EllipticArc:
    """Centre and half diameters moved."""
    diameters = ellipse.axes + own[3:].reshape(2, 3)
    return EllipticArc.conjugate(ellipse.centre + own[:3], diameters, ellipse.low, ellipse.high)


def _moved_spline(spline: Spline, ends: np.ndarray | None, own: np.ndarray) -> Spline:
    """Inner control points moved; a joint divides the leg between its neighbours as it did before."""
    curves = spline.curves.copy()
    count = len(curves)
    curves[:, 1:3] += own.reshape(count, 2, 3)
    before = np.arange(count if spline.closed and ends is None else count - 1)
    after = (before + 1) % count
    legs = np.linalg.norm(np.diff(spline.curves, axis=1), axis=2)[:, [0, 2]]  # (c, 2) the first and the last
    both = legs[before, 1] + legs[after, 0]
    share = np.where(both > 0, legs[before, 1] / np.maximum(both, 1e-300), 0.5)[:, None]
    joints = (1 - share) * curves[before, 2] + share * curves[after, 1]
    curves[before, 3] = curves[after, 0] = joints
    if ends is not None:
        curves[0, 0], curves[-1, 3] = ends
    return Spline(curves, spline.closed)


MOVES: dict[str, Callable[[Any, Any, np.ndarray], Shape]] = {  # each for the shapes of its kind alone
    "arc": _moved_arc,
    "circle": _moved_circle,
    "elliptic_arc": _moved_elliptic_arc,
    "ellipse": _moved_ellipse,
    "spline": _moved_spline,
}
