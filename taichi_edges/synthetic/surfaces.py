"""The faces a solid is put together from: flat caps, walls swept along an outline, surfaces of revolution.

Every face brings its triangles, oriented outwards, and the exact sharp edges on its border. Where two faces meet they
bring the same vertices and the same edges; `solids.assemble` welds the former and keeps one of the latter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.synthetic.profiles import Path, Point, Profile, circle, rectangle


@dataclass(frozen=True)
class Surface:
    """triangles: (m, 3, 3) corners. edges: tuple of (2, 3) lines and (k, 4, 3) cubics of one smooth curve each."""

    triangles: np.ndarray
    edges: tuple[np.ndarray, ...] = ()

    def placed(self, axes: ArrayLike, origin: ArrayLike = (0.0, 0.0, 0.0)) -> "Surface":
        """Moved: local x, y, z along the rows of `axes` (3, 3, a rotation), local zero to `origin`."""
        axes, origin = np.asarray(axes, dtype=np.float64), np.asarray(origin, dtype=np.float64)
        return Surface(self.triangles @ axes + origin, tuple(edge @ axes + origin for edge in self.edges))


def lift(points: np.ndarray, height: float) -> np.ndarray:
    """(..., 2) points of the plane -> (..., 3) at a height z."""
    return np.concatenate([points, np.full((*points.shape[:-1], 1), float(height))], axis=-1)


def grid_triangles(points: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of an (r, c, 3) grid, facing columns x rows; cells of no area are left out."""
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    triangles = np.concatenate([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return triangles[np.linalg.norm(normals, axis=1) > 1e-12]


def cap(profile: Profile, height: float, upward: bool) -> Surface:
    """The flat face inside `profile` at a height. Its border edges come with the walls that end there."""
    import mapbox_earcut

    polygons = [path.polygon for path in profile.paths]
    vertices = np.concatenate(polygons)
    ends = np.cumsum([len(polygon) for polygon in polygons]).astype(np.uint32)
    indices = mapbox_earcut.triangulate_float64(vertices, ends).reshape(-1, 3)
    corners = vertices[indices]
    sides = np.diff(corners, axis=1)
    counter_clockwise = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0] > 0
    turned = counter_clockwise != upward
    corners[turned] = corners[turned, ::-1]
    return Surface(lift(corners, height))


def wall(path: Path, bottom: float, top: float, top_path: Path | None = None, skip: Sequence[int] = ()) -> Surface:
    """The face swept by a closed path from the height `bottom` up to `top`.

    top_path: a path of the same make-up, where the wall leans (drafts, chamfers). skip: indices of straight segments
    whose face is supplied by `pierced`.
    Both rims are sharp edges throughout; along the sweep there is an edge where the path has a sharp joint.
    """
    assert path.closed
    top_path = path if top_path is None else top_path
    triangles, edges = [], []
    for index, (low, high) in enumerate(zip(path.segments, top_path.segments, strict=True)):
        if index not in skip:
            rows = [lift(low.polyline(), bottom), lift(high.polyline(), top)]
            triangles.append(grid_triangles(np.stack(rows)))
        edges += [lift(low.points, bottom), lift(high.points, top)]
        if path.sharp[index]:
            edges.append(np.concatenate([lift(low.flat[:1], bottom), lift(high.flat[:1], top)]))
    return Surface(np.concatenate(triangles), tuple(edges))


def pierced(
    path: Path, index: int, bottom: float, top: float, holes: Sequence[Path]
) -> tuple[Surface, tuple[np.ndarray, np.ndarray]]:
    """The flat wall face over segment `index` of a path, with holes in it.

    holes: Paths in the face's own plane: x along the segment from its start, y up from `bottom`.
    Returns the face and the frame (axes, origin) of that plane, whose z points out of the solid, for `placed`.
    """
    start, end = path.segments[index].points
    length = float(np.linalg.norm(end - start))
    along = np.append((end - start) / length, 0.0)
    upward = np.array([0.0, 0.0, 1.0])
    frame = np.stack([along, upward, np.cross(along, upward)]), lift(start, bottom)
    face = cap(Profile(rectangle((0, 0), (length, top - bottom)), tuple(holes)), 0.0, upward=True)
    return face.placed(*frame), frame


def revolved(path: Path, centre: Point = (0.0, 0.0)) -> Surface:
    """The face swept by an (r, z) path turned about the vertical axis through `centre`.

    A circle is a sharp edge where the path has a sharp joint or an open end off the axis.
    """
    turn = circle((0.0, 0.0), 1.0).segments[0]
    directions = turn.polyline()
    directions = np.concatenate([directions[:-1], directions[:1]])  # closes without a rounding error
    shift = np.append(np.asarray(centre, dtype=np.float64), 0.0)
    meridian = path.polygon if not path.closed else np.vstack([path.polygon, path.polygon[:1]])
    rings = np.stack([lift(radius * directions, height) for radius, height in meridian])
    joints = [s.flat[0] for s, sharp in zip(path.segments, path.sharp, strict=True) if sharp]
    joints += [] if path.closed else [path.segments[-1].flat[-1]]
    edges = [lift(radius * turn.points, height) + shift for radius, height in joints if radius > 1e-9]
    return Surface(grid_triangles(rings + shift), tuple(edges))
