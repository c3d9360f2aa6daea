"""The true edges as primitives, each once and exact: what a CAD file splits for its own reasons is put together again.

A full circle comes as two or six arcs, a straight side as two lines where a face begins. Such pieces are one primitive:
* pieces of one straight line that touch end to end;
* pieces of one circle that touch end to end;
* smooth pieces that together are one closed ellipse.
All else stays as the file says: a spline that the file splits is two edges, for nothing tells where it should be cut.
A polyline of the file has vertices on its curve, up to 17 mm apart, so its chords miss the curve by up to 0.1 mm. A
cubic spline through the vertices misses a circle of radius r with one every h by 0.013 h^4 / r^3: 0.1 micrometres.
"""

from collections.abc import Sequence

import numpy as np

from taichi_edges.arrays.components import components
from taichi_edges.evaluation.dense_curves import STEP

# Points at most this far apart, in normalised units, are one vertex. Joined edges share it exactly, but an edge that
# ends on an arc is off the cubics which the arc is written as: by 2.7e-4 of its radius, 0.14 mm at a radius of 0.5.
JOINED = 0.0002
CORNER_DEGREES = 20.0  # edges at less continue or touch each other: 5 mm on they are 1.7 mm apart, half a pixel or so
SHAPE_TOLERANCE = 3e-4  # of the radius, or the length if less: a cubic of 90 degrees misses its circle by 2.7e-4
CHORD_ERROR = 1e-5  # normalised units: polylines that miss their curve by less stay as they are


def true_primitives(curves: Sequence[np.ndarray], kinds: Sequence[str]) -> list[np.ndarray]:
    """The curves and kinds of a GroundTruth -> list of (m, 3) polylines, one for each primitive, as good as exact."""
    shapes = [shape_of(curve, kind) for curve, kind in zip(curves, kinds, strict=True)]
    same = [
        (one, other)
        for one, other in touching_pieces(curves)
        if shapes[one] == shapes[other] != "free" and fit_one(shapes[one], curves[one], curves[other])
    ]
    joined = [
        (chain, kinds[group[0]], shapes[group[0]])
        for group in grouped(len(curves), same)
        for chain in chains([curves[index] for index in group])
    ]
    return [refined(curve, kind) for curve, kind in close_ellipses(joined)]


def length_of(polyline: np.ndarray) -> float:
    """(m, 3) polyline -> its length."""
    return float(np.linalg.norm(np.diff(polyline, axis=0), axis=1).sum())


# --------------------------------------------------------------------------------------------------------- shapes


def shape_of(polyline: np.ndarray, kind: str) -> str:
    """'line', 'circle' or 'free': by the vertices, except that what the file calls a line is no circle."""
    length = length_of(polyline)
    if fits_line(polyline, length):
        return "line"
    return "circle" if kind != "line" and fits_circle(polyline, length) else "free"


def fits_line(points: np.ndarray, length: float) -> bool:
    """Do the (m, 3) points lie on one straight line, to SHAPE_TOLERANCE of the length?"""
    centred = points - points.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    off = np.linalg.norm(centred - np.outer(centred @ direction, direction), axis=1)
    return bool(off.max() <= SHAPE_TOLERANCE * length)


def fits_circle(points: np.ndarray, length: float) -> bool:
    """Do the (m, 3) points lie on one circle, to SHAPE_TOLERANCE of its radius or the length, whichever is less?"""
    flat, height = in_their_plane(points)
    # |p|^2 = 2 c.p + (r^2 - |c|^2) is linear in the centre c and the bracket: exact for points on a circle.
    matrix = np.column_stack([2.0 * flat, np.ones(len(flat))])
    solution = np.linalg.lstsq(matrix, (flat**2).sum(axis=1), rcond=None)[0]
    radius = np.sqrt(max(solution[2] + solution[:2] @ solution[:2], 0.0))
    off = np.abs(np.linalg.norm(flat - solution[:2], axis=1) - radius)
    return bool(max(off.max(), height.max()) <= SHAPE_TOLERANCE * min(radius, length))


def fits_ellipse(points: np.ndarray, length: float) -> bool:
    """Do the (m, 3) points of a closed curve lie on one ellipse, to SHAPE_TOLERANCE of a sixth of its length?"""
    flat, height = in_their_plane(points)
    scale = length / 6.0  # the radius of a circle of that length
    x, y = (flat / scale).T
    terms = np.column_stack([x * x, x * y, y * y, x, y])  # of a conic about the mean of the points, its value there 1
    a, b, c, d, e = solution = np.linalg.lstsq(terms, np.ones(len(flat)), rcond=None)[0]
    steepness = np.hypot(2 * a * x + b * y + d, b * x + 2 * c * y + e)
    off = np.abs(terms @ solution - 1.0) / np.maximum(steepness, 1e-9)
    return bool(4 * a * c > b * b and max(off.max(), height.max() / scale) <= SHAPE_TOLERANCE)


def in_their_plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(m, 3) points -> (m, 2) coordinates in the plane that fits them best, and (m,) distances from it."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return centred @ axes[:2].T, np.abs(centred @ axes[2]) if len(axes) == 3 else np.zeros(len(points))


FITS = {"line": fits_line, "circle": fits_circle}


def fit_one(shape: str, one: np.ndarray, other: np.ndarray) -> bool:
    """Do two (m, 3) polylines lie on one and the same line or circle?"""
    return FITS[shape](np.concatenate([one, other]), min(length_of(one), length_of(other)))


# ------------------------------------------------------------------------------------------- pieces put together


def touching_pieces(curves: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Sorted list of pairs of curves, the first number the lower, that share an end."""
    from scipy.spatial import cKDTree

    if not len(curves):
        return []
    ends = np.array([end for curve in curves for end in (curve[0], curve[-1])])
    pairs = cKDTree(ends).query_pairs(JOINED, output_type="ndarray") // 2
    return sorted({(int(min(pair)), int(max(pair))) for pair in pairs if pair[0] != pair[1]})


def grouped(count: int, pairs: Sequence[Sequence[int]]) -> list[list[int]]:
    """Lists of the numbers 0..count-1 that the pairs connect, in the order of their first ones."""
    labels = components(count, *np.array(pairs, dtype=np.int64).reshape(-1, 2).T)
    order = np.argsort(labels, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(labels))[:-1]) if count else []
    return [group.tolist() for group in groups]


def chains(pieces: Sequence[np.ndarray]) -> list[np.ndarray]:
    """List of (m, 3) polylines that touch end to end -> as few polylines as they make, pieces turned where needed."""
    left, made = list(pieces), []
    while left:
        chain = left.pop(0)
        for _ in range(2):  # on from the last point, then from the first one, which is the last of the chain reversed
            while (following := next_piece(chain, left)) is not None:
                chain = np.concatenate([chain, following[1:]])
            chain = chain[::-1]
        made.append(chain)
    return made


def next_piece(chain: np.ndarray, left: list[np.ndarray]) -> np.ndarray | None:
    """Takes the piece that starts where the open chain ends out of `left`, turned if needed; None without one."""
    if touch(chain[0], chain[-1]):
        return None
    for index, piece in enumerate(left):
        for candidate in (piece, piece[::-1]):
            if touch(chain[-1], candidate[0]):
                del left[index]
                return candidate
    return None


def touch(one: np.ndarray, other: np.ndarray) -> bool:
    """Are the two points one vertex?"""
    return bool(np.linalg.norm(one - other) <= JOINED)


def close_ellipses(primitives: Sequence[tuple[np.ndarray, str, str]]) -> list[tuple[np.ndarray, str]]:
    """List of (polyline, kind, shape) -> list of (polyline, kind), the pieces of every closed ellipse put together."""
    curves = [curve for curve, _, _ in primitives]
    free = [shape == "free" and kind != "line" for _, kind, shape in primitives]
    smooth = [
        (one, other)
        for one, other in touching_pieces(curves)
        if free[one] and free[other] and continue_smoothly(curves[one], curves[other])
    ]
    result = []
    for group in grouped(len(curves), smooth):
        made = chains([curves[index] for index in group])
        closed = len(group) > 1 and len(made) == 1 and touch(made[0][0], made[0][-1])
        if closed and fits_ellipse(made[0][:-1], length_of(made[0])):
            result.append((made[0], "curve"))
        else:
            result += [primitives[index][:2] for index in group]
    return result


def continue_smoothly(one: np.ndarray, other: np.ndarray) -> bool:
    """Does one of the (m, 3) polylines go on where the other ends, at some end that they share?"""
    for a in (one, one[::-1]):
        for b in (other, other[::-1]):
            into, onward = a[-1] - a[-2], b[1] - b[0]
            turn = np.degrees(np.arctan2(np.linalg.norm(np.cross(into, onward)), into @ onward))
            if touch(a[-1], b[0]) and turn <= CORNER_DEGREES:
                return True
    return False


# ------------------------------------------------------------------------------------------------------- exactness


def refined(polyline: np.ndarray, kind: str) -> np.ndarray:
    """(m, 3) vertices of a smooth curve -> (n, 3) vertices on it so dense that the chords are as good as the curve."""
    steps = np.linalg.norm(np.diff(polyline, axis=0), axis=1)
    polyline = polyline[np.concatenate([[True], steps > 0])]
    if kind == "line" or len(polyline) < 3 or chord_error(polyline) <= CHORD_ERROR:
        return polyline
    from scipy.interpolate import CubicSpline

    arc = np.concatenate([[0.0], np.cumsum(steps[steps > 0])])
    closed = touch(polyline[0], polyline[-1]) and continue_smoothly(polyline[-2:], polyline[:2])
    if closed:
        polyline = np.concatenate([polyline[:-1], polyline[:1]])  # the very same point, which a periodic spline needs
    spline = CubicSpline(arc, polyline, bc_type="periodic" if closed else "not-a-knot")
    return spline(np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / STEP)) + 1))


def chord_error(polyline: np.ndarray) -> float:
    """How far the chords of an (m, 3) polyline miss a smooth curve through its vertices: length times turn / 8."""
    chords = np.diff(polyline, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    directions = chords / lengths[:, None]
    turns = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    return float((np.maximum(lengths[1:], lengths[:-1]) * turns).max() / 8.0)
