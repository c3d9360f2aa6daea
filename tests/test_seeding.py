"""Seeds by multi-view voting lie on the edges of a part, along them, and cover them."""

from dataclasses import replace

import numpy as np
import pytest
import reference_support as reference
from scipy.spatial import cKDTree

from taichi_edges.corridor import train
from taichi_edges.corridor.pipeline import Run
from taichi_edges.files.ply import write_float_vertices
from taichi_edges.scene.settings import SceneConfig
from taichi_edges.seeding import voting
from taichi_edges.seeding.starts import random_points
from taichi_edges.seeding.voting import DistanceBatches, line_directions, nearly_best, vote_cells, vote_seeds
from taichi_edges.splatting.gaussians import orient_gaussians
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import Imperfections, render_views


@pytest.fixture(scope="module")
def part():
    return PARTS["block"]()


@pytest.fixture(scope="module")
def views(part):
    return render_views(part, 18, 200, Imperfections(), np.random.default_rng(5))[0]


@pytest.fixture
def seeds(taichi, views):
    return vote_seeds(views, 0.5, np.random.default_rng(0))


def test_seeds_cover_the_edges_and_few_lie_elsewhere(seeds, part):
    truth, tangents, _ = part.edges.sample(0.002)
    to_truth, nearest = cKDTree(truth).query(seeds.points)
    # What matters is that no edge goes without seeds; those a few pixels off (a pixel is 9 mm here) are pulled in by
    # the training. A random point of the cube lies within six pixels of an edge once in ten times, within two in 100.
    assert (cKDTree(seeds.points).query(truth)[0] < 2 * seeds.pixel).mean() > 0.99
    assert (to_truth < 2 * seeds.pixel).mean() > 0.75
    assert (to_truth < 6 * seeds.pixel).mean() > 0.95
    along = np.abs((seeds.directions * tangents[nearest]).sum(axis=1))
    corners = cKDTree(part.edges.lines.reshape(-1, 3)).query(seeds.points)[0] < 8 * seeds.pixel
    assert np.median(along[(to_truth < 2 * seeds.pixel) & ~corners]) > 0.95


def test_the_same_generator_gives_the_same_seeds(taichi, views):
    one, other = (vote_seeds(views, 0.5, np.random.default_rng(7)) for _ in range(2))
    assert one.points.tobytes() == other.points.tobytes()


def test_of_too_many_seeds_some_are_drawn(start_taichi, views, seeds):
    some = vote_seeds(views, 0.5, np.random.default_rng(0), 300)
    distances, which = cKDTree(seeds.points).query(some.points)
    assert len(some.points) == len(set(which)) == 300 and distances.max() == 0
    np.testing.assert_array_equal(some.directions, seeds.directions[which])


def test_maps_without_agreement_give_no_seeds(taichi, views):
    blank = replace(views, edge_maps=np.zeros_like(views.edge_maps))
    assert len(vote_seeds(blank, 0.5, np.random.default_rng(0)).points) == 0


@pytest.mark.slow(reason="starts Taichi anew")
def test_seeds_do_not_depend_on_batches_chunks_and_threads(taichi, start_taichi, views, monkeypatch):
    expected = vote_seeds(views, 0.5, np.random.default_rng(0))
    monkeypatch.setattr(voting, "BATCH_BYTES", 7 * 200 * 200)
    monkeypatch.setattr(voting, "CHUNK", 5000)
    start_taichi("f32", 1)
    found = vote_seeds(views, 0.5, np.random.default_rng(0))
    assert len(list(DistanceBatches(views.edge_maps, 0.5))) == 3
    assert found.points.tobytes() == expected.points.tobytes()
    assert found.directions.tobytes() == expected.directions.tobytes()


def test_distances_are_exact_to_a_quarter_pixel(generator):
    maps = (generator.random((3, 40, 60)) > 0.995).astype(np.uint8) * 128
    maps[:, 20, 30] = 128
    rows, columns = np.indices((40, 60))
    for edge_map, found in zip(maps, voting.distance_maps(maps, 0.5, threads=2), strict=True):
        edges = np.argwhere(edge_map)
        exact = np.sqrt(((np.stack([rows, columns], axis=-1)[:, :, None] - edges) ** 2).sum(axis=-1).min(axis=2))
        # OpenCV approximates by steps of a knight and of a king: 2 % at most.
        assert (found / 4 <= exact * 1.02).all() and (found / 4 > exact * 0.98 - 0.25).all()
    assert voting.distance_maps(np.zeros((1, 40, 60), np.uint8), 0.5).min() == 255


@pytest.mark.parametrize("split", [0, 1])
def test_cells_see_edges_as_those_of_the_slow_twin_do(taichi, views, generator, split):
    views = replace(views, box=np.array([[-0.1, 0.1, 0.0], [1.1, 0.9, 1.4]]))  # part of it is outside the images
    size, needed = 0.02, voting.KEEP * len(views)
    cells = generator.integers(0, np.ceil((views.box[1] - views.box[0]) / size) // (1 + split), (2000, 3), np.int32)
    found = voting.see_edges(views, DistanceBatches(views.edge_maps, 0.5), cells, split, size)
    if split:
        cells = np.concatenate([2 * cells + corner for corner in voting.EIGHTHS], axis=1).reshape(-1, 3)
    centres = views.box[0] + (cells + 0.5) * size
    radius = views.intrinsics[0, 0, 0] * size * np.sqrt(3) / 2
    distances = voting.distance_maps(views.edge_maps, 0.5) / 4
    near, doubtful = reference.has_edge_within(views, centres, distances, radius)
    clear = ~doubtful.any(axis=0)
    np.testing.assert_array_equal(found[clear], near.sum(axis=0)[clear] >= needed)
    assert clear.mean() > 0.8 and 0.05 < found.mean() < 0.95


def test_more_levels_find_the_same_cells_and_none_is_entered_that_is_too_large(taichi, views, monkeypatch):
    distances, pixel = DistanceBatches(views.edge_maps, 0.5), voting.pixel_size(views)
    cells, size = vote_cells(views, distances, pixel)
    assert size == pytest.approx(voting.FINEST_PX * pixel)
    monkeypatch.setattr(voting, "MOST_FIRST", 2000)
    more, same_size = vote_cells(views, distances, pixel)
    assert same_size == size
    # A coarser cell is kept where its eighths would be, but for the rounding to pixels and the perspective within it.
    # The first cells reach beyond the box, and coarser ones farther.
    within = np.floor((views.box[1] - views.box[0]) / size)
    one, other = (set(map(tuple, found[(found < within).all(axis=1)].tolist())) for found in (cells, more))
    assert len(one & other) > 0.99 * max(len(one), len(other))
    monkeypatch.setattr(voting, "MOST_CELLS", len(cells))
    fewer, coarse = vote_cells(views, distances, pixel)
    assert coarse > size and 0 < len(fewer) < len(cells)


def test_suppression_keeps_the_best_of_each_neighbourhood():
    points = np.array([[0.5, 0.5, 0.5], [0.501, 0.5, 0.5], [0.9, 0.5, 0.5]])
    assert nearly_best(points, np.array([0.9, 0.5, 0.3]), 0.02).tolist() == [True, False, True]
    assert nearly_best(np.zeros((0, 3)), np.zeros(0), 0.02).shape == (0,)


def test_directions_follow_a_line_and_lonely_points_get_some_unit_vector():
    line = np.linspace([0.1, 0.2, 0.3], [0.3, 0.4, 0.4], 30)
    points = np.concatenate([line, [[0.9, 0.9, 0.9]]])
    directions = line_directions(points, points, 0.05)
    unit = np.array([2, 2, 1]) / 3
    assert np.abs(directions[:30] @ unit).min() == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.norm(directions[30]) == pytest.approx(1.0)


def test_directions_are_those_of_the_slow_twin(generator, monkeypatch):
    others = generator.random((600, 3)) * [1, 1, 0.2]
    points = others[:100]
    monkeypatch.setattr(voting, "NEIGHBOURHOODS", 30)
    directions = line_directions(points, others, 0.08)
    for i, near in enumerate(cKDTree(others).query_ball_point(points, 0.08)):
        if len(near) < 3:
            assert directions[i].tolist() == [1, 0, 0]
            continue
        spreads, axes = np.linalg.eigh(np.cov(others[near].T))
        if spreads[2] > 1.01 * spreads[1]:  # else any direction between the two will do
            assert abs(axes[:, 2] @ directions[i]) == pytest.approx(1.0, abs=1e-6)
    assert line_directions(np.zeros((0, 3)), np.zeros((0, 3)), 0.08).shape == (0, 3)


def test_nearly_best_is_what_a_dense_grid_gives(generator):
    points = generator.random((3000, 3)) * [1.0, 0.5, 0.25] - 0.1
    points[:300] += 5.0  # far away, so that most cells between are empty
    scores = generator.random(3000).astype(np.float32)
    radius = 0.1
    cells = np.floor(points / (radius / 2)).astype(int)
    best = {}
    for cell, score in zip(map(tuple, cells.tolist()), scores, strict=True):
        best[cell] = max(best.get(cell, 0), score)
    around = [max(best.get((x + i, y + j, z + k), 0) for i, j, k in voting.AROUND) for x, y, z in cells.tolist()]
    found = nearly_best(points, scores, radius)
    np.testing.assert_array_equal(found, scores >= voting.NEARLY * np.array(around, np.float32))
    assert 0.01 < found.mean() < 0.5


class Warned:
    """A Progress that keeps the warnings."""

    def __init__(self):
        self.lines = []

    def warn(self, text):
        self.lines.append(text)


@pytest.mark.parametrize("points, named", [("", "random points"), ("cloud.ply", "the given points")])
def test_without_votes_the_training_starts_from_the_given_or_random_points(
    taichi, views, tmp_path, generator, points, named
):
    blank = replace(views, edge_maps=np.zeros_like(views.edge_maps))
    given = generator.random((80, 3)).astype(np.float32)
    if points:
        write_float_vertices(tmp_path / "seeds.ply", ("x", "y", "z"), given)
    source = {"reader": "emap", "path": "there", "points": points}
    config = SceneConfig(source=source, train={"seeds": "votes", "gaussians": 300})
    warned = Warned()
    gaussians = train.start_of_training(Run(config, tmp_path, progress=warned), blank, np.random.default_rng(0))
    assert len(warned.lines) == 1 and warned.lines[0].endswith(f"the training starts from {named} instead")
    assert "poses or intrinsics may not be those of these images" in warned.lines[0]
    assert len(gaussians) == (80 if points else 300)
    if points:
        np.testing.assert_allclose(gaussians.means, given, atol=1e-6)


def test_oriented_gaussians_point_along_their_directions(generator):
    directions = generator.normal(size=(50, 3))
    directions = np.concatenate([directions, [[1, 0, 0], [-1, 0, 0], [0, 1, 0]]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gaussians = orient_gaussians(np.zeros((53, 3)), directions, along=0.01, across=0.003, opacity=0.3)
    assert np.abs((gaussians.directions() * directions).sum(axis=1)).min() == pytest.approx(1.0, abs=1e-6)
    assert gaussians.scales[0] == pytest.approx([0.01, 0.003, 0.003])
    assert gaussians.opacities == pytest.approx(0.3)


def test_random_points_fill_the_box(generator):
    box = np.array([[0.0, 0.2, 0.4], [1.0, 0.4, 0.5]])
    points = random_points(1000, box, generator)
    assert (points >= box[0]).all() and (points <= box[1]).all()
    assert np.ptp(points, axis=0) == pytest.approx(box[1] - box[0], rel=0.05)
