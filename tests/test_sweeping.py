"""Seeds by sweeping lie on edges, along them and cover them; what is no edge gives few."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import arc, blank_views, distances_to, either_errors, line, tangents, views_of
from scipy.spatial import cKDTree

from taichi_edges.corridor import train
from taichi_edges.corridor.pipeline import Run
from taichi_edges.progress import Progress
from taichi_edges.scene.settings import SceneConfig
from taichi_edges.seeding import sweeping
from taichi_edges.seeding.sweeping import (
    LEAST_COMPANIONS,
    Agreements,
    SweepSeeds,
    best_seeds,
    companions_of,
    direction_maps,
    neighbor_views,
    references,
    sweep_seeds,
    swept_gaussians,
)
from taichi_edges.synthetic.rendering import look_at
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import pixel_size

UPRIGHT = line([0.3, 0.4, 0.2], [0.3, 0.4, 0.8])
LEVEL = line([0.3, 0.25, 0.5], [0.8, 0.3, 0.5])
SLANTED = line([0.6, 0.7, 0.2], [0.75, 0.4, 0.8])
RIM = arc([0.55, 0.55, 0.35], 0.2)
CURVES = (UPRIGHT, LEVEL, SLANTED, RIM)
STROKE = 30  # px; of clutter, long enough that it is taken for edges
BIN = np.radians(15.0)  # of directions, see `sweeping.BINS`; what agrees is up to so far from the middle


def cluttered(views, generator, strokes, length=STROKE):
    """Views with straight strokes added anywhere, in each view others. length: edgels, a pixel apart."""
    of_views = []
    for view in range(len(views)):
        middles = generator.uniform(0, [views.width, views.height], (strokes, 2))
        angles = generator.uniform(0, np.pi, strokes)
        along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        steps = np.arange(length) - length / 2
        points = (middles[:, None] + steps[:, None] * along[:, None]).reshape(-1, 2)
        normals = np.repeat(np.stack([-along[:, 1], along[:, 0]], axis=1), length, axis=0)
        inside = ((points >= 0) & (points < [views.width - 1, views.height - 1])).all(axis=1)
        own = (
            np.concatenate(pair)
            for pair in zip(views.edgels.of_view(view)[:2], (points[inside], normals[inside]), strict=True)
        )
        points, normals = own
        of_views.append((points, normals, np.ones(len(points))))
    return replace(views, edgels=Edgels.of_views(of_views))


def without_edgels(count):
    """Blank views whose edgels have been looked for."""
    none = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    return replace(blank_views(count), edgels=Edgels.of_views([none] * count))


def good(seeds):
    """The seeds that training may start from: (points, directions)."""
    enough = seeds.companions >= LEAST_COMPANIONS
    return seeds.points[enough], seeds.directions[enough]


def misses(points, curves, pixel):
    """(n,) pixels from each point to the nearest curve, and (n,) which it is."""
    distances = np.stack([distances_to(curve, points) for curve in curves])
    return distances.min(axis=0) / pixel, distances.argmin(axis=0)


def walking_cameras(count, size=400, baseline=0.12):
    """Cameras side by side along x that look along y at the cube: horizontal edges lie in their viewing planes."""
    intrinsics = np.array([[1.2 * size, 0, 0.5 * (size - 1)], [0, 1.2 * size, 0.5 * (size - 1)], [0, 0, 1.0]])
    centres = np.array([[0.5 + (view - 0.5 * (count - 1)) * baseline, -1.0, 0.5] for view in range(count)])
    poses = np.stack([look_at(centre, centre + [0, 1.0, 0]) for centre in centres])
    return np.repeat(intrinsics[None], count, axis=0), poses


@either_errors()
def test_seeds_lie_on_edges_along_them_and_cover_them(taichi, generator, errors):
    views = cluttered(views_of(CURVES, generator, noise_px=0.2, hidden=0.2, errors=errors), generator, strokes=40)
    points, directions = good(sweep_seeds(views))
    away, which = misses(points, CURVES, pixel := pixel_size(views))
    near = away < 2.0
    assert near.mean() > 0.85  # though there are as many strokes as edges, and a fifth of these is hidden
    for number, curve in enumerate(CURVES):
        s = np.linspace(0, 1, 400)
        on = near & (which == number)
        assert (cKDTree(points[on]).query(curve(s))[0] < 4 * pixel).mean() > 0.97
        truth = tangents(curve, s)[cKDTree(curve(s)).query(points[on])[1]]
        turned = np.arccos(np.clip(np.abs((truth * directions[on]).sum(axis=1)), 0, 1))
        # Told to half a bin when all neighbours agree, so that up to a quarter is the rounding's; the rest is noise.
        assert np.median(turned) < 0.3 * BIN and np.quantile(turned, 0.9) < 0.8 * BIN


@either_errors()
def test_seeds_are_not_to_one_side_in_depth(taichi, generator, errors):
    views = views_of([UPRIGHT, SLANTED], generator, noise_px=0.1, errors=errors)
    seeds, pixel = sweep_seeds(views), pixel_size(views)
    points = seeds.points[seeds.companions >= LEAST_COMPANIONS]
    for curve in (UPRIGHT, SLANTED):
        dense = curve(np.linspace(0, 1, 4000))
        distances, nearest = cKDTree(dense).query(points)
        near = distances < 3 * pixel
        offsets = points[near] - dense[nearest[near]]
        assert np.linalg.norm(offsets.mean(axis=0)) < 0.3 * pixel  # from all around, errors in depth cancel
        assert np.median(distances[near]) < 0.8 * pixel and len(points) > 200


def test_depth_of_a_reference_is_centred(taichi, generator):
    views = views_of([UPRIGHT], generator, cameras=walking_cameras(7), count=7)
    points, _ = good(sweep_seeds(views))
    depth = points[:, 1] - 0.4
    step = 1.4**2 / (1.2 * 400) * sweeping.STEP_PX / 0.36  # a step in depth, unit cube: of the longest baseline
    assert len(points) > 50 and abs(np.median(depth)) < step and np.abs(depth).max() < 4 * step


def test_clutter_gives_few_seeds(taichi, generator):
    blank = without_edgels(24)
    clutter = cluttered(blank, generator, strokes=60)
    chosen = references(clutter.edgels, sweeping.chain_lengths(clutter.edgels)).sum()
    points, _ = good(sweep_seeds(clutter))
    assert chosen > 2000 and len(points) < 0.02 * chosen


@either_errors()
def test_edges_along_the_baseline_are_not_invented_at_wrong_depths(taichi, generator, errors):
    along = line([0.3, 0.5, 0.42], [0.7, 0.5, 0.42])
    views = views_of([along, UPRIGHT], generator, noise_px=0.15, cameras=walking_cameras(9), count=9, errors=errors)
    points, _ = good(sweep_seeds(views))
    away, _ = misses(points, [along, UPRIGHT], pixel_size(views))
    assert (away < 8).sum() > 50 and (away > 8).mean() < 0.05


@pytest.mark.slow(reason="starts Taichi anew")
def test_seeds_do_not_depend_on_threads_nor_on_the_run(start_taichi, generator):
    views = cluttered(views_of(CURVES, generator, noise_px=0.2), generator, strokes=20)
    found = []
    for threads in (2, 2, 1):
        start_taichi("f32", threads)
        found.append(sweep_seeds(views))
    for name in ("points", "directions", "views", "companions", "pixel"):
        one, *others = (getattr(seeds, name).tobytes() for seeds in found)
        assert one and all(other == one for other in others)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_too_few_views_give_nothing(taichi, generator, count):
    seeds = sweep_seeds(views_of(CURVES, generator, count=count))
    assert seeds.points.shape == seeds.directions.shape == (0, 3)
    assert seeds.views.shape == seeds.companions.shape == seeds.pixel.shape == (0,)


def test_views_that_see_nothing_in_common_give_nothing(taichi, generator):
    cameras = np.array([[0.5, 0.5, 0.5 + 40 * k] for k in range(6)])
    away = np.stack([look_at(camera, camera + [0, 1, 0]) for camera in cameras])
    views = replace(views_of(CURVES, generator, count=6), world_to_camera=away)
    assert all(len(others) == 0 for others in neighbor_views(views))
    assert len(sweep_seeds(views).points) == 0


def test_rays_that_miss_the_box_give_nothing(taichi, generator):
    corner = replace(views_of(CURVES, generator), box=np.array([[0.0, 0, 0], [0.05, 0.05, 0.05]]))
    assert len(sweep_seeds(corner).points) == 0


def test_no_edgels_and_no_long_chains_give_nothing(taichi, generator):
    assert len(sweep_seeds(without_edgels(8)).points) == 0
    short = cluttered(without_edgels(8), generator, strokes=50, length=sweeping.LEAST_CHAIN // 2)
    chosen = references(short.edgels, sweeping.chain_lengths(short.edgels))
    assert chosen.mean() < 0.2 and len(good(sweep_seeds(short))[0]) < 5
    assert swept_gaussians(without_edgels(8), 1000, 0.3, Progress()) is None


@either_errors()
def test_gaussians_lie_along_edges_at_most_so_many(taichi, generator, errors):
    views = views_of(CURVES, generator, noise_px=0.1, errors=errors)
    pixel = pixel_size(views)
    gaussians = swept_gaussians(views, 10_000, 0.3, Progress())
    assert gaussians.scales[0] == pytest.approx(np.array([2.0, 0.7, 0.7]) * pixel, rel=1e-5)
    assert gaussians.opacities == pytest.approx(0.3)
    away, which = misses(gaussians.means.astype(float), CURVES, pixel)
    assert (away < 2).mean() > 0.8 and set(which) == {0, 1, 2, 3}  # strays are thinned less than what lies on edges
    fewer = swept_gaussians(views, 100, 0.3, Progress())
    assert len(fewer) == 100 and set(map(bytes, fewer.means)) < set(map(bytes, gaussians.means))


def test_best_seeds_have_most_companions_and_there_is_room_for_them(generator):
    views, count = blank_views(8), 3000
    pixel = pixel_size(views)
    points = 0.4 + generator.random((count, 3)) * 0.2  # in the images of all views
    companions = generator.integers(0, 20, count)
    along = np.tile([1.0, 0, 0], (count, 1))
    seeds = SweepSeeds(points, along, np.full(count, 4), np.full(count, pixel), companions, references=300)
    chosen = best_seeds(seeds, views, count)
    cells = np.floor(points / (sweeping.THINNED_PX * pixel)).astype(int)
    assert len(np.unique(cells[chosen], axis=0)) == len(chosen)
    # 300 references of 8 px each, each place in the sight of 8 views: 300 px of edges, a seed every 3 px; twice that.
    assert len(chosen) == 2 * 300 * 8 / 3 / 8
    best = {}
    for cell, number in zip(map(tuple, cells.tolist()), companions, strict=True):
        best[cell] = max(best.get(cell, 0), number)
    expected = np.sort(list(best.values()))[::-1][: len(chosen)]
    np.testing.assert_array_equal(np.sort(companions[chosen])[::-1], expected)
    assert len(best_seeds(seeds, views, 70)) == 70
    assert len(best_seeds(replace(seeds, companions=np.zeros(count, int)), views, 70)) == 0


def test_neighbours_see_the_same_from_elsewhere():
    views = blank_views(24)
    outward = sweeping.camera_centres(views) - 0.5
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(outward @ outward.T, -1, 1)))  # at the middle of the cube, which all see
    for view, others in enumerate(neighbor_views(views)):
        near = np.flatnonzero((angles[view] > 3) & (angles[view] < 45))
        assert view not in others and (angles[view][others] < 75).all()  # 50 degrees somewhere in the cube
        assert len(set(others)) == sweeping.MOST_NEIGHBORS or set(near) <= set(others)


def test_of_neighbours_that_see_as_much_those_apart_are_chosen(monkeypatch):
    centres = np.column_stack([np.arange(9.0), np.zeros((9, 2))])  # a row of cameras
    monkeypatch.setattr(sweeping, "MOST_NEIGHBORS", 3)
    assert sweeping.best_and_apart(np.array([5, 5, 5, 5, 0, 5, 5, 5, 5]), centres, 4).tolist() == [0, 8, 2]
    assert sweeping.best_and_apart(np.array([5, 5, 9, 5, 0, 8, 5, 5, 5]), centres, 4).tolist() == [2, 5, 8]
    assert sweeping.best_and_apart(np.array([0, 0, 0, 7, 0, 0, 0, 0, 0]), centres, 4).tolist() == [3]
    assert sweeping.best_and_apart(np.zeros(9, int), centres, 4).tolist() == []


def test_pixels_beside_edgels_know_the_nearest_ones_direction(taichi, generator):
    points, angles = generator.uniform(-2, 42, (40, 2)), generator.uniform(0, 2 * np.pi, 40)
    points[:5] = [[5, 5], [15, 5], [25, 5], [5, 25], [25, 25]] + generator.uniform(-0.5, 0.5, (5, 2))  # well inside
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    edgels = Edgels.of_views([(points, normals, np.ones(40)), (points[:5], normals[:5], np.ones(5))])
    maps = direction_maps(edgels, 36, 40)
    codes, cosines, sines = maps.codes, maps.cosines, maps.sines
    for view, count in enumerate((40, 5)):
        own = edgels.points[:count].astype(float)
        pixels = np.stack(np.meshgrid(np.arange(40), np.arange(36)), axis=-1)
        apart = own - pixels[:, :, None]
        beside = (np.abs(np.rint(own) - pixels[:, :, None]) <= 1).all(axis=-1)
        distances = np.where(beside, np.linalg.norm(apart, axis=-1), np.inf)
        np.testing.assert_array_equal(codes[view] > 0, np.isfinite(distances).any(axis=-1))
        ordered = np.sort(distances, axis=-1)
        clear = np.isfinite(ordered[:, :, 0]) & (ordered[:, :, 1] > ordered[:, :, 0] + 0.02)  # a byte tells so much
        nearest = normals[distances.argmin(axis=-1)]
        aligned = nearest[:, :, 0] * cosines[codes[view]] + nearest[:, :, 1] * sines[codes[view]]
        assert clear.sum() > 20 and np.abs(aligned[clear]).min() > np.cos(np.pi / sweeping.CODES)


def test_references_are_one_in_each_cell_and_on_long_chains(generator):
    views = cluttered(without_edgels(3), generator, strokes=30)
    lengths = sweeping.chain_lengths(views.edgels)
    chosen = references(views.edgels, lengths)
    cells = np.column_stack([views.edgels.views, views.edgels.points // sweeping.EVERY_PX])
    assert lengths[chosen].min() >= sweeping.LEAST_CHAIN
    assert len(np.unique(cells[chosen], axis=0)) == chosen.sum()
    assert len(np.unique(cells[lengths >= sweeping.LEAST_CHAIN], axis=0)) == chosen.sum()


def test_companions_are_on_the_same_line_in_the_same_direction():
    pixel, along = 0.002, np.array([1.0, 0, 0])
    places = np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [20, 0, 0], [-3, 0, 0]]) * pixel
    directions = np.array([along, -along, along, along, [0, 1, 0]])
    counts = np.array([4, 5, 6, 7, 8])
    found = companions_of(Agreements(0.5 + places, directions, counts, np.full(5, pixel)))
    # The second is on the first one's line; the third is beside it, the fourth is far, the fifth is turned.
    assert found.tolist() == [5 - 2, 4 - 2, 0, 0, 0]


def test_companions_do_not_depend_on_the_chunks_nor_on_the_scale(generator, monkeypatch):
    points = generator.random((400, 3)) * [0.2, 0.004, 0.004]
    directions = np.tile([1.0, 0, 0], (400, 1))
    counts, pixel = generator.integers(4, 8, 400), generator.uniform(0.001, 0.003, 400)
    given = Agreements(points, directions, counts, pixel)
    expected = companions_of(given)
    monkeypatch.setattr(sweeping, "SEARCHED", 37)
    np.testing.assert_array_equal(companions_of(given), expected)
    larger = replace(given, points=8 * points, pixel=8 * pixel)
    np.testing.assert_array_equal(companions_of(larger), expected)
    assert expected.max() > 0


class Warned(Progress):
    """Keeps the warnings."""

    def __init__(self):
        super().__init__()
        self.lines = []

    def warn(self, text):
        self.lines.append(text)


def test_three_views_are_too_few_to_sweep_and_their_edgels_are_lifted(taichi, generator, tmp_path):
    config = SceneConfig(source={"reader": "emap", "path": "there"}, train={"seeds": "sweep", "gaussians": 300})
    warned, views = Warned(), views_of(CURVES, generator, count=3)
    train.start_of_training(Run(config, tmp_path, progress=warned), views, np.random.default_rng(0))
    assert warned.lines[0].startswith("fewer than 4 views see the same")
    assert warned.lines[0].endswith("the edgels are lifted instead")


def test_without_seeds_the_training_says_so_and_starts_from_random_points(taichi, tmp_path):
    config = SceneConfig(source={"reader": "emap", "path": "there"}, train={"seeds": "sweep", "gaussians": 300})
    warned = Warned()
    gaussians, strokes = train.start_of_training(
        Run(config, tmp_path, progress=warned), without_edgels(8), np.random.default_rng(0)
    )
    assert strokes is None and len(gaussians) == 300 and len(warned.lines) == 1
    assert "the views agree on an edge in fewer than 50 places" in warned.lines[0]
    assert warned.lines[0].endswith("the training starts from random points instead")
