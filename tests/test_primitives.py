"""True edges as primitives: what a file splits is counted once, and is as exact as the curve itself."""

import numpy as np
import pytest
from true_shapes import line

from taichi_edges.evaluation.dense_curves import dense_curves
from taichi_edges.evaluation.primitives import true_primitives


def arc(start, end, radius=0.2, centre=(0.5, 0.5, 0.5), flatness=1.0, vertices=20):
    """(vertices, 3) of an arc in the xy plane from `start` to `end` degrees; flatness: of an ellipse."""
    angles = np.radians(np.linspace(start, end, vertices))
    return np.asarray(centre) + radius * np.stack([np.cos(angles), flatness * np.sin(angles), 0 * angles], axis=1)


def primitives(*polylines, kind="curve"):
    return true_primitives([np.asarray(polyline) for polyline in polylines], [kind] * len(polylines))


# -------------------------------------------------------------------------------------------------------- counting


def test_arcs_of_one_circle_that_touch_are_one_edge():
    thirds = [arc(0, 120), arc(120, 240), arc(240, 360)]
    assert len(primitives(*thirds)) == 1
    assert len(primitives(thirds[2], thirds[0][::-1], thirds[1])) == 1  # whatever their order and sense
    assert len(primitives(*thirds[:2])) == 1  # though they do not close
    whole = primitives(*thirds)[0]
    np.testing.assert_allclose(whole[0], whole[-1], atol=1e-9)


def test_arcs_that_do_not_touch_or_differ_in_radius_stay_apart():
    assert len(primitives(arc(0, 100), arc(120, 240))) == 2
    assert len(primitives(arc(0, 120), arc(240, 360, radius=0.21))) == 2
    turned_back = arc(0, 90)[-1] + [0, 0.1, 0]  # an S: both arcs go through the point, with one tangent
    assert len(primitives(arc(0, 90), arc(270, 180, radius=0.1, centre=turned_back))) == 2


def test_lines_that_continue_each_other_are_one_edge():
    halves = [line([0, 0, 0], [0.4, 0, 0]), line([0.4, 0, 0], [1, 0, 0])]
    assert len(primitives(*halves, kind="line")) == 1
    assert len(primitives(halves[0], halves[1] + [0.01, 0, 0], kind="line")) == 2  # a gap of 10 mm
    bent = line([0.4, 0, 0], [1, np.tan(np.radians(1)) * 0.6, 0])
    assert len(primitives(halves[0], bent, kind="line")) == 2


def test_a_line_split_where_another_ends_is_one_edge():
    pieces = [line([0, 0, 0], [0.4, 0, 0]), line([0.4, 0, 0], [1, 0, 0]), line([0.4, 0, 0], [0.4, 0.3, 0])]
    assert sorted(len(curve) for curve in primitives(*pieces, kind="line")) == [2, 3]


def test_a_closed_ellipse_is_one_edge_and_an_open_one_is_as_the_file_says():
    quarters = [arc(start, start + 90, flatness=0.6) for start in (0, 90, 180, 270)]
    assert len(primitives(*quarters)) == 1
    assert len(primitives(*quarters[:3])) == 3


def test_a_spline_that_the_file_splits_is_two_edges():
    wave = np.stack([x := np.linspace(0, 1, 41), 0.1 * np.sin(2 * np.pi * x), 0 * x], axis=1)
    assert len(primitives(wave[:21], wave[20:])) == 2
    angles = np.linspace(0, 2 * np.pi, 81)
    egg = np.stack([np.cos(angles), np.sin(angles) * (1 + 0.2 * np.cos(angles)), 0 * angles], axis=1)
    assert len(primitives(egg[:41], egg[40:])) == 2  # closed and smooth, but no conic


def test_a_polygon_whose_corners_lie_on_a_circle_is_no_circle():
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]]
    np.testing.assert_array_equal(primitives(square, kind="line")[0], square)


def test_no_curves_make_no_edges():
    assert primitives() == []


# ------------------------------------------------------------------------------------------------------- exactness


@pytest.mark.parametrize("ends", [(0, 360), (10, 130)])
def test_an_arc_is_met_between_the_vertices_of_the_file(ends):
    coarse = arc(*ends, vertices=1 + abs(ends[1] - ends[0]) // 4)  # 14 mm apart: the chords miss it by 0.12 mm
    (exact,) = primitives(coarse)
    radii = np.linalg.norm(exact - [0.5, 0.5, 0.5], axis=1)
    np.testing.assert_allclose(radii, 0.2, atol=1e-6)  # a spline misses by 4e-8 inside, ten times that at its ends


def test_distances_agree_with_every_chord_tried(generator):
    """The slow twin. Where two curves are almost equally near, the foot may lie on a chord of the other one."""
    polylines = [generator.uniform(0, 1, (5, 3)) for _ in range(6)]
    points = generator.uniform(0, 1, (200, 3))
    starts = np.concatenate([polyline[:-1] for polyline in polylines])
    chords = np.concatenate([np.diff(polyline, axis=0) for polyline in polylines])
    offsets = points[:, None] - starts
    share = np.clip((offsets * chords).sum(axis=2) / (chords**2).sum(axis=1), 0, 1)
    expected = np.linalg.norm(offsets - share[..., None] * chords, axis=2).min(axis=1)
    np.testing.assert_allclose(dense_curves(polylines).distances(points), expected, atol=1e-5)


def test_curves_within_a_radius_are_found_each_once():
    curves = dense_curves([line([0, 0, 0], [1, 0, 0]), line([0, 0.003, 0], [1, 0.003, 0]), line([0, 1, 0], [1, 1, 0])])
    at, found, _, distances = curves.within(np.array([[0.5, 0.001, 0], [5, 5, 5]]), 0.005)
    np.testing.assert_array_equal(at, [0, 0])
    np.testing.assert_array_equal(found, [0, 1])
    np.testing.assert_allclose(distances, [0.001, 0.002], atol=1e-12)
