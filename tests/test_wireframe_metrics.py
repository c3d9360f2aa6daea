"""Corners, joints, free ends and exact distances, in cases whose answer can be told by heart."""

import numpy as np
import pytest
from true_shapes import assert_perfect, circle_pieces, line, truth_of

from taichi_edges.evaluation.ground_truth import GroundTruth, read_ground_truth
from taichi_edges.evaluation.metrics import evaluate, metrics_rows
from taichi_edges.geometry.edge_set import EdgeSet, write_edges
from taichi_edges.synthetic.parts import PARTS

CORNERS = 0.4 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SQUARE = [line(CORNERS[index - 1], CORNERS[index]) for index in range(4)]
BAR, STEM = line([0, 0, 0], [0.8, 0, 0]), line([0.3, 0, 0], [0.3, 0.3, 0])


def scored(lines, truth=None):
    """Metrics of lines, each an edge, against lines."""
    return evaluate(EdgeSet.of(lines), truth_of(*(SQUARE if truth is None else truth)))


def lengthened(segment, at_start, at_end):
    """(2, 3) line -> the line with its ends moved outwards by millimetres."""
    along = (segment[1] - segment[0]) / np.linalg.norm(segment[1] - segment[0])
    return segment + np.outer([-at_start / 1000, at_end / 1000], along)


def arc_piece(centre, radius, start, end):
    """(4, 3) cubic for an arc of at most 90 degrees in the xy plane, angles in degrees."""
    a, b = np.radians([start, end])
    handle = 4 / 3 * np.tan((b - a) / 4)
    one, other = np.array([np.cos(a), np.sin(a), 0]), np.array([np.cos(b), np.sin(b), 0])
    turned = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # rows: a quarter turn from the right
    points = np.stack([one, one + handle * one @ turned, other - handle * other @ turned, other])
    return np.asarray(centre) + radius * points


def edge_file_truth(folder, edges):
    return read_ground_truth(write_edges(folder / "truth.json", edges, {}))


# --------------------------------------------------------------------------------------------------------- corners


def test_a_square_closes_its_corners():
    metrics = scored(SQUARE)
    assert (metrics["corners"], metrics["corners_closed"], metrics["tangential_joints"]) == (4, 4, 0)
    assert metrics["corners_closed_percent"] == metrics["corners_reached_percent"] == 100.0
    assert metrics["tangential_joints_closed_percent"] is None
    assert metrics["free_ends"] == metrics["free_ends_at_corners"] == metrics["false_free_ends"] == 0


@pytest.mark.parametrize(
    ("short_mm", "reached", "free_at_corners", "false"), [(3, 100.0, 8, 0), (7, 0.0, 8, 0), (12, 0.0, 0, 8)]
)
def test_sides_that_stop_short_close_nothing(short_mm, reached, free_at_corners, false):
    metrics = scored([lengthened(side, -short_mm, -short_mm) for side in SQUARE])
    assert metrics["corners_closed_percent"] == 0.0
    assert metrics["corners_reached_percent"] == reached
    assert metrics["free_ends"] == 8
    assert metrics["free_ends_at_corners"] == free_at_corners
    assert metrics["false_free_ends"] == false


@pytest.mark.parametrize(("too_long_mm", "reached"), [(3, 100.0), (20, 0.0)])
def test_sides_that_run_past_each_other_are_not_joined(too_long_mm, reached):
    """Their interiors cross in one point, but no end is there."""
    metrics = scored([lengthened(side, too_long_mm, too_long_mm) for side in SQUARE])
    assert metrics["corners_closed_percent"] == 0.0
    assert metrics["corners_reached_percent"] == reached
    assert metrics["free_ends"] == 8


@pytest.mark.parametrize(("too_long_mm", "closed", "at_corners"), [(3, 100.0, 4), (20, 0.0, 0)])
def test_a_line_that_passes_over_a_corner_closes_it_only_if_its_end_is_near(too_long_mm, closed, at_corners):
    """The other sides end on it, so theirs are no free ends."""
    sides = [lengthened(side, too_long_mm, too_long_mm) if number % 2 else side for number, side in enumerate(SQUARE)]
    metrics = scored(sides)
    assert metrics["corners_closed_percent"] == closed
    assert (metrics["free_ends"], metrics["free_ends_at_corners"]) == (4, at_corners)


@pytest.mark.parametrize(("apart_mm", "closed"), [(0.1, 4), (0.3, 2)])
def test_ends_are_joined_only_where_they_are_the_same_point(apart_mm, closed):
    metrics = scored([SQUARE[0] + [0, 0, apart_mm / 1000], *SQUARE[1:]])
    assert metrics["corners_closed"] == closed
    assert metrics["corners_reached_percent"] == 100.0


def test_all_edges_of_a_corner_have_to_meet():
    """Three sides of a cube's corner: two are joined, the third stops 2 mm short."""
    axes = [line([0, 0, 0], axis) for axis in 0.3 * np.eye(3)]
    assert scored(axes, axes)["corners_closed"] == 1
    metrics = scored([*axes[:2], lengthened(axes[2], -2, 0)], axes)
    assert (metrics["corners_closed"], metrics["corners_reached_percent"]) == (0, 100.0)
    metrics = scored(axes[:2], axes)
    assert (metrics["corners_closed"], metrics["corners_reached_percent"]) == (0, 0.0)


def test_a_square_4_mm_aside_is_still_closed_and_one_6_mm_aside_is_not():
    for aside_mm, closed in ((4, 4), (6, 0)):
        assert scored([side + [0, 0, aside_mm / 1000] for side in SQUARE])["corners_closed"] == closed


def test_an_edge_cut_in_two_still_closes_its_corners_but_counts_twice():
    halves = [line(SQUARE[0][0], SQUARE[0].mean(axis=0)), line(SQUARE[0].mean(axis=0), SQUARE[0][1])]
    metrics = scored([*halves, *SQUARE[1:]])
    assert metrics["corners_closed"] == 4 and metrics["free_ends"] == 0
    assert metrics["edges_to_true_edges"] == 5 / 4


def test_a_duplicate_beside_a_closed_square_leaves_it_closed():
    metrics = scored([*SQUARE, SQUARE[0] + [0, 0, 0.002]])
    assert metrics["corners_closed"] == 4
    assert metrics["free_ends"] == metrics["free_ends_at_corners"] == 2
    assert metrics["excess_duplicated_length_percent"] == pytest.approx(20.0)


def test_an_edge_of_another_direction_does_not_close_a_corner():
    """Both its ends are joined where they should be, but the fourth side is an arc that bulges out."""
    bulge = arc_piece([0.2, 0.2, 0], 0.2 * np.sqrt(2), 225, 315)
    metrics = evaluate(EdgeSet.of([SQUARE[0], *SQUARE[2:]], [bulge]), truth_of(*SQUARE))
    assert metrics["free_ends"] == 0
    assert metrics["corners_closed"] == 2


@pytest.mark.parametrize(("degrees", "corners"), [(15, 0), (25, 1), (90, 1), (155, 1), (165, 0)])
def test_a_corner_is_where_edges_meet_at_more_than_20_degrees(degrees, corners):
    away = 0.3 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    pair = [line([0, 0, 0], [0.3, 0, 0]), line([0, 0, 0], away)]
    metrics = scored(pair, pair)
    assert (metrics["corners"], metrics["tangential_joints"]) == (corners, 1 - corners)
    assert metrics["corners_closed"] + metrics["tangential_joints_closed"] == 1


def test_a_leaf_has_one_corner_where_it_closes(tmp_path):
    leaf = np.array([[0, 0, 0], [0.4, 0.3, 0], [-0.4, 0.3, 0], [0, 0, 0.0]])
    truth = edge_file_truth(tmp_path, EdgeSet.of(curves=[leaf]))
    metrics = evaluate(EdgeSet.of(curves=[leaf]), truth)
    assert (metrics["corners"], metrics["corners_closed"], metrics["free_ends"]) == (1, 1, 0)
    halves = np.stack([split_cubic(leaf)[0] + [0, 0, 0.001], split_cubic(leaf)[1]])  # 1 mm apart at both their ends
    metrics = evaluate(EdgeSet.of(curves=halves), truth)
    assert (metrics["corners_closed"], metrics["corners_reached_percent"], metrics["free_ends"]) == (0, 100.0, 4)


def split_cubic(control):
    """(4, 3) cubic -> its two halves (de Casteljau)."""
    a, b, c, d = control
    ab, bc, cd = (a + b) / 2, (b + c) / 2, (c + d) / 2
    abc, bcd = (ab + bc) / 2, (bc + cd) / 2
    middle = (abc + bcd) / 2
    return np.stack([a, ab, abc, middle]), np.stack([middle, bcd, cd, d])


# ------------------------------------------------------------------------------------------------------ T-junctions


def test_a_t_junction_is_a_corner_closed_by_the_end_on_the_bar():
    metrics = scored([BAR, STEM], [BAR, STEM])
    assert (metrics["corners"], metrics["corners_closed"]) == (1, 1)
    assert metrics["free_ends"] == metrics["true_free_ends"] == 3  # the junction is none
    assert metrics["free_ends_at_corners"] == metrics["false_free_ends"] == 0


@pytest.mark.parametrize(
    ("lines", "closed", "reached"),
    [
        ([lengthened(BAR, 0, -500), lengthened(BAR, -300, 0), STEM], 1, 100.0),  # the bar in two, all three joined
        ([BAR, lengthened(STEM, -1, 0)], 0, 100.0),
        ([BAR, lengthened(STEM, -6, 0)], 0, 0.0),
        ([BAR], 0, 0.0),
        ([STEM], 0, 0.0),
        ([BAR, lengthened(STEM, 20, 0)], 0, 0.0),
    ],
    ids=["bar in two", "stem 1 mm short", "stem 6 mm short", "no stem", "no bar", "stem runs on"],
)
def test_a_t_junction_that_is_not_whole(lines, closed, reached):
    metrics = scored(lines, [BAR, STEM])
    assert (metrics["corners_closed"], metrics["corners_reached_percent"]) == (closed, reached)


@pytest.mark.parametrize("degrees", [0, 20, 25, 45])
def test_an_end_on_the_largest_arc_is_joined_though_cubics_miss_it(tmp_path, degrees):
    """A line that ends on the circle itself, where its cubics of 90 degrees are on it (0, 45) or 0.14 mm outside."""
    outwards = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    stem = line(0.5 + 0.5 * outwards, 0.5 + 0.7 * outwards)
    edges = EdgeSet(stem[None], circle_pieces(4, radius=0.5), np.array([0]), np.full(4, 1))
    metrics = evaluate(edges, edge_file_truth(tmp_path, edges))
    assert (metrics["corners"], metrics["corners_closed"], metrics["free_ends"]) == (1, 1, 1)


def test_the_two_lines_of_a_split_bar_are_one_true_edge():
    split = [lengthened(BAR, 0, -500), lengthened(BAR, -300, 0), STEM]
    metrics = scored([BAR, STEM], split)
    assert (metrics["true_edges"], metrics["true_edges_as_filed"], metrics["corners_closed"]) == (2, 3, 1)


# ------------------------------------------------------------------------------------------------ tangential joints


def filleted(overlap_mm=0.0):
    """Two lines at a right angle with a fillet of 100 mm between; the lines run on into it, where the arc is left out.

    Returns the EdgeSet of three edges.
    """
    gap = np.degrees(overlap_mm / 100.0)
    lines = [line([-0.5, 0, 0], [overlap_mm / 1000, 0, 0]), line([0.1, 0.1 - overlap_mm / 1000, 0], [0.1, 0.6, 0])]
    return EdgeSet.of(lines, [arc_piece([0, 0.1, 0], 0.1, -90 + gap, -gap)])


def test_a_fillet_has_tangential_joints_and_no_corners(tmp_path):
    truth = edge_file_truth(tmp_path, filleted())
    metrics = evaluate(filleted(), truth)
    assert (metrics["corners"], metrics["corners_closed_percent"]) == (0, None)
    assert (metrics["tangential_joints"], metrics["tangential_joints_closed"]) == (2, 2)
    assert (metrics["free_ends"], metrics["true_free_ends"], metrics["false_free_ends"]) == (2, 2, 0)


def test_one_smooth_edge_through_a_fillet_closes_its_joints(tmp_path):
    edges = filleted()
    one = EdgeSet(edges.lines, edges.curves, np.zeros(2, int), np.zeros(1, int))
    metrics = evaluate(one, edge_file_truth(tmp_path, edges))
    assert (metrics["edges"], metrics["true_edges"], metrics["tangential_joints_closed"]) == (1, 3, 2)
    assert metrics["free_ends"] == 2


def test_lines_that_run_on_into_a_fillet_do_not_stand_for_it(tmp_path):
    """By 16 mm, where they are 1.3 mm off: they are near it and nearly parallel, but do not follow it."""
    truth = edge_file_truth(tmp_path, filleted())
    metrics = evaluate(filleted(overlap_mm=16), truth)
    assert (metrics["tangential_joints_closed"], metrics["tangential_joints_reached_percent"]) == (0, 0.0)
    assert metrics["free_ends"] == 6 and metrics["false_free_ends"] == 4
    without_arc = EdgeSet.of(filleted().lines)
    assert evaluate(without_arc, truth)["tangential_joints_reached_percent"] == 0.0


def test_a_contact_that_has_slid_along_is_closed_only_in_the_wide_sense(tmp_path):
    """The fillet is of 90 mm instead of 100, so its contacts lie 10 mm on, joined as they should be."""
    truth = edge_file_truth(tmp_path, filleted())
    lines = [line([-0.5, 0, 0], [0.01, 0, 0]), line([0.1, 0.09, 0], [0.1, 0.6, 0])]
    metrics = evaluate(EdgeSet.of(lines, [arc_piece([0.01, 0.09, 0], 0.09, -90, 0)]), truth)
    assert metrics["tangential_joints_closed_percent"] == metrics["tangential_joints_reached_percent"] == 0.0
    assert metrics["tangential_joints_closed_20mm_percent"] == 100.0
    apart = evaluate(EdgeSet.of(lines, [arc_piece([0.01, 0.09, 0.001], 0.09, -90, 0)]), truth)
    assert apart["tangential_joints_closed_20mm_percent"] == 0.0


def test_a_line_that_touches_a_circle_has_a_tangential_joint_there(tmp_path):
    sources = np.full(4, 1)
    both = EdgeSet(np.array([line([0.7, 0.5, 0.5], [0.7, 0.9, 0.5])]), circle_pieces(4), np.array([0]), sources)
    truth = edge_file_truth(tmp_path, both)
    metrics = evaluate(both, truth)
    assert (metrics["true_edges"], metrics["tangential_joints"], metrics["tangential_joints_closed"]) == (2, 1, 1)
    circle_alone = EdgeSet(np.zeros((0, 2, 3)), circle_pieces(4), np.zeros(0, int), sources)
    assert evaluate(circle_alone, truth)["tangential_joints_reached_percent"] == 0.0


def touching_parabola():
    """A parabola that touches the circle of radius 0.2 in the plane across; its apex is at (0.7, 0.5, 0.5)."""
    return np.array([[0.7, 0.3, 0.4], [0.7, 1.3 / 3, 1.6 / 3], [0.7, 1.7 / 3, 1.6 / 3], [0.7, 0.7, 0.4]])


@pytest.mark.parametrize(("above_mm", "closed"), [(0.0, 1), (0.1, 1), (1.0, 0)])
def test_two_curves_that_touch_need_no_end_where_they_do(tmp_path, above_mm, closed):
    """The file cuts the parabola at its apex; one edge all along it is as good if it touches the circle."""
    halves, circle = np.stack(split_cubic(touching_parabola())), circle_pieces(4)
    truth = edge_file_truth(tmp_path, curves_of([halves[:1], halves[1:], circle]))
    assert evaluate(curves_of([halves[:1], halves[1:], circle]), truth)["tangential_joints_closed"] == 1
    whole = touching_parabola() + [0, 0, above_mm / 1000]
    metrics = evaluate(curves_of([whole[None], circle]), truth)
    assert (metrics["true_edges"], metrics["tangential_joints"]) == (3, 1)
    assert metrics["tangential_joints_closed"] == closed
    assert metrics["tangential_joints_reached_percent"] == 100.0


def curves_of(edges):
    """List of (k, 4, 3) cubics, each the pieces of one edge -> EdgeSet."""
    sources = np.repeat(np.arange(len(edges)), [len(pieces) for pieces in edges])
    return EdgeSet(np.zeros((0, 2, 3)), np.concatenate(edges), np.zeros(0, int), sources)


def test_order_and_sense_of_the_edges_do_not_matter(generator, tmp_path):
    """Edges of a part, some shortened, some joined; the same ones in another order, run through backwards."""
    part = PARTS["bracket"]().edges
    truth = edge_file_truth(tmp_path, part)
    lines = np.array([lengthened(segment, *generator.choice([-7, -3, 0, 0, 3], 2)) for segment in part.lines])
    one, other = generator.permutation(len(lines)), generator.permutation(len(part.curves))
    turned = EdgeSet(lines[one, ::-1], part.curves[other, ::-1], part.line_sources[one], part.curve_sources[other])
    first = evaluate(EdgeSet(lines, part.curves, part.line_sources, part.curve_sources), truth)
    second = evaluate(turned, truth)
    keys = [key for key in first if "corner" in key or "joint" in key or "free" in key or key.startswith("exact")]
    assert len(keys) == 20
    assert [second[key] for key in keys] == pytest.approx([first[key] for key in keys], abs=1e-3)


# ---------------------------------------------------------------------------------------------------------- circles


def test_a_circle_that_the_file_splits_is_one_edge_without_ends():
    angles = np.radians(np.linspace(0, 360, 91))
    circle = 0.5 + 0.2 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    thirds = tuple(circle[start : start + 31] for start in (0, 30, 60))
    truth = GroundTruth(circle, thirds, ("curve",) * 3, 0.4 * np.pi, "made by the test")
    whole = EdgeSet(np.zeros((0, 2, 3)), circle_pieces(4), np.zeros(0, int), np.zeros(4, int))
    metrics = evaluate(whole, truth)
    assert (metrics["edges"], metrics["true_edges"], metrics["true_edges_as_filed"]) == (1, 1, 3)
    assert metrics["corners"] == metrics["tangential_joints"] == metrics["free_ends"] == metrics["true_free_ends"] == 0
    # Cubics of 90 degrees miss the circle by 2.7e-4 of its radius at most, chords of the file by 0.12 mm.
    assert metrics["exact_p95_mm"] < 0.055 and metrics["exact_completeness_p95_mm"] < 0.055
    metrics = evaluate(EdgeSet.of(curves=circle_pieces(3)), truth)
    assert (metrics["edges_to_true_edges"], metrics["free_ends"]) == (3.0, 0)
    two_of_three = evaluate(EdgeSet.of(curves=circle_pieces(3)[:2]), truth)
    assert (two_of_three["free_ends"], two_of_three["false_free_ends"]) == (2, 2)


# -------------------------------------------------------------------------------------------------- exact distances


def test_a_line_1_mm_aside_is_1_mm_off_everywhere():
    true = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    metrics = scored([true + [0, 0.001, 0]], [true])
    for key in ("exact_mean_mm", "exact_median_mm", "exact_p95_mm", "exact_completeness_mean_mm"):
        assert metrics[key] == pytest.approx(1.0, abs=1e-6)
    assert metrics["exact_precision_5mm_percent"] == metrics["exact_recall_5mm_percent"] == 100.0


def test_a_line_that_drifts_off_is_weighted_by_length_not_by_parameter():
    """From 0 to 4 mm off; the cubic's parameter crowds at its ends."""
    start, end = np.array([0.2, 0.5, 0.5]), np.array([0.8, 0.504, 0.5])
    true = truth_of(line([0.1, 0.5, 0.5], [0.9, 0.5, 0.5]))
    metrics = evaluate(EdgeSet.of(curves=[np.stack([start, start, end, end])]), true)
    assert metrics["exact_mean_mm"] == pytest.approx(2.0, abs=0.01)
    assert metrics["exact_median_mm"] == pytest.approx(2.0, abs=0.01)
    assert metrics["exact_p95_mm"] == pytest.approx(3.8, abs=0.01)


def test_half_a_line_is_exact_but_not_complete():
    true = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    metrics = scored([lengthened(true, 0, -300)], [true])
    assert metrics["exact_mean_mm"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["exact_completeness_mean_mm"] == pytest.approx(75.0, abs=0.01)  # half of it 0 to 300 mm away
    assert metrics["exact_recall_5mm_percent"] == pytest.approx(100 * 305 / 600, abs=0.2)


def test_what_only_samples_tell_is_unknown():
    samples_only = GroundTruth(truth_of(*SQUARE).points, (), (), None, "made by the test")
    metrics = evaluate(EdgeSet.of(SQUARE[:2]), samples_only)
    assert metrics["free_ends"] == 2
    unknown = ("true_edges", "edges_to_true_edges", "corners", "corners_closed_percent", "tangential_joints")
    unknown += ("free_ends_at_corners", "false_free_ends", "exact_mean_mm", "exact_recall_5mm_percent")
    assert [metrics[key] for key in (*unknown, "excess_duplicated_length_percent")] == [None] * (len(unknown) + 1)
    rows = dict(metrics_rows(metrics))
    assert rows["corners closed"] == rows["distance to true curves"] == "unknown"
    assert rows["free ends"] == "2"


def test_rows_say_what_is_closed_and_what_is_free():
    rows = dict(metrics_rows(scored([*SQUARE[:3], lengthened(SQUARE[3], -3, 0)])))
    assert rows["corners closed"] == "3 of 4 (reached: 100.0 %)"
    assert rows["tangential joints closed"] == "none in the truth"
    assert rows["free ends"] == "2 (2 at corners, 0 at no true end)"
    assert rows["distance to true curves"] == "0.00 mm mean, 0.00 mm median, 0.00 mm p95"


def test_no_prediction_closes_nothing():
    metrics = scored([])
    assert (metrics["corners"], metrics["corners_closed_percent"], metrics["free_ends"]) == (4, 0.0, 0)
    assert metrics["exact_mean_mm"] is metrics["exact_completeness_p95_mm"] is None
    assert metrics["exact_precision_5mm_percent"] == metrics["exact_recall_5mm_percent"] == 0.0


# ------------------------------------------------------------------------------------------------- truth as it is


@pytest.mark.parametrize(
    ("name", "edges", "corners", "tangential"),
    [("block", 12, 8, 0), ("bracket", 24, 8, 8), ("wave", 12, 8, 0), ("knob", 5, 0, 0), ("demo", 35, 8, 16)],
)
def test_every_synthetic_part_is_its_own_perfect_wireframe(tmp_path, name, edges, corners, tangential):
    part = PARTS[name]().edges
    metrics = evaluate(part, edge_file_truth(tmp_path, part))
    assert metrics["edges"] == metrics["true_edges"] == edges
    assert (metrics["corners"], metrics["tangential_joints"]) == (corners, tangential)
    assert_perfect(metrics)
