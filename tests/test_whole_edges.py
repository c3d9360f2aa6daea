"""Whole lines and arcs out of oriented points: tangential touches, cusps, gaps, fillets, neighbours, noise."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from taichi_edges.fitting.arcs import Arc, fit_arc
from taichi_edges.geometry.bezier import bezier_lengths, evaluate_bezier
from taichi_edges.scene.settings import ClusterConfig, FitConfig
from taichi_edges.strokes.arc_growth import Cloud, Scale
from taichi_edges.strokes.assembly import assemble, fit_clusters
from taichi_edges.strokes.clustering import seed_order
from taichi_edges.strokes.free_curves import free_curves
from taichi_edges.strokes.merging import Piece
from taichi_edges.strokes.neighbors import UNASSIGNED, alignment, neighbor_graph
from taichi_edges.strokes.noise import LEAST_NOISE, measured_scale

SPACING = 0.003  # unit-cube units between neighbouring points, as on real scenes
NOISES = (1e-4, 3e-4, 1e-3)  # unit-cube units: images, images with less sure edges, detectors' maps
SEEDS = range(3)


def turned(points, seed=0):
    """(n, 3) points in a frame that has no axis in common with the world's, near the middle of the unit cube."""
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return points @ rotation + 0.5


def circle(radius, start=0.0, end=2 * np.pi, centre=(0.0, 0.0, 0.0)):
    """Exact points of an arc in the plane z = 0 from angle to angle, radians, and unit tangents."""
    count = max(int(radius * abs(end - start) / SPACING), 4)
    angle = start + (end - start) * (np.arange(count) + 0.5) / count
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return np.asarray(centre) + radius * points, np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)


def line(start, end):
    """Exact points of a line, and unit tangents."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    count = max(int(np.linalg.norm(end - start) / SPACING), 4)
    shares = (np.arange(count)[:, None] + 0.5) / count
    return start + shares * (end - start), np.tile((end - start) / np.linalg.norm(end - start), (count, 1))


def curve(function, low, high):
    """Exact points of a curve (n,) -> (n, 3), evenly spaced, and unit tangents."""
    t = np.linspace(low, high, 4001)
    dense = function(t)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    count = int(arc[-1] / SPACING)
    at = (np.arange(count) + 0.5) * arc[-1] / count
    points, tangents = (
        np.stack([np.interp(at, arc, values[:, axis]) for axis in range(3)], axis=1)
        for values in (dense, np.gradient(dense, arc, axis=0))
    )
    return points, tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def observed(*parts, noise=2e-4, seed=0):
    """The parts as one set of noisy points and directions of random sign; and which part each point is of."""
    generator = np.random.default_rng(seed)
    points, tangents = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    both = turned(np.concatenate([points, points + tangents]))
    directions = both[len(points) :] - both[: len(points)]
    directions = directions + generator.normal(0, 0.02, directions.shape)
    directions *= generator.choice([-1.0, 1.0], (len(points), 1)) / np.linalg.norm(directions, axis=1, keepdims=True)
    places = both[: len(points)] + generator.normal(0, noise, points.shape)
    return places, directions, np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])


def edges_of(points, directions):
    """The Clusters and the EdgeSet of oriented points."""
    found = assemble(points, directions, ClusterConfig())
    return found, fit_clusters(found, FitConfig())[0].edge_set()


def count_edges(edges):
    return len(set(edges.line_sources.tolist()) | set(edges.curve_sources.tolist()))


def distances_to(edges, points):
    """(n,) from exact points (before `turned`) to the edges, and (m,) back from samples of the edges."""
    samples, exact = edges.sample(1e-3)[0], turned(points)
    return cKDTree(samples).query(exact)[0], cKDTree(exact).query(samples)[0]


# ------------------------------------------------------------------------------------------------------------- arcs


@pytest.mark.parametrize(("radius", "angle"), [(0.1, 2 * np.pi), (0.1, 1.0), (0.05, 3.0), (1.0, 0.3), (1e3, 1e-3)])
def test_an_arc_fit_from_a_poor_start_ends_on_the_arc(radius, angle):
    points, tangents = (
        turned(part) - shift for part, shift in zip(circle(radius, -angle / 2, angle / 2), (0, 0.5), strict=True)
    )
    middle, tangent = turned(np.array([[radius, 0, 0]]))[0], turned(np.array([[0.0, 1, 0]]))[0] - 0.5
    inward = 0.5 - turned(np.array([[1.0, 0, 0]]))[0]
    start = Arc(
        middle + 0.01 * radius * inward, tangent, 0.6 * inward / radius, -radius * angle / 2, radius * angle / 2
    )
    arc = fit_arc(start, points, tangents, 0.0, 1.0, straight=False, rounds=8)
    assert np.abs(arc.coordinates(points)[1]).max() < 1e-6
    assert arc.curvature == pytest.approx(1 / radius, rel=1e-3, abs=1e-5)


def test_a_line_is_an_arc_without_bend():
    points, tangents = line((0, 0, 0), (0.5, 0.2, 0.1))
    start = Arc(points[3] + 0.002, np.array([1.0, 0.3, 0.3]) / np.linalg.norm([1.0, 0.3, 0.3]), np.zeros(3))
    arc = fit_arc(start, points, tangents, 0.0, 1.0, straight=True, rounds=6)
    assert arc.curvature == 0 and np.abs(arc.coordinates(points)[1]).max() < 1e-9


@pytest.mark.parametrize("angle", [0.4, 1.6, 3.5, 2 * np.pi])
def test_cubics_of_an_arc_follow_it(angle):
    arc = Arc(np.array([0.3, 0, 0]), np.array([0, 1.0, 0]), np.array([-5.0, 0, 0])).over(-0.1 * angle, 0.1 * angle)
    cubics = arc.cubics()
    centre = np.array([0.1, 0, 0])
    radii = np.linalg.norm(evaluate_bezier(cubics, np.linspace(0, 1, 50)) - centre, axis=2)
    assert len(cubics) == np.ceil(angle / (np.pi / 2) - 1e-9) and arc.closed == (angle == 2 * np.pi)
    assert np.abs(radii / 0.2 - 1).max() < 3e-4
    assert bezier_lengths(cubics).sum() == pytest.approx(0.2 * angle, rel=1e-3)
    assert np.array_equal(cubics[1:, 0], cubics[:-1, 3])
    assert not arc.closed or np.array_equal(cubics[0, 0], cubics[-1, 3])


def test_an_arc_goes_on_where_it_is_moved_to_its_middle():
    arc = Arc(np.array([0.3, 0, 0]), np.array([0, 1.0, 0]), np.array([-5.0, 0, 0]), -0.1, 0.3)
    moved = arc.recentred()
    np.testing.assert_allclose(moved.at(np.array([-0.2, 0, 0.2])), arc.at(np.array([-0.1, 0.1, 0.3])), atol=1e-12)


# ------------------------------------------------------------------------------------------------------ whole edges


@pytest.mark.slow(reason="grows thousands of points")
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_rim_that_lines_touch_is_one_closed_circle(noise, seed):
    tangents = [
        line((0.2, 0, 0), (0.2, 0.3, 0)),
        line((-0.2, -0.3, 0), (-0.2, 0.3, 0)),
        line((0, 0.2, 0), (-0.3, 0.2, 0)),
    ]
    rim = circle(0.2)
    found, edges = edges_of(*observed(rim, *tangents, noise=noise, seed=seed)[:2])
    closed = [arc for arc in found.arcs if arc is not None and arc.closed]
    assert len(closed) == 1 and 1 / closed[0].curvature == pytest.approx(0.2, abs=2 * noise)
    truth = np.concatenate([part[0] for part in (rim, *tangents)])
    to_edges, to_truth = distances_to(edges, truth)
    # An edge may end up to where its neighbour is no farther than the tolerance: sqrt(2 R 4 noises) along it.
    assert np.quantile(to_edges, 0.97) < 4 * noise + SPACING and to_truth.max() < 6 * noise + SPACING
    assert count_edges(edges) <= 6  # one of the lines goes on beyond its contact: it may be two


@pytest.mark.slow(reason="grows thousands of points")
@pytest.mark.parametrize("seed", SEEDS)
def test_curves_that_touch_a_rim_in_their_middle_leave_it_whole(seed):
    """Hyperbola-like arcs of a chamfered nut: each touches the rim and meets the next one in a cusp."""
    angles = np.pi / 3 * np.arange(6)
    lobes = []
    for angle in angles:

        def lobe(t, angle=angle):
            depth = 0.2 * (1 / np.cos(t) - 1)
            return np.stack(
                [np.cos(t + angle) * (0.2 + depth), np.sin(t + angle) * (0.2 + depth), -1.5 * depth], axis=1
            )

        lobes.append(curve(lobe, -np.pi / 6, np.pi / 6))
    found, edges = edges_of(*observed(circle(0.2), *lobes, seed=seed)[:2])
    closed = [arc for arc in found.arcs if arc is not None and arc.closed]
    assert len(closed) == 1 and 1 / closed[0].curvature == pytest.approx(0.2, abs=5e-4)
    to_edges, to_truth = distances_to(edges, np.concatenate([circle(0.2)[0], *(part[0] for part in lobes)]))
    assert np.quantile(to_edges, 0.97) < 0.005 and to_truth.max() < 0.005


@pytest.mark.parametrize("seed", SEEDS)
def test_two_arcs_that_meet_in_a_cusp_are_two(seed):
    left, right = circle(0.2, 0, 1.2, (-0.2, 0, 0)), circle(0.2, np.pi - 1.2, np.pi, (0.2, 0, 0))
    _, edges = edges_of(*observed(left, right, seed=seed)[:2])
    assert count_edges(edges) in (2, 3)  # they lie within the noise of each other near the cusp
    to_edges, to_truth = distances_to(edges, np.concatenate([left[0], right[0]]))
    assert np.quantile(to_edges, 0.97) < 0.003 and to_truth.max() < 0.003


@pytest.mark.parametrize("noise", NOISES)
def test_a_line_with_gaps_is_one(noise):
    parts = [line((0, 0, 0), (0.2, 0, 0)), line((0.225, 0, 0), (0.3, 0, 0)), line((0.325, 0, 0), (0.6, 0, 0))]
    _, edges = edges_of(*observed(*parts, noise=noise)[:2])
    assert len(edges.lines) == 1 and len(edges.curves) == 0
    assert edges.lengths[0] == pytest.approx(0.6, abs=2 * SPACING)


@pytest.mark.slow(reason="grows thousands of points")
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_filleted_corner_is_line_arc_line(noise, seed):
    parts = line((-0.3, -0.1, 0), (0, -0.1, 0)), circle(0.1, -np.pi / 2, 0), line((0.1, 0, 0), (0.1, 0.3, 0))
    points, directions, _part = observed(*parts, noise=noise, seed=seed)
    _, edges = edges_of(points, directions)
    assert len(edges.lines) == 2 and len(set(edges.curve_sources.tolist())) == 1
    to_edges, to_truth = distances_to(edges, np.concatenate([each[0] for each in parts]))
    assert to_truth.max() < 4 * noise + SPACING and np.quantile(to_edges, 0.98) < 4 * noise + SPACING


def test_parallel_edges_2_mm_apart_are_two():
    _, edges = edges_of(*observed(line((0, 0, 0), (0.4, 0, 0)), line((0, 0.002, 0), (0.4, 0.002, 0)), noise=1e-4)[:2])
    assert len(edges.lines) == 2 and (edges.lengths > 0.38).all()


@pytest.mark.slow(reason="grows thousands of points")
@pytest.mark.parametrize("noise", NOISES)
def test_an_edge_seen_twice_is_one(noise):
    parts = [line((0, 0, 0), (0.4, 0, 0)), line((0.1, noise, 0), (0.35, noise, 0)), circle(0.2), circle(0.2 + noise)]
    for twice in (parts[:2], parts[2:]):
        assert count_edges(edges_of(*observed(*twice, noise=noise)[:2])[1]) == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_an_edge_that_is_noisier_than_the_others_is_found_whole(seed):
    sharp = [line((0, y, 0), (0.5, y, 0)) for y in (0, 0.1, 0.2)]
    points, directions, part = observed(*sharp, line((0, 0.3, 0), (0.5, 0.3, 0)), noise=1e-4, seed=seed)
    blurred = part == 3
    points[blurred] += np.random.default_rng(seed).normal(0, 5e-4, (blurred.sum(), 3))
    _, edges = edges_of(points, directions)
    assert len(edges.lines) == 4 and (edges.lengths > 0.48).all()


def test_an_ellipse_is_free_curves_along_it():
    ellipse = curve(lambda t: np.stack([0.3 * np.cos(t), 0.15 * np.sin(t), 0 * t], axis=1), 0, 2 * np.pi)
    _, edges = edges_of(*observed(ellipse)[:2])
    to_edges, to_truth = distances_to(edges, ellipse[0])
    assert np.quantile(to_edges, 0.99) < 0.004 and to_truth.max() < 0.004


def test_strays_are_no_edges(generator):
    points, directions, _ = observed(line((0, 0, 0), (0.4, 0, 0)))
    strays = generator.random((300, 3))
    ways = generator.normal(size=(300, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    found, edges = edges_of(np.concatenate([points, strays]), np.concatenate([directions, ways]))
    assert count_edges(edges) == 1 and (found.labels[len(points) :] == UNASSIGNED).mean() > 0.97


def test_edges_do_not_depend_on_the_order_of_the_points(generator):
    points, directions, _ = observed(circle(0.2), line((0.2, 0, 0), (0.2, 0.3, 0)), line((0, 0, 0), (0.3, 0, 0.3)))
    order = generator.permutation(len(points))
    here, there = (assemble(points[some], directions[some], ClusterConfig()) for some in (slice(None), order))
    restored = np.empty_like(there.labels)
    restored[order] = there.labels
    np.testing.assert_array_equal(restored, here.labels)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_hardly_any_points_are_no_edge(count, generator):
    found, edges = edges_of(generator.random((count, 3)), np.tile([1.0, 0, 0], (count, 1)))
    assert len(edges) == 0 and (found.labels == UNASSIGNED).all()


def test_points_of_a_contact_are_shared():
    parts = circle(0.2), line((0.2, -0.3, 0), (0.2, 0.3, 0))
    points, directions, _ = observed(*parts)
    found, edges = edges_of(points, directions)
    assert count_edges(edges) == 2 and len(edges.lines) == 1 and edges.lengths[0] == pytest.approx(0.6, abs=0.01)
    assert (
        len(found.shared)
        and (np.linalg.norm(points[found.shared[:, 0]] - turned(np.array([[0.2, 0, 0]])), axis=1) < 0.05).all()
    )


def test_dropped_edges_leave_the_others_with_their_points():
    points, directions, _ = observed(circle(0.2), line((0.2, -0.3, 0), (0.2, 0.3, 0)), line((0, 0, 0.1), (0, 0.3, 0.1)))
    found = assemble(points, directions, ClusterConfig())
    kept = found.keep(np.array([False, True, True]))
    assert len(kept.arcs) == 2 and np.array_equal(kept.arcs, found.arcs[1:])
    np.testing.assert_array_equal(kept.labels, np.where(found.labels > 0, found.labels - 1, UNASSIGNED))
    assert set(kept.shared[:, 1].tolist()) <= {0, 1}


# ------------------------------------------------------------------------------------------------------------ noise


@pytest.mark.parametrize("noise", [1e-5, 3e-4, 1e-3, 2e-3])
def test_the_scale_covers_the_noise_and_is_not_much_wider(noise):
    parts = [line((0, y, 0), (0.5, y, 0)) for y in (0, 0.1, 0.2, 0.3)]
    points, directions, _ = observed(*parts, circle(0.15, centre=(0, 0, 0.3)), noise=noise)
    graph = neighbor_graph(points, 10, 0.03)
    aligned = alignment(directions, graph)
    neighbors = [row[good] for row, good in zip(graph.indices, (graph.indices >= 0) & (aligned >= 0.8), strict=True)]
    scale = measured_scale(points, directions, neighbors, seed_order(points, directions, graph, aligned), 0.03)
    assert max(noise, LEAST_NOISE) <= scale.noise <= max(6 * noise, LEAST_NOISE)


def ellipse(t):
    return np.stack([0.5 + 0.3 * np.cos(2 * np.pi * t), 0.5 + 0.1 * np.sin(2 * np.pi * t), 0 * t + 0.5], axis=1)


def saddle(t):
    turn = 2 * np.pi * t
    return np.stack([0.5 + 0.2 * np.cos(turn), 0.5 + 0.2 * np.sin(turn), 0.5 + 0.04 * np.cos(2 * turn)], axis=1)


def wave(t):
    return np.stack([0.1 + 0.8 * t, 0.5 + 0.1 * np.sin(2 * np.pi * t), 0 * t + 0.5], axis=1)


def helix(t):
    return np.stack([0.5 + 0.2 * np.cos(6 * np.pi * t), 0.5 + 0.2 * np.sin(6 * np.pi * t), 0.2 + 0.6 * t], axis=1)


@pytest.mark.slow(reason="grows thousands of points")
@pytest.mark.parametrize(("curve", "closed"), [(ellipse, True), (saddle, True), (wave, False), (helix, False)])
def test_a_free_curve_is_one_edge_and_closes_if_it_is_closed(generator, curve, closed):
    fine = np.linspace(0, 1, 20001)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1))])
    t = np.interp(np.linspace(0, arc[-1], int(arc[-1] / 0.0025), endpoint=not closed), arc, fine)
    along = curve(t + 1e-4) - curve(t - 1e-4)
    along = along / np.linalg.norm(along, axis=1, keepdims=True) + generator.normal(0, 0.02, (len(t), 3))
    points = curve(t) + generator.normal(0, 2e-4, (len(t), 3))
    found = assemble(points, along / np.linalg.norm(along, axis=1, keepdims=True), ClusterConfig())
    edges, counts = fit_clusters(found, FitConfig())
    assert len(found.arcs) == 1 and counts["loop" if closed else "curve"] == 1
    off = cKDTree(edges.edge_set().sample(5e-4)[0]).query(curve(fine))[0]
    assert off.max() < 3e-3


def test_a_chain_takes_no_points_from_a_piece_it_does_not_cover(generator):
    """Two arcs of a wave, and a third piece of which the wave is a small part only: that one keeps its points."""
    t = np.linspace(0, 1, 400)
    away = np.stack([np.linspace(0.1, 0.9, 600), np.full(600, 0.9), np.full(600, 0.9)], axis=1)
    points = np.concatenate([wave(t), away]) + generator.normal(0, 2e-4, (1000, 3))
    along = np.concatenate([wave(t + 1e-4) - wave(t - 1e-4), np.tile([1.0, 0, 0], (600, 1))])
    cloud = Cloud(points, along / np.linalg.norm(along, axis=1, keepdims=True), Scale(2e-4, np.radians(1.0), 0.03))
    straight = Arc(np.zeros(3), np.array([1.0, 0, 0]), np.zeros(3), 0.0, 0.1, False)
    parts = [np.arange(0, 150), np.arange(150, 350), np.arange(350, 1000)]
    pieces = [Piece(straight, None, own, np.zeros(0, int), np.zeros(len(own)), 0.0) for own in parts]
    curves, replaced = free_curves(cloud, pieces, ClusterConfig())
    assert replaced == {0, 1} and len(curves) == 1
    assert np.isin(curves[0], np.arange(350)).all() and len(curves[0]) > 300
