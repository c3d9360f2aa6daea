"""The synthetic parts are exact, and their views show what a camera would see."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from taichi_edges.evidence.pixel_owners import PixelOwners
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.profiles import CHORD_ERROR, Profile, circle, polygon, rectangle, slot
from taichi_edges.synthetic.rendering import (
    Imperfections,
    camera_centre,
    render_edge_maps,
    render_pictures,
    render_views,
    ring_cameras,
)
from taichi_edges.synthetic.solids import assemble, extrude
from taichi_edges.synthetic.surfaces import cap, wall
from taichi_edges.synthetic.visibility import ray_scene, sample_edges, visible_from
from taichi_edges.views.cameras import inside_image, project

SIZE = 300
CLEAN = Imperfections.none()


@pytest.fixture(scope="module")
def parts():
    return {name: make() for name, make in PARTS.items()}


def edge_maps_of(part, view_count=6, imperfections=CLEAN, seed=0, size=SIZE):
    cameras = ring_cameras(view_count, size)
    return render_edge_maps(part, *cameras, size, imperfections, np.random.default_rng(seed)), cameras


def visible_samples(part, lens, pose, spacing=0.002):
    """Samples of the exact edges, their pixels, and which of them the camera sees."""
    samples = sample_edges(part, spacing)
    pixels, _ = project(samples.points, lens, pose)
    return samples, pixels, visible_from(ray_scene(part), samples, camera_centre(pose))


@pytest.mark.parametrize("name", PARTS)
def test_part_is_centred_in_the_unit_cube(parts, name):
    low, high = parts[name].vertices.min(axis=0), parts[name].vertices.max(axis=0)
    np.testing.assert_allclose((low + high) / 2, 0.5, atol=1e-12)
    assert (high - low).max() == pytest.approx(0.9)


@pytest.mark.parametrize("name", PARTS)
def test_exact_edges_lie_on_the_mesh(parts, name):
    exact = np.concatenate(
        list(parts[name].edges.lines)
        + [evaluate_bezier(control, np.linspace(0, 1, 50)) for control in parts[name].edges.curves]
    )
    distances = ray_scene(parts[name]).compute_distance(exact.astype(np.float32)).numpy()
    assert distances.max() < 2 * CHORD_ERROR


@pytest.mark.parametrize("name", PARTS)
def test_every_sharp_edge_of_the_mesh_is_among_the_exact_edges(parts, name):
    mesh = parts[name].mesh_edges
    middles = parts[name].vertices[mesh.ends[mesh.sharp]].mean(axis=1)
    distances, _ = cKDTree(sample_edges(parts[name], 0.001).points).query(middles)
    assert distances.max() < 0.001  # half the sampling, and the chord error
    chords = parts[name].vertices[mesh.ends[mesh.sharp]]
    length = np.linalg.norm(chords[:, 1] - chords[:, 0], axis=1).sum()
    assert length == pytest.approx(parts[name].edges.lengths.sum(), rel=1e-4)  # so none is there twice


@pytest.mark.parametrize("name", PARTS)
def test_edges_meet_at_their_ends(parts, name):
    edges = parts[name].edges
    ends = np.concatenate([edges.lines.reshape(-1, 3), edges.curves[:, [0, 3]].reshape(-1, 3)])
    distances, _ = cKDTree(ends).query(ends, k=2)
    assert distances[:, 1].max() < 1e-12


@pytest.mark.parametrize(
    "name, lines, curves", [("block", 12, 0), ("bracket", 16, 8), ("wave", 10, 2), ("knob", 0, 5), ("demo", 14, 21)]
)
def test_sources_count_the_edges(parts, name, lines, curves):
    edges = parts[name].edges
    assert len(edges.lines) == len(set(edges.line_sources)) == lines
    assert len(set(edges.curve_sources)) == curves
    assert not set(edges.line_sources) & set(edges.curve_sources)


def test_fillets_have_no_edge_along_the_sweep(parts):
    lines = parts["bracket"].edges.lines
    along_sweep = np.abs(np.diff(lines, axis=1)[:, 0] @ [0, 1, 0]) > 0.1
    assert along_sweep.sum() == 4  # six corners, two of them rounded


def test_arcs_are_circles_to_1e_5(parts):
    edges = parts["bracket"].edges
    holes = [s for s in np.unique(edges.curve_sources) if (edges.curve_sources == s).sum() == 8]
    assert len(holes) == 4
    for source in holes:
        points = evaluate_bezier(edges.curves[edges.curve_sources == source], np.linspace(0, 1, 33)[:-1]).reshape(-1, 3)
        radii = np.linalg.norm(points - points.mean(axis=0), axis=1)
        assert np.ptp(radii) < 1e-5 and radii.mean() == pytest.approx(0.12, abs=1e-5)


def test_outlines_may_be_given_in_either_direction():
    outline, hole = rectangle((0, 0), (1, 1)), slot((0.3, 0.5), (0.7, 0.5), 0.1)
    one = extrude("one", Profile(outline, (hole,)), 0.3)
    other = extrude("other", Profile(outline.reversed(), (hole.reversed(),)), 0.3)
    volumes = [np.linalg.det(part.vertices[part.triangles]).sum() / 6 for part in (one, other)]
    expected = 0.3 * (1 - 0.4 * 0.2 - np.pi * 0.1**2) * 0.9**3
    np.testing.assert_allclose(volumes, expected, rtol=1e-4)


def test_faces_that_do_not_close_are_refused():
    profile = Profile(polygon([(0, 0), (1, 0), (0, 1)]))
    with pytest.raises(ValueError, match="do not close"):
        assemble("open", [cap(profile, 0.0, upward=False), wall(profile.outer, 0.0, 1.0)])


def test_ring_cameras_have_the_whole_cube_in_view_from_above_and_below():
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    lenses, poses = ring_cameras(9, SIZE)
    for lens, pose in zip(lenses, poses, strict=True):
        pixels, depths = project(corners, lens, pose)
        assert (depths > 0).all() and (pixels > -0.5).all() and (pixels < SIZE - 0.5).all()
        np.testing.assert_allclose(project(np.full((1, 3), 0.5), lens, pose)[0], (SIZE - 1) / 2, atol=1e-9)
        assert (pose[:, :3] @ [0, 0, 1])[1] < 0  # the world's z is up in the picture
    heights = np.array([camera_centre(pose)[2] for pose in poses])
    assert len(np.unique(heights.round(6))) >= 3 and heights.min() < 0 < 1 < heights.max()


def test_block_shows_nine_of_its_twelve_edges(parts):
    maps, (lenses, poses) = edge_maps_of(parts["block"])
    low, high = parts["block"].vertices.min(axis=0), parts["block"].vertices.max(axis=0)
    faces_seen = [((camera_centre(pose) < low) | (camera_centre(pose) > high)).sum() for pose in poses]
    assert faces_seen.count(3) >= 3
    for edge_map, lens, pose, faces in zip(maps, lenses, poses, faces_seen, strict=True):
        samples, pixels, visible = visible_samples(parts["block"], lens, pose)
        share = np.bincount(samples.strokes, visible) / np.bincount(samples.strokes)
        expected = {2: 7, 3: 9}[faces]
        assert (share > 0.98).sum() == expected and (share < 0.02).sum() == 12 - expected
        values = map_coordinates(edge_map.astype(float), pixels.T[::-1], order=1)
        assert values[visible].min() > 0.8 * 255  # a line of 2.3 px half-way between two pixels: 0.88
        far = cKDTree(pixels[visible]).query(pixels)[0] > 5  # five standard deviations
        assert far.sum() > 100 and values[far].max() == 0


@pytest.mark.parametrize("name", ["bracket", "wave", "demo", "nut", "blade"])
def test_drawn_edges_are_centred_on_the_projected_curves(parts, name):
    maps, (lenses, poses) = edge_maps_of(parts[name], view_count=3)
    across = np.arange(-4, 4.01, 0.25)
    errors = []
    for edge_map, lens, pose in zip(maps, lenses, poses, strict=True):
        samples, pixels, visible = visible_samples(parts[name], lens, pose)
        pixels, strokes = pixels[visible], samples.strokes[visible]
        chosen = np.arange(0, len(pixels), 7)
        for index, near in zip(chosen, cKDTree(pixels).query_ball_point(pixels[chosen], 9.0), strict=True):
            offsets = pixels[near] - pixels[index]
            tangent = np.linalg.eigh(offsets.T @ offsets)[1][:, 1]
            normal = np.array([-tangent[1], tangent[0]])
            along = offsets @ tangent
            # Only where nothing but this one, almost straight edge is near, and goes on in both directions.
            alone = (strokes[near] == strokes[index]).all() and np.abs(offsets @ normal).max() < 0.5
            if alone and along.min() < -8 and along.max() > 8:
                profile = map_coordinates(
                    edge_map.astype(float), (pixels[index] + across[:, None] * normal).T[::-1], order=1
                )
                errors.append(profile @ across / profile.sum())
    assert len(errors) > 50
    assert np.abs(errors).max() < 0.1


@pytest.mark.slow(reason="renders whole parts")
@pytest.mark.parametrize("name", ["knob", "demo", "pipe", "fillet", "blade"])
def test_edges_and_contours_together_outline_the_part(parts, name):
    with_contours = dataclasses.replace(CLEAN, contours=True)
    maps, cameras = edge_maps_of(parts[name], view_count=4, imperfections=with_contours)
    without, _ = edge_maps_of(parts[name], view_count=4)
    pictures = render_pictures(parts[name], *cameras, SIZE)
    share_without = []
    for edge_map, bare, picture in zip(maps, without, pictures, strict=True):
        covered = (picture.min(axis=2) < 250).astype(np.uint8)
        outline = (covered - cv2.erode(covered, np.ones((3, 3), np.uint8))) > 0
        assert distance_transform_edt(edge_map < 128)[outline].max() < 2.5
        share_without.append((distance_transform_edt(bare < 128)[outline] > 2.5).mean())
    assert max(share_without) > 0.02  # the contours of smooth surfaces are no edges


def test_same_seed_same_maps_and_another_seed_others(parts):
    one, _ = edge_maps_of(parts["wave"], 2, Imperfections(), seed=1)
    again, _ = edge_maps_of(parts["wave"], 2, Imperfections(), seed=1)
    other, _ = edge_maps_of(parts["wave"], 2, Imperfections(), seed=2)
    np.testing.assert_array_equal(one, again)
    assert (one != other).any(axis=(1, 2)).all()


def test_gaps_take_the_share_of_the_length_they_say(parts):
    gappy = dataclasses.replace(CLEAN, gap_fraction=0.2, gap_length_px=30.0)
    whole, _ = edge_maps_of(parts["demo"], 12)
    maps, _ = edge_maps_of(parts["demo"], 12, gappy)
    lost = 1.0 - (maps > 200).sum() / (whole > 200).sum()
    # Round ends fill a gap by less than 1.2 px on each side; edges that run close together hide some gaps.
    assert 0.2 * (1 - 2.4 / 30) - 0.03 < lost < 0.2 + 0.02
    assert (maps <= whole).all()


def test_noise_and_speckle_have_the_strength_they_say(parts):
    noisy = dataclasses.replace(CLEAN, noise=0.05)
    whole, _ = edge_maps_of(parts["block"])
    maps, _ = edge_maps_of(parts["block"], imperfections=noisy)
    background = maps[whole == 0].astype(float)
    assert background.mean() == pytest.approx(0.05 * 255 / np.sqrt(2 * np.pi), rel=0.05)  # the negative half is cut off
    speckled, _ = edge_maps_of(parts["block"], imperfections=dataclasses.replace(CLEAN, speckle=2.0))
    false = ((speckled > 128) & (whole == 0)).astype(np.uint8)
    dashes = sum(cv2.connectedComponents(one)[0] - 1 for one in false)
    assert dashes == pytest.approx(len(whole) * 2.0 * SIZE**2 / 1e4, rel=0.3)  # 108 expected, less what falls on edges


def test_wider_lines_are_wider(parts):
    areas = [
        (edge_maps_of(parts["block"], 1, dataclasses.replace(CLEAN, width_px=width))[0] >= 128).sum()
        for width in (2.0, 4.0)
    ]
    assert areas[1] / areas[0] == pytest.approx(2.0, rel=0.1)


def test_render_views_gives_views_and_pictures(parts, taichi):
    views, pictures = render_views(parts["demo"], 4, 120, Imperfections(), np.random.default_rng(0))
    assert len(views) == 4 and (views.height, views.width) == (120, 120) and set(views.image_paths) == {""}
    assert pictures.shape == (4, 120, 120, 3) and pictures.dtype == np.uint8
    assert (pictures[:, 0, 0] == 255).all() and (pictures[:, 60, 60] < 250).all()
    on_edges = sample_edges(parts["demo"], 0.02).points
    assert all(inside_image(views.project(on_edges, view)[0], 120, 120).all() for view in range(4))
    strength = PixelOwners(views, on_edges.astype(np.float32), 0.5).strength
    assert (strength > 0.5 / 4).mean() > 0.9  # an edge pixel in one view of four, at least


def test_circle_runs_once_round():
    path = circle((0.2, 0.3), 0.5)
    assert path.closed and not path.sharp.any()
    assert path.area == pytest.approx(np.pi * 0.25, rel=1e-3)
