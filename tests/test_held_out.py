"""Views that only the evaluation sees: how they are chosen, what is hidden from them, and how they rank results."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import spearmanr

from taichi_edges.corridor import evaluate, prepare
from taichi_edges.corridor.pipeline import Run
from taichi_edges.detectors.ridges import trace_ridges
from taichi_edges.errors import UserError
from taichi_edges.evaluation.dense_curves import middle_samples
from taichi_edges.evaluation.edgel_index import MOST_SINE, EdgelIndex
from taichi_edges.evaluation.held_out import PLACE_PX, Visibility, held_out_metrics
from taichi_edges.evaluation.metrics import average_per_voxel, exact_polylines, point_metrics
from taichi_edges.evaluation.projected_curves import Chords
from taichi_edges.progress import Progress
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import Imperfections, render_edge_maps, ring_cameras
from taichi_edges.synthetic.visibility import LineSamples, outward_directions, ray_scene, visible_from
from taichi_edges.views.cameras import Camera
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.splitting import choose_held_out, split_views
from taichi_edges.views.views import Views, pixel_size, read_views

SIZE, VIEWS = 540, 30  # at which the 5 mm of the metrics in space are the 1.5 px of those in views


def seen_views(part, generator, count=VIEWS):
    """Views of a part with the edgels on the ridges of its maps, which have gaps, speckles, contours and jitter."""
    cameras = ring_cameras(count, SIZE)
    maps = render_edge_maps(part, *cameras, SIZE, Imperfections(), generator)
    names = tuple(f"v{view}" for view in range(count))
    return Views(names, maps, *cameras, ("",) * count, edgels=trace_ridges(maps, 2.5, 0.3, 2))


@pytest.fixture(scope="module")
def bracket():
    """(part, training views, held-out views)."""
    part = PARTS["bracket"]()
    views = seen_views(part, np.random.default_rng(0))
    return part, *split_views(views, choose_held_out(views.names, "auto"))


# ------------------------------------------------------------------------------------------------------------- choice


@pytest.mark.parametrize(("count", "held_out"), [(1, 0), (7, 0), (8, 1), (14, 1), (15, 2), (19, 2), (25, 3), (200, 3)])
def test_one_view_in_ten_is_held_out_and_seven_stay(count, held_out):
    names = [f"v{view}" for view in range(count)]
    chosen = choose_held_out(names, "auto")
    assert len(chosen) == held_out and choose_held_out(names, "off") == []
    gaps = np.diff([-1, *chosen, count])
    assert held_out == 0 or gaps.max() <= 2 * gaps.min()  # evenly: no stretch is twice as long as another


@pytest.mark.parametrize(("count", "wanted"), [(8, 4), (9, 4), (12, 1), (30, 4), (6, 3)])
def test_a_number_spares_the_first_and_the_last_view(count, wanted):
    chosen = choose_held_out([str(view) for view in range(count)], wanted)
    assert len(set(chosen)) == wanted and 0 not in chosen and count - 1 not in chosen


def test_names_choose_views_and_a_wrong_one_is_named():
    names = ["left", "middle", "right", "top", "below"]
    assert choose_held_out(names, ["top", "left"]) == [0, 3]
    with pytest.raises(UserError, match="no view 'lefd'; did you mean 'left'"):
        choose_held_out(names, ["lefd"])
    for too_many in (3, 9, ["left", "right", "top"]):
        with pytest.raises(UserError, match="of 5 views leave too few"):
            choose_held_out(names, too_many)


def test_a_split_keeps_every_view_and_its_edgels_on_one_side(generator):
    part = PARTS["block"]()
    views = seen_views(part, generator, 5)
    rest, held_out = split_views(views, [1, 3])
    assert rest.names == ("v0", "v2", "v4") and held_out.names == ("v1", "v3")
    for half, view, original in ((rest, 1, 2), (held_out, 1, 3)):
        np.testing.assert_array_equal(half.edge_maps[view], views.edge_maps[original])
        np.testing.assert_array_equal(half.world_to_camera[view], views.world_to_camera[original])
        for one, other in zip(half.edgels.of_view(view), views.edgels.of_view(original), strict=True):
            np.testing.assert_array_equal(one, other)
    for without_edgels in (
        views,
        replace(views, edgels=None),
        replace(views, edgels=views.edgels.keep(np.zeros(len(views.edgels), bool))),
    ):
        all_of_them, none = split_views(without_edgels, [])
        assert len(all_of_them) == 5 and len(none) == 0


@pytest.mark.slow(reason="calibrates many views")
def test_what_is_held_out_is_corrected_for_biases_found_elsewhere(tmp_path):
    """Both files have their edgels moved by the same shift, and maps drawn through them."""
    source = {"reader": "synthetic", "part": "block", "views": 8, "size": 128}

    def prepared(name, calibration):
        scene = {"source": source, "calibration": calibration}
        run = Run(check_scene(scene, "the test"), tmp_path / name, threads=2)
        facts = prepare.prepare(run)
        return facts, read_views(run.path("views.npz")), read_views(run.path("held_out.npz"))

    facts, *plain = prepared("plain", "off")
    assert facts["views"] == 7 and facts["held_out"] == ["block_004"] and plain[1].names == ("block_004",)
    _, *shifted = prepared("shifted", {"shift": [0.75, -0.5], "silhouette": "off"})
    for before, after in zip(plain, shifted, strict=True):
        assert "block_004" not in before.names or len(before) == 1
        np.testing.assert_allclose(after.edgels.points, before.edgels.points - np.float32([0.75, -0.5]), atol=1e-4)
        assert (after.edge_maps != before.edge_maps).any()


# ----------------------------------------------------------------------------------------------------------- geometry


def test_agreeing_edgels_are_those_of_a_brute_force_search(generator):
    width, height = 40, 30
    points = generator.uniform(-0.5, [width - 0.5, height - 0.5], (400, 2))
    places = generator.uniform(-3, [width + 3, height + 3], (300, 2))
    directions = generator.normal(size=(2, 400, 2))
    normals, along = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    along = along[:300]
    for radius in (1.5, 3.0):
        at, found, beside = EdgelIndex.of(points, normals, width, height).agreeing(places, along, radius)
        apart = np.linalg.norm(places[:, None] - points, axis=2)
        expected = np.argwhere((apart <= radius) & (np.abs(along @ normals.T) <= MOST_SINE))
        order = np.lexsort((found, at))
        np.testing.assert_array_equal(np.stack([at, found], axis=1)[order], expected)
        assert (np.diff(at) >= 0).all()
        expected = ((places[at] - points[found]) * normals[found]).sum(axis=1)
        np.testing.assert_allclose(beside, expected, atol=1e-5)  # float32, as the edgels are


def test_traces_are_even_in_the_image_and_on_the_curve(generator):
    """Whatever leaves the image, or passes behind the camera, is cut off; the length is that of the projection."""
    cameras = ring_cameras(1, 200)
    camera = Camera(cameras[0][0], cameras[1][0], 200, 200)
    polylines = list(generator.uniform(-3.0, 4.0, (60, 3, 3)))
    chords = Chords.of(polylines)
    traces = chords.in_image(camera, 0.75)
    assert len(traces) and traces.lengths.max() <= 0.75
    position = np.interp(traces.travelled, chords.travelled, np.arange(len(chords) + 1))
    chord = np.minimum(position.astype(int), len(chords) - 1)
    points = chords.starts[chord] + (position - chord)[:, None] * (chords.ends - chords.starts)[chord]
    pixels, _, inside = camera.project_lines(points, points)
    np.testing.assert_allclose(pixels[inside], traces.pixels[inside], atol=1e-6)
    assert inside.mean() > 0.99  # a sample half a step from the border may round to the other side
    dense = 0.0
    for start, end in zip(chords.starts, chords.ends, strict=True):
        line = start + np.linspace(0, 1, 20001)[:, None] * (end - start)
        pixels, _, inside = camera.project_lines(line, line)
        both = inside[1:] & inside[:-1]
        dense += np.linalg.norm(np.diff(pixels, axis=0), axis=1)[both].sum()
    assert traces.lengths.sum() == pytest.approx(dense, rel=2e-3)  # steps across the border are missing in `dense`


def test_texture_has_no_long_edges_but_lines_and_circles_are(generator):
    angles = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    outward = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    circle = 100 + 40 * outward
    line = np.stack([np.arange(20, 80.0), np.full(60, 20.3)], axis=1)
    strokes = generator.uniform(20, 180, (40, 1, 2)) + np.arange(8)[:, None] * [1.0, 0.0]
    strokes = strokes[np.abs(np.linalg.norm(strokes[:, 4] - 100, axis=1) - 40) > 12]  # clear of the circle
    strokes = strokes[np.abs(strokes[:, 0, 1] - 20.3) > 3].reshape(-1, 2)
    points = np.concatenate([circle, line, strokes])
    normals = np.concatenate([outward, np.tile([0.0, 1.0], (len(line) + len(strokes), 1))])
    long = EdgelIndex.of(points, normals, 200, 200).on_long_edges()
    assert long[:360].all()
    assert long[360:].mean() < 0.2  # strokes that happen to continue each other


def test_many_chains_in_a_large_image_are_told_apart():
    """More chains times pixels than 32 bits can count."""
    corners = np.stack(np.meshgrid(np.arange(20.0, 1900, 60), np.arange(20.0, 1990, 20)), axis=-1).reshape(-1, 1, 2)
    points = (corners + np.arange(40)[:, None] * [1.0, 0.0]).reshape(-1, 2)
    short = np.arange(len(points)) % 40 >= 20
    short &= np.arange(len(points)) >= len(points) // 2
    points = points[~short]
    long = EdgelIndex.of(points, np.tile([0.0, 1.0], (len(points), 1)), 2000, 2000).on_long_edges()
    whole = np.arange(len(points)) < np.count_nonzero(~short[: len(short) // 2])
    np.testing.assert_array_equal(long, whole)


# --------------------------------------------------------------------------------------------------------- visibility


def test_what_is_hidden_is_hardly_ever_judged(bracket):
    """Against ray casting. Where visibility ends between two views, nothing can be said: those are the exceptions."""
    part, training, held_out = bracket
    places, tangents, _ = Chords.of(exact_polylines(part.edges)).places(PLACE_PX * pixel_size(training))
    visibility, scene = Visibility.of(places, tangents, training), ray_scene(part)
    zeros = np.zeros(len(places), int)
    samples = LineSamples(places, outward_directions(part, places, 0.001), zeros, zeros)
    visible, judged = [], []
    for view in range(len(held_out)):
        centre = held_out.camera(view).centre
        visible.append(visible_from(scene, samples, centre))
        judged.append(visibility.judged_from(centre))
    visible, judged = np.concatenate(visible), np.concatenate(judged)
    assert 0.2 < visible.mean() < 0.9  # the test would say nothing otherwise
    assert judged[~visible].mean() < 0.15
    assert judged[visible].mean() > 0.7


# ------------------------------------------------------------------------------------------------------------ metrics


def test_true_edges_score_nearly_perfectly(bracket):
    part, training, held_out = bracket
    metrics = held_out_metrics(exact_polylines(part.edges), training, held_out)
    assert metrics["held_out_views"] == 3
    # Of the length, gaps are 4 %, and hidden places that are judged nevertheless some more.
    assert metrics["held_out_precision_percent"] > 90
    assert metrics["held_out_recall_long_percent"] > 95  # contours of the rounded bend are no edges
    assert metrics["held_out_recall_percent"] < metrics["held_out_recall_long_percent"]  # speckles are not long
    assert metrics["held_out_judged_percent"] > 50
    # Edges are shifted by 0.15 px (standard deviation in each axis) in each view: a median of 0.1.
    assert metrics["held_out_residual_median_px"] < 0.2 and metrics["held_out_residual_p90_px"] < 0.6


def test_false_edges_cost_precision_and_missing_ones_recall(bracket):
    part, training, held_out = bracket
    polylines = exact_polylines(part.edges)
    perfect = held_out_metrics(polylines, training, held_out)
    diagonals = [np.array([[0.15, 0.3, 0.9], [0.8, 0.7, 0.2]]), np.array([[0.2, 0.8, 0.4], [0.9, 0.35, 0.8]])]
    false = held_out_metrics([*polylines, *diagonals], training, held_out)
    assert false["held_out_precision_percent"] < perfect["held_out_precision_percent"] - 5
    assert abs(false["held_out_recall_long_percent"] - perfect["held_out_recall_long_percent"]) < 1
    missing = held_out_metrics(polylines[::2], training, held_out)
    assert missing["held_out_recall_long_percent"] < 0.75 * perfect["held_out_recall_long_percent"]
    assert missing["held_out_precision_percent"] > 85


def test_no_edges_and_no_views_give_no_numbers(bracket):
    _, training, held_out = bracket
    nothing = held_out_metrics([], training, held_out)
    assert nothing["held_out_precision_percent"] is None and nothing["held_out_residual_median_px"] is None
    assert nothing["held_out_recall_percent"] == nothing["held_out_f_score_percent"] == 0.0
    none = held_out_metrics([np.eye(3)], training, split_views(training, [])[1])
    assert none.pop("held_out_views") == 0 and set(none.values()) == {None}


def test_views_without_edgels_disagree_with_everything(bracket):
    part, training, held_out = bracket
    empty = Edgels.of_views([(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))] * len(held_out))
    blank = replace(held_out, edgels=empty)
    metrics = held_out_metrics(exact_polylines(part.edges), training, blank)
    assert metrics["held_out_precision_percent"] == 0.0 and metrics["held_out_recall_percent"] is None


def variants(edges, generator):
    """Degraded copies of an EdgeSet: edges dropped, added, moved, cut short, twice there and in pieces."""
    pieces = exact_polylines(edges)

    def moved(some, distance):
        away = generator.normal(size=(len(some), 3))
        return [piece + distance * way / np.linalg.norm(way) for piece, way in zip(some, away, strict=True)]

    def added(length):
        ends = generator.uniform(0.15, 0.85, (40, 2, 3))
        total = np.cumsum(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))
        return list(ends[: np.searchsorted(total, length) + 1])

    total = sum(np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece in pieces)
    halves = [half for piece in pieces for half in (piece[: len(piece) // 2 + 1], piece[len(piece) // 2 :])]
    shuffled = [pieces[index] for index in generator.permutation(len(pieces))]
    return {
        "true": pieces,
        "twice": [*pieces, *moved(pieces, 0.001)],
        "in pieces": [half for half in halves if len(half) > 1],
        "a fifth missing": shuffled[: 4 * len(pieces) // 5],
        "half missing": shuffled[: len(pieces) // 2],
        "four fifths missing": shuffled[: len(pieces) // 5],
        "a fifth false": pieces + added(0.25 * total),
        "half false": pieces + added(total),
        "half missing, half false": shuffled[: len(pieces) // 2] + added(total / 2),
        "a third moved by 20 mm": shuffled[: 2 * len(pieces) // 3] + moved(shuffled[2 * len(pieces) // 3 :], 0.02),
        "all moved by 12 mm": moved(pieces, 0.012),
        "all moved by 30 mm": moved(pieces, 0.03),
    }


def f_score_in_space(polylines, truth):
    """EMAP's F-score at 5 mm of polylines against (n, 3) true points: sampled every 5 mm, averaged per voxel."""
    points = middle_samples(polylines, 0.005)[0].astype(np.float32)
    return point_metrics(average_per_voxel(points), truth.astype(np.float32))["f_score_5mm_percent"]


@pytest.mark.slow(reason="scores many variants")
def test_held_out_views_rank_results_as_the_distances_to_the_true_edges_do(bracket):
    part, training, held_out = bracket
    truth = middle_samples(exact_polylines(part.edges), 0.0005)[0]
    results = variants(part.edges, np.random.default_rng(1))
    in_space = [f_score_in_space(polylines, truth) for polylines in results.values()]
    in_views = [held_out_metrics(result, training, held_out)["held_out_f_score_percent"] for result in results.values()]
    found = dict(zip(results, zip(in_space, in_views, strict=True), strict=True))
    assert spearmanr(in_space, in_views).statistic >= 0.9, found


class Warnings(Progress):
    """Keeps the warnings."""

    def __init__(self):
        self.texts = []

    def warn(self, text):
        self.texts.append(text)


def test_edges_that_fit_no_better_than_chance_are_told_from_those_that_fit(bracket):
    """As with images in another order than their poses."""
    part, views, held_out = bracket
    edgels = held_out.edgels
    exchanged = Edgels.of_views([edgels.of_view((view + 1) % len(held_out)) for view in range(len(held_out))])
    told = Warnings()
    for one in (held_out, replace(held_out, edgels=exchanged)):
        evaluate.warn_of_chance(held_out_metrics(exact_polylines(part.edges), views, one), told)
    (text,) = told.texts
    assert "of the edges fit the held-out views, where chance alone gives" in text and "their order" in text
    evaluate.warn_of_chance(held_out_metrics(exact_polylines(part.edges), views, split_views(views, [])[1]), told)
    assert told.texts == [text]  # nothing is known without held-out views
