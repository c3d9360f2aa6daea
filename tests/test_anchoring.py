"""A façade seen by cameras that went along it: what runs the same way has no depth of its own, but meets others."""

from collections import Counter

import numpy as np
import pytest
from edgel_scenes import SIZE, blank_views, edgel_errors, either_errors, line, pixel_of, views_of

from taichi_edges.detectors.straight_runs import LEAST_LENGTH_PX, runs_of, straight_runs
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.geometry.shapes import Line
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.refinement.anchoring import anchored_lines
from taichi_edges.refinement.stage import refine_wireframe
from taichi_edges.scene.settings import RefineConfig
from taichi_edges.views.edgels import Edgels

VIEWS, FOCAL, DISTANCE = 9, 400.0, 1.1
WALL = 0.6  # z of the façade, which spans x and y
NOISE_PX = 0.15
SEEDS = range(3)


def walk():
    """Cameras (intrinsics, poses) along x, looking along z: those of a photographer who does not duck."""
    centres = np.column_stack([np.linspace(0.2, 0.8, VIEWS), np.full(VIEWS, 0.5), np.full(VIEWS, WALL - DISTANCE)])
    middle = (SIZE - 1) / 2
    intrinsics = np.array([[FOCAL, 0, middle], [0, FOCAL, middle], [0, 0, 1.0]])
    poses = np.concatenate([np.broadcast_to(np.eye(3), (VIEWS, 3, 3)), -centres[:, :, None]], axis=2)
    return np.broadcast_to(intrinsics, (VIEWS, 3, 3)).copy(), poses


def windows(generator):
    """Ends (n, 2, 3) of the vertical and of the horizontal sides of six windows."""
    upright, level = [], []
    for x in (0.25, 0.5, 0.75):
        for y in (0.35, 0.7):
            left, top = (x, y) - generator.uniform(0.06, 0.09, 2)
            right, bottom = (x, y) + generator.uniform(0.06, 0.09, 2)
            upright += [[(at, top, WALL), (at, bottom, WALL)] for at in (left, right)]
            level += [[(left, at, WALL), (right, at, WALL)] for at in (top, bottom)]
    return np.array(upright), np.array(level)


def facade(generator, *more, errors="white"):
    """Views of the windows and (n, 2, 3) more lines; shapes of the verticals; ends of the horizontals."""
    upright, level = windows(generator)
    curves = [line(*ends) for ends in (*upright, *level, *more)]
    views = views_of(curves, generator, noise_px=NOISE_PX, cameras=walk(), count=VIEWS, errors=errors)
    return views, [Line(ends) for ends in upright], level


def ends_of(lines):
    """(n, 2, 3) ends, from left to right."""
    ends = np.array([each.points for each in lines]).reshape(-1, 2, 3)
    return np.array([pair[np.argsort(pair[:, 0])] for pair in ends]).reshape(-1, 2, 3)


def matched(found, level, pixel):
    """Indices of the horizontals that found ends (n, 2, 3) repeat, -1 for none: 2 px in depth, 4 px at the ends."""
    near = np.abs(found[:, None] - level[None]) <= pixel * np.array([4.0, 1.0, 2.0])
    near = near.all(axis=(2, 3))
    return np.where(near.any(axis=1), near.argmax(axis=1), -1)


@either_errors()
@pytest.mark.parametrize("seed", SEEDS)
def test_horizontals_get_the_depth_of_the_verticals(taichi, generator, seed, errors):
    views, upright, level = facade(generator, errors=errors)
    found = matched(ends_of(anchored_lines(EdgelMatching(views), upright)), level, pixel_of(views))
    assert Counter(found.tolist()) == Counter(range(len(level)))


@pytest.mark.slow(reason="anchors whole façades")
@either_errors()
@pytest.mark.parametrize("seed", SEEDS)
def test_pipe_in_front_of_the_wall_pulls_nothing(taichi, generator, seed, errors):
    x = generator.uniform(0.4, 0.6)
    pipe = np.array([[(x, 0.1, WALL - 0.15), (x, 0.9, WALL - 0.15)]])
    views, upright, level = facade(generator, *pipe, errors=errors)
    found = anchored_lines(EdgelMatching(views), [*upright, Line(pipe[0])])
    found = matched(ends_of(found), level, pixel_of(views))
    assert Counter(found.tolist()) == Counter(range(len(level)))


@either_errors()
def test_what_hangs_on_anchored_lines_is_found_after_them(taichi, generator, errors):
    """A bar in the middle of a window meets nothing but the lintel and the sill."""
    _, level = windows(np.random.default_rng(0))
    upright, _ = windows(np.random.default_rng(0))
    bars = level.mean(axis=1).reshape(-1, 2, 3)
    curves = [line(*ends) for ends in (*upright, *level, *bars)]
    matching = EdgelMatching(views_of(curves, generator, NOISE_PX, cameras=walk(), count=VIEWS, errors=errors))
    found = anchored_lines(matching, [Line(ends) for ends in upright])
    ends, expected = np.array([each.points for each in found]), np.concatenate([level, bars])
    apart = np.minimum(*(np.abs(each[:, None] - expected).max(axis=(2, 3)) for each in (ends, ends[:, ::-1])))
    assert len(found) == len(expected) and apart.min(axis=0).max() <= 4 * matching.pixel


@either_errors()
def test_nothing_is_found_where_there_are_no_edgels(taichi, generator, errors):
    upright, _ = windows(generator)
    views = views_of([line(*ends) for ends in upright], generator, NOISE_PX, cameras=walk(), count=VIEWS, errors=errors)
    assert anchored_lines(EdgelMatching(views), [Line(ends) for ends in upright]) == []
    blank = blank_views(VIEWS, walk())
    views = views_of([], generator, cameras=walk(), count=VIEWS)
    assert len(blank) == len(views) and anchored_lines(EdgelMatching(views), [Line(ends) for ends in upright]) == []
    assert anchored_lines(EdgelMatching(views), []) == []


def strokes(generator, count):
    """(points, normals, strengths) of straight strokes anywhere in an image, 20 to 60 px long."""
    points, normals = [], []
    for _ in range(count):
        angle, length = generator.uniform(0, np.pi), generator.uniform(20, 60)
        along = np.array([np.cos(angle), np.sin(angle)])
        points.append(generator.uniform(20, SIZE - 20, 2) + np.arange(0, length)[:, None] * along)
        normals.append(np.broadcast_to([-along[1], along[0]], points[-1].shape))
    points, normals = np.concatenate(points), np.concatenate(normals)
    inside = ((points > 0) & (points < SIZE - 1)).all(axis=1)
    return points[inside], normals[inside], np.ones(inside.sum())


@pytest.mark.slow(reason="anchors whole façades")
@either_errors()
@pytest.mark.parametrize("seed", SEEDS)
def test_texture_that_differs_from_view_to_view_is_no_edge(taichi, generator, seed, errors):
    upright, _ = windows(generator)
    views = views_of([line(*ends) for ends in upright], generator, NOISE_PX, cameras=walk(), count=VIEWS, errors=errors)
    mixed = []
    for view in range(VIEWS):
        pairs = zip(views.edgels.of_view(view), strokes(generator, 150), strict=True)
        mixed.append([np.concatenate(pair) for pair in pairs])
    views = type(views)(**{**views.__dict__, "edgels": Edgels.of_views(mixed)})
    assert len(anchored_lines(EdgelMatching(views), [Line(ends) for ends in upright])) <= 1


@either_errors()
def test_frames_close_and_keep_their_depth_in_the_wireframe(taichi, generator, errors):
    views, upright, level = facade(generator, errors=errors)
    wireframe, counts = refine_wireframe(Wireframe.loose(upright), views, RefineConfig(enabled=True, anchor=True))
    found = matched(ends_of(list(wireframe.shapes[len(upright) :])), level, pixel_of(views))
    assert counts.anchored == len(level) and sorted(found.tolist()) == list(range(len(level)))
    assert len(wireframe.vertices) == 2 * len(upright) and (wireframe.degrees == 2).all()


def test_without_the_key_nothing_is_anchored(taichi, generator):
    views, upright, _ = facade(generator)
    wireframe, counts = refine_wireframe(Wireframe.loose(upright), views, RefineConfig(enabled=True))
    assert counts.anchored == 0 and len(wireframe) == len(upright)


def run_of(start, end, generator, errors):
    """Edgels of a straight 2D stroke: points and normals (n, 2), a pixel apart."""
    start, end = np.array(start, float), np.array(end, float)
    along = (end - start) / np.linalg.norm(end - start)
    normals = np.tile([-along[1], along[0]], (int(np.linalg.norm(end - start)) + 1, 1))
    points = start + np.arange(len(normals))[:, None] * along
    return points + NOISE_PX * normals * edgel_errors(points, generator, errors)[:, None], normals


@either_errors()
def test_runs_are_cut_at_bends_and_joined_over_gaps(generator, errors):
    parts = [((20, 20), (80, 30)), ((81.5, 31), (120, 70)), ((20, 100), (60, 100)), ((68, 100), (110, 100))]
    points, normals = map(
        np.concatenate, zip(*(run_of(*part, generator, errors=errors) for part in parts), strict=True)
    )
    found = straight_runs(points, normals)
    found = np.array([ends[np.argsort(ends[:, 0])] for ends in found[np.argsort(found[:, 0, 1])]])
    expected = [[(20, 20), (80, 30)], [(81.5, 31), (120, 70)], [(20, 100), (110, 100)]]
    assert found.shape == (3, 2, 2)
    assert np.abs(found - expected).max() < 2.5


def test_circle_leaves_short_chords_only_that_lie_on_it(generator):
    angles = np.arange(0, 2 * np.pi, 1 / 50.0)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    found = straight_runs(100 + 50 * normals, normals)
    assert len(found) and (np.linalg.norm(found[:, 1] - found[:, 0], axis=1) >= LEAST_LENGTH_PX).all()
    assert np.abs(np.linalg.norm(found.mean(axis=1) - 100, axis=1) - 50).max() < 2.0


def test_no_edgels_give_no_runs():
    assert len(runs_of(Edgels.of_views([[np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)]]), np.zeros(0, bool))) == 0
