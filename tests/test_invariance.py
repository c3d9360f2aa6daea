"""One yardstick: edges do not depend on the units, the frame, the box or the resolution that they are told in.

Edgels are exact, so that nothing but the arithmetic and the tolerances can make a difference.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from edgel_scenes import arc, blank_views, line, project_edgels, views_of

from taichi_edges.corridor.cluster import cluster
from taichi_edges.corridor.fit import fit
from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.pipeline import Run
from taichi_edges.corridor.refine import refine
from taichi_edges.corridor.train import train
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.geometry.shapes import Line
from taichi_edges.geometry.wireframe import Wireframe, read_wireframe
from taichi_edges.progress import Progress
from taichi_edges.readers.scene_checks import into_unit_cube
from taichi_edges.refinement.stage import refine_wireframe
from taichi_edges.scene.settings import RefineConfig
from taichi_edges.synthetic.rendering import look_at
from taichi_edges.views.cameras import Similarity
from taichi_edges.views.drawing import draw_edge_maps
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import pixel_size, write_views

SIZE, VIEWS = 300, 10
LOW, HIGH = np.array([0.15, 0.2, 0.3]), np.array([0.85, 0.8, 0.7])
KINDS = ["arc"] + ["circle"] * 2 + ["line"] * 13 + ["spline"]


def bezier(*control):
    """A curve: one cubic."""
    return lambda s: evaluate_bezier(np.array(control)[None], np.asarray(s))[0]


def turned(centre, radius, low, high):
    """A curve: a horizontal arc between two angles, degrees."""

    def at(s):
        angles = np.radians(low + np.asarray(s) * (high - low))
        return np.asarray(centre) + radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)

    return at


def curves_of_part():
    """A block; on its top two circles, one small; on a side a free curve; at its bottom a D."""
    corners = [np.where(bits, HIGH, LOW) for bits in np.ndindex(2, 2, 2)]
    sides = [(a, b) for a in corners for b in corners if (a < b).sum() == 1 and (a <= b).all()]
    top, bottom = HIGH[2], LOW[2]
    return [
        *(line(*side) for side in sides),
        arc([0.4, 0.5, top], 0.15),
        arc([0.7, 0.4, top], 0.04),
        bezier([0.15, 0.7, 0.45], [0.15, 0.6, 0.8], [0.15, 0.42, 0.25], [0.15, 0.3, 0.55]),
        turned([0.35, 0.4, bottom], 0.12, -30, 210),
        line([0.35 - 0.12 * np.sqrt(0.75), 0.34, bottom], [0.35 + 0.12 * np.sqrt(0.75), 0.34, bottom]),
    ]


@lru_cache
def views_of_part(size):
    """Views of the part, pictures so large."""
    blank = blank_views(VIEWS, size=size)
    of_views = []
    for view in range(VIEWS):
        points, normals = zip(*(project_edgels(blank, view, of, apart=1.0) for of in curves_of_part()), strict=True)
        points, normals = np.concatenate(points), np.concatenate(normals)
        of_views.append((points, normals, *(np.full(len(points), value) for value in (1.0, 0.0, False))))
    edgels = Edgels.of_views(of_views)
    return replace(blank, edgels=edgels, edge_maps=draw_edge_maps(edgels, size, size, 2))


def found(folder, views, rate=1e-4):
    """The Wireframe, unit cube, that the stages find in Views. rate: `train.learning_rates.means`."""
    scene = f"source: {{reader: synthetic}}\ntrain: {{steps: 1, learning_rates: {{means: {rate}}}}}\n"
    (folder / "scene.yaml").write_text(scene)
    run = Run(load_scene(folder / "scene.yaml"), folder, threads=2, progress=Progress())
    write_views(run.path("views.npz"), views)
    for stage in (train, cluster, fit, refine):
        stage(run)
    return read_wireframe(run.path("edges.json")).transformed(views.similarity.to_unit, views.similarity.scale)


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """What is found with the usual pictures, in units of which the part fills one."""
    return found(tmp_path_factory.mktemp("usual"), views_of_part(SIZE))


def assert_same(one, other, within):
    """Two Wireframes have edges of the same kinds at the same places. within: of their ends, or their middles."""
    assert sorted(edge.shape.kind for edge in one.edges) == sorted(edge.shape.kind for edge in other.edges)
    apart = np.array([[_apart(a, b) for b in other.shapes] for a in one.shapes])
    assert apart.min(axis=1).max() < within and apart.min(axis=0).max() < within


def _apart(one, other):
    """Between the ends of two shapes, or the middles of closed ones; infinite for other kinds."""
    if one.kind != other.kind:
        return np.inf
    if one.closed:
        s = np.linspace(0, 1, 65)[1:]
        return np.linalg.norm(one.at(s).mean(axis=0) - other.at(s).mean(axis=0)) + abs(one.length - other.length)
    return min(np.linalg.norm(one.ends - ends, axis=1).max() for ends in (other.ends, other.ends[::-1]))


def test_the_part_is_found(usual):
    assert sorted(shape.kind for shape in usual.shapes) == KINDS


@pytest.mark.parametrize(("scale", "offset"), [(1e3, 0.0), (1e-3, 1e6)])
def test_units_and_frame_do_not_matter(usual, tmp_path, scale, offset):
    """As a user gives them: cameras in a frame of so large units, whose origin is so many of the part's sizes away."""
    similarity = Similarity(1 / scale, tuple(-offset * np.array([1.0, -2.0, 0.5])))
    views = views_of_part(SIZE)
    rotations = views.world_to_camera[:, :, :3]
    given = views.world_to_camera[:, :, 3] + rotations @ np.asarray(similarity.offset)
    given = np.concatenate([rotations, given[:, :, None] / similarity.scale], axis=2)
    views = replace(views, world_to_camera=into_unit_cube(given, similarity), similarity=similarity)
    assert_same(usual, found(tmp_path, views), 0.1 * pixel_size(views))


def test_a_box_that_is_far_too_large_does_not_matter(usual, tmp_path):
    """The rate is said in units of the box, and so is not the same."""
    loose = Similarity(0.1, (0.4, 0.4, 0.45))
    views = views_of_part(SIZE)
    views = replace(views, world_to_camera=into_unit_cube(views.world_to_camera, loose))
    wireframe = found(tmp_path, views, 1e-4 * loose.scale).transformed(loose.to_input, 1 / loose.scale)
    assert_same(usual, wireframe, 0.1 * pixel_size(views_of_part(SIZE)))


@pytest.mark.parametrize("times", [0.5, 2])
def test_resolution_does_not_matter(usual, tmp_path, times):
    """But for free ends, which are known to half a pixel."""
    views = views_of_part(round(SIZE * times))
    assert_same(usual, found(tmp_path, views), 0.7 * max(pixel_size(views), pixel_size(views_of_part(SIZE))))


# --------------------------------------------------------------------------------------------------- near and far

FOCAL, STAND, ASIDE_PX = 400.0, np.array([-1.0, 0.5, 0.5]), 75.0
STROKES_PX = [  # away from the cameras, sideways, upwards; edgels are where these are and nowhere else
    *([(0, -50, 40), (0, -7, 40)], [(0, 0, 33), (0, 0, -10)]),  # they meet: each is 7 px short of at most 8
    *([(0, -50, -30), (0, -20, -30)], [(1.3, -20, -30), (1.3, -20, 5)]),  # do not: 1.3 px apart, where at most 1 is
    *([(0, -10, -50), (0, 50, -50)], [(0.4, 30, -50), (0.4, 30, -20)]),  # one touches the other: 0.4 px of at most 0.5
]


def strokes_at(depth, side):
    """Lines so far away whose pictures from STAND, to one side of what is there, depend on that in nothing else."""
    ways = np.array(STROKES_PX) + [0, side * ASIDE_PX, 0]
    return [Line(STAND + depth * (np.array([1.0, 0, 0]) + way / FOCAL)) for way in ways]


def cameras_around(count=16, radius=0.45):
    """Cameras on a circle about STAND that look at the middle of the cube."""
    angles = np.arange(count) / count * 2 * np.pi
    places = STAND + radius * np.stack([0 * angles, np.cos(angles), np.sin(angles)], axis=1)
    lens = np.array([[FOCAL, 0, 199.5], [0, FOCAL, 199.5], [0, 0, 1]])
    return np.repeat(lens[None], count, axis=0), np.array([look_at(place, np.full(3, 0.5)) for place in places])


def test_how_far_away_edges_are_does_not_matter(taichi, generator):
    """A few, and the same twice as far away and as large. A pixel at the scene is larger than at the near ones by half,
    and smaller than at the far ones by a quarter.
    """
    strokes = [*strokes_at(1.0, -1), *strokes_at(2.0, 1)]
    curves = [lambda s, shape=shape: shape.at(np.asarray(s)) for shape in strokes]
    views = views_of(curves, generator, cameras=cameras_around(), count=16)
    found, _ = refine_wireframe(Wireframe.loose(strokes), views, RefineConfig(enabled=True, verdict=False))
    is_near = np.array([shape.at(0.5)[0] < 0.5 for shape in found.shapes])
    for some in (found.keep(is_near), found.keep(~is_near)):
        assert len(some) == 6 and len(some.vertices) == 11 and len(some.contacts) == 1
        assert np.bincount([end for edge in some.edges for end in edge.vertices]).max() == 2  # so one pair meets
