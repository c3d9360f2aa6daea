"""Forking clusters become chains; chains are cut where straight meets curved. With the slow twins of the costs."""

import numpy as np
import pytest

from taichi_edges.strokes import segmentation
from taichi_edges.strokes.branches import separate_branches
from taichi_edges.strokes.segmentation import (
    MIN_NOISE,
    MIN_STRETCH,
    NOISE_WINDOW,
    OUTLIER,
    PRICES,
    STATIONS,
    cut_chain,
    local_noise,
    split_clusters,
    stretch_costs,
)

NOISE = 1e-3


def noisy(points, seed):
    return points + np.random.default_rng(seed).normal(scale=NOISE, size=points.shape)


def arc(radius, start, end, count):
    angle = np.linspace(start, end, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)


def line(start, end, count):
    return np.linspace(start, end, count)


@pytest.mark.parametrize("seed", range(3))
def test_a_tangent_line_and_its_circle_are_separated(seed):
    rim = arc(0.2, -1.2, 1.2, 100)
    tangent = line([0.2, 0.0, 0.0], [0.2, 0.4, 0.0], 60)[5:]
    points = noisy(np.concatenate([rim, tangent]), seed)
    labels = separate_branches(points, np.zeros(len(points), int), 8)
    upper_rim, far_tangent = slice(75, 100), slice(120, 155)
    assert len(set(labels[upper_rim]) - {-1}) == 1 and len(set(labels[far_tangent]) - {-1}) == 1
    assert labels[90] != labels[140]


@pytest.mark.parametrize("seed", range(3))
def test_chains_and_loops_are_left_whole(seed):
    for points in (arc(0.2, 0, 2 * np.pi, 150)[:-1], line([0, 0, 0], [0.5, 0.1, 0], 60), arc(0.3, 0, 2, 80)):
        labels = separate_branches(noisy(points, seed), np.zeros(len(points), int), 8)
        assert (labels == 0).mean() > 0.98


def test_small_branches_are_unassigned_and_numbers_are_consecutive():
    trunk = line([0, 0, 0], [0.5, 0, 0], 80)
    twig = line([0.25, 0.01, 0], [0.25, 0.06, 0], 5)
    other = line([0, 0.5, 0], [0.5, 0.5, 0], 40)
    points = noisy(np.concatenate([trunk, twig, other]), 0)
    labels = separate_branches(points, np.array([0] * 85 + [1] * 40), 10)
    assert set(labels[82:85]) == {-1}
    assert set(labels) == {-1, 0, 1}


@pytest.mark.parametrize("seed", range(3))
def test_a_filleted_corner_becomes_line_arc_line(seed):
    first = line([-0.3, -0.1, 0], [0, -0.1, 0], 60)
    bend = arc(0.1, -np.pi / 2, 0, 40)
    last = line([0.1, 0, 0], [0.1, 0.3, 0], 60)
    points = noisy(np.concatenate([first, bend[1:], last[1:]]), seed)
    labels = split_clusters(points, np.zeros(len(points), int), 8)
    assert len(set(labels)) == 3
    assert len({labels[20], labels[78], labels[130]}) == 3
    # Each point carries about 5 mm of edge; the cuts are at most a station (5 points) and the sagitta's 3 points off.
    for kind, truth in ((20, slice(0, 60)), (78, slice(60, 99)), (130, slice(99, 158))):
        assert (labels[truth] == labels[kind]).mean() > 0.75


@pytest.mark.parametrize("seed", range(3))
def test_smooth_curves_and_lines_are_not_cut(seed):
    for points in (arc(0.2, 0, 2 * np.pi, 150)[:-1], arc(0.3, 0, 2, 80), line([0, 0, 0], [0.7, 0.2, 0.1], 90)):
        labels = split_clusters(noisy(points, seed), np.zeros(len(points), int), 10)
        assert set(labels) == {0}


def test_unassigned_points_stay_so():
    points = noisy(line([0, 0, 0], [0.5, 0, 0], 40), 1)
    labels = np.array([-1] * 10 + [0] * 30)
    assert (split_clusters(points, labels, 8)[:10] == -1).all()
    assert (separate_branches(points, labels, 8)[:10] == -1).all()


# ------------------------------------------------------------------------------------------------------- slow twins


def capped_cost(residuals, directions, noise):
    """Sum of squared residuals across the unit directions, in units of the noise, each at most OUTLIER."""
    across = residuals - (residuals * directions).sum(axis=1, keepdims=True) * directions
    return np.minimum((across**2).sum(axis=1) / noise**2, OUTLIER).sum()


def slow_costs(stretch, noise):
    """What `stretch_costs` says of one stretch: by singular vectors and by least squares in Legendre polynomials."""
    if len(stretch) < MIN_STRETCH:
        return 0.0, 0.0
    centred = stretch - stretch.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    parameter = np.linspace(-1, 1, len(stretch))
    cubic = [np.polynomial.Legendre.fit(parameter, stretch[:, axis], 3, domain=[-1, 1]) for axis in range(3)]
    residuals = stretch - np.stack([axis(parameter) for axis in cubic], axis=1)
    slopes = np.stack([axis.deriv()(parameter) for axis in cubic], axis=1)
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
    return capped_cost(centred, direction, noise), capped_cost(residuals, slopes, noise)


def slow_noise(chain):
    window = min(NOISE_WINDOW, len(chain))
    scatter = []
    for start in range(0, len(chain) - window + 1, max(window // 2, 1)):
        part = chain[start : start + window]
        direction = np.linalg.svd(part - part.mean(axis=0), full_matrices=False)[2][0]
        parameter = np.linspace(-1, 1, window)
        residuals = part - np.stack([np.polyval(np.polyfit(parameter, x, 2), parameter) for x in part.T], axis=1)
        across = residuals - (residuals @ direction)[:, None] * direction
        scatter.append((across**2).sum() / (2 * max(window - 3, 1)))
    return np.sqrt(np.median(scatter))


def slow_cuts(chain):
    """`cut_chain` by trying every predecessor of every station in turn."""
    noise, price = max(slow_noise(chain), MIN_NOISE), np.log(len(chain))
    stations = np.unique(np.linspace(0, len(chain), min(STATIONS, len(chain) // MIN_STRETCH) + 1).round().astype(int))
    best = [(0.0, [0], [])]  # cost, bounds and kinds of the cheapest way to each station
    for end in stations[1:]:
        ways = []
        for (cost, bounds, kinds), start in zip(best, stations, strict=False):
            line, curve = slow_costs(chain[start:end], noise)
            ways.append((cost + line + PRICES["line"] * price, [*bounds, end], [*kinds, False]))
            ways.append((cost + curve + PRICES["arc"] * price, [*bounds, end], [*kinds, True]))
        best.append(min(ways, key=lambda way: way[0]))
    return best[-1][1:]


def rough_chain(generator, count):
    """Ordered points along a random smooth walk, unevenly spaced, with noise and some outliers."""
    steps = np.cumsum(generator.normal(0, 0.1, (count, 3)), axis=0) + [1, 0, 0]
    chain = 5.0 + 0.01 * np.cumsum(steps * generator.uniform(0.5, 1.5, (count, 1)), axis=0)
    chain += generator.normal(0, NOISE, chain.shape)
    chain[generator.random(count) < 0.05] += 20 * NOISE
    return chain


@pytest.mark.slow(reason="has a slow twin")
@pytest.mark.parametrize("block", [1, 100, 1 << 13])
def test_costs_of_all_stretches_match_those_of_one_at_a_time(generator, monkeypatch, block):
    monkeypatch.setattr(segmentation, "BLOCK", block)
    chain = rough_chain(generator, 60)
    ends, starts = np.tril_indices(61, -1)
    expected = np.array([slow_costs(chain[a:b], NOISE) for a, b in zip(starts, ends, strict=True)])
    # Sums of at most 60 terms up to 9, from points of the size 5 known to 1e-15: squares of residuals to 1e-14 / 1e-6.
    np.testing.assert_allclose(np.stack(stretch_costs(chain, starts, ends, NOISE), axis=1), expected, atol=1e-6)


def test_points_all_in_one_place_cost_nothing():
    starts, ends = np.array([0, 2]), np.array([8, 12])
    np.testing.assert_array_equal(stretch_costs(np.full((12, 3), 0.3), starts, ends, NOISE), np.zeros((2, 2)))


@pytest.mark.parametrize("count", [3, 10, 57, 200])
def test_local_noise_matches_window_after_window(generator, count):
    chain = rough_chain(generator, count)
    assert local_noise(chain) == pytest.approx(slow_noise(chain), rel=1e-6)


@pytest.mark.parametrize("count", [12, 55, 170])
def test_cuts_are_the_cheapest_ones(generator, count):
    chain = rough_chain(generator, count)
    bounds, curved = cut_chain(chain)
    assert (bounds, curved) == slow_cuts(chain)
