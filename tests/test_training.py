"""Training follows the paper's schedule, keeps the right Gaussians, and finds the edges of a part."""

from dataclasses import replace

import numpy as np
import pytest
from paper_training import paper_training
from scipy.spatial import cKDTree

from taichi_edges.detectors.ridges import trace_ridges
from taichi_edges.errors import UserError
from taichi_edges.evidence.support import line_width
from taichi_edges.progress import Progress
from taichi_edges.scene.settings import LearningRates
from taichi_edges.seeding.starts import random_points
from taichi_edges.splatting.density import Population, cull_opacity, cull_support, duplicate
from taichi_edges.splatting.gaussians import Gaussians, logit, start_gaussians
from taichi_edges.splatting.training import Settling, Training, nearest_neighbors, rates
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.visibility import sample_edges
from taichi_edges.views.drawing import draw_edge_maps

PIXEL = 0.02  # unit-cube units, in views of 96 x 96: the cube is some 60 px wide


@pytest.fixture(scope="module")
def block(clean_block):
    """12 small views of a block, and points on its edges."""
    return clean_block(12, 96)[0], sample_edges(PARTS["block"](), 0.002).points


def numbered_population(means, opacities=None):
    """A Population in which the moments and the positional gradient of Gaussian i are 1 + i, so that it can be told."""
    count = len(means)
    numbers = 1.0 + np.arange(count, dtype=np.float32)
    gaussians = Gaussians(
        np.asarray(means, np.float32),
        np.repeat(-numbers[:, None], 3, axis=1),
        np.repeat(numbers[:, None], 4, axis=1),
        logit(np.full(count, 0.5) if opacities is None else np.asarray(opacities)).astype(np.float32),
    )
    moments = np.repeat(numbers[:, None], 11, axis=1)
    return Population(gaussians, moments, -moments, numbers)


def assert_kept(population, expected):
    """Exactly the Gaussians of these indices, each with what is its own."""
    numbers = 1.0 + np.asarray(expected)
    np.testing.assert_array_equal(population.positional_gradients, numbers)
    np.testing.assert_array_equal(population.first_moments, np.repeat(numbers[:, None], 11, axis=1))
    np.testing.assert_array_equal(population.second_moments, -population.first_moments)
    np.testing.assert_array_equal(population.gaussians.quaternions, np.repeat(numbers[:, None], 4, axis=1))


# Density control ------------------------------------------------------------------------------------------------------


def test_faint_gaussians_are_culled_with_their_moments(generator):
    opacities = np.array([0.9, 0.01, 0.06, 0.04, 0.5])
    assert_kept(cull_opacity(numbered_population(generator.random((5, 3)), opacities), 0.05), [0, 2, 4])


def test_gaussians_off_the_edges_are_culled_with_their_moments(start_taichi, block, generator):
    start_taichi("f32", 2)
    views, edges = block
    on = edges[:: len(edges) // 30]
    off = generator.random((60, 3))
    off = off[cKDTree(edges).query(off)[0] > 5 * PIXEL]
    culled = cull_support(numbered_population(np.concatenate([on, off])), views, 0.3, 0.5)
    kept = culled.positional_gradients.astype(int) - 1
    assert_kept(culled, kept)
    # Most edges are seen from half of the views and more; a stray point is on a line, 7 % of the pixels, by chance.
    assert (kept < len(on)).sum() > 0.7 * len(on)
    assert (kept >= len(on)).sum() < 0.2 * len(off)


def test_duplicates_stand_near_their_source_with_moments_of_zero(generator):
    population = numbered_population(generator.random((9, 3)))  # gradients 1..9: 6, 7, 8, 9 are above half
    doubled = duplicate(population, 0.5, 2, 0.01, 1000, generator)
    assert_kept(doubled.keep(np.arange(9)), np.arange(9))
    sources = [5, 6, 7, 8, 5, 6, 7, 8]
    copies = doubled.keep(np.arange(9, len(doubled)))
    np.testing.assert_array_equal(copies.gaussians.quaternions[:, 0], 1.0 + np.array(sources))
    np.testing.assert_array_equal(copies.gaussians.log_scales, population.gaussians.log_scales[sources])
    np.testing.assert_array_equal(copies.gaussians.opacity_logits, population.gaussians.opacity_logits[sources])
    assert not copies.first_moments.any() and not copies.second_moments.any()
    assert not copies.positional_gradients.any()
    offsets = copies.gaussians.means - population.gaussians.means[sources]
    assert (np.abs(offsets) > 0).all() and np.abs(offsets).max() < 0.06  # normal: 6 deviations
    for array in (*vars(doubled.gaussians).values(), doubled.first_moments, doubled.second_moments):
        assert array.dtype == np.float32 and len(array) == 17


@pytest.mark.parametrize("maximum, expected", [(12, 12), (9, 9), (5, 9), (1000, 17)])
def test_duplication_respects_the_maximum(generator, maximum, expected):
    population = numbered_population(generator.random((9, 3)))
    assert len(duplicate(population, 0.5, 2, 0.01, maximum, generator)) == expected


def test_duplicates_spread_with_the_given_deviation(generator):
    population = numbered_population(np.zeros((2, 3)))
    offsets = duplicate(population, 0.5, 5000, 0.01, 10**6, generator).gaussians.means[2:]
    # 15000 numbers: the error of a deviation is 1 / sqrt(2 * 15000) = 0.6 %, of which 5 are allowed.
    assert offsets.std() == pytest.approx(0.01, rel=0.03)


def test_nothing_to_duplicate(generator):
    population = numbered_population(np.zeros((0, 3)))
    assert len(duplicate(population, 0.5, 2, 0.01, 100, generator)) == 0
    population = numbered_population(generator.random((4, 3)))
    still = Population(population.gaussians, population.first_moments, population.second_moments, np.zeros(4))
    assert len(duplicate(still, 0.5, 2, 0.01, 100, generator)) == 4
    assert len(duplicate(population, 0.5, 0, 0.01, 100, generator)) == 4


# Neighbours -----------------------------------------------------------------------------------------------------------


def brute_force_distances(points, k):
    """(n, k) sorted distances to the k nearest others."""
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(distances, np.inf)
    return np.sort(distances, axis=1)[:, :k]


@pytest.mark.parametrize("count", [5, 6, 200])
def test_nearest_neighbors_are_the_nearest(generator, count):
    points = generator.random((count, 3)).astype(np.float32)
    neighbors = nearest_neighbors(points, 4)
    assert neighbors.shape == (count, 4)
    assert (neighbors != np.arange(count)[:, None]).all()
    assert all(len(set(row)) == 4 for row in neighbors)
    distances = np.linalg.norm(points[:, None] - points[neighbors], axis=2)
    np.testing.assert_allclose(np.sort(distances, axis=1), brute_force_distances(points, 4), rtol=1e-5)


def test_coinciding_points_are_neighbours_of_each_other_but_not_of_themselves(generator):
    points = np.repeat(generator.random((20, 3)), 7, axis=0)[generator.permutation(140)]
    neighbors = nearest_neighbors(points, 4)
    assert (neighbors != np.arange(140)[:, None]).all()
    assert all(len(set(row)) == 4 for row in neighbors)
    np.testing.assert_array_equal(points[neighbors], np.repeat(points[:, None], 4, axis=1))


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_last_neighbour_repeats_where_there_are_too_few(generator, count):
    points = generator.random((count, 3))
    neighbors = nearest_neighbors(points, 4)
    assert neighbors.shape == (count, 4)
    assert (neighbors != np.arange(count)[:, None]).all()
    distances = np.linalg.norm(points[:, None] - points[neighbors], axis=2)
    expected = brute_force_distances(points, count - 1)
    np.testing.assert_allclose(distances[:, : count - 1], expected, rtol=1e-12)
    repeated = np.repeat(neighbors[:, count - 2, None], 5 - count, axis=1)
    np.testing.assert_array_equal(neighbors[:, count - 1 :], repeated)


# Schedule -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "epoch, means",
    [
        (0, 1e-3),
        (9, 1e-3),
        (10, 1e-3 * 0.75),
        (29, 1e-3 * 0.75**2),
        (30, 1e-3 * 0.75**3),
        (49, 1e-3 * 0.75**4),
        (50, 1e-3 * 0.75**5),
        (60, 1e-3 * 0.75**5),  # five times, then no more
        (499, 1e-3 * 0.75**5),
    ],
)
def test_learning_rates_are_the_supplements(epoch, means):
    others = (2e-4, 1e-3, 3e-2) if epoch >= 30 else (0.0, 0.0, 0.0)  # positions only for 30 epochs
    assert rates(paper_training(), epoch / 500) == pytest.approx((means, *others))


def test_the_loss_has_settled_when_two_passes_hardly_lower_it():
    settling = Settling(range(3))
    for falling in (1.0, 0.8, 0.64):
        for view, level in enumerate((1.0, 5.0, 2.0)):  # each view is compared with itself
            assert settling.drop() == np.inf
            settling.add(view, level * falling)
    assert settling.drop() == pytest.approx(0.2)
    for falling in (0.64, 0.64):
        for view, level in enumerate((1.0, 5.0, 2.0)):
            settling.add(view, level * falling)
    assert settling.drop() == pytest.approx(0.0)


@pytest.mark.slow(reason="trains")
@pytest.mark.parametrize("settled, end", [(1.0, 60 + 3 * 12), (0.0, 240)])
def test_a_run_ends_early_only_when_nothing_more_is_scheduled(start_taichi, block, settled, end):
    density = {"duplicate_at": [], "cull_opacity_at": [0.25], "cull_support_at": [], "min_opacity": 0.0}
    config = paper_training(
        epochs=0, steps=240, gaussians=300, regularize_from=0.0, regularize_every=1000, density=density
    )
    config = config.model_copy(update={"settled": settled})
    _, _, records = train(start_taichi, block, config)
    # The cull after step 60 starts the comparison anew: the views' losses once more, then two passes.
    assert records[-1].step == end


@pytest.mark.slow(reason="trains")
@pytest.mark.parametrize("least, share_of_strays", [(0.0, None), (0.3, 0.1)])
def test_flanks_spare_established_edges_but_no_strays(
    start_taichi, block, generator, monkeypatch, least, share_of_strays
):
    """The mask is made anew after every cull by support; a Gaussian without support of its own has no say in it."""
    views, edges = block
    start_taichi("f32", 2)
    density = {
        "duplicate_at": [],
        "cull_opacity_at": [0.6],
        "cull_support_at": [0.25, 0.75],
        "min_support": 0.0,
        "reset_opacity": False,
    }
    config = paper_training(
        epochs=0, steps=24, density=density, flanks_from=0.5, established_support=least, regularize_from=1.0
    )
    rates = {"means": 0.0, "scales": 0.0, "opacities": 0.0, "quaternions": 0.0}
    config = config.model_copy(update={"learning_rates": LearningRates(**rates)})
    off = generator.random((200, 3))
    off = off[cKDTree(edges).query(off)[0] > 5 * PIXEL]
    on = edges[:: len(edges) // 200]
    training = Training(views, config, generator, threads=2)
    given, take_in = [], training.splatter.take_in_flanks
    monkeypatch.setattr(training.splatter, "take_in_flanks", lambda points: (given.append(points), take_in(points)))
    training.run(start_gaussians(np.concatenate([on, off]), generator, 0.01, 0.5), Progress())
    assert sorted(step for step, actions in training.actions.items() if training.take_in_flanks in actions) == [12, 18]
    for points in given:
        strays = (cKDTree(edges).query(points)[0] > 4 * PIXEL).sum() if len(points) else 0
        assert len(points) == 0 if share_of_strays is None else len(points) > 0.5 * len(on)
        assert strays <= (share_of_strays or 0) * len(off)
    assert len(given) == 2


@pytest.mark.slow(reason="trains")
def test_no_end_before_the_regularizers_have_begun(start_taichi, block):
    density = {"duplicate_at": [], "cull_opacity_at": [], "cull_support_at": []}
    config = paper_training(epochs=0, steps=120, settled=1.0, gaussians=300, regularize_from=0.75, density=density)
    _, _, records = train(start_taichi, block, config)
    assert records[-1].step == 90


def test_maps_without_any_edge_pixel_are_refused(start_taichi, block):
    views = replace(block[0], edge_maps=np.zeros_like(block[0].edge_maps))
    with pytest.raises(UserError, match="none of the 12 edge maps has an edge pixel"):
        train(start_taichi, (views, None), paper_training(gaussians=300))


@pytest.mark.slow(reason="trains")
@pytest.mark.parametrize("loss, visited", [("balanced", 7), ("whole_image", 12)])
def test_an_epoch_is_one_pass_over_the_views_that_say_something(start_taichi, block, loss, visited):
    edge_maps = block[0].edge_maps.copy()
    edge_maps[7:] = 0
    config = paper_training(epochs=3, gaussians=300, loss=loss, density={"duplicate_at": []})
    _, _, records = train(start_taichi, (replace(block[0], edge_maps=edge_maps), None), config)
    assert records[-1].step == 3 * visited


@pytest.mark.slow(reason="trains")
@pytest.mark.parametrize("steps, total", [(5, 12), (30, 30)])
def test_every_view_is_seen_at_least_once(start_taichi, block, steps, total):
    config = paper_training(epochs=0, steps=steps, gaussians=300, density={"duplicate_at": []})
    _, _, records = train(start_taichi, block, config)
    assert records[-1].step == total


# End to end -----------------------------------------------------------------------------------------------------------


def train(start_taichi, block, config):
    """One run on the block, from random points."""
    views, _ = block
    start_taichi("f32", 2)
    generator = np.random.default_rng(0)
    points = random_points(config.gaussians, views.box, generator)
    start = start_gaussians(points, generator, config.initial_scale, config.initial_opacity)
    return start, *Training(views, config, generator, threads=2).run(start, Progress())


@pytest.mark.slow(reason="trains")
def test_training_finds_the_edges_of_a_block(start_taichi, block):
    """A short schedule with everything in it: positions alone, duplication, culls, regularisers."""
    density = {"duplicate_at": [0.4, 0.55], "cull_opacity_at": [0.75], "cull_support_at": [0.7]}
    config = paper_training(
        epochs=65,
        gaussians=300,
        initial_scale=0.01,
        only_means=0.15,
        regularize_from=0.85,
        density=density,
    )
    start, trained, records = train(start_taichi, block, config)
    assert [record.step for record in records] == [*range(50, 65 * 12, 50), 65 * 12]
    assert records[-1].gaussians == len(trained)
    assert records[7].gaussians > 300
    assert records[-1].loss < 0.5 * records[0].loss
    tree = cKDTree(block[1])
    opaque = trained.opacities > 0.5
    assert opaque.sum() > 50
    assert (tree.query(start.means)[0] < PIXEL).mean() < 0.05
    assert (tree.query(trained.means[opaque])[0] < PIXEL).mean() > 0.5
    for array in vars(trained).values():
        assert np.isfinite(array).all()


@pytest.mark.slow(reason="trains")
def test_flanks_bring_the_centres_onto_the_lines(start_taichi, block):
    """From starts beside the edges, with rates at which a Gaussian can shrink within the run."""
    views, edges = block
    views, medians = replace(views, edge_maps=redrawn(views)), []
    fast = {"means_decay": 0.84, "means_decay_every": 0.05, "means_decays": 20, "only_means": 0.1}
    rates = {"means": 2e-3, "scales": 5e-3, "opacities": 3e-2, "quaternions": 5e-3}
    density = {"duplicate_at": [], "cull_opacity_at": [], "cull_support_at": []}
    for share in (1.0, 0.5):
        start_taichi("f32", 2)
        generator = np.random.default_rng(1)
        beside = edges[generator.choice(len(edges), 600)] + generator.normal(size=(600, 3)) * PIXEL
        config = paper_training(epochs=0, steps=240, density=density, flanks_from=share, learning_rates=rates, **fast)
        training = Training(views, config, generator, threads=2)
        trained, _ = training.run(start_gaussians(beside, generator, 0.01, 0.3), Progress())
        assert (trained.opacities > 0.2).sum() > 500
        medians.append(np.median(cKDTree(edges).query(trained.means[trained.opacities > 0.2])[0]))
    assert medians[1] < 0.9 * medians[0] < 0.1 * PIXEL


def redrawn(views):
    """The edge maps of some views, drawn as lines of one width through their ridges."""
    edgels = trace_ridges(views.edge_maps, line_width(views, 0.5)[0], 0.3)
    return draw_edge_maps(edgels, views.height, views.width)


@pytest.mark.slow(reason="trains")
def test_the_same_seed_trains_the_same_gaussians(start_taichi, block):
    density = {"duplicate_at": [0.5], "cull_opacity_at": [], "cull_support_at": [0.75]}
    schedule = {"only_means": 0.4, "regularize_from": 0.6, "regularize_every": 3, "flanks_from": 0.5}
    config = paper_training(epochs=8, gaussians=1500, density=density, established_support=0.1, **schedule)
    runs = [train(start_taichi, block, config) for _ in range(2)]
    for one, other in zip(vars(runs[0][1]).values(), vars(runs[1][1]).values(), strict=True):
        assert one.tobytes() == other.tobytes()
