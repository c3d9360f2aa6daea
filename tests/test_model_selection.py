"""Which shape a stretch of edge is: by BIC, in units of the noise, however densely it was sampled."""

from dataclasses import replace

import numpy as np
import pytest
from placed_shapes import KINDS, PLANE, Placing, any_shape
from scipy.spatial import cKDTree

from taichi_edges.fitting.distances import distances_to
from taichi_edges.fitting.model_selection import Track, Yardstick, best_shape, misfit, observations, track_of
from taichi_edges.fitting.prices import OUTLIER, price_of
from taichi_edges.geometry.shapes import EllipticArc, Line, Spline

NOISE, PIXEL, STRETCH, SPACING = (
    1e-3,
    0.0025,
    0.01,
    0.0025,
)  # unit-cube units, about those of a scene of 800 x 800 pixels
YARDSTICK = Yardstick(NOISE, PIXEL)
SEEDS = range(3)


def noisy(track, generator, noise=NOISE):
    """The Track, its places off by `noise` across in each direction; errors go together over a stretch."""
    stretches = (track.arc // STRETCH).astype(int)
    offsets = generator.normal(0, noise, (stretches.max() + 1, 3))[stretches]
    return replace(track, points=track.points + offsets)


def chosen(track):
    """The best shape of a Track, and its cost."""
    return best_shape(track, YARDSTICK, observations(track.share, YARDSTICK))


def bow(sagitta, length=0.3):
    """An arc of a given length whose middle is `sagitta` off its chord: 8 sagitta = length^2 / radius."""
    radius = length**2 / 8 / sagitta
    half = length / radius / 2
    return EllipticArc(np.zeros(3), radius * np.eye(3)[:2], -half, half)


def anywhere(shape, generator):
    """A shape turned and moved at random, its size kept."""
    return shape.transformed(Placing(generator, scale=1.0))


# --------------------------------------------------------------------------------------------------------- distances


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("reach", [0.002, 0.05])
def test_distance_is_that_to_the_nearest_of_many_places(generator, kind, reach):
    shape = any_shape(kind, generator)
    dense = shape.at(np.linspace(0, 1, 5001))
    points = dense[generator.integers(0, len(dense), 200)] + generator.normal(0, reach, (200, 3))
    slow = cKDTree(dense).query(points)[0]
    found = distances_to(shape, points)
    # Dense places are up to one and a half mean steps apart, or cubics' three; chords of a chain lie inside its bends.
    slack = 2 * shape.length / 5000 + (0.002 * shape.length if shape.kind == "spline" else 0.0)
    assert (found - slow).min() > -slack
    if shape.kind == "elliptic_arc":  # the far side of the ellipse, which is not there, may be nearer
        near = slow < shape.radii[1] ** 2 / shape.radii[0]
        found, slow = found[near], slow[near]
    assert (found - slow).max(initial=0.0) < slack


@pytest.mark.parametrize("flatness", [0.05, 0.3, 0.9, 1.0 - 1e-5])
def test_distance_to_an_ellipse_far_from_it_and_near_its_centre(generator, flatness):
    ellipse = anywhere(EllipticArc(np.zeros(3), 0.2 * np.diag([1.0, flatness, 0.0])[:2], 0.0, 2 * np.pi), generator)
    points = ellipse.centre + generator.uniform(-0.4, 0.4, (500, 3))
    dense = ellipse.at(np.linspace(0, 1, 5001))
    slow = cKDTree(dense).query(points)[0]
    np.testing.assert_allclose(distances_to(ellipse, points), slow, atol=2e-4)


def test_point_beyond_an_end_is_as_far_as_the_end(generator):
    for kind in ("line", "arc", "long_arc"):
        shape = any_shape(kind, generator)
        beyond = shape.ends + 0.01 * np.array([[-1.0], [1.0]]) * shape.tangents(np.array([0.0, 1.0]))
        np.testing.assert_allclose(distances_to(shape, beyond), 0.01, rtol=1e-9)


# ------------------------------------------------------------------------------------------------------------ misfit


def test_misfit_is_one_for_each_observation_that_is_off_by_the_noise():
    share = np.full(100, 0.003)
    assert misfit(np.full(100, NOISE), share, YARDSTICK) == pytest.approx(0.3 / STRETCH)
    assert misfit(np.full(100, 100 * NOISE), share, YARDSTICK) == pytest.approx(OUTLIER * 0.3 / STRETCH)


@pytest.mark.parametrize("kind", ["line", "arc", "spline"])
def test_cost_does_not_depend_on_how_densely_an_edge_is_sampled(generator, kind):
    shape = any_shape(kind, generator)
    across = np.cross(shape.tangents(0.5), generator.normal(size=3))
    moved = shape.transformed(lambda points: points + 1.5 * NOISE * across / np.linalg.norm(across))
    costs = []
    for spacing in (SPACING, SPACING / 3, SPACING / 10):
        track = track_of(shape, spacing)
        costs.append(misfit(distances_to(moved, track.points), track.share, YARDSTICK))
        assert observations(track.share, YARDSTICK) == pytest.approx(max(shape.length / STRETCH, np.e), rel=1e-3)
    assert costs[0] == pytest.approx(costs[2], rel=0.03) and costs[1] == pytest.approx(costs[2], rel=0.03)


def test_few_places_are_an_observation_with_a_price():
    assert np.log(observations(np.array([1e-6]), YARDSTICK)) == 1.0


def test_longer_chains_cost_more():
    cubics = np.zeros((4, 4, 3))
    prices = [price_of(Spline(cubics[:count])) for count in (1, 2, 3, 4)]
    assert prices == sorted(set(prices))
    assert price_of(bow(0.01)) < price_of(Spline(cubics[:1]))


# ----------------------------------------------------------------------------------------------------------- choices


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("angle", [0.0, 1.0, 2.0, 4.0, 2 * np.pi])
def test_true_shape_is_chosen(generator, angle, seed):
    low, axes = generator.uniform(-4, 4), generator.uniform(0.1, 0.2) * PLANE
    true = EllipticArc(np.zeros(3), axes, low, low + angle) if angle else Line(generator.uniform(0.1, 0.3) * PLANE)
    true = anywhere(true, generator)
    found, cost = chosen(noisy(track_of(true, SPACING), generator, 0.5 * NOISE))
    assert found.kind == true.kind
    t = np.linspace(0.02, 0.98, 50)
    # Errors of the mean of length / STRETCH observations, of a few parameters: three of them stay below 2 noises.
    assert distances_to(true, found.at(t)).max() < 2 * NOISE
    assert found.length == pytest.approx(true.length, abs=0.02 * true.length + 4 * NOISE)
    assert cost < price_of(true) * np.log(max(true.length / STRETCH, np.e)) + 3 * true.length / STRETCH


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("noises", "kind"), [(0.3, "line"), (8.0, "arc")])
def test_bend_counts_where_it_exceeds_the_noise(generator, noises, kind, seed):
    shape = anywhere(bow(noises * NOISE), generator)
    assert chosen(noisy(track_of(shape, SPACING), generator, 0.5 * NOISE))[0].kind == kind


def test_same_places_are_a_line_for_a_coarse_yardstick_and_an_arc_for_a_fine_one(generator):
    track = track_of(anywhere(bow(5 * NOISE), generator), SPACING)
    kinds = [best_shape(track, Yardstick(noise, PIXEL), 30)[0].kind for noise in (10 * NOISE, NOISE)]
    assert kinds == ["line", "arc"]


@pytest.mark.parametrize("seed", SEEDS)
def test_wave_is_a_spline(generator, seed):
    t = np.linspace(0, 1, 200)
    wave = Placing(generator, 1.0)(np.stack([0.4 * t, 0.03 * np.sin(2 * np.pi * t), 0.02 * t**2], axis=1))
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(wave, axis=0), axis=1))])
    track = Track(wave, arc, np.full(200, arc[-1] / 200))
    found, _ = chosen(noisy(track, generator, 0.5 * NOISE))
    # The outermost places say where the ends are, and they are off by a noise or two themselves.
    assert found.kind == "spline" and distances_to(found, wave[10:-10]).max() < 3 * NOISE


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("round", "kind"), [(2 * np.pi, "ellipse"), (3.0, "elliptic_arc")])
def test_flat_circle_is_an_ellipse(generator, round, kind, seed):
    low = generator.uniform(-3, 3) if kind == "ellipse" else generator.uniform(-0.5, 0.5) - 1.5
    true = anywhere(EllipticArc(np.zeros(3), np.diag([0.2, 0.12, 0])[:2], low, low + round), generator)
    found, _ = chosen(noisy(track_of(true, SPACING), generator, 0.3 * NOISE))
    assert found.kind == kind and distances_to(true, found.at(np.linspace(0, 1, 50))).max() < 2 * NOISE
    assert found.length == pytest.approx(true.length, rel=0.02)


@pytest.mark.parametrize("kind", ["line", "arc", "elliptic_arc"])
def test_shape_runs_the_way_its_track_does(generator, kind):
    track = track_of(any_shape(kind, generator), SPACING)
    for points in (track.points, track.points[::-1]):
        found, _ = chosen(replace(track, points=points))
        assert np.linalg.norm(found.ends - points[[0, -1]], axis=1).max() < SPACING


def test_nothing_is_cheaper_than_nothing():
    track = track_of(Line(np.array([[0.2, 0.2, 0.2], [0.5, 0.5, 0.2]])), SPACING)
    assert best_shape(track, YARDSTICK, 100, worth=1.0) == (None, np.inf)


def test_outliers_do_not_bend_a_line(generator):
    true = any_shape("line", generator)
    true = Line(true.at(np.array([0.0, 0.3 / true.length])))
    track = track_of(true, SPACING)
    points = track.points.copy()
    points[40:46] += 10 * NOISE
    found, _ = chosen(replace(track, points=points))
    assert found.kind == "line" and distances_to(found, true.at(np.linspace(0.05, 0.95, 9))).max() < NOISE


@pytest.mark.parametrize("count", [3, 4, 6])
def test_few_places_in_a_row_are_a_line(generator, count):
    found, _ = chosen(track_of(Line(generator.uniform(0.4, 0.6, (2, 3))), 1.0 / count))
    assert found.kind == "line"


# ------------------------------------------------------------------------------------------------------------ tracks


@pytest.mark.parametrize("kind", KINDS)
def test_track_is_even_and_covers_the_shape(generator, kind):
    shape = any_shape(kind, generator)
    track = track_of(shape, SPACING)
    steps = np.linalg.norm(np.diff(track.points, axis=0), axis=1)
    # Chords of SPACING are shorter than their arcs by (SPACING / radius)^2 / 24, radius 0.005 at least in ellipses.
    assert steps.max() <= SPACING * 1.001 and steps.min() > 0.9 * steps.max()
    assert track.share.sum() == pytest.approx(shape.length, rel=0.005)
    assert track.arc[0] == pytest.approx(0.5 * track.share[0]) and (np.diff(track.arc) > 0).all()
    assert distances_to(shape, track.points).max() < 1e-3 * shape.length
    assert track.closed == shape.closed and track.ordering.arc[0] == 0


def test_track_of_a_short_shape_has_places_enough_for_every_fit():
    track = track_of(Line(np.array([[0.0, 0, 0], [0, 0, 1e-5]])), SPACING)
    assert len(track.points) >= 6 and chosen(track)[0].kind == "line"


@pytest.mark.parametrize("kind", ["line", "arc", "elliptic_arc", "snake"])
def test_fit_reaches_to_the_ends_of_its_track(generator, kind):
    """The outermost places are the middles of what they stand for: half a step is easily lost, on every round."""
    snake = Spline(np.array([[[0, 0, 0], [0.1, 0.04, 0], [0.2, -0.04, 0], [0.3, 0, 0.01]]]))
    shapes = [anywhere(snake, generator)] if kind == "snake" else [any_shape(kind, generator) for _ in range(20)]
    fits = [(shape, chosen(track_of(shape, SPACING))[0]) for shape in shapes]
    shape, found = next(pair for pair in fits if pair[0].kind == pair[1].kind)  # a slight bend may pass for a line
    beyond = ((found.ends - shape.ends) * shape.tangents(np.array([0.0, 1.0]))).sum(axis=1)
    # A chain of cubics that is parametrised anew a few times only still slides along itself.
    assert np.abs(beyond).max() < (0.3 if kind == "snake" else 0.1) * SPACING
