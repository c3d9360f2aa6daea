"""The errors of synthetic edgels are what they are said to be."""

import numpy as np
import pytest
from edgel_scenes import CORRELATED, CORRELATION_PX, edgel_errors, line, views_of

COUNT, STEP_PX = 400, 0.5


def many(generator, errors, count=400):
    """(count, COUNT) errors of straight edges, STEP_PX from edgel to edgel."""
    points = np.outer(np.arange(COUNT) * STEP_PX, [0.6, 0.8])
    return np.array([edgel_errors(points, generator, errors) for _ in range(count)])


@pytest.mark.parametrize("errors", ["white", "correlated"])
def test_errors_have_unit_variance_everywhere(generator, errors):
    found = many(generator, errors)
    assert found.mean() == pytest.approx(0, abs=0.1) and found.var() == pytest.approx(1, abs=0.1)
    # Of 400 each: the variance is known to sqrt(2 / 400) = 0.07.
    np.testing.assert_allclose(found[:, [0, COUNT // 2, COUNT - 1]].var(axis=0), 1, atol=0.35)


@pytest.mark.parametrize("apart_px", [0.5, 10.0, 30.0, 60.0])
def test_correlated_errors_go_together_over_thirty_pixels(generator, apart_px):
    lag = int(apart_px / STEP_PX)
    for errors, expected in (("white", 0.0), ("correlated", CORRELATED * np.exp(-((apart_px / CORRELATION_PX) ** 2)))):
        found = many(generator, errors)
        assert (found[:, lag:] * found[:, : COUNT - lag]).mean() == pytest.approx(expected, abs=0.12)


def test_forty_pixels_count_as_one_observation(generator):
    """The mean of 200 px has the variance of 5 independent errors, a little less as there are two ends."""
    assert many(generator, "white").mean(axis=1).var() == pytest.approx(1 / COUNT, rel=0.3)
    assert many(generator, "correlated").mean(axis=1).var() == pytest.approx(1 / 5, rel=0.3)


def test_edgels_are_off_across_their_edge_by_so_many_pixels(generator):
    seed = generator.integers(1 << 30)
    curve = line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])
    exact = views_of([curve], np.random.default_rng(seed), 0.0)
    for errors in ("white", "correlated"):
        noisy = views_of([curve], np.random.default_rng(seed), 0.3, errors=errors)
        off = noisy.edgels.points - exact.edgels.points
        across = (off * exact.edgels.normals).sum(axis=1)
        np.testing.assert_allclose(off, across[:, None] * exact.edgels.normals, atol=1e-4)
        assert across.std() == pytest.approx(0.3, rel=0.2)
