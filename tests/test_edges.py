"""From points to edges: filtering, clustering, ordering, fitting, Bezier curves and the edge file."""

import heapq
import json

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from taichi_edges.errors import UserError
from taichi_edges.fitting.cubic_chains import BENDING, Ordering, fit_chain, lsq_chain, nearest_on_chain
from taichi_edges.geometry.bezier import LENGTH_SEGMENTS, bernstein, bezier_lengths, evaluate_bezier
from taichi_edges.geometry.edge_set import EdgeSet, edges_and_about, read_edges, write_edges
from taichi_edges.points.filtering import filter_points, statistical_inliers
from taichi_edges.scene.settings import ClusterConfig, FilterConfig, FitConfig
from taichi_edges.strokes.cluster_fits import fit_cluster, fit_curve, fit_line, wireframe_of
from taichi_edges.strokes.clustering import DIRECTION_MEMORY, grow_clusters, seed_order
from taichi_edges.strokes.neighbors import UNASSIGNED, alignment, members_of_clusters, neighbor_graph
from taichi_edges.strokes.ordering import connected_graph, join_pieces, order_points
from taichi_edges.views.views import Views

CENTRE = np.full(3, 0.5)
NOISE = 0.002  # unit-cube units, on every axis: what trained Gaussians scatter about an edge
SEEDS = range(8)


def along(count, generator):
    """(count,) parameters in 0..1, one in each of `count` equal cells: random, but without gaps."""
    return (np.arange(count) + generator.random(count)) / count


def noisy_line(start, end, count, noise=0.0, seed=0):
    """Points (count, 3) and directions (count, 3), the latter with random signs."""
    generator = np.random.default_rng(seed)
    start, end = np.asarray(start, float), np.asarray(end, float)
    points = start + along(count, generator)[:, None] * (end - start) + generator.normal(0, noise, (count, 3))
    signs = generator.choice([-1.0, 1.0], (count, 1))
    return points, signs * (end - start) / np.linalg.norm(end - start)


def noisy_arc(radius, start, end, count, noise=0.0, seed=0, centre=CENTRE):
    """The same for a circular arc in the plane z = 0.5 from angle `start` to `end`, radians."""
    generator = np.random.default_rng(seed)
    angles = start + (end - start) * along(count, generator)
    level = np.zeros(count)
    points = centre + radius * np.stack([np.cos(angles), np.sin(angles), level], axis=1)
    signs = generator.choice([-1.0, 1.0], (count, 1))
    return points + generator.normal(0, noise, (count, 3)), signs * np.stack(
        [-np.sin(angles), np.cos(angles), level], axis=1
    )


def joined(*parts):
    """One set of points and directions out of several."""
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def partition(labels):
    """The clusters as a set of sets of indices, whatever their numbers."""
    return {frozenset(np.flatnonzero(labels == label)) for label in set(labels.tolist()) - {UNASSIGNED}}


CROSS = joined(noisy_line((0, 0.5, 0.5), (1, 0.5, 0.5), 200), noisy_line((0.5, 0, 0.5), (0.5, 1, 0.5), 200, seed=1))
CORNER = joined(noisy_line((0, 0, 0), (1, 0, 0), 200), noisy_line((0, 0, 0), (0, 1, 0), 200, seed=1))
PARALLEL = joined(noisy_line((0, 0, 0), (1, 0, 0), 200), noisy_line((0, 0.02, 0), (1, 0.02, 0), 200, seed=1))
CIRCLE = noisy_arc(0.3, 0, 2 * np.pi, 300, NOISE)


# ------------------------------------------------------------------------------------------------------- clustering


@pytest.mark.parametrize("shape", [CROSS, CORNER, PARALLEL], ids=["cross", "corner", "parallel 2 cm apart"])
def test_two_lines_are_two_clusters(shape):
    labels = grow_clusters(*shape, ClusterConfig())
    truth = np.repeat([0, 1], 200)
    assert labels.max() == 1
    # A point in the crossing itself may go either way; everywhere else the lines must be told apart.
    agree = (labels == truth).mean()
    assert max(agree, 1 - agree) >= 0.98


def test_a_full_circle_is_one_closed_cluster():
    points, directions = CIRCLE
    labels = grow_clusters(points, directions, ClusterConfig())
    assert set(labels) == {0}
    assert order_points(points).closed


@pytest.mark.parametrize("shape", [CROSS, CORNER, PARALLEL, CIRCLE], ids=["cross", "corner", "parallel", "circle"])
def test_clusters_do_not_depend_on_the_order_of_the_points(shape, generator):
    points, directions = shape
    labels = grow_clusters(points, directions, ClusterConfig())
    order = generator.permutation(len(points))
    shuffled = grow_clusters(points[order], directions[order], ClusterConfig())
    restored = np.empty_like(shuffled)
    restored[order] = shuffled
    assert partition(restored) == partition(labels)


def test_clusters_do_not_depend_on_the_signs_of_the_directions(generator):
    points, directions = CIRCLE
    flipped = directions * generator.choice([-1.0, 1.0], (len(points), 1))
    assert partition(grow_clusters(points, flipped, ClusterConfig())) == partition(
        grow_clusters(points, directions, ClusterConfig())
    )


def test_theta_0_joins_whatever_touches():
    assert set(grow_clusters(*CORNER, ClusterConfig(theta=0.0))) == {0}


def test_theta_1_keeps_exact_lines_only():
    assert len(partition(grow_clusters(*CORNER, ClusterConfig(theta=1.0 - 1e-9)))) == 2
    assert partition(grow_clusters(*CIRCLE, ClusterConfig(theta=1.0))) == set()


def test_a_gap_beyond_max_gap_separates():
    pieces = joined(noisy_line((0, 0, 0), (0.4, 0, 0), 40), noisy_line((0.5, 0, 0), (1, 0, 0), 50))
    separate = grow_clusters(*pieces, ClusterConfig(max_gap=0.05, neighbors=30))
    assert sorted(len(piece) for piece in partition(separate)) == [40, 50]
    assert set(grow_clusters(*pieces, ClusterConfig(max_gap=0.15, neighbors=30))) == {0}


@pytest.mark.parametrize(("step", "followed"), [(6.0, True), (22.0, False)])
def test_an_edge_is_followed_round_a_gentle_bend_but_not_round_a_tight_one(step, followed):
    """Every neighbour agrees with the next one (cos 22 degrees = 0.93); the edge grown so far is what objects."""
    turn = np.radians(step) * np.arange(14)
    radius = 0.01 / (2 * np.sin(np.radians(step) / 2))  # 1 cm from point to point
    points = radius * np.stack([np.sin(turn), 1 - np.cos(turn), 0 * turn], axis=1)
    directions = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    labels = grow_clusters(points, directions, ClusterConfig(theta=0.8, min_points=2, neighbors=2, max_gap=0.012))
    assert (len(set(labels)) == 1) == followed


def test_larger_clusters_come_first_and_small_ones_are_left_out():
    shapes = joined(
        noisy_line((0, 0, 0), (0.1, 0, 0), 9),
        noisy_line((0, 0.5, 0), (0.5, 0.5, 0), 60),
        noisy_line((0, 1, 0), (1, 1, 0), 120),
    )
    labels = grow_clusters(*shapes, ClusterConfig(min_points=10))
    np.testing.assert_array_equal(labels, np.repeat([UNASSIGNED, 1, 0], [9, 60, 120]))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_points_are_no_cluster(count):
    labels = grow_clusters(np.zeros((count, 3)), np.tile([1.0, 0, 0], (count, 1)), ClusterConfig())
    np.testing.assert_array_equal(labels, np.full(count, UNASSIGNED))


def test_members_are_grouped_by_label(generator):
    labels = generator.integers(-1, 6, 200)
    labels[labels == 3] = 7  # two labels that nothing has
    groups = members_of_clusters(labels)
    assert len(groups) == 8
    for label, members in enumerate(groups):
        np.testing.assert_array_equal(members, np.flatnonzero(labels == label))
    assert members_of_clusters(np.zeros(0, int)) == members_of_clusters(np.full(4, UNASSIGNED)) == []


def slow_clusters(points, directions, config):
    """The traversal point by point, as the paper says it; clusters by falling size."""
    graph = neighbor_graph(points, config.neighbors, config.max_gap)
    aligned = alignment(directions, graph)
    labels, running, seeds = np.full(len(points), UNASSIGNED), directions.copy(), []
    for seed in seed_order(points, directions, graph, aligned):
        if labels[seed] != UNASSIGNED:
            continue
        labels[seed], queue = len(seeds), [(0.0, seed)]
        while queue:
            travelled, point = heapq.heappop(queue)
            for slot, neighbor in enumerate(graph.indices[point]):
                cosine = directions[neighbor] @ running[point]
                far = neighbor < 0 or aligned[point, slot] < config.theta or abs(cosine) < config.theta
                if far or labels[neighbor] != UNASSIGNED:
                    continue
                newest = np.sign(cosine) * directions[neighbor]
                blend = DIRECTION_MEMORY * running[point] + (1 - DIRECTION_MEMORY) * newest
                labels[neighbor], running[neighbor] = len(seeds), blend / np.linalg.norm(blend)
                heapq.heappush(queue, (travelled + graph.distances[point, slot], neighbor))
        seeds.append(seed)
    sizes = np.bincount(labels, minlength=len(seeds))
    order = [label for label in np.argsort(-sizes, kind="stable") if sizes[label] >= config.min_points]
    return np.array([order.index(label) if label in order else UNASSIGNED for label in labels])


def test_clusters_of_a_tangle_match_the_slow_traversal(generator):
    lines = [noisy_line(*generator.random((2, 3)), 60, NOISE, seed) for seed in range(12)]
    points, directions = joined(*lines, CIRCLE)
    directions = directions + generator.normal(0, 0.2, directions.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    config = ClusterConfig(max_gap=0.05)
    labels = grow_clusters(points, directions, config)
    assert labels.max() > 5
    np.testing.assert_array_equal(labels, slow_clusters(points, directions, config))


# --------------------------------------------------------------------------------------------------------- ordering

CLOSED = {
    "circle": lambda seed: noisy_arc(0.3, 0, 2 * np.pi, 150, NOISE, seed)[0],
    "sparse circle": lambda seed: noisy_arc(0.3, 0, 2 * np.pi, 40, NOISE, seed)[0],
    "small hole": lambda seed: noisy_arc(0.03, 0, 2 * np.pi, 60, NOISE, seed)[0],
}
OPEN = {
    "line": lambda seed: noisy_line((0, 0, 0), (1, 0, 0), 100, NOISE, seed)[0],
    "sparse line": lambda seed: noisy_line((0, 0, 0), (1, 0, 0), 12, NOISE, seed)[0],
    "five points": lambda seed: noisy_line((0, 0, 0), (0.05, 0, 0), 5, NOISE, seed)[0],
    "short thick line": lambda seed: noisy_line((0, 0, 0), (0.05, 0, 0), 60, 2 * NOISE, seed)[0],
    "line with a gap": lambda seed: np.concatenate(
        [
            noisy_line((0, 0, 0), (0.4, 0, 0), 60, NOISE, seed)[0],
            noisy_line((0.6, 0, 0), (1, 0, 0), 60, NOISE, seed + 99)[0],
        ]
    ),
    "quarter": lambda seed: noisy_arc(0.3, 0, np.pi / 2, 80, NOISE, seed)[0],
    "circle with 60 degrees missing": lambda seed: noisy_arc(0.3, 0, np.radians(300), 150, NOISE, seed)[0],
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", CLOSED)
def test_closed_edges_are_found_closed(name, seed):
    assert order_points(CLOSED[name](seed)).closed


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", OPEN)
def test_open_edges_are_found_open(name, seed):
    assert not order_points(OPEN[name](seed)).closed


def test_arc_length_follows_a_bent_edge():
    points, _ = noisy_arc(0.3, 0, 1.5 * np.pi, 200, seed=4)  # the parameters of noisy_arc rise with the index
    ordering = order_points(points)
    arc = ordering.arc if ordering.arc[0] < ordering.arc[-1] else ordering.length - ordering.arc
    assert ordering.length == pytest.approx(0.3 * 1.5 * np.pi, rel=0.02)
    assert np.abs(arc - np.linspace(0, ordering.length, 200)).max() < 0.02


def test_arc_length_goes_once_round_a_circle():
    points, _ = noisy_arc(0.3, 0, 2 * np.pi, 200, seed=4)
    ordering = order_points(points)
    steps = np.diff(np.concatenate([ordering.arc, ordering.arc[:1]]))
    steps = (steps + ordering.length / 2) % ordering.length - ordering.length / 2  # across the joint as well
    assert ordering.length == pytest.approx(2 * np.pi * 0.3, rel=0.03)
    assert abs(abs(steps.sum()) - ordering.length) < 1e-9 and (np.abs(steps) < 0.05).all()


def test_coinciding_points_are_ordered_too():
    ordering = order_points(np.repeat([[0.0, 0, 0], [0.1, 0, 0]], 6, axis=0))
    assert ordering.length == pytest.approx(0.1) and not ordering.closed


def test_pieces_of_a_graph_are_joined_by_their_shortest_connections(generator):
    """Slow twin: all distances at once, and always the nearest point outside the piece of the first point."""
    points = (generator.random((9, 3))[:, None] + generator.normal(0, 0.01, (9, 12, 3))).reshape(-1, 3)
    labels = np.arange(9).repeat(12)
    distances = cdist(points, points)
    expected, inside = {}, labels == 0
    while not inside.all():
        gaps = np.where(inside[:, None] & ~inside, distances, np.inf)
        a, b = np.unravel_index(gaps.argmin(), gaps.shape)
        expected[min(a, b), max(a, b)] = distances[a, b]
        inside |= labels == labels[b]
    bridged = join_pieces(points, coo_array((108, 108)).tocsr(), labels).tocoo()
    found = {(a, b): value for a, b, value in zip(*bridged.coords, bridged.data, strict=True) if a < b}
    assert bridged.nnz == 2 * len(found) and found.keys() == expected.keys()
    np.testing.assert_allclose([found[pair] for pair in expected], list(expected.values()))
    assert connected_components(connected_graph(points), directed=False)[0] == 1


# ---------------------------------------------------------------------------------------------------------- fitting


@pytest.mark.parametrize("seed", SEEDS)
def test_noisy_line_is_a_line_within_the_noise(seed):
    start, end = np.array([0.1, 0.2, 0.3]), np.array([0.8, 0.5, 0.9])
    fit = fit_cluster(noisy_line(start, end, 150, NOISE, seed)[0], FitConfig())
    assert fit.kind == "line"
    ends = (
        fit.shape.points
        if np.linalg.norm(fit.shape.points[0] - start) < np.linalg.norm(fit.shape.points[1] - start)
        else fit.shape.points[::-1]
    )
    across = np.cross(ends - start, (end - start) / np.linalg.norm(end - start))
    # The line's standard error is 2 * NOISE / sqrt(150) at its ends; the ends themselves lie a few spacings off.
    assert np.linalg.norm(across, axis=1).max() < 5 * 2 * NOISE / np.sqrt(150)
    assert np.abs(ends - [start, end]).max() < 3 * NOISE + 2 * np.linalg.norm(end - start) / 150


def test_ends_of_an_exact_line_are_exact():
    line, error = fit_line(np.linspace(0, 1, 50)[:, None] * [1.0, 0, 0], 0.005)
    np.testing.assert_allclose(np.sort(line[:, 0]), [0, 1], atol=1e-12)
    assert error < 1e-12


@pytest.mark.parametrize("seed", SEEDS)
def test_outliers_do_not_spoil_a_line(seed):
    points, _ = noisy_line((0, 0.5, 0.5), (1, 0.5, 0.5), 200, NOISE / 2, seed)
    strays = np.random.default_rng(seed).uniform((0.3, 0.55, 0.55), (0.7, 0.7, 0.7), (20, 3))
    fit = fit_cluster(np.concatenate([points, strays]), FitConfig())
    assert fit.kind == "line"
    assert np.linalg.norm(fit.shape.points[:, 1:] - 0.5, axis=1).max() < NOISE
    np.testing.assert_allclose(np.sort(fit.shape.points[:, 0]), [0, 1], atol=0.015)


def test_one_stray_point_does_not_lengthen_a_line():
    points, _ = noisy_line((0, 0, 0), (0.5, 0, 0), 150, NOISE / 4)
    fit = fit_cluster(np.concatenate([points, [[0.6, 0, 0]]]), FitConfig())
    assert fit.kind == "line" and fit.shape.points[:, 0].max() < 0.51


@pytest.mark.parametrize("seed", SEEDS)
def test_noisy_arc_is_a_curve_on_the_arc(seed):
    fit = fit_cluster(noisy_arc(0.3, 0, 2.0, 120, NOISE, seed)[0], FitConfig())
    assert fit.kind == "curve"
    samples = evaluate_bezier(fit.shape.curves, np.linspace(0, 1, 50)).reshape(-1, 3) - CENTRE
    assert np.abs(np.linalg.norm(samples, axis=1) - 0.3).max() < 3 * NOISE
    assert bezier_lengths(fit.shape.curves).sum() == pytest.approx(0.6, abs=0.03)


@pytest.mark.parametrize("count", [60, 200, 600])
def test_full_circle_is_a_loop_whose_pieces_meet_smoothly_on_the_circle(count):
    fit = fit_cluster(noisy_arc(0.3, 0, 2 * np.pi, count)[0], FitConfig())
    assert fit.kind == "loop"
    first, last = fit.shape.curves[:, 0], fit.shape.curves[:, 3]
    np.testing.assert_array_equal(first, np.roll(last, 1, axis=0))
    away = fit.shape.curves[:, 1] - first
    towards = np.roll(last - fit.shape.curves[:, 2], 1, axis=0)
    cosines = (away * towards).sum(axis=1) / np.linalg.norm(away, axis=1) / np.linalg.norm(towards, axis=1)
    assert cosines.min() > np.cos(np.radians(2))
    samples = evaluate_bezier(fit.shape.curves, np.linspace(0, 1, 100)).reshape(-1, 3) - CENTRE
    assert np.abs(np.linalg.norm(samples, axis=1) - 0.3).max() < 1e-3
    assert np.abs(samples[:, 2]).max() < 1e-3


def test_s_shape_is_one_smooth_curve_along_both_arcs():
    upper, _ = noisy_arc(0.2, 0, np.pi, 100, NOISE / 4, seed=1)
    lower, _ = noisy_arc(0.2, np.pi, 2 * np.pi, 100, NOISE / 4, seed=2, centre=CENTRE + [0.4, 0, 0])
    points = np.concatenate([upper, lower])
    fit = fit_cluster(points, FitConfig())
    assert fit.kind == "curve"
    distances, _ = nearest_on_chain(points, fit.shape.curves)
    assert distances.mean() < NOISE / 2 and distances.max() < 0.006  # the curvature jumps in the middle
    np.testing.assert_array_equal(fit.shape.curves[1:, 0], fit.shape.curves[:-1, 3])
    assert bezier_lengths(fit.shape.curves).sum() == pytest.approx(2 * np.pi * 0.2, rel=0.03)


def test_delta_decides_between_line_and_curve():
    points, _ = noisy_arc(1.0, 0, 0.35, 150, NOISE)  # bent by 0.015 in its middle, four times the mean noise
    assert fit_cluster(points, FitConfig(delta=0.0)).kind == "line"
    assert fit_cluster(points, FitConfig(delta=1.0)).kind == "curve"


def test_two_identical_points_are_degenerate():
    assert fit_cluster(np.full((2, 3), 0.5), FitConfig()).kind == "degenerate"


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7])
def test_a_handful_of_points_in_a_row_is_a_line(count):
    fit = fit_cluster(np.linspace(0, 0.1, count)[:, None] * [1.0, 0, 0], FitConfig())
    assert fit.kind == "line"
    np.testing.assert_allclose(np.sort(fit.shape.points[:, 0]), [0, 0.1], atol=1e-12)


def test_every_cluster_is_counted_once():
    shapes = [
        noisy_line((0, 0, 0), (1, 0, 0), 100, NOISE)[0],
        noisy_arc(0.3, 0, 2, 100, NOISE)[0],
        noisy_arc(0.3, 0, 2 * np.pi, 100, NOISE)[0],
        noisy_line((0, 0, 0), (0.005, 0, 0), 20)[0],
        np.full((12, 3), 0.5),
    ]
    points, labels = np.concatenate(shapes), np.repeat(np.arange(5), [len(shape) for shape in shapes])
    unassigned = np.random.default_rng(0).random((30, 3))
    points, labels = np.concatenate([points, unassigned]), np.concatenate([labels, np.full(30, UNASSIGNED)])
    config = FitConfig(min_length=0.01)
    edges, counts = wireframe_of(fit_cluster(points[members], config) for members in members_of_clusters(labels))
    assert counts == {"line": 1, "curve": 1, "loop": 1, "short": 1, "degenerate": 1}
    assert [shape.kind for shape in edges.shapes] == ["line", "spline", "spline"]
    assert [shape.closed for shape in edges.shapes] == [False, False, True]
    pieces = edges.edge_set()
    assert pieces.line_sources.tolist() == [0] and set(pieces.curve_sources.tolist()) == {1, 2}
    assert len(pieces.curve_sources) == len(pieces.curves)


def test_no_clusters_give_no_edges():
    edges, counts = wireframe_of([])
    assert len(edges) == 0 and sum(counts.values()) == 0


@pytest.mark.parametrize("pieces", [1, 2, 5])
def test_the_chain_is_the_b_spline_with_double_knots(generator, pieces):
    """Slow twin: SciPy's basis functions, with the same penalty on the second differences of the coefficients."""
    parameters = generator.uniform(0, pieces, 40)
    parameters[:3] = 0, pieces, pieces // 2  # both ends and a joint
    points, weights = generator.normal(size=(40, 3)), generator.random(40)
    knots = np.repeat(np.arange(pieces + 1.0), 2)
    knots = np.concatenate([[0, 0], knots, [pieces, pieces]])
    design = BSpline.design_matrix(parameters, knots, 3).toarray() * np.sqrt(weights)[:, None]
    bend = np.diff(np.eye(2 * pieces + 2), 2, axis=0) * BENDING * np.sqrt(weights.sum())
    targets = np.concatenate([points * np.sqrt(weights)[:, None], np.zeros((2 * pieces, 3))])
    spline = BSpline(knots, np.linalg.lstsq(np.concatenate([design, bend]), targets, rcond=None)[0], 3)
    within = np.linspace(0, 1, 11)[:-1]
    found = evaluate_bezier(lsq_chain(parameters, points, weights, pieces), within)
    np.testing.assert_allclose(found, spline(np.arange(pieces)[:, None] + within), atol=1e-9)


@pytest.mark.parametrize("straggler", [[0.3, 0.0, 0.0], [0.1, 0.4, 0.2]])
def test_a_cubic_is_found_whatever_its_pace(straggler):
    """Its parameter is not its arc length, so at first it is many tolerances off; in the end the penalty is left."""
    cubic = np.array([[[0.0, 0.0, 0.0], straggler, [0.3, 0.0, 0.0], [0.3, 0.3, 0.0]]])
    dense = evaluate_bezier(cubic, np.linspace(0, 1, 4001))[0]
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    at = np.linspace(0, arc[-1], 120)
    points = np.stack([np.interp(at, arc, axis) for axis in dense.T], axis=1)
    curves, _ = fit_chain(points, Ordering(at, arc[-1], False), NOISE, 1)
    assert nearest_on_chain(points, curves)[0].max() < 0.5 * NOISE
    np.testing.assert_allclose(curves[0, [0, 3]], cubic[0, [0, 3]], atol=0.5 * NOISE)


def test_distances_to_a_chain_match_brute_force(generator):
    corners = np.cumsum(generator.uniform(-0.2, 0.2, (10, 3)), axis=0)
    curves = np.stack([corners[0:4], corners[3:7], corners[6:10]])
    points = generator.normal(0, 0.3, (50, 3))
    dense = evaluate_bezier(curves, np.linspace(0, 1, 5001)).reshape(-1, 3)
    expected, _ = cKDTree(dense).query(points)
    distances, parameters = nearest_on_chain(points, curves)
    # The second derivatives are below 6 * 0.8, so chords of 1/127 in the parameter are off by 4.8 / 8 / 127^2 at most.
    np.testing.assert_allclose(distances, expected, atol=2e-4)
    pieces = np.minimum(parameters.astype(int), 2)
    reached = [evaluate_bezier(curves[piece], [at - piece])[0] for piece, at in zip(pieces, parameters, strict=True)]
    np.testing.assert_allclose(np.linalg.norm(np.array(reached) - points, axis=1), expected, atol=5e-4)


# ----------------------------------------------------------------------------------------------------------- Bezier


def de_casteljau(control, t):
    """The definition: repeated linear interpolation."""
    points = np.asarray(control, float)
    while len(points) > 1:
        points = (1 - t) * points[:-1] + t * points[1:]
    return points[0]


def test_bezier_points_match_de_casteljau(generator):
    control, parameters = generator.normal(size=(4, 3)), generator.random(20)
    np.testing.assert_allclose(
        evaluate_bezier(control, parameters), [de_casteljau(control, t) for t in parameters], atol=1e-12
    )
    np.testing.assert_allclose(bernstein(parameters).sum(axis=1), 1.0)


def test_bezier_lengths_are_sums_of_chords(generator):
    curves = generator.normal(size=(3, 4, 3))
    expected = [
        sum(
            np.linalg.norm(
                de_casteljau(control, (i + 1) / LENGTH_SEGMENTS) - de_casteljau(control, i / LENGTH_SEGMENTS)
            )
            for i in range(LENGTH_SEGMENTS)
        )
        for control in curves
    ]
    np.testing.assert_allclose(bezier_lengths(curves), expected)
    assert bezier_lengths(np.zeros((0, 4, 3))).shape == (0,)


# ------------------------------------------------------------------------------------------------- EdgeSet and file


def some_edges(generator, lines=3, curves=2):
    """Random edges with sources that are not just 0, 1, 2."""
    edges = EdgeSet.of(generator.random((lines, 2, 3)), generator.random((curves, 4, 3)))
    sources = 10 + np.arange(lines), np.full(curves, 7)
    return EdgeSet(edges.lines, edges.curves, *sources)


def test_samples_lie_on_the_edges_at_most_the_spacing_apart(generator):
    edges, spacing = some_edges(generator), 0.01
    points, tangents, owners = edges.sample(spacing)
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1.0)
    for index, polyline in enumerate(edges.polylines(2000)):
        own = points[owners == index]
        assert np.linalg.norm(np.diff(own, axis=0), axis=1).max() <= spacing * (1 + 1e-9)
        np.testing.assert_allclose(own[[0, -1]], polyline[[0, -1]], atol=1e-12)
        dense = (
            polyline
            if len(polyline) > 2
            else polyline[0] + np.linspace(0, 1, 2001)[:, None] * (polyline[1] - polyline[0])
        )
        # Curves are sampled along 32 chords: off by |second derivative| / 8 / 32^2, which is below 24 * sqrt(3) here.
        assert cKDTree(dense).query(own)[0].max() < 24 * np.sqrt(3) / 8 / 32**2
    assert len(own) >= edges.lengths[-1] / spacing


def test_samples_of_no_edges_are_empty():
    points, tangents, owners = EdgeSet.of().sample(0.01)
    assert points.shape == tangents.shape == (0, 3) and owners.shape == (0,)


def test_edges_come_back_bit_for_bit(generator, tmp_path):
    edges = some_edges(generator)
    path = write_edges(tmp_path / "edges.json", edges, {"frame": "input", "seed": 3})
    again, about = edges_and_about(path)
    for name in ("lines", "curves", "line_sources", "curve_sources"):
        np.testing.assert_array_equal(getattr(again, name), getattr(edges, name))
    assert about == {"frame": "input", "seed": 3}
    copy = write_edges(tmp_path / "again.json", again, about)
    assert copy.read_bytes() == path.read_bytes()


def test_no_edges_come_back_too(tmp_path):
    again = read_edges(write_edges(tmp_path / "edges.json", EdgeSet.of(), {}))
    assert again.lines.shape == (0, 2, 3) and again.curves.shape == (0, 4, 3) and len(again) == 0


LINE = [[[0, 0, 0], [1, 0, 0]]]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "cannot be read as JSON"),
        ("[]", "needs the keys curves_ctl_pts and lines_end_pts"),
        ({"lines_end_pts": LINE}, "needs the keys curves_ctl_pts and lines_end_pts"),
        ({"lines_end_pts": [[[0, 0, 0]]], "curves_ctl_pts": []}, "lines_end_pts must hold 2 points"),
        ({"lines_end_pts": [], "curves_ctl_pts": [["a"]]}, "curves_ctl_pts must hold 4 points"),
        ({"lines_end_pts": LINE, "curves_ctl_pts": [], "line_sources": [0]}, "line_sources alone"),
        ({"lines_end_pts": LINE, "curves_ctl_pts": [], "curve_sources": []}, "curve_sources alone"),
        (
            {"lines_end_pts": LINE, "curves_ctl_pts": [], "line_sources": [0, 1], "curve_sources": []},
            "do not match: 2 and 1",
        ),
        (
            {"lines_end_pts": LINE, "curves_ctl_pts": [], "line_sources": [0], "curve_sources": [4]},
            "do not match: 1 and 0",
        ),
        ({"lines_end_pts": LINE, "curves_ctl_pts": [], "line_sources": [0.5], "curve_sources": []}, "whole numbers"),
        ({"lines_end_pts": LINE, "curves_ctl_pts": [], "line_sources": 3, "curve_sources": []}, "whole numbers"),
    ],
)
def test_a_wrong_edge_file_is_named_in_one_line(tmp_path, content, says):
    path = tmp_path / "edges.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(UserError) as refused:
        read_edges(path)
    text = str(refused.value)
    assert text.startswith(f"{path}: ") and says in text and "\n" not in text


def test_a_missing_edge_file_is_named(tmp_path):
    with pytest.raises(UserError, match="nowhere.json: No such file"):
        read_edges(tmp_path / "nowhere.json")


# -------------------------------------------------------------------------------------------------------- filtering


def four_views(column=16):
    """Four times the same camera at the origin, looking along z, 32 x 32 px; one bright column in each edge map."""
    lens = np.array([[32.0, 0, 15.5], [0, 32.0, 15.5], [0, 0, 1]])
    maps = np.zeros((4, 32, 32), np.uint8)
    maps[:, :, column] = 255
    cameras = np.repeat(lens[None], 4, axis=0), np.repeat(np.eye(4)[None, :3], 4, axis=0)
    return Views(tuple("abcd"), maps, *cameras, image_paths=("",) * 4)


def points_on_column(count, column=16, depth=2.0):
    """(count, 3) points that project into the given column, at different heights."""
    rows = np.linspace(4, 27, count)
    return np.stack(
        [np.full(count, (column - 15.5) / 32 * depth), (rows - 15.5) / 32 * depth, np.full(count, depth)], axis=1
    )


def filtered(points, opacities=None, **config):
    """filter_points with directions that carry the points' numbers."""
    opacities = np.ones(len(points)) if opacities is None else opacities
    directions = np.stack([np.arange(len(points)), np.zeros(len(points)), np.zeros(len(points))], axis=1)
    settings = FilterConfig(**{"outlier_neighbors": 0, "refine": False, **config})
    found, counts = filter_points(points, directions, opacities, four_views(), settings, 0.5)
    kept = found.directions[:, 0].astype(int)
    np.testing.assert_array_equal(found.points, np.asarray(points)[kept])
    assert counts.gaussians == len(points)
    assert counts.gaussians - counts.low_opacity - counts.low_support - counts.outliers == len(found)
    return kept.tolist(), counts


def test_transparent_gaussians_are_left_out(taichi):
    opacities = np.array([0.9, 0.19, 0.2, 0.0])
    kept, counts = filtered(points_on_column(4), opacities, min_opacity=0.2)
    assert kept == [0, 2] and counts.low_opacity == 2


def test_points_off_the_edges_behind_the_cameras_and_outside_the_images_have_no_support(taichi):
    on_edge, off_edge = points_on_column(1)[0], points_on_column(1, column=5)[0]
    behind, outside = -on_edge, points_on_column(1, column=200)[0]
    kept, counts = filtered(np.stack([on_edge, off_edge, behind, outside]), min_support=0.0)
    assert kept == [0] and counts.low_support == 3


def test_support_counts_only_the_views_that_see_a_point(taichi):
    views = four_views()
    away = views.world_to_camera.copy()
    away[3] = np.diag([-1.0, 1, -1, 1])[:3]  # the last camera looks the other way
    views = Views(views.names, views.edge_maps, views.intrinsics, away, views.image_paths)
    points = points_on_column(3)
    settings = FilterConfig(min_support=1.0, outlier_neighbors=0, refine=False)
    assert len(filter_points(points, points, np.ones(3), views, settings, 0.5)[0]) == 3


def test_support_is_a_share_of_the_views(taichi):
    views = four_views()
    maps = views.edge_maps.copy()
    maps[1:] = 0  # an edge in one view of four
    views = Views(views.names, maps, views.intrinsics, views.world_to_camera, views.image_paths)
    points = points_on_column(3)
    for share, expected in ((0.25, 3), (0.26, 0)):
        settings = FilterConfig(min_support=share, outlier_neighbors=0, refine=False)
        found = filter_points(points, points, np.ones(3), views, settings, 0.5)[0]
        assert len(found) == expected


def test_isolated_points_are_outliers(generator):
    points = np.concatenate([generator.random((60, 3)), [[9.0, 9, 9]]])
    np.testing.assert_array_equal(statistical_inliers(points, 10, 5.0), np.arange(60))
    np.testing.assert_array_equal(statistical_inliers(points, 0, 5.0), np.arange(61))


def test_too_few_points_have_no_outliers(generator):
    np.testing.assert_array_equal(statistical_inliers(generator.random((5, 3)), 10, 1.0), np.arange(5))


@pytest.mark.slow(reason="fits many pieces")
@pytest.mark.parametrize("lobes", [6, 8])
def test_a_rim_of_scallops_gets_the_pieces_it_needs_although_one_more_does_not_help(lobes):
    angles = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    rim = np.stack([0.5 + 0.4 * np.cos(angles), 0.5 + 0.4 * np.sin(angles), 0.05 * np.cos(lobes * angles)], axis=1)
    curves, error = fit_curve(rim, order_points(rim), 0.005)
    assert error < 0.002 and len(curves) <= 4 * lobes
    samples = evaluate_bezier(curves, np.linspace(0, 1, 50)).reshape(-1, 3)
    assert cKDTree(samples).query(rim)[0].max() < 0.005


def test_nothing_left_is_no_error(taichi):
    kept, counts = filtered(points_on_column(5), np.zeros(5))
    assert kept == [] and counts.low_opacity == 5
