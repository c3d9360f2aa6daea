"""Part: a closed triangle mesh with its exact sharp edges, and how faces are put together into one."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taichi_edges.arrays.components import components
from taichi_edges.geometry.edge_set import EdgeSet
from taichi_edges.synthetic.profiles import SHARP_ANGLE, Path, Profile
from taichi_edges.synthetic.surfaces import Surface, cap, revolved, wall

LONGEST_SIDE = 0.9  # of the bounding box, in the unit cube
WELD = 9  # decimals: vertices that agree to so many are one; faces that meet agree to rounding errors (1e-16)


@dataclass(frozen=True)
class MeshEdges:
    """The edges of a closed mesh, each between two triangles.

    ends: (e, 2) vertex indices. sides: (e, 2) indices of the triangles. normals: (e, 2, 3) their unit normals.
    sharp: (e,) bool, the normals differ by more than SHARP_ANGLE. convex: (e,) bool.
    """

    ends: np.ndarray
    sides: np.ndarray
    normals: np.ndarray
    sharp: np.ndarray
    convex: np.ndarray


@dataclass(frozen=True)
class Part:
    """A solid in the unit cube.

    name:      as in PARTS.
    vertices:  (n, 3) float64, triangles: (m, 3) int, closed and oriented outwards.
    edges:     EdgeSet of the exact sharp edges. Pieces of one curve share a source; lines and curves never do.
    """

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    edges: EdgeSet

    @cached_property
    def normals(self) -> np.ndarray:
        """(m, 3) unit normals of the triangles."""
        a, b, c = np.moveaxis(self.vertices[self.triangles], 1, 0)
        normals = np.cross(b - a, c - a)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    @cached_property
    def mesh_edges(self) -> MeshEdges:
        """MeshEdges of the part."""
        ends, sides = pair_edges(self.triangles)
        normals = self.normals[sides]
        sharp = np.einsum("ek,ek->e", normals[:, 0], normals[:, 1]) < np.cos(np.radians(SHARP_ANGLE))
        beyond = self.vertices[self.triangles[sides[:, 1]]].mean(axis=1) - self.vertices[ends[:, 0]]
        return MeshEdges(ends, sides, normals, sharp, np.einsum("ek,ek->e", beyond, normals[:, 0]) < 0)

    @cached_property
    def corner_normals(self) -> np.ndarray:
        """(m, 3, 3) normal of the smooth surface at each corner of each triangle; it breaks at sharp edges only."""
        ends, sides = (array[~self.mesh_edges.sharp] for array in (self.mesh_edges.ends, self.mesh_edges.sides))
        # Corners of two triangles at one vertex belong together where the edge between the triangles is smooth.
        corner = (self.triangles[sides][:, :, None, :] == ends[:, None, :, None]).argmax(axis=3) + 3 * sides[:, :, None]
        groups = components(self.triangles.size, *corner.transpose(1, 0, 2).reshape(2, -1))
        weighted = (corner_angles(self.vertices[self.triangles])[:, :, None] * self.normals[:, None]).reshape(-1, 3)
        sums = np.stack([np.bincount(groups, weighted[:, axis]) for axis in range(3)], axis=1)
        return (sums / np.linalg.norm(sums, axis=1, keepdims=True))[groups].reshape(-1, 3, 3)


def corner_angles(corners: np.ndarray) -> np.ndarray:
    """(m, 3, 3) corners -> (m, 3) inner angles: weights that make vertex normals independent of the triangulation."""
    onward = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    return np.arctan2(np.linalg.norm(np.cross(onward, back), axis=2), (onward * back).sum(axis=2))


def pair_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of a closed mesh: (e, 2) vertices and (e, 2) triangles, the first of which runs along the edge.

    Raises ValueError where an edge has not exactly two triangles of opposite direction.
    """
    directed = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    owner = np.repeat(np.arange(len(triangles)), 3)
    order = np.lexsort((directed[:, 0] > directed[:, 1], directed.max(axis=1), directed.min(axis=1)))
    directed, owner = directed[order], owner[order]
    keys = np.sort(directed, axis=1)
    single = np.unique(keys, axis=0, return_counts=True)[1] != 2
    if single.any() or not np.array_equal(directed[0::2], directed[1::2, ::-1]):
        raise ValueError(f"the faces do not close: {single.sum()} edges have not exactly two triangles")
    return directed[0::2], owner.reshape(-1, 2)


def distinct_edges(surfaces: Sequence[Surface]) -> EdgeSet:
    """The exact edges of all faces, each once: two faces that meet both bring the edge, perhaps run backwards."""
    found: dict[tuple[float, ...], np.ndarray] = {}
    for edge in (edge for surface in surfaces for edge in surface.edges):
        points = edge.reshape(-1, 3)
        # First and second moments do not depend on the direction, nor on where a full circle starts.
        moments = np.concatenate([points.mean(axis=0), (points**2).mean(axis=0), [edge.ndim]])
        found.setdefault(tuple(np.round(moments, WELD) + 0.0), edge)
    lines = [edge for edge in found.values() if edge.ndim == 2]
    curves = [edge for edge in found.values() if edge.ndim == 3]
    pieces = np.array([len(edge) for edge in curves], dtype=np.int64)
    return EdgeSet(
        np.array(lines).reshape(-1, 2, 3),
        np.concatenate([np.zeros((0, 4, 3)), *curves]),
        np.arange(len(lines)),
        len(lines) + np.repeat(np.arange(len(curves)), pieces),
    )


def assemble(name: str, surfaces: Sequence[Surface]) -> Part:
    """A Part of the faces `surfaces`, which must close, scaled into the unit cube and centred in it."""
    corners = np.concatenate([surface.triangles for surface in surfaces])
    vertices, indices = weld(corners.reshape(-1, 3))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = LONGEST_SIDE / (high - low).max()

    def into_cube(points: np.ndarray) -> np.ndarray:
        return (points - (low + high) / 2.0) * scale + 0.5

    part = Part(name, into_cube(vertices), indices.reshape(-1, 3), distinct_edges(surfaces).transformed(into_cube))
    _ = part.mesh_edges  # refuses faces that do not close
    return part


def weld(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) -> the distinct points (k, 3) and the (n,) index of each."""
    _, first, indices = np.unique(np.round(points, WELD) + 0.0, axis=0, return_index=True, return_inverse=True)
    return points[first], indices.reshape(-1)


def extrude(name: str, profile: Profile, height: float) -> Part:
    """A profile swept upwards."""
    caps = [cap(profile, 0.0, upward=False), cap(profile, height, upward=True)]
    return assemble(name, caps + [wall(path, 0.0, height) for path in profile.paths])


def revolve(name: str, path: Path) -> Part:
    """An (r, z) path turned about the vertical axis: closed off the axis, or open with both its ends on the axis."""
    return assemble(name, [revolved(path)])
