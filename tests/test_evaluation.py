"""The evaluator: hand-computable cases, the floors of the real scenes, and mistakes in the ground truth."""

import json
import os
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from true_shapes import assert_perfect, circle_pieces, line, truth_as_edges, truth_of

from taichi_edges.errors import UserError
from taichi_edges.evaluation.ground_truth import GroundTruth, edges_of_list, read_ground_truth, true_parameters
from taichi_edges.evaluation.metrics import (
    VOXELS_PER_UNIT,
    average_per_voxel,
    duplicated_percent,
    evaluate,
    measure_alone,
    metrics_rows,
    sample_prediction,
)
from taichi_edges.evaluation.primitives import true_primitives
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.geometry.edge_set import EdgeSet, write_edges

SCENES = {"00000006": "abc_nef/00000006/gt", "00004926": "abc_nef_edge/00004926/gt"}


@pytest.fixture(scope="session")
def data():
    folder = os.environ.get("TAICHI_EDGES_DATA")
    if not folder:
        pytest.skip("TAICHI_EDGES_DATA is not set: the real scenes are not here")
    return Path(folder)


@pytest.fixture(scope="session")
def abc_truths(data):
    """Read once: the yml and the obj of a scene take a second."""
    return {scene: read_ground_truth(data / folder) for scene, folder in SCENES.items()}


def duplicates_of(edges):
    sources = np.concatenate([edges.line_sources, edges.curve_sources])
    return duplicated_percent(edges.polylines(), sources)


# ----------------------------------------------------------------------------------------------- distances and shares


def test_a_line_shifted_by_3_mm_is_3_mm_off():
    true = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    metrics = evaluate(EdgeSet.of([true + [0, 0.003, 0]]), truth_of(true))
    # The truth is sampled every 0.5 mm: at most sqrt(3^2 + 0.25^2) = 3.0104 mm to the nearest sample.
    assert 3.0 - 1e-4 < metrics["accuracy_mm"] < 3.0104
    # The prediction has points at most a voxel's diagonal 13.5 mm apart, on average closer than that.
    assert 3.0 - 1e-4 < metrics["completeness_mm"] < 5.0
    assert metrics["precision_5mm_percent"] == 100.0
    assert metrics["recall_10mm_percent"] == metrics["f_score_10mm_percent"] == 100.0
    assert metrics["predicted_to_true_length_percent"] == pytest.approx(100.0)


@pytest.mark.parametrize(("shift_mm", "precise_at"), [(7, (0, 100, 100)), (15, (0, 0, 100)), (25, (0, 0, 0))])
def test_thresholds_separate_shifts(shift_mm, precise_at):
    shift = [0.0, shift_mm / 1000, 0.0]
    true = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    metrics = evaluate(EdgeSet.of([true + shift]), truth_of(true))
    assert tuple(metrics[f"precision_{t}mm_percent"] for t in (5, 10, 20)) == precise_at
    assert metrics["accuracy_mm"] == pytest.approx(shift_mm, abs=0.02)


def test_half_a_line_recalls_half():
    true = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    metrics = evaluate(EdgeSet.of([line(true[0], true.mean(axis=0))]), truth_of(true))
    assert metrics["precision_5mm_percent"] == 100.0
    # Half, and what lies less than the threshold beyond the end: 20 of 600 mm. The last predicted point is the mean of
    # its voxel, up to 5 mm before the end.
    assert metrics["recall_20mm_percent"] == pytest.approx(50 + 100 * 20 / 600, abs=100 * 5 / 600 + 0.2)
    assert metrics["predicted_to_true_length_percent"] == pytest.approx(50.0)
    precision, recall = metrics["precision_20mm_percent"], metrics["recall_20mm_percent"]
    assert metrics["f_score_20mm_percent"] == pytest.approx(2 * precision * recall / (precision + recall))


@pytest.mark.parametrize("threshold", [5, 10, 20])
def test_a_point_exactly_at_the_threshold_is_not_nearer(threshold):
    edges = EdgeSet.of([line([0.2, 0.0, 0.5], [0.8, 0.0, 0.5])])
    predicted = sample_prediction(edges).astype(np.float64)  # y is exactly 0, so the distance is exactly the shift
    at, just_below = threshold / 1000, threshold / 1000 * (1 - 1e-6)
    for distance, percent in ((at, 0.0), (just_below, 100.0)):
        truth = GroundTruth(predicted + [0.0, distance, 0.0], (), (), None, "made by the test")
        metrics = evaluate(edges, truth)
        assert metrics[f"precision_{threshold}mm_percent"] == percent
        assert metrics[f"recall_{threshold}mm_percent"] == percent


def test_sampling_follows_emap():
    # 0.024 // 0.005 = 4 points at 0, 1/3, 2/3 and 1; voxels are 1/128 = 0.0078 wide, so none shares one with another.
    start, end = np.array([0.001, 0.001, 0.001]), np.array([0.025, 0.001, 0.001])
    sampled = sample_prediction(EdgeSet.of([line(start, end)]))
    assert sampled.dtype == np.float32
    np.testing.assert_allclose(np.sort(sampled[:, 0]), [0.001, 0.009, 0.017, 0.025], atol=1e-7)
    # One uniform in the parameter: a cubic with its handles at its ends has points crowded there, not evenly spread.
    curve = np.array([[0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    expected = average_per_voxel(evaluate_bezier(curve, np.linspace(0, 1, 199)).astype(np.float32))
    np.testing.assert_allclose(sample_prediction(EdgeSet.of(curves=[curve])), expected, atol=1e-6)


def test_voxel_average_agrees_with_a_loop(generator):
    """The slow twin, points outside [-1, 1]^3 included: the grid goes on there."""
    points = generator.uniform(-1.3, 1.3, (3000, 3)).astype(np.float32)
    points[:1500] = points[0] + 0.02 * points[:1500]  # many to a voxel
    bins = {}
    for point in points:
        voxel = np.floor((point + np.float32(1)) * np.float32(VOXELS_PER_UNIT)).astype(int)
        bins.setdefault(tuple(voxel), []).append(point)
    expected = np.array([np.mean(bins[key], axis=0, dtype=np.float64) for key in sorted(bins)])
    np.testing.assert_allclose(average_per_voxel(points), expected, atol=1e-6)


def test_a_prediction_far_outside_counts_against_precision():
    true = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    metrics = evaluate(EdgeSet.of([true, true + [0, 3.0, 0]]), truth_of(true))
    assert metrics["precision_20mm_percent"] == pytest.approx(50.0, abs=1.0)
    assert metrics["recall_20mm_percent"] == 100.0


@pytest.mark.parametrize(
    "edges",
    [
        EdgeSet.of(),
        EdgeSet.of([line([0.5, 0.5, 0.5], [0.5, 0.5, 0.5])], [np.full((4, 3), 0.5)]),
        EdgeSet.of([line([0.5, 0.5, 0.5], [0.504, 0.5, 0.5])]),
    ],
    ids=["no edges", "zero length", "too short for a sample"],
)
def test_a_prediction_without_points_scores_zero_and_warns_of_nothing(edges):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        metrics = evaluate(edges, truth_of(line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])))
        rows = metrics_rows(metrics)
    assert metrics["accuracy_mm"] is None
    assert metrics["completeness_mm"] is None
    for name in ("precision", "recall", "f_score"):
        assert [metrics[f"{name}_{threshold}mm_percent"] for threshold in (5, 10, 20)] == [0.0, 0.0, 0.0]
    assert metrics["duplicated_length_percent"] == 0.0
    assert ("accuracy", "unknown") in rows
    assert json.loads(json.dumps(metrics)) == metrics


def test_an_edge_that_is_not_finite_is_refused_by_name():
    edges = EdgeSet.of([line([0, 0, 0], [1, 0, 0]), line([0, 0, 0], [np.nan, 0, 0])])
    with pytest.raises(UserError, match="line 1"):
        evaluate(edges, truth_of(line([0, 0, 0], [1, 0, 0])))


def test_counts_pieces_and_edges():
    edges = EdgeSet(
        np.stack([line([0, 0, 0], [1, 0, 0]), line([0, 0, 0], [0, 1, 0]), line([0, 0, 0], [0, 0, 1])]),
        circle_pieces(4),
        np.array([7, -1, -1]),
        np.array([3, 3, 3, 3]),
    )
    metrics = evaluate(edges, truth_of(line([0, 0, 0], [1, 0, 0])))
    assert (metrics["lines"], metrics["curves"], metrics["edges"], metrics["true_edges"]) == (3, 4, 4, 1)
    assert metrics["predicted_length_units"] == pytest.approx(3 + 2 * np.pi * 0.2, rel=1e-3)


def test_edges_measured_alone_are_measured_as_beside_a_truth():
    lines, nothing = np.random.default_rng(0).uniform(size=(4, 2, 3)), np.zeros(0, int)
    edges = EdgeSet(lines, np.zeros((0, 4, 3)), np.array([0, 1, 1, 2]), nothing)
    beside = evaluate(edges, GroundTruth(np.zeros((1, 3)), (), (), None, "one point"))
    alone = measure_alone(edges)
    assert alone["edges"] == 3 and alone == {key: beside[key] for key in alone}


def test_rows_are_labels_with_values_and_units():
    true = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    samples_only = GroundTruth(truth_of(true).points, (), (), None, "made by the test")
    rows = dict(metrics_rows(evaluate(EdgeSet.of([true]), samples_only)))
    assert rows["precision at 5 mm"] == "100.0 %"
    assert rows["accuracy"].endswith(" mm")
    assert rows["length"] == "0.60 units (truth unknown)"
    assert rows["duplicated length"] == "0.0 % (truth unknown)"


# ----------------------------------------------------------------------------------------------------- duplicates


def test_a_line_repeated_n_times_counts_once():
    one = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5])
    assert duplicates_of(EdgeSet.of([one])) == 0.0
    assert duplicates_of(EdgeSet.of([one, one[::-1]])) == pytest.approx(50.0)  # whichever way it runs
    assert duplicates_of(EdgeSet.of([one, one, one + [0, 0.003, 0]])) == pytest.approx(200 / 3)
    assert duplicates_of(EdgeSet.of([one, one + [0, 0.006, 0]])) == 0.0


def test_a_short_piece_beside_a_long_one_is_the_duplicate_whatever_the_order():
    long, short = line([0.2, 0.5, 0.5], [0.8, 0.5, 0.5]), line([0.4, 0.502, 0.5], [0.5, 0.502, 0.5])
    for lines in ([long, short], [short, long]):
        assert duplicates_of(EdgeSet.of(lines)) == pytest.approx(100 * 0.1 / 0.7)


def test_only_the_overlap_of_two_lines_is_duplicated():
    lines = [line([0.0, 0, 0], [0.6, 0, 0]), line([0.5, 0, 0], [0.9, 0, 0])]
    assert duplicates_of(EdgeSet.of(lines)) == pytest.approx(100 * 0.1 / 1.0, abs=0.2)  # to a sample: 2 of 1000 mm


def test_a_duplicate_of_a_duplicate_is_judged_by_what_counts():
    rungs = [line([0, y, 0], [1.0 - y, y, 0]) for y in (0.0, 0.004, 0.008)]
    # The second repeats the first; the third is 8 mm from the first, and the second does not count any more.
    assert duplicates_of(EdgeSet.of(rungs)) == pytest.approx(100 * 0.996 / 2.988, abs=0.2)


def test_edges_that_cross_meet_or_continue_are_no_duplicates():
    centre = np.array([0.5, 0.5, 0.5])
    for degrees in (30, 45, 90, 135, 150):
        away = centre + 0.3 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
        corner = [line(centre, centre + [0.3, 0, 0]), line(centre, away)]
        crossing = [line(centre - [0.3, 0, 0], centre + [0.3, 0, 0]), line(2 * centre - away, away)]
        assert duplicates_of(EdgeSet.of(corner)) == 0.0
        assert duplicates_of(EdgeSet.of(crossing)) == 0.0
    for degrees in (155, 170, 180):  # hardly bent where they meet: they go on, they do not run beside each other
        away = centre + 0.3 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
        assert duplicates_of(EdgeSet.of([line(centre, centre + [0.3, 0, 0]), line(centre, away)])) == 0.0


@pytest.mark.parametrize("count", [2, 3, 4, 8, 40])
def test_the_pieces_of_a_circle_are_no_duplicates_of_each_other(count):
    pieces = circle_pieces(count)
    together = EdgeSet(np.zeros((0, 2, 3)), pieces, np.zeros(0, int), np.zeros(count, int))
    assert duplicates_of(together) == 0.0
    assert duplicates_of(EdgeSet.of(curves=pieces)) == 0.0  # nor in EMAP's files, which do not say that they belong


def test_a_circle_found_twice_is_half_duplicate_though_cut_differently():
    inner, outer = circle_pieces(4, radius=0.1), circle_pieces(7, radius=0.103)
    curves = np.concatenate([inner, outer])
    edges = EdgeSet(np.zeros((0, 2, 3)), curves, np.zeros(0, int), np.array([0] * 4 + [1] * 7))
    assert duplicates_of(edges) == pytest.approx(100 * 0.1 / 0.203, abs=0.3)  # the longer one, outside, counts first
    alike = EdgeSet(np.zeros((0, 2, 3)), curves, np.zeros(0, int), np.array([0] * 11))  # one source, run through twice
    assert duplicates_of(alike) == pytest.approx(50.0, abs=1.0)


def test_duplicates_of_lines_agree_with_a_loop(generator):
    """The slow twin: every line in turn, longest first, against the feet of the perpendiculars on those before it."""
    starts = np.zeros((25, 3)) + [0.0, 0.004, 0.0] * generator.integers(0, 5, (25, 1))
    starts[:, 0] += generator.uniform(0, 1, 25)
    lines = np.stack([starts, starts + [1.0, 0, 0] * generator.uniform(0.1, 0.6, (25, 1))], axis=1)
    lines[:, 1, 1] += generator.uniform(-0.005, 0.005, 25)
    lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    counted, repeated = [], 0
    for number in np.argsort(-lengths):
        start, along = lines[number, 0], (lines[number, 1] - lines[number, 0]) / lengths[number]
        at = np.arange(0.00025, lengths[number], 0.0005)
        marks = np.zeros(len(at), dtype=bool)
        for other_start, other_along, other_at, other_marks in counted:
            feet = (start + at[:, None] * along - other_start) @ other_along
            apart = np.linalg.norm(start + at[:, None] * along - other_start - feet[:, None] * other_along, axis=1)
            on_it = (feet >= 0) & (feet < other_at[-1]) & (apart <= 0.005)
            marks[on_it] |= ~other_marks[np.searchsorted(other_at, feet[on_it])]
        counted.append((start, along, at, marks))
        repeated += marks.sum() * 0.0005
    # Both are sampled, every 2 and every 0.5 mm, and the fast one reads 5 mm as 4.9: ends and rims differ, by 0.6 % at
    # most in 150 draws.
    assert duplicates_of(EdgeSet.of(lines)) == pytest.approx(100 * repeated / lengths.sum(), abs=2.0)


def test_duplicates_of_the_truth_are_reported_beside_the_prediction():
    near = [line([0, 0, 0], [1, 0, 0]), line([0, 0.002, 0], [1, 0.002, 0])]  # two true edges 2 mm apart
    metrics = evaluate(EdgeSet.of(near[:1]), truth_of(*near))
    assert metrics["duplicated_length_percent"] == 0.0
    assert metrics["true_duplicated_length_percent"] == pytest.approx(50.0)


# ------------------------------------------------------------------------------------------------- the real scenes


@pytest.mark.parametrize(
    ("scene", "lines", "curves", "length"), [("00000006", 12, 20, 13.05), ("00004926", 27, 6, 15.11)]
)
def test_abc_truth_has_the_known_curves(data, abc_truths, scene, lines, curves, length):
    truth = abc_truths[scene]
    assert (truth.kinds.count("line"), truth.kinds.count("curve")) == (lines, curves)
    assert truth.length == pytest.approx(length, abs=0.005)
    assert truth.points.min() > 0 and truth.points.max() < 1  # the box of stats.json is a little larger than the model
    independent = json.loads((data / SCENES[scene] / "curves.json").read_text())["curves"]  # derived by other code
    for ours, theirs in zip(truth.curves, independent, strict=True):
        np.testing.assert_allclose(ours, theirs["points"], atol=1e-6)


def test_the_rebuilt_scene_is_the_published_sampling(data, abc_truths):
    published = read_ground_truth(data / SCENES["00004926"] / "00004926_0.005.ply")
    assert published.curves == () and published.length is None
    rebuilt = abc_truths["00004926"].points
    assert len(rebuilt) == len(published.points) == 63840
    np.testing.assert_allclose(rebuilt, published.points, atol=1e-7)  # the same order even; the PLY was float32


@pytest.mark.parametrize("scene", SCENES)
def test_truth_as_its_own_prediction_gives_the_floors(abc_truths, scene):
    truth = abc_truths[scene]
    start = time.perf_counter()
    metrics = evaluate(truth_as_edges(truth), truth)
    assert time.perf_counter() - start < 5.0  # 0.3 s here; the limit leaves room for a busy machine
    assert 0.01 < metrics["accuracy_mm"] < 0.30
    assert 1.85 < metrics["completeness_mm"] < 1.99
    assert metrics["precision_5mm_percent"] == 100.0
    assert 99.2 < metrics["recall_5mm_percent"] < 99.9
    assert metrics["edges"] == metrics["true_edges_as_filed"] == len(truth.curves)
    assert_perfect(metrics)
    assert metrics["predicted_to_true_length_percent"] == pytest.approx(100.0, abs=0.1)
    difference = metrics["duplicated_length_percent"] - metrics["true_duplicated_length_percent"]
    assert abs(difference) < 0.1


def test_plate_truth_is_read_from_its_edge_list(data):
    truth = read_ground_truth(data / "cad/plate/gt_edges.json")
    assert (truth.kinds.count("line"), truth.kinds.count("curve")) == (12, 25)  # 240 cubics, joined
    sampled = read_ground_truth(data / "cad/plate/gt_pts_0.005.ply")
    # Sampled every 5 mm along the same edges: none of the two is farther than half of that from the other.
    assert cKDTree(truth.points).query(sampled.points)[0].max() < 0.0005
    assert cKDTree(sampled.points).query(truth.points)[0].max() < 0.003


def test_plate_as_its_own_prediction_gives_its_floor(data):
    path = data / "cad/plate/gt_edges.json"
    edges = edges_of_list(path, json.loads(path.read_text())["edges"])
    metrics = evaluate(edges, read_ground_truth(path))
    assert metrics["accuracy_mm"] < 0.15
    assert metrics["completeness_mm"] < 2.2
    assert metrics["precision_5mm_percent"] == 100.0
    assert metrics["recall_5mm_percent"] > 99.5
    assert metrics["duplicated_length_percent"] == metrics["true_duplicated_length_percent"] == 0.0
    # The rim of the deep bore comes as two halves; every line runs into a fillet, at both its ends.
    assert (metrics["true_edges"], metrics["corners"], metrics["tangential_joints"]) == (36, 0, 24)
    assert_perfect(metrics)


@pytest.mark.parametrize(
    ("scene", "edges", "corners", "tangential"), [("00000006", 27, 12, 6), ("00004926", 33, 20, 0)]
)
def test_abc_truth_has_the_known_primitives_and_corners(abc_truths, scene, edges, corners, tangential):
    """00000006: 12 lines, 12 splines, a circle in six arcs that the splines touch in pairs, two whole circles."""
    truth = abc_truths[scene]
    metrics = evaluate(truth_as_edges(truth), truth)
    assert (metrics["true_edges"], metrics["corners"], metrics["tangential_joints"]) == (edges, corners, tangential)


def test_the_circles_of_a_scene_are_met_between_the_vertices_too(abc_truths):
    """The chords of the file are 0.1 mm off; 00000006 is a nut, whose three circles have one axis."""
    truth = abc_truths["00000006"]
    closed = [curve for curve in true_primitives(truth.curves, truth.kinds) if np.allclose(curve[0], curve[-1])]
    radii = [np.linalg.norm(curve[:, :2] - 0.5, axis=1) for curve in closed]
    assert sorted(round(radius.mean(), 4) for radius in radii) == [0.2286, 0.2286, 0.4329]
    assert max(np.ptp(radius) for radius in radii) < 1e-6


# ------------------------------------------------------------------------------------------- files, and mistakes


def test_a_truth_in_other_units_is_scored_in_the_unit_cube(tmp_path):
    edges = EdgeSet(np.array([line([0, 0, 0], [1, 0, 0])]), circle_pieces(4), np.array([0]), np.array([1, 1, 1, 1]))
    in_mm = edges.transformed(lambda points: 1000 * points - 500)
    path = write_edges(tmp_path / "edges.json", in_mm, {})
    truth = read_ground_truth(path, lambda points: (points + 500) / 1000)
    assert truth.length == pytest.approx(1 + 2 * np.pi * 0.2, rel=1e-3)
    shifted = edges.transformed(lambda points: points + [0, 0, 0.003])
    assert evaluate(shifted, truth)["accuracy_mm"] == pytest.approx(3.0, abs=0.3)


def test_an_edge_file_of_ours_is_a_truth(tmp_path):
    edges = EdgeSet(np.array([line([0, 0, 0], [1, 0, 0])]), circle_pieces(4), np.array([0]), np.array([1, 1, 1, 1]))
    truth = read_ground_truth(write_edges(tmp_path / "edges.json", edges, {"units": "input", "edges": 2}))
    assert truth.kinds == ("line", "curve")
    assert truth.length == pytest.approx(1 + 2 * np.pi * 0.2, rel=1e-3)
    metrics = evaluate(edges, truth)
    assert metrics["precision_5mm_percent"] == 100.0
    assert metrics["accuracy_mm"] < 0.3
    assert "edges.json" in truth.source


@pytest.mark.parametrize("factor", [1.0, 1000.0])
@pytest.mark.parametrize("ends", [(-1e-16, 0.5), (np.pi, 4.2), (0.0, 2 * np.pi), (-0.3, 0.3), (2.0, 0.1)])
def test_interior_parameters_are_read_with_and_without_their_factor(factor, ends):
    true = np.linspace(*ends, 20)
    stored = true.copy()
    stored[1:-1] *= factor
    np.testing.assert_allclose(true_parameters(stored), true)


def test_parameters_that_turn_back_are_refused():
    assert true_parameters([0.0, 0.4, 0.2, 0.6]) is None


ABC_LINE = """curves:
- {sharp: true, type: Line, location: [0, 0, 0], direction: [1, 0, 0], vert_indices: [0, 1], vert_parameters: [0, 2]}
"""
ABC_ARC = """- {sharp: true, type: Circle, location: [0, 0, 0], radius: 2, x_axis: [1, 0, 0], y_axis: [0, 1, 0],
   vert_indices: [1, 2, 3], vert_parameters: [0, 500, 1]}
"""
ABC_SPLINE = "- {sharp: true, type: BSpline, vert_indices: [1, 2], vert_parameters: [0, 1], poles: []}\n"
ABC_STATS = {"0001": {"bbox": [0, 0, 0, 2, 2, 0, 2, 2, 0]}}


def abc_folder(folder, features, stats=ABC_STATS):
    (folder / "0001_abc_features_000.yml").write_text(features)
    if stats is not None:
        (folder / "stats.json").write_text(json.dumps(stats))
    return folder


def test_an_abc_folder_without_obj_is_rebuilt(tmp_path):
    truth = read_ground_truth(abc_folder(tmp_path, ABC_LINE + ABC_ARC))
    assert truth.kinds == ("line", "curve")
    # Raw 2 units long, the box 2 by 2 around (1, 1, 0): the line runs from (0, 0, 0.5) to (1, 0, 0.5).
    np.testing.assert_allclose(truth.curves[0], [[0, 0, 0.5], [1, 0, 0.5]])
    np.testing.assert_allclose(truth.curves[1][1], [np.cos(0.5), np.sin(0.5), 0.5])
    # Spacing in RAW units: 2 // 0.005 points on the line, and the same rule for the chords of the arc.
    chord = 2 * np.sin(0.25) * 2
    assert len(truth.points) == int(2 // 0.005) + 2 * int(chord // 0.005)
    assert "rebuilt" in truth.source


def test_an_obj_is_preferred_to_the_parameters(tmp_path):
    folder = abc_folder(tmp_path, ABC_LINE + ABC_SPLINE)
    (folder / "0001_abc_trimesh_000.obj").write_text("v 0 0 0\nv 2 0 0\nvn 1 0 0\nv 2 2 0\n")
    truth = read_ground_truth(folder)
    assert "obj" in truth.source
    np.testing.assert_allclose(truth.curves[1], [[1, 0, 0.5], [1, 1, 0.5]])


def test_only_the_curves_of_an_abc_folder_are_read(tmp_path):
    """The surfaces after them are 98 % of the file; where the curves do not come first, all of it is read."""
    surfaces = "surfaces:\n- {face_indices: [0, 1], type: Plane}\n"
    alone = read_ground_truth(abc_folder(tmp_path, ABC_LINE + ABC_ARC))
    for features in (ABC_LINE + ABC_ARC + surfaces, surfaces + ABC_LINE + ABC_ARC):
        truth = read_ground_truth(abc_folder(tmp_path, features))
        np.testing.assert_array_equal(truth.points, alone.points)
    assert "features" in refusal(abc_folder(tmp_path, ABC_LINE + "- {sharp: [\n" + surfaces))
    assert "features" in refusal(abc_folder(tmp_path, surfaces))


UNMATCHED_SOURCES = (
    '{"lines_end_pts": [[[0, 0, 0], [1, 0, 0]]], "curves_ctl_pts": [], "line_sources": [], "curve_sources": []}'
)


def refusal(path):
    with pytest.raises(UserError) as caught:
        read_ground_truth(path)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_what_cannot_be_rebuilt_names_the_curve_and_the_missing_file(tmp_path):
    text = refusal(abc_folder(tmp_path, ABC_LINE + ABC_SPLINE))
    assert "sharp curve 1 (BSpline)" in text and "0001_abc_trimesh_000.obj" in text
    shifted = ABC_ARC.replace("location: [0, 0, 0]", "location: [0.1, 0, 0]")  # no longer starts where the line ends
    text = refusal(abc_folder(tmp_path, ABC_LINE + shifted))
    assert "sharp curve 1 (Circle)" in text and "0001_abc_trimesh_000.obj" in text


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("broken.json", "{", "broken JSON"),
        ("list.json", "[1]", "not an edge file"),
        ("other.json", "{}", "not an edge file"),
        ("none.json", '{"lines_end_pts": [], "curves_ctl_pts": []}', "no edge"),
        ("sources.json", UNMATCHED_SOURCES, "do not match"),
        ("plate0.json", '{"edges": 3}', "not an edge file"),
        ("plate.json", '{"edges": [{"kind": "line", "p": [[0, 0, 0]]}]}', r"edges[0]"),
        ("plate2.json", '{"edges": [{"kind": "circle"}]}', r"edges[0]"),
        ("points.ply", "not a ply", "no readable points"),
        ("truth.txt", "", "not a ground truth"),
    ],
)
def test_a_file_that_is_no_truth_is_named_in_one_line(tmp_path, name, content, says):
    path = tmp_path / name
    path.write_text(content)
    text = refusal(path)
    assert text.startswith(f"{path}: ") and says in text


def test_folder_mistakes_are_named_in_one_line(tmp_path):
    assert "no such ground truth" in refusal(tmp_path / "nowhere")
    assert "*_features_*.yml" in refusal(tmp_path)
    assert "stats.json" in refusal(abc_folder(tmp_path, ABC_LINE, stats=None))
    assert "no scene '0001'" in refusal(abc_folder(tmp_path, ABC_LINE, stats={"0002": {}}))
    assert "bbox" in refusal(abc_folder(tmp_path, ABC_LINE, stats={"0001": {"bbox": [1, 2]}}))
    incomplete = ("curves: [{type: Line}]", "curves: [{sharp: yes}]", "curves: []")
    for broken in ("curves: [", "curves: 3", "[]", "", *incomplete):
        assert "features" in refusal(abc_folder(tmp_path, broken))
    abc_folder(tmp_path, ABC_LINE + ABC_SPLINE)
    obj = tmp_path / "0001_abc_trimesh_000.obj"
    for broken in ("v 0 0 0\n", "v 0 zero 0\n", ""):
        obj.write_text(broken)
        assert str(obj) in refusal(tmp_path)
    obj.with_name("0001_abc_trimesh_001.obj").write_text("")
    assert "2 files" in refusal(tmp_path)
