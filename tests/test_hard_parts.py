"""The hard parts have the edges they say, as large as they say; what is true of all parts is in `test_synthetic.py`."""

import numpy as np
import pytest

from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.synthetic.free_form import hyperbola_cubics, nut_side
from taichi_edges.synthetic.hard_parts import HARD_PARTS, PIXEL
from taichi_edges.synthetic.profiles import CHORD_ERROR
from taichi_edges.synthetic.rendering import camera_centre, pixel_size, ring_cameras
from taichi_edges.synthetic.solids import LONGEST_SIDE
from taichi_edges.synthetic.visibility import ray_scene, sample_contours, sample_edges, visible_from

ARC_ERROR = 4.2e-6  # of the radius, of an arc's cubics


@pytest.fixture(scope="module")
def parts():
    return {name: make() for name, make in HARD_PARTS.items()}


def curves_of(part):
    """One (n, 3) array of densely spaced points for each true curve, and its number of cubics."""
    edges = part.edges
    for source in np.unique(edges.curve_sources):
        cubics = edges.curves[edges.curve_sources == source]
        yield evaluate_bezier(cubics, np.linspace(0.0, 1.0, 33)).reshape(-1, 3), len(cubics)


def circles_of(part):
    """(n, 4) centre and radius, in units of the cube, of the full circles among the curves: closed, equal radii."""
    found = []
    for points, _ in curves_of(part):
        centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
        radii = np.linalg.norm(points - centre, axis=1)
        if np.allclose(points[0], points[-1], atol=1e-12) and np.ptp(radii) < 3 * ARC_ERROR * radii.mean():
            found.append([*centre, radii.mean()])
    return np.array(found)


@pytest.mark.parametrize(
    "name, lines, curves",
    [
        ("frame", 72, 0),
        ("shaft", 0, 24),
        ("pipe", 0, 4),
        ("fillet", 16, 4),
        ("nut", 6, 16),
        ("rims", 24, 38),
        ("grille", 156, 12),
        ("blade", 12, 3),
    ],
)
def test_edges_are_as_many_as_the_part_says(parts, name, lines, curves):
    edges = parts[name].edges
    assert len(edges.lines) == len(set(edges.line_sources)) == lines
    assert len(set(edges.curve_sources)) == curves
    assert edges.lengths.min() > 0


@pytest.mark.parametrize("name", HARD_PARTS)
def test_edges_are_inside_the_cube(parts, name):
    points = np.concatenate([points for points, _ in curves_of(parts[name])] + [parts[name].edges.lines.reshape(-1, 3)])
    margin = (1.0 - LONGEST_SIDE) / 2.0 - 2 * ARC_ERROR
    assert points.min() > margin and points.max() < 1.0 - margin


@pytest.mark.parametrize("name", HARD_PARTS)
def test_all_of_every_edge_is_seen_from_two_places(parts, name):
    scene, samples = ray_scene(parts[name]), sample_edges(parts[name], 0.01)
    _, poses = ring_cameras(30, 400)
    seen = np.sum([visible_from(scene, samples, camera_centre(pose)) for pose in poses], axis=0)
    assert seen.min() >= 2  # or nobody could recover it


def test_a_pixel_is_as_large_as_the_drawings_say(parts):
    assert pixel_size(*ring_cameras(3, 400)) == pytest.approx(PIXEL * LONGEST_SIDE, rel=1e-4)
    drawn = {"frame": 4.5 * PIXEL, "grille": 10 * PIXEL}  # the shortest lines: bar, plate
    for name, length in drawn.items():
        assert parts[name].edges.lengths.min() == pytest.approx(length * LONGEST_SIDE, rel=1e-9)


def test_frame_has_bars_along_all_its_edges(parts):
    lengths = np.sort(np.linalg.norm(np.diff(parts["frame"].edges.lines, axis=1)[:, 0], axis=1))
    bar = 4.5 * PIXEL
    sides = np.array([0.5, 0.72, 1.0])
    expected = np.sort(np.concatenate([np.repeat(bar, 24), np.repeat(sides, 4), np.repeat(sides - 2 * bar, 12)]))
    np.testing.assert_allclose(lengths, LONGEST_SIDE * expected, atol=1e-12)


def test_shaft_circles_are_1_5_to_6_pixels_apart(parts):
    circles = circles_of(parts["shaft"])
    assert len(circles) == 24
    scale = 195 / LONGEST_SIDE  # pixels as drawn
    heights, radii = (circles[:, 2] - circles[:, 2].min()) * scale, circles[:, 3] * scale
    np.testing.assert_allclose(2 * radii, np.rint(2 * radii), atol=1e-3)  # drawn to half pixels
    gaps = np.hypot(heights[:, None] - heights, radii[:, None] - radii)
    nearest = np.sort(gaps, axis=1)[:, 1]
    assert nearest.min() == pytest.approx(1.5, abs=1e-3) and np.median(nearest) < 3
    assert (nearest < 6).sum() == 23  # all but the end of the taper
    assert radii[np.argmin(heights)] == pytest.approx(9, abs=1e-3)


def test_pipe_has_two_rims_at_each_end_and_nothing_else(parts):
    circles = circles_of(parts["pipe"])
    np.testing.assert_allclose(np.sort(circles[:, 3]), 0.9 * np.array([0.09, 0.09, 0.11, 0.11]), rtol=ARC_ERROR)
    centres = np.unique(circles[:, :3].round(6), axis=0)
    assert len(centres) == 2
    np.testing.assert_allclose(np.abs(np.diff(centres, axis=0)[0]), 0.9 * np.array([0.7, 0, 0.89]), atol=1e-6)


@pytest.mark.parametrize("name", ["shaft", "pipe", "fillet", "blade"])
def test_smooth_faces_have_contours(parts, name):
    for centre in ([2.2, -1.4, 1.3], [-1.6, -1.2, -0.9]):
        assert len(sample_contours(parts[name], np.array(centre), 0.002).points) > 100


def test_fillets_are_tangent_arcs_of_large_radius(parts):
    lengths = [np.linalg.norm(np.diff(points, axis=0), axis=1).sum() for points, _ in curves_of(parts["fillet"])]
    expected = LONGEST_SIDE * np.pi / 2 * np.repeat([0.25, 0.35], 2)
    np.testing.assert_allclose(np.sort(lengths), expected, rtol=1e-4)
    sweeps = np.abs(np.diff(parts["fillet"].edges.lines, axis=1)[:, 0, 1]) > 0.4
    assert sweeps.sum() == 4  # six corners, two of them rounded


def test_hyperbola_cubics_are_exact_to_1e_8():
    points = evaluate_bezier(hyperbola_cubics(np.arcsinh(np.tan(np.radians(30.0)))), np.linspace(0, 1, 101))
    error = np.hypot(1.0, points[..., 0]) - points[..., 1]
    assert np.abs(error).max() < 1e-8
    np.testing.assert_allclose(points[0, 0], -points[-1, -1] * [1, -1], atol=1e-15)


def test_nut_arcs_lie_on_side_and_cone_and_touch_the_rim(parts):
    apothem, height = np.sqrt(3.0) / 4.0, 0.4
    for edge in nut_side(apothem, height).edges[:2]:
        points = evaluate_bezier(edge, np.linspace(0, 1, 101)).reshape(-1, 3)
        np.testing.assert_allclose(points[:, 0], apothem, atol=1e-15)
        from_end = np.minimum(points[:, 2], height - points[:, 2])
        radii = np.hypot(points[:, 0], points[:, 1])
        np.testing.assert_allclose(from_end, (radii - apothem) * np.tan(np.radians(30)), atol=1e-8)
        assert np.abs(from_end).min() < 1e-12  # it touches the rim in its middle
    circles = circles_of(parts["nut"])
    np.testing.assert_allclose(np.sort(circles[:, 3]), 0.9 * np.repeat([0.24, apothem], 2), rtol=ARC_ERROR)
    np.testing.assert_allclose(parts["nut"].edges.lengths[:6], 0.9 * (0.4 - 2 * apothem * (2 / 3 - 3**-0.5)), rtol=1e-9)


def test_rims_are_half_a_pixel_to_two_pixels_apart(parts):
    circles = circles_of(parts["rims"])
    assert len(circles) == 14
    heights, radii = circles[:, 2], circles[:, 3]
    gaps = np.hypot(heights[:, None] - heights, radii[:, None] - radii) / (PIXEL * LONGEST_SIDE)
    nearest = np.sort(gaps, axis=1)[:, 1]
    assert nearest.min() == pytest.approx(0.5, abs=1e-3) and (nearest < 2.001).sum() == 12
    lines = parts["rims"].edges.lines
    middles = lines.mean(axis=1)
    apart = np.sort(np.linalg.norm(middles[:, None] - middles, axis=2), axis=1)[:, 1] / (PIXEL * LONGEST_SIDE)
    assert set(apart.round(3)) == {1.0, 2.0, 6.0, 10.0}  # two risers, the way to the terrace, the outer wall


def test_grille_openings_are_separate_and_round_holes_equal(parts):
    circles = circles_of(parts["grille"])
    assert len(circles) == 12 and np.ptp(circles[:, 3]) < 1e-9
    assert len(np.unique(circles[:, :2].round(6), axis=0)) == 6


def test_blade_is_smooth_round_its_leading_edge_and_sharp_at_the_trailing_one(parts):
    mesh, vertices = parts["blade"].mesh_edges, parts["blade"].vertices
    edges = parts["blade"].edges
    curves = list(curves_of(parts["blade"]))
    assert sorted(count for _, count in curves) == [1, 2, 2]  # trailing edge; root and tip, each one curve
    trailing = next(points for points, count in curves if count == 1)
    ends = vertices[mesh.ends[mesh.sharp]]
    steep = np.abs(np.diff(ends, axis=1)[:, 0, 2]) > 1e-6
    middles = ends[steep].mean(axis=1)
    foot = edges.lines[..., 2].max()
    upper = middles[middles[:, 2] > foot + 1e-6]  # nothing sharp rises from the block but the trailing edge
    distances = np.linalg.norm(upper[:, None] - trailing, axis=2).min(axis=1)
    assert len(upper) == 64 and distances.max() < 0.9 / 32 / 2 + CHORD_ERROR
    away = trailing - trailing.mean(axis=0)
    axes = np.linalg.svd(away, full_matrices=False)[2]
    assert np.abs(away @ axes[2]).max() > 2 * PIXEL  # a space curve: no plane holds it
