"""Normals from the edgels around are those of the edge, at any angle, on bends and at corners."""

import numpy as np
import pytest
from edgel_scenes import edgel_errors, either_errors

from taichi_edges.detectors.smoothing import LEAST_AROUND, with_smooth_normals
from taichi_edges.views.edgels import Edgels

SIZE = 240
NOISE_PX, TURNED = 0.15, 3.0  # of detected edgels: px across the edge; degrees, of a single normal


pytestmark = pytest.mark.usefixtures("taichi")


def unit(degrees):
    """Unit vectors at angles."""
    return np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))], axis=-1)


def noisy(points, angles, generator, noise=NOISE_PX, turned=TURNED, errors="white"):
    """A view of points on edges whose normals are at `angles`, degrees: moved across, normals turned and flipped."""
    count = len(points)
    points = points + noise * edgel_errors(points, generator, errors)[:, None] * unit(angles)
    normals = unit(angles + generator.normal(0, turned, count)) * generator.choice([-1, 1], (count, 1))
    return points, normals, generator.uniform(0.2, 1, count)


def degrees_off(normals, angles):
    """(n,) degrees in -90..90 from the true angles to those of normals of either sign."""
    found = np.degrees(np.arctan2(normals[:, 1], normals[:, 0]))
    return (found - angles + 90) % 180 - 90


def straight(middle, angle, count=81):
    """Points a pixel apart on a line and the angle of its normal at each, degrees. angle: of the line."""
    return np.asarray(middle) + (np.arange(count) - count // 2)[:, None] * unit(angle), np.full(count, angle + 90.0)


@either_errors()
@pytest.mark.parametrize("angle", [0.0, 23.0, 45.0, 90.0, 137.0])
def test_normals_of_a_line(generator, angle, errors):
    views, truth = [], []
    for _ in range(8):
        points, angles = straight(generator.uniform(100, 140, 2), angle)
        views.append(noisy(points, angles, generator, errors=errors))
        truth.append(angles)
    off = degrees_off(with_smooth_normals(Edgels.of_views(views), SIZE, SIZE).normals, np.concatenate(truth))
    # Slope through 17 edgels: 0.15 px / sqrt(17^3 / 12) is 0.43 degrees; at the ends 9 to one side: 2 degrees.
    inner = np.tile(np.abs(np.arange(81) - 40) <= 32, 8)
    assert np.sqrt((off[inner] ** 2).mean()) < 0.9 and np.quantile(np.abs(off[inner]), 0.99) < 3.0
    assert np.sqrt((off**2).mean()) < 1.2 and abs(off.mean()) < 0.3


@either_errors()
def test_normals_of_a_circle_are_unbiased(generator, errors):
    angles = np.degrees(np.arange(0, 2 * np.pi, 1 / 40))
    views = [
        noisy(generator.uniform(110, 130, 2) + 40 * unit(angles), angles, generator, errors=errors) for _ in range(6)
    ]
    off = degrees_off(with_smooth_normals(Edgels.of_views(views), SIZE, SIZE).normals, np.tile(angles, 6))
    assert np.sqrt((off**2).mean()) < 1.0 and np.quantile(np.abs(off), 0.97) < 3.0
    assert abs(off.mean()) < 0.15  # 0.5 degrees each, over some 1500 that share their neighbours with 17


@either_errors()
def test_tight_bends_are_not_straightened(generator, errors):
    angles = np.degrees(np.arange(0, 2 * np.pi, 1 / 25))
    views = [
        noisy(generator.uniform(110, 130, 2) + 25 * unit(angles), angles, generator, errors=errors) for _ in range(6)
    ]
    edgels, truth = Edgels.of_views(views), np.tile(angles, 6)
    off = degrees_off(with_smooth_normals(edgels, SIZE, SIZE).normals, truth)
    assert np.sqrt((off**2).mean()) < 0.75 * np.sqrt((degrees_off(edgels.normals, truth) ** 2).mean())


@either_errors()
def test_ends_of_bends_are_no_chords(generator, errors):
    angles = np.degrees(np.arange(60) / 40)
    views = [
        noisy(generator.uniform(110, 130, 2) + 40 * unit(angles), angles, generator, 0.05, errors=errors)
        for _ in range(20)
    ]
    off = degrees_off(with_smooth_normals(Edgels.of_views(views), SIZE, SIZE).normals, np.tile(angles, 20))
    off = off.reshape(20, 60)
    assert np.abs(off[:, [0, -1]].mean(axis=0)).max() < 0.8 * np.degrees(4 / 40)  # of the chord of the last 8 px


@either_errors()
def test_corners_are_not_mixed(generator, errors):
    along, corner = np.arange(1, 41)[:, None], np.array([100.0, 100.0])
    arms = [noisy(corner + along * unit(arm), np.full(40, arm + 90.0), generator, errors=errors) for arm in (0.0, 75.0)]
    points, normals, strengths = (np.concatenate(columns) for columns in zip(*arms, strict=True))
    together = with_smooth_normals(Edgels.of_views([(points, normals, strengths)]), SIZE, SIZE).normals
    alone = [with_smooth_normals(Edgels.of_views([arm]), SIZE, SIZE).normals for arm in arms]
    np.testing.assert_allclose(together, np.concatenate(alone), atol=1e-6)  # but for the order of sums
    assert np.sqrt((degrees_off(together, np.repeat([90.0, 165.0], 40)) ** 2).mean()) < 1.8


@either_errors()
def test_parallel_edges_are_not_mixed(generator, errors):
    runs = [straight([100, 100 + 2 * k], 0.0) for k in range(3)]
    points, angles = (np.concatenate(columns) for columns in zip(*runs, strict=True))
    views = [noisy(points, angles, generator, errors=errors) for _ in range(8)]
    off = degrees_off(with_smooth_normals(Edgels.of_views(views), SIZE, SIZE).normals, np.tile(angles, 8))
    assert np.sqrt((off**2).mean()) < 1.5


def test_only_normals_change_and_keep_their_side(generator):
    views = [noisy(*straight(generator.uniform(100, 140, 2), 20.0 * k), generator) for k in range(6)]
    nothing = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    edgels = Edgels.of_views([views[0], nothing, *views[1:]])
    found = with_smooth_normals(edgels, SIZE, SIZE)
    for name in ("starts", "points", "strengths"):
        assert getattr(found, name).tobytes() == getattr(edgels, name).tobytes()
    assert found.normals.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, atol=1e-6)
    assert ((found.normals * edgels.normals).sum(axis=1) > 0).all()


def test_views_do_not_mix(generator):
    one, other = (noisy(*straight([120, 120], angle), generator) for angle in (0.0, 12.0))
    together = with_smooth_normals(Edgels.of_views([one, other]), SIZE, SIZE).normals
    apart = [with_smooth_normals(Edgels.of_views([view]), SIZE, SIZE).normals for view in (one, other)]
    np.testing.assert_array_equal(together, np.concatenate(apart))


def test_edgels_with_few_around_keep_their_normals(generator):
    points, angles = straight([100, 100], 30.0, LEAST_AROUND - 1)
    lonely = generator.uniform(0, 60, (10, 2)) // 20 * 20, generator.uniform(0, 180, 10)
    points, angles = np.concatenate([points, lonely[0]]), np.concatenate([angles, lonely[1]])
    edgels = Edgels.of_views([noisy(points, angles, generator, noise=0.0)])
    np.testing.assert_array_equal(with_smooth_normals(edgels, SIZE, SIZE).normals, edgels.normals)
    repeated = Edgels.of_views([noisy(np.full((9, 2), 50.0), np.full(9, 30.0), generator, noise=0.0, turned=0.0)])
    np.testing.assert_array_equal(with_smooth_normals(repeated, SIZE, SIZE).normals, repeated.normals)
    none = Edgels.of_views([(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))])
    assert len(with_smooth_normals(none, SIZE, SIZE)) == 0


def test_place_in_a_large_image_does_not_matter(generator):
    points, angles = straight([60.0, 60.0], 17.0)
    view = noisy(points, angles, generator)
    view[0][:] = np.round(view[0] * 1024) / 1024  # so that moving it is exact
    here = with_smooth_normals(Edgels.of_views([view]), 120, 120).normals
    # By whole cells, so that sums run in the same order.
    there = with_smooth_normals(Edgels.of_views([(view[0] + [6400, 4000], *view[1:])]), 4200, 6600).normals
    np.testing.assert_array_equal(here, there)


def test_edgels_outside_the_image_do_no_harm(generator):
    points, angles = straight([0.0, 100.0], 5.0)  # a calibration moved half of them out
    off = degrees_off(
        with_smooth_normals(Edgels.of_views([noisy(points, angles, generator)]), SIZE, SIZE).normals, angles
    )
    assert np.sqrt((off[40:] ** 2).mean()) < 1.5 and np.isfinite(off).all()
