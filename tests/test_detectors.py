"""Thinning of edge maps: ridges are found where the lines are, whatever their width."""

import numpy as np
import pytest

from taichi_edges.detectors.ridges import gaussian_derivatives, ridge_points, trace_ridges
from taichi_edges.evidence.support import line_width
from taichi_edges.views.drawing import DRAWN_SIGMA, PATCH, draw_edge_maps, draw_lines
from taichi_edges.views.views import Views

SIZE = 120


def thinned(edge_maps, width_px, threshold, threads=None):
    """The edge maps redrawn through their ridges."""
    edgels = trace_ridges(edge_maps, width_px, threshold, threads)
    return draw_edge_maps(edgels, *edge_maps.shape[1:], threads)


def line_map(angle, width, centre=(60.3, 59.8), height=255):
    """Edge map of one straight line with a Gaussian profile of FWHM `width` px; also its unit normal."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    normal = np.array([-np.sin(angle), np.cos(angle)])
    distance = (columns - centre[0]) * normal[0] + (rows - centre[1]) * normal[1]
    return np.rint(height * np.exp(-0.5 * (distance / (width / 2.355)) ** 2)).astype(np.uint8), normal


def views_of(edge_maps):
    """Views with the camera two units in front of the unit cube's middle, looking along z."""
    count = len(edge_maps)
    intrinsics = np.tile([[100.0, 0, SIZE / 2], [0, 100.0, SIZE / 2], [0, 0, 1]], (count, 1, 1))
    pose = np.concatenate([np.eye(3), [[-0.5], [-0.5], [1.5]]], axis=1)
    names = tuple(str(i) for i in range(count))
    return Views(names, np.stack(edge_maps), intrinsics, np.tile(pose, (count, 1, 1)), ("",) * count)


@pytest.mark.parametrize("width", [2.4, 5.0, 8.0])
@pytest.mark.parametrize("angle", [0.0, 0.35, 0.8, 1.5])
def test_ridge_lies_on_the_line_to_a_seventh_of_a_pixel(angle, width):
    edge_map, normal = line_map(angle, width)
    points, normals, values = ridge_points(edge_map, max(0.8, 0.29 * width), 0.3)
    inner = ((points > 15) & (points < SIZE - 16)).all(axis=1)  # the image's border cuts the line's ends
    assert inner.sum() > 50
    assert np.abs((points[inner] - [60.3, 59.8]) @ normal).max() < 0.15
    assert np.abs(np.abs(normals[inner] @ normal) - 1).max() < 0.02
    assert values[inner].min() > 0.3


def test_derivatives_of_a_quadratic_are_exact():
    rows, columns = np.mgrid[:40, :50].astype(np.float32)
    image = 0.5 + 0.02 * columns - 0.01 * rows + 0.003 * columns**2 - 0.002 * columns * rows + 0.001 * rows**2
    gx, gy, gxx, gxy, gyy = (d[20, 25] for d in gaussian_derivatives(image, 1.5))
    # Correlation with symmetric kernels differentiates polynomials of second degree without error, up to f32 rounding.
    assert gx == pytest.approx(0.02 + 0.006 * 25 - 0.002 * 20, abs=1e-4)
    assert gy == pytest.approx(-0.01 - 0.002 * 25 + 0.002 * 20, abs=1e-4)
    assert (gxx, gxy, gyy) == pytest.approx((0.006, -0.002, 0.002), abs=1e-4)


def test_thinned_lines_have_one_width_whatever_the_detector_drew():
    for width in (2.4, 5.0, 8.0):
        edge_map, _ = line_map(0.35, width)
        measured, _ = line_width(views_of([edge_map]), 0.5)
        thin = thinned(edge_map[None], measured, 0.3)[0]
        across = (thin[30:-30, 30:-30] >= 128).sum(axis=0).mean() * np.cos(0.35)
        assert across == pytest.approx(2.355 * DRAWN_SIGMA, abs=0.6)


@pytest.mark.parametrize("width", [3, 5, 9])
def test_line_width_of_a_bar_is_its_number_of_pixels(width):
    edge_map = np.zeros((SIZE, SIZE), np.uint8)
    edge_map[50 : 50 + width] = 255
    pixels, units = line_width(views_of([edge_map]), 0.5)
    assert pixels == pytest.approx(width, abs=0.4)
    assert units == pytest.approx(pixels * 2.0 / 100.0)  # 2 units away, focal length 100 px


def test_faint_lines_are_dropped_and_all_others_drawn_at_full_height():
    strong, _ = line_map(0.0, 3.0, (60, 30))
    weak, _ = line_map(0.0, 3.0, (60, 60), height=130)
    faint, _ = line_map(0.0, 3.0, (60, 90), height=60)
    thin = thinned(np.maximum(np.maximum(strong, weak), faint)[None], 3.0, 0.3)[0]
    assert thin[30, 60] == pytest.approx(255, abs=3)
    assert thin[60, 60] == pytest.approx(255, abs=3)
    assert thin[85:95].max() == 0


def test_specks_leave_no_line_and_an_empty_map_stays_empty():
    edge_map = np.zeros((SIZE, SIZE), np.uint8)
    edge_map[40:42, 50:52] = 255
    assert thinned(edge_map[None], 2.4, 0.3).max() == 0
    assert draw_lines(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), 20, 30).shape == (20, 30)


def test_a_wide_dark_margin_moves_the_ridge_and_changes_nothing_else():
    edge_map, _ = line_map(0.35, 4.0)
    wide = np.pad(edge_map, ((70, 11), (33, 140)))
    points, normals, values = ridge_points(edge_map, 1.2, 0.3)
    moved, same_normals, same_values = ridge_points(wide, 1.2, 0.3)
    inner = ((points > 5) & (points < SIZE - 6)).all(axis=1)  # beyond, the border of the small map repeats its pixels
    shared = ((moved - [33, 70] > 5) & (moved - [33, 70] < SIZE - 6)).all(axis=1)
    np.testing.assert_allclose(moved[shared] - [33, 70], points[inner], atol=1e-4)  # f32
    np.testing.assert_allclose(same_normals[shared], normals[inner], atol=1e-4)
    np.testing.assert_array_equal(same_values[shared], values[inner])


def test_drawn_ridges_match_a_pixel_by_pixel_drawing(generator):
    points, angles, values = generator.uniform(0, 29, (30, 2)), generator.uniform(0, 7, 30), generator.random(30)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    expected = np.zeros((30, 30))
    for point, normal, value in zip(points, normals, values, strict=True):
        for row, column in np.ndindex(30, 30):
            away = np.array([column, row]) - point
            if np.abs(np.array([column, row]) - np.rint(point)).max() <= PATCH:
                across = away @ normal
                beyond = max(away @ away - across**2 - 1, 0)
                expected[row, column] = max(expected[row, column], value * np.exp(-0.5 * (across**2 + beyond)))
    drawn = draw_lines(points, normals, values, 30, 30, sigma=1.0)
    np.testing.assert_allclose(drawn, expected * 255, atol=0.501)


def test_thinning_does_not_depend_on_the_threads():
    maps = np.stack([line_map(angle, 4.0)[0] for angle in np.linspace(0, 3, 7)])
    expected = thinned(maps, 4.0, 0.3, threads=1)
    np.testing.assert_array_equal(thinned(maps, 4.0, 0.3, threads=3), expected)
