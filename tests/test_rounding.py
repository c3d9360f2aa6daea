"""Contours of round surfaces have a radius, sharp edges have none."""

import numpy as np
import pytest
from edgel_scenes import CylinderContour, arc, blank_views, centre, line, pixel_of, tangents, views_of

from taichi_edges.evidence import rounding
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.rounding import count_views, radii_at, rounding_at

A = line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])
RIM = arc([0.5, 0.5, 0.6], 0.25)
PIXEL = 0.004608  # of the default views, unit-cube units
NOISE_PX = 0.1
TIGHT_PX = 3 * NOISE_PX
S = np.linspace(0.1, 0.9, 9)


def rounding_of(views, curve):
    """Rounding at places on a curve."""
    return rounding_at(EdgelMatching(views), curve(S), tangents(curve, S), TIGHT_PX)


def sharpness(found):
    """Median of the share of the views that a sharp edge explains as well."""
    return np.median(found.views / np.maximum(found.rounded, 1))


@pytest.mark.parametrize("radius_px", [2, 4, 8, 15, 30, 60])
def test_a_contour_has_the_radius_of_its_cylinder(taichi, generator, radius_px):
    contour = CylinderContour([0.6, 0.5], radius_px * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, contour], generator, noise_px=NOISE_PX, apart=1.0)
    assert pixel_of(views) == pytest.approx(PIXEL, rel=1e-3)
    for view in (0, 5, 11):
        found = rounding_of(views, contour.seen_from(centre(views, view)))
        if radius_px <= 30:  # three views of 24 show a contour of 60 px near its line: too few to tell
            assert np.median(found.radius_px) == pytest.approx(radius_px, rel=0.3)
        assert sharpness(found) < 0.6 and (found.rounded >= found.views).all()


@pytest.mark.parametrize("curve", [A, RIM], ids=["line", "circle"])
def test_a_sharp_edge_has_no_radius(taichi, generator, curve):
    found = rounding_of(views_of([A, RIM], generator, noise_px=NOISE_PX, apart=1.0), curve)
    assert np.median(found.radius_px) == 0 and sharpness(found) > 0.95
    assert found.views.min() > 18 and (found.radius_px[found.rounded == found.views] == 0).all()


def radii_of(views, curve, beyond=(0.0, 0.0, 0.0)):
    """`radii_at` places on a curve, or beyond it."""
    return radii_at(EdgelMatching(views), curve(S) + beyond, tangents(curve, S), TIGHT_PX)


@pytest.mark.parametrize("radius_px", [4, 6, 8, 15, 30, 60])
@pytest.mark.parametrize("front_px", [0.0, 0.5])
def test_the_true_radius_is_in_the_range(taichi, generator, radius_px, front_px):
    """Also of lines in front of the surface, where a fit puts them. A step of the radii is 6 %."""
    middle = np.array([0.6, 0.5, 0.0])
    contour = CylinderContour(middle[:2], radius_px * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, contour], generator, noise_px=NOISE_PX, apart=1.0)
    for view in (0, 5, 11):
        seen = contour.seen_from(centre(views, view))
        outwards = (seen(S) - middle)[0] * [1, 1, 0] / (radius_px * PIXEL)
        found = radii_of(views, seen, front_px * PIXEL * outwards)
        assert np.median(found.least_px) <= radius_px * 1.06 and np.median(found.most_px) >= radius_px / 1.06
        assert np.median(found.rounded / found.views) >= 2 and (found.around >= found.rounded).all()
        if radius_px <= 15:
            assert np.median(found.uncertainty_px / found.radius_px) < 0.2
        if radius_px == 60:  # the greatest that is tried: three views of 24 show it, and wider ones explain as many
            assert np.isinf(np.median(found.most_px))


def test_views_that_see_more_pixels_tell_the_same_radius(taichi, generator):
    """Pixels are those of the place, whatever lens every other view has."""
    intrinsics, poses = (array.copy() for array in (blank_views().intrinsics, blank_views().world_to_camera))
    intrinsics[::2, [0, 1], [0, 1]] *= 0.6
    contour = CylinderContour([0.6, 0.5], 15 * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, contour], generator, noise_px=NOISE_PX, apart=1.0, cameras=(intrinsics, poses))
    seen = contour.seen_from(centre(views, 5))
    found, radius_px = radii_of(views, seen), 15 * PIXEL / EdgelMatching(views).pixel_at(seen(S)).mean()
    assert np.median(found.radius_px) == pytest.approx(radius_px, rel=0.12)
    assert np.median(found.rounded) >= 8


@pytest.mark.parametrize("curve", [A, RIM], ids=["line", "circle"])
@pytest.mark.parametrize("aside_px", [0.0, 0.7])
def test_a_sharp_edge_has_no_radius_even_beside_it(taichi, generator, curve, aside_px):
    views = views_of([A, RIM], generator, noise_px=NOISE_PX, apart=1.0)
    found = radii_of(views, curve, [0, 0, aside_px * PIXEL])
    assert np.median(found.radius_px) == np.median(found.uncertainty_px) == 0
    assert np.median(found.views / found.rounded) > 0.9


def test_views_of_radii_are_those_of_a_slow_twin(taichi, generator):
    offsets = generator.uniform(-8, 8, (2, 8, rounding.MOST_AROUND)).astype(np.float32)
    offsets[..., 2:] = rounding.UNKNOWN
    angles = generator.uniform(-np.pi, np.pi, (2, 8)).astype(np.float32)
    explained = np.zeros((2, 1 + rounding.RADII), np.float32)
    count_views(offsets, angles, TIGHT_PX, np.zeros_like(angles), explained)
    turns = np.arange(rounding.DIRECTIONS) * 2 * np.pi / rounding.DIRECTIONS
    cosines = np.cos(angles.astype(float)[:, None] - turns[:, None])  # (n, turns, V)
    radii = np.append(0.0, rounding.LEAST_RADIUS_PX * rounding.RADIUS_STEP ** np.arange(rounding.RADII))
    wanted = np.zeros_like(explained)
    for number, radius in enumerate(radii):
        for front in TIGHT_PX * np.arange(rounding.DEEPEST, rounding.FARTHEST + 1):
            for side in (-1, 1):
                moved = side * (radius * np.sign(cosines) - (radius + front) * cosines)
                tolerance = TIGHT_PX + rounding.GROWING * np.abs(moved)[..., None]
                there = (np.abs(offsets[:, None] - moved[..., None]) <= tolerance).any(axis=-1)
                wanted[:, number] = np.maximum(wanted[:, number], there.sum(axis=-1).max(axis=-1))
    assert wanted.max() >= 4
    assert np.abs(explained - wanted).max() <= 1 and (explained == wanted).mean() > 0.95  # float32 at the tolerance


def test_a_second_edge_beside_it_does_not_make_an_edge_round(taichi, generator):
    beside = line([0.2, 0.3, 0.3 + 3 * PIXEL], [0.8, 0.35, 0.4 + 3 * PIXEL])
    found = rounding_of(views_of([A, beside], generator, noise_px=NOISE_PX, apart=1.0), A)
    assert sharpness(found) > 0.85


def test_nowhere_no_view_has_an_edgel(taichi, generator):
    views = views_of([A], generator, noise_px=NOISE_PX, count=5)
    for measure in (rounding_at, radii_at):
        far = measure(EdgelMatching(views), np.array([[0.5, 0.9, 0.9], [0.5, 0.5, 60.0]]), np.eye(3)[:2], TIGHT_PX)
        assert far.views.tolist() == far.rounded.tolist() == far.around.tolist() == far.radius_px.tolist() == [0, 0]
    for measure in (rounding_at, radii_at):
        none = measure(EdgelMatching(views), np.zeros((0, 3)), np.zeros((0, 3)), TIGHT_PX)
        assert none.views.shape == none.radius_px.shape == (0,)
