"""Straight 2D runs that are paired in space: segments lie on the edges, whole, also along a row of cameras."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import blank_views, distances_to, line, pixel_of, views_of
from scipy.spatial import cKDTree

from taichi_edges.corridor import train
from taichi_edges.corridor.findings import describe_train
from taichi_edges.corridor.pipeline import Run
from taichi_edges.detectors.straight_runs import runs_of
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.progress import Progress
from taichi_edges.scene.settings import SceneConfig
from taichi_edges.seeding import segments
from taichi_edges.seeding.pairing import CANDIDATES, Segments, paired_runs
from taichi_edges.seeding.proposals import propose_straight
from taichi_edges.seeding.segments import fitted, is_shown, likely
from taichi_edges.synthetic.rendering import look_at
from taichi_edges.views.edgels import Edgels

UPRIGHT = line([0.3, 0.4, 0.2], [0.3, 0.4, 0.8])
LEVEL = line([0.3, 0.25, 0.5], [0.8, 0.3, 0.5])
SLANTED = line([0.6, 0.7, 0.2], [0.75, 0.4, 0.8])
LINES = (UPRIGHT, LEVEL, SLANTED)
STROKE = 30  # px; of clutter, long enough that it is taken for edges
NOISE_PX = 0.15


def cluttered(views, generator, strokes, length=STROKE):
    """Views with straight strokes added anywhere, in each view others. length: edgels, a pixel apart."""
    of_views = []
    for view in range(len(views)):
        middles = generator.uniform(0, [views.width, views.height], (strokes, 2))
        angles = generator.uniform(0, np.pi, strokes)
        along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = (middles[:, None] + (np.arange(length) - length / 2)[:, None] * along[:, None]).reshape(-1, 2)
        normals = np.repeat(np.stack([-along[:, 1], along[:, 0]], axis=1), length, axis=0)
        inside = ((points >= 0) & (points < [views.width - 1, views.height - 1])).all(axis=1)
        pairs = zip(views.edgels.of_view(view)[:2], (points[inside], normals[inside]), strict=True)
        points, normals = (np.concatenate(pair) for pair in pairs)
        of_views.append((points, normals, np.ones(len(points))))
    return replace(views, edgels=Edgels.of_views(of_views))


def without_edgels(count):
    """Blank views whose edgels have been looked for."""
    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    return replace(blank_views(count), edgels=Edgels.of_views([none] * count))


def row_of_cameras(count, size=400, baseline=0.12, unevenness=0.05):
    """Cameras side by side along x that look along y at the cube, each a little higher or lower than the next."""
    intrinsics = np.array([[1.2 * size, 0, 0.5 * (size - 1)], [0, 1.2 * size, 0.5 * (size - 1)], [0, 0, 1.0]])
    heights = unevenness * np.array([(-1.0) ** view for view in range(count)])
    centres = [[0.5 + (view - 0.5 * (count - 1)) * baseline, -1.0, 0.5 + heights[view]] for view in range(count)]
    poses = np.stack([look_at(np.array(centre), np.array(centre) + [0, 1.0, 0]) for centre in centres])
    return np.repeat(intrinsics[None], count, axis=0), poses


def all_runs(views):
    return runs_of(views.edgels, np.ones(len(views.edgels), bool))


def pixels_off(points, curves, views):
    """(n,) pixels from each point to the nearest of some curves."""
    return np.min([distances_to(curve, points) for curve in curves], axis=0) / pixel_of(views)


def test_pairs_lie_on_the_edges_with_both_ends(taichi, generator):
    views = views_of(LINES, generator, noise_px=NOISE_PX, apart=1.0)
    runs = all_runs(views)
    found = paired_runs(views, runs)
    _, counts = np.unique(found.runs, return_counts=True)
    assert counts.max() <= CANDIDATES and len(counts) > 0.95 * len(runs)
    first = found.keep(np.unique(found.runs, return_index=True)[1])
    off = pixels_off(first.ends.reshape(-1, 3), LINES, views)
    assert (off < 3.0).mean() > 0.95


def test_fitted_segments_are_nearer_than_a_pair_and_those_without_edgels_stay(taichi, generator):
    views = views_of(LINES, generator, noise_px=NOISE_PX, apart=1.0)
    matching = EdgelMatching(views)
    truth = np.stack([curve(np.array([0.05, 0.95])) for curve in LINES])
    moved = truth + 1.5 * pixel_of(views) * generator.normal(size=truth.shape) / np.sqrt(3)
    nowhere = np.array([[[0.9, 0.9, 0.1], [0.9, 0.9, 0.2]]])
    found = fitted(matching, Segments(np.concatenate([moved, nowhere]), np.arange(4)))
    off = pixels_off(found.ends[:3].reshape(-1, 3), LINES, views)
    assert off.max() < 0.2 and off.mean() < 0.3 * pixels_off(moved.reshape(-1, 3), LINES, views).mean()
    np.testing.assert_allclose(found.ends[3], nowhere[0], atol=1e-9)


def test_depth_along_a_row_of_cameras_comes_from_all_edgels_together(taichi, generator):
    along = line([0.3, 0.5, 0.42], [0.7, 0.5, 0.42])
    views = views_of([along, UPRIGHT], generator, noise_px=NOISE_PX, cameras=row_of_cameras(9), count=9, apart=1.0)
    strokes = propose_straight(views, EdgelMatching(views))
    off = pixels_off(strokes.points, [along, UPRIGHT], views)
    assert (off < 3.0).mean() > 0.95
    s = np.linspace(0.05, 0.95, 200)
    for curve in (along, UPRIGHT):
        assert (cKDTree(strokes.points).query(curve(s))[0] < 4 * pixel_of(views)).mean() > 0.9


def test_strokes_explain_the_edges_once_among_clutter(taichi, generator):
    views = cluttered(views_of(LINES, generator, noise_px=NOISE_PX, apart=1.0), generator, strokes=60)
    strokes = propose_straight(views, EdgelMatching(views))
    pixel, s = pixel_of(views), np.linspace(0.05, 0.95, 200)
    assert (pixels_off(strokes.points, LINES, views) < 2.0).mean() > 0.95
    for curve in LINES:
        assert (cKDTree(strokes.points).query(curve(s))[0] < 4 * pixel).mean() > 0.95
    length = sum(np.linalg.norm(curve(np.array([1.0])) - curve(np.array([0.0]))) for curve in LINES)
    assert len(strokes) * 2.0 * pixel < 1.2 * length  # a point every 2 px, each edge once
    assert (np.diff(strokes.numbers) >= 0).all()


def test_clutter_alone_gives_nothing(taichi, generator):
    clutter = cluttered(without_edgels(24), generator, strokes=60)
    assert len(all_runs(clutter)) > 1000
    assert len(propose_straight(clutter, EdgelMatching(clutter))) == 0


@pytest.mark.parametrize("seen", [range(12), range(0, 24, 2)])
def test_views_beside_each_other_show_an_edge_and_not_every_other_one(taichi, generator, seen):
    everywhere = views_of([UPRIGHT, SLANTED], generator, noise_px=NOISE_PX, apart=1.0)
    some = [everywhere.edgels.of_view(view) for view in range(len(everywhere))]
    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    edgels = Edgels.of_views([found if view in seen else none for view, found in enumerate(some)])
    matching = EdgelMatching(replace(everywhere, edgels=edgels))
    segment = Segments(UPRIGHT(np.array([0.0, 1.0]))[None], np.zeros(1, np.int64))
    shown, excess = is_shown(matching, segment)
    assert shown[0] == (seen == range(12)) and 0.4 < excess[0] < 0.6
    assert len(likely(matching, segment)) == shown[0]


def train_on(views, folder, monkeypatch, **settings):
    """The run and the facts of its training on views that are there already."""
    config = SceneConfig(name="still", source={"reader": "colmap", "path": "anywhere"}, train=settings)
    run = Run(config, folder, threads=2, progress=Progress())
    monkeypatch.setattr(train, "read_views", lambda path: views)
    monkeypatch.setattr("taichi_edges.kernels.device.start_taichi", lambda *_: None)
    return run, train.train(run)


def test_no_training_leaves_the_gaussians_where_they_start(taichi, generator, tmp_path, monkeypatch):
    views = views_of(LINES, generator, noise_px=NOISE_PX, apart=1.0)
    run, facts = train_on(views, tmp_path, monkeypatch, enabled=False, seeds="pair")
    start, strokes = train.start_of_training(run, views, np.random.default_rng(0))
    assert facts == {"gaussians": len(start), "view_steps": 0, "final_loss": None} and len(np.unique(strokes)) == 3
    assert (tmp_path / "train_log.csv").read_text().count("\n") == 1
    assert describe_train(facts) == f"{len(start)} Gaussians, left where they start"


def test_what_lies_on_no_stroke_is_trained_all_the_same(taichi, generator, tmp_path, monkeypatch):
    views = views_of(LINES, generator, noise_px=NOISE_PX, apart=1.0)
    maps = views.edge_maps.copy()
    maps[:, views.height // 2, ::2] = 255  # training looks at maps, and these views have edgels only
    views = replace(views, edge_maps=maps)
    _, facts = train_on(views, tmp_path, monkeypatch, enabled=False, seeds="random", gaussians=200, steps=30)
    assert facts["view_steps"] >= 30 and facts["final_loss"] is not None


@pytest.mark.parametrize("strokes", [0, 1])
def test_views_with_hardly_an_edgel_give_nothing(taichi, generator, strokes):
    views = cluttered(without_edgels(5), generator, strokes)
    assert len(propose_straight(views, EdgelMatching(views))) == 0


def test_segments_are_judged_alike_however_many_at_once(taichi, generator, monkeypatch):
    views = cluttered(views_of(LINES, generator, noise_px=NOISE_PX, apart=1.0), generator, strokes=20)
    matching = EdgelMatching(views)
    found = paired_runs(views, all_runs(views))
    whole = likely(matching, found)
    monkeypatch.setattr(segments, "AT_ONCE", 7 * len(views))
    np.testing.assert_array_equal(likely(matching, found).ends, whole.ends)
    assert len(whole) > 10


def test_three_views_are_lifted_and_it_is_said(taichi, generator, tmp_path):
    views = views_of(LINES, generator, noise_px=NOISE_PX, count=3, apart=1.0)
    told = []
    progress = Progress()
    progress.warn = told.append
    config = SceneConfig(name="few", source={"reader": "colmap", "path": "anywhere"}, train={"seeds": "pair"})
    run = Run(config, tmp_path, threads=2, progress=progress)
    train.start_of_training(run, views, generator)
    assert "3 views" in told[0] and "lifted instead" in told[0]
