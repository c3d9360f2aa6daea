"""Chains of edgels are as long as the edges in a view, end where these turn, and leave texture in pieces."""

import numpy as np
import pytest
from edgel_scenes import edgel_errors, either_errors

from taichi_edges.detectors.chains import SURE_PX, chain_labels, chain_lengths, with_chain_strengths
from taichi_edges.views.edgels import Edgels

SIZE = 200
NOISE_PX = 0.1  # across; a step to the side that would end a chain is five times what two such edgels differ by


def kept_of(edgels, least):
    """The Edgels on chains of at least `least`, with their chain's say."""
    found, lengths = with_chain_strengths(edgels, SIZE, SIZE)
    return found.keep(lengths >= least)


def run_of(start, angle, count, noise=0.0, generator=None, errors="white"):
    """Points (n, 2) a pixel apart on a straight line, and their normals (n, 2). angle: degrees, of the line."""
    along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    normal = np.array([-along[1], along[0]])
    points = np.asarray(start, float) + np.arange(count)[:, None] * along
    if noise:
        points = points + noise * edgel_errors(points, generator, errors)[:, None] * normal
    return points, np.tile(normal, (count, 1))


def view_of(*runs, strength=0.5):
    """Points, normals and strengths of runs in one view."""
    points, normals = (np.concatenate([np.zeros((0, 2)), *columns]) for columns in zip(*runs, strict=True))
    return points, normals, np.full(len(points), strength)


NOTHING = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)


@either_errors()
def test_a_chain_is_as_long_as_its_edge(generator, errors):
    runs = (
        run_of([20, 20], 0, 60, NOISE_PX, generator, errors=errors),
        run_of([20, 60], 37, 25, NOISE_PX, generator, errors=errors),
    )
    edgels = Edgels.of_views([view_of(*runs), NOTHING, view_of(runs[1])])
    assert chain_lengths(edgels).tolist() == [60] * 60 + [25] * 25 + [25] * 25
    labels = chain_labels(edgels)
    assert [len(set(labels[part])) for part in (slice(60), slice(60, 85), slice(85, 110))] == [1, 1, 1]
    assert len(set(labels)) == 3  # those of another view are others


def test_sign_of_normals_says_nothing(generator):
    points, normals = run_of([20, 20], 30, 50)
    signs = generator.choice([-1, 1], (50, 1))
    assert set(chain_lengths(Edgels.of_views([view_of((points, signs * normals))]))) == {50}


def test_chains_end_at_corners():
    arm = run_of([50, 50], 0, 40), run_of([50, 51], 90, 30)
    assert sorted(set(chain_lengths(Edgels.of_views([view_of(*arm)])))) == [30, 40]


def test_chains_follow_curves():
    angles = np.arange(0, 2 * np.pi, 1 / 20)  # a radius of 20 px turns by 3 degrees from one to the next
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    edgels = Edgels.of_views([(100 + 20 * normals, normals, np.ones(len(angles)))])
    assert set(chain_lengths(edgels)) == {len(angles)}


def test_edges_beside_each_other_are_two():
    edgels = Edgels.of_views([view_of(run_of([20, 20], 10, 50), run_of([20, 21.2], 10, 40))])
    assert sorted(set(chain_lengths(edgels))) == [40, 50]


def test_gaps_end_chains():
    edgels = Edgels.of_views([view_of(run_of([20, 20], 0, 30), run_of([52, 20], 0, 20))])
    assert sorted(set(chain_lengths(edgels))) == [20, 30]


def test_texture_is_short(generator):
    count = 4000  # a tenth of all pixels, in any direction
    angles = generator.uniform(0, np.pi, count)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    texture = generator.uniform(0, SIZE, (count, 2)), normals, np.ones(count)
    assert np.quantile(chain_lengths(Edgels.of_views([texture])), 0.95) < 12


def test_no_edgels():
    for views in ([], [NOTHING], [NOTHING, NOTHING]):
        assert chain_labels(Edgels.of_views(views)).shape == chain_lengths(Edgels.of_views(views)).shape == (0,)


@either_errors()
def test_long_chains_are_kept_in_order_and_are_surer(taichi, generator, errors):
    long, short = (
        run_of([20, 20], 20, 60, NOISE_PX, generator, errors=errors),
        run_of([20, 120], 0, 8, NOISE_PX, generator, errors=errors),
    )
    points, normals, strengths = view_of(long, short, strength=0.3)
    shuffled = generator.permutation(len(points))
    first = points[shuffled], normals[shuffled], strengths[shuffled]
    edgels = Edgels.of_views([first, NOTHING, view_of(short), view_of(long, strength=0.6)])
    found = kept_of(edgels, 12)
    chosen = np.concatenate([shuffled < 60, np.zeros(8, bool), np.ones(60, bool)])
    np.testing.assert_array_equal(found.points, edgels.points[chosen])
    assert found.starts.tolist() == [0, 60, 60, 60, 120]
    expected = 1 - (1 - edgels.strengths[chosen]) ** (60 / SURE_PX)
    np.testing.assert_allclose(found.strengths, expected, rtol=1e-5)
    assert (found.strengths > edgels.strengths[chosen]).all() and found.strengths.max() <= 1
    truth = np.array([-np.sin(np.radians(20)), np.cos(np.radians(20))])
    assert np.abs(found.normals @ truth).min() > np.cos(np.radians(3))


def test_edgels_of_short_chains_are_no_less_sure_than_they_were(taichi):
    edgels = Edgels.of_views([view_of(run_of([20, 20], 0, 3), strength=0.4)])
    np.testing.assert_allclose(kept_of(edgels, 0).strengths, 0.4, rtol=1e-6)


def test_nothing_is_left_of_nothing_and_of_texture(taichi):
    for views in ([NOTHING], [NOTHING, view_of(run_of([20, 20], 0, 5))]):
        found = kept_of(Edgels.of_views(views), 12)
        assert len(found) == 0 and found.view_count == len(views)


@pytest.mark.slow(reason="starts Taichi anew")
def test_chains_are_the_same_whichever_threads_and_run(start_taichi, generator):
    runs = [
        run_of(generator.uniform(20, 150, 2), generator.uniform(0, 180), 40, NOISE_PX, generator) for _ in range(20)
    ]
    edgels, found = Edgels.of_views([view_of(*runs), view_of(*runs[:5])]), []
    for threads in (2, 2, 1):
        start_taichi("f32", threads)
        kept = kept_of(edgels, 12)
        found.append(kept.points.tobytes() + kept.normals.tobytes() + kept.strengths.tobytes())
    assert found[0] and found[0] == found[1] == found[2]
