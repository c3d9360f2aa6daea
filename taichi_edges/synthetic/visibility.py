"""Which samples of a part's edges a camera sees: hidden-line removal by ray casting, and occluding contours."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.ranges import ragged
from taichi_edges.geometry.bezier import evaluate_bezier

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

    from taichi_edges.synthetic.solids import Part

# A sample is lifted off the surface by so much (world units) before its ray to the camera is cast. It must exceed the
# distance between exact edge and mesh (CHORD_ERROR, 5e-5) and the rounding of float32 rays (1e-6); it shifts the point
# where an edge disappears behind a face by less than a tenth of a pixel at 400 pixels (a pixel is 5e-3 there).
LIFT = 3e-4
FLAT = 1e-9  # 1 - cosine: two triangles nearer than this lie in one plane, where rounding alone makes a contour


@dataclass(frozen=True)
class LineSamples(Columns):
    """Points along everything a camera may see as a line.

    points: (n, 3). outward: (n, 3) unit directions away from the solid. chains: (n,) int; consecutive points of one
    chain are joined. strokes: (n,) int, the edge they belong to (its source); all contours are one stroke.
    """

    points: np.ndarray
    outward: np.ndarray
    chains: np.ndarray
    strokes: np.ndarray

    def with_further(self, others: "LineSamples") -> "LineSamples":
        """These samples and the others, whose chains and strokes are renumbered."""
        chains = others.chains + self.chains.max(initial=-1) + 1
        strokes = others.strokes + self.strokes.max(initial=-1) + 1
        return LineSamples.joined([self, replace(others, chains=chains, strokes=strokes)])


def ray_scene(part: "Part") -> "RaycastingScene":
    """The part's mesh, ready for rays (Open3D RaycastingScene; its primitive ids are the part's triangles)."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(part.vertices.astype(np.float32), part.triangles.astype(np.uint32))
    return scene


def sample_segments(starts: np.ndarray, ends: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points at most `spacing` apart on (s, 3) straight segments, both ends included.

    Returns points (n, 3) and (n,) the index of the segment.
    """
    counts = np.maximum(np.ceil(np.linalg.norm(ends - starts, axis=1) / spacing).astype(np.int64), 1) + 1
    owners, within = ragged(counts)
    fractions = (within / (counts[owners] - 1))[:, None]
    return (1.0 - fractions) * starts[owners] + fractions * ends[owners], owners


def sample_edges(part: "Part", spacing: float) -> LineSamples:
    """Samples of the exact sharp edges, at most `spacing` (world units) apart."""
    edges = part.edges
    places, numbers = ([array] for array in sample_segments(edges.lines[:, 0], edges.lines[:, 1], spacing))
    for piece, control_points in enumerate(edges.curves):
        # |B'| <= 3 max|side of the control polygon|, so equal steps of t keep the spacing.
        longest = np.linalg.norm(np.diff(control_points, axis=0), axis=1).max()
        count = max(int(np.ceil(3.0 * longest / spacing)), 1) + 1
        places.append(evaluate_bezier(control_points, np.linspace(0.0, 1.0, count)))
        numbers.append(np.full(count, len(edges.lines) + piece))
    points, chains = np.concatenate(places), np.concatenate(numbers)
    sources = np.concatenate([edges.line_sources, edges.curve_sources])
    return LineSamples(points, outward_directions(part, points, spacing), chains, sources[chains])


def outward_directions(part: "Part", points: np.ndarray, spacing: float) -> np.ndarray:
    """(n, 3) mean normal of the two faces that meet at the sharp mesh edge nearest to each of the (n, 3) points."""
    mesh = part.mesh_edges
    ends = part.vertices[mesh.ends[mesh.sharp]]
    nearby, owners = sample_segments(ends[:, 0], ends[:, 1], spacing)
    _, nearest = cKDTree(nearby).query(points)
    return middle_direction(mesh.normals[mesh.sharp][owners[nearest]])


def middle_direction(normals: np.ndarray) -> np.ndarray:
    """(n, 2, 3) unit normals -> (n, 3) the unit direction half-way between the two."""
    total = normals.sum(axis=1)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def sample_contours(part: "Part", centre: np.ndarray, spacing: float) -> LineSamples:
    """Samples of the occluding contours seen from `centre` (3,): mesh edges inside a smooth surface at which it turns
    away from the camera.

    Concave edges are left out: there the surface hides the place where it turns away.
    """
    mesh = part.mesh_edges
    bent = 1.0 - np.einsum("ek,ek->e", mesh.normals[:, 0], mesh.normals[:, 1]) > FLAT
    candidates = np.flatnonzero(~mesh.sharp & mesh.convex & bent)
    towards = centre - part.vertices[mesh.ends[candidates, 0]]
    facing = np.einsum("esk,ek->es", mesh.normals[candidates], towards) > 0
    turning = candidates[facing[:, 0] != facing[:, 1]]
    ends = part.vertices[mesh.ends[turning]]
    points, chains = sample_segments(ends[:, 0], ends[:, 1], spacing)
    return LineSamples(points, middle_direction(mesh.normals[turning])[chains], chains, np.zeros_like(chains))


def visible_from(scene: "RaycastingScene", samples: LineSamples, centre: np.ndarray) -> np.ndarray:
    """(n,) bool: is the way from each sample to the camera centre (3,) free?"""
    origins = samples.points + LIFT * samples.outward
    rays = np.concatenate([origins, centre - origins], axis=1).astype(np.float32)
    return ~scene.test_occlusions(rays, tnear=0.0, tfar=1.0).numpy()
