"""Contours of round surfaces have a radius, sharp edges have none."""

import numpy as np
import pytest
from edgel_scenes import CylinderContour, arc, centre, line, pixel_of, tangents, views_of

from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.rounding import rounding_at

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
        assert np.median(found.radius_px) == pytest.approx(radius_px, rel=0.3)
        assert sharpness(found) < 0.6 and (found.rounded >= found.views).all()


@pytest.mark.parametrize("curve", [A, RIM], ids=["line", "circle"])
def test_a_sharp_edge_has_no_radius(taichi, generator, curve):
    found = rounding_of(views_of([A, RIM], generator, noise_px=NOISE_PX, apart=1.0), curve)
    assert np.median(found.radius_px) == 0 and sharpness(found) > 0.95
    assert found.views.min() > 18 and (found.radius_px[found.rounded == found.views] == 0).all()


def test_a_second_edge_beside_it_does_not_make_an_edge_round(taichi, generator):
    beside = line([0.2, 0.3, 0.3 + 3 * PIXEL], [0.8, 0.35, 0.4 + 3 * PIXEL])
    found = rounding_of(views_of([A, beside], generator, noise_px=NOISE_PX, apart=1.0), A)
    assert sharpness(found) > 0.85


def test_nowhere_no_view_has_an_edgel(taichi, generator):
    views = views_of([A], generator, noise_px=NOISE_PX, count=5)
    far = rounding_at(EdgelMatching(views), np.array([[0.5, 0.9, 0.9], [0.5, 0.5, 60.0]]), np.eye(3)[:2], TIGHT_PX)
    assert far.views.tolist() == far.rounded.tolist() == far.radius_px.tolist() == [0, 0]
    none = rounding_at(EdgelMatching(views), np.zeros((0, 3)), np.zeros((0, 3)), TIGHT_PX)
    assert none.views.shape == none.radius_px.shape == (0,)
