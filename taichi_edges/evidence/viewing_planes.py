"""Oriented 3D points moved to where the edgels of all views say the edge is.

An edgel with its normal is a plane through the camera's centre that holds the edge. Where the planes of many views meet
is the edge: its direction is what all planes have in common, its place their robust least squares. This is what an
image loss converges to, but the loss sees grey levels of drawn lines, and these planes the sub-pixel points themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.columns import Columns

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.plane_equations import PlaneEquations

RADII_PX = (3.0, 2.0, 1.5, 1.2, 1.0, 1.0)  # of the edgels that are looked at, round by round
LEAST_SPREAD = 0.02  # planes that lean against each other less (squared sine) say nothing across their common side
LINE_SPREAD = 0.25  # the planes' third eigenvalue over the second, below which they have a direction in common


@dataclass(frozen=True)
class RefinedPoints(Columns):
    """Oriented points and what supports them.

    points, directions: (n, 3) unit cube, unit vectors. views: (n,) number of views in which an edgel lies on the point,
    each counted by how closely, and by the edgel's strength. support: (n,) `views` as a share of those that have the
    point in the image. spread: (n,) how much the viewing planes lean against each other, the second eigenvalue over the
    first: the squared sine of their angles, roughly.
    """

    points: np.ndarray
    directions: np.ndarray
    views: np.ndarray
    support: np.ndarray
    spread: np.ndarray


def refine_points(
    matching: "EdgelMatching",
    points: np.ndarray,
    directions: np.ndarray,
    radii: Sequence[float] = RADII_PX,
    scale: float | None = None,
) -> RefinedPoints:
    """Points and directions moved to the robust intersection of the viewing planes of their edgels.

    matching: EdgelMatching. points: (n, 3) unit cube. directions: (n, 3) unit vectors. radii: px, one for each round,
    in which no point moves by more than that. scale: px, of the robust weights; None for that of the matching.
    """
    scale = matching.scale_px if scale is None else scale
    points, directions = np.array(points, np.float64), np.array(directions, np.float64)
    pixel = matching.pixel_at(points)[:, None]
    for radius in radii:
        equations = matching.equations(points, directions, radius, scale)
        steps, directions = _solve(equations, directions)
        lengths = np.linalg.norm(steps, axis=1, keepdims=True)
        points += steps * np.minimum(1.0, radius * pixel / np.maximum(lengths, 1e-300))
    equations = matching.equations(points, directions, radii[-1], scale)
    values = np.linalg.eigh(equations.matrices)[0]
    spread, views = np.maximum(values[:, 1], 0.0) / np.maximum(values[:, 2], 1e-12), equations.weights
    return RefinedPoints(points, directions, views, views / np.maximum(equations.views, 1.0), spread)


def _solve(equations: "PlaneEquations", directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps (n, 3) across the common direction of the planes, and that direction where there is one.

    equations: PlaneEquations. directions: (n, 3), so far.
    """
    values, axes = np.linalg.eigh(equations.matrices)  # of the planes' normals, ascending
    sides = axes[:, :, 1:]  # (n, 3, 2)
    pulls = np.einsum("nck,nc->nk", sides, equations.gradients)
    firm = values[:, 1:] > LEAST_SPREAD * np.maximum(values[:, 2:], 1e-12)
    steps = -np.einsum("nck,nk->nc", sides, np.where(firm, pulls / np.maximum(values[:, 1:], 1e-12), 0.0))
    common = firm[:, 0] & (values[:, 0] < LINE_SPREAD * values[:, 1])
    return steps, np.where(common[:, None], axes[:, :, 0], directions)
