"""How likely an edge is one: edges, contours and rounded edges are told apart."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import CylinderContour, arc, centre, line, views_of
from scipy.spatial import cKDTree

from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.verdict import (
    FITTED,
    MARKS,
    MOST_BLUR_PX,
    MOST_OUTSIDE_PX,
    PRIOR,
    SHARP_PX,
    marks_of,
    probabilities,
)
from taichi_edges.geometry.shapes import Line
from taichi_edges.views.edgels import Edgels

A = line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])
RIM = arc([0.5, 0.5, 0.6], 0.25)
PIXEL = 0.004608  # of the default views, unit-cube units
NOISE_PX = 0.1


def shape(curve):
    """The Line from one end of a curve to the other."""
    return Line(curve(np.array([0.0, 1.0])))


def verdicts(views, *curves):
    """(n,) probabilities of lines."""
    return probabilities(marks_of(EdgelMatching(views), [shape(curve) for curve in curves], NOISE_PX))


@pytest.mark.parametrize("radius_px", [2, 6, 15, 40])
def test_an_edge_is_one_and_the_contour_of_a_cylinder_is_none(taichi, generator, radius_px):
    contour = CylinderContour([0.6, 0.5], radius_px * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, contour], generator, noise_px=NOISE_PX, apart=1.0)
    edge, *contours = verdicts(views, A, *(contour.seen_from(centre(views, view)) for view in (0, 7, 15)))
    assert edge > 0.8 and max(contours) < 0.4


def test_an_edge_that_a_third_of_the_views_see_is_one(taichi, generator):
    views = views_of([A, RIM], generator, noise_px=NOISE_PX, hidden=0.66, apart=1.0)
    assert verdicts(views, A)[0] > 0.8


def test_a_blurred_edge_is_less_likely_one_than_a_sharp_one(taichi, generator):
    state = generator.bit_generator.state
    found = {}
    for blur in (0.0, SHARP_PX, 0.5, 1.5, None):
        generator.bit_generator.state = state  # the same noise
        views = views_of([A, RIM], generator, noise_px=NOISE_PX, apart=1.0, blur=blur)
        found[blur] = verdicts(views, A)[0]
    assert found[0.0] == found[SHARP_PX] == found[None]  # ready maps do not tell
    assert found[0.0] > found[0.5] > found[1.5] and found[0.0] - found[1.5] > 0.15
    odds = {blur: p / (1 - p) for blur, p in found.items()}
    assert odds[0.0] > 20 * odds[1.5] and odds[0.0] > 4 * odds[0.5]


def test_marks_are_what_they_say(taichi, generator):
    contour = CylinderContour([0.6, 0.5], 8 * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, contour], generator, noise_px=NOISE_PX, apart=1.0, blur=0.5)
    nothing = line([0.1, 0.9, 0.1], [0.2, 0.9, 0.9])
    curves = [A, contour.seen_from(centre(views, 3)), nothing]
    marks = marks_of(EdgelMatching(views), [shape(curve) for curve in curves], NOISE_PX)
    assert marks.shape == (3, len(MARKS)) and len(FITTED.marks) == len(MARKS)
    steadiness, blur, spread, sharpness, _ = marks.T
    most = 24 / (24 + PRIOR)  # all views say yes
    assert steadiness[0] > 0.95 * most and steadiness[1] < 0.8 and sharpness[0] > 0.95 * most and sharpness[1] < 0.6
    assert blur[0] == pytest.approx(0.5 - SHARP_PX) and blur[2] == MOST_BLUR_PX - SHARP_PX
    assert spread[0] == 0.5 and spread[2] == 0 and steadiness[2] < 0.5
    assert probabilities(marks)[2] < 0.01


def test_two_edges_beside_each_other_do_not_speak_against_each_other(taichi, generator):
    """Two pixels apart, as the two sides of a chamfer: the edgels of the other edge are about each."""
    pair = [A, line([0.2, 0.3, 0.3 + 2 * PIXEL], [0.8, 0.35, 0.4 + 2 * PIXEL])]
    views = views_of([*pair, RIM], generator, noise_px=NOISE_PX, apart=1.0)
    assert verdicts(views, *pair).min() > 0.8


def with_outline(views, curve, inwards):
    """The views, the edgels on a curve marked as on the outline of an object that lies `inwards`, (3,), of it."""
    columns = []
    for view in range(len(views)):
        points, normals, strengths = views.edgels.of_view(view)
        places, inner = (views.project(curve(np.linspace(0, 1, 500)) + step, view)[0] for step in (0, inwards))
        distances, nearest = cKDTree(places).query(points)
        towards = ((inner - places)[nearest] * normals).sum(axis=1, keepdims=True)
        on = distances < 3 * NOISE_PX
        columns.append((points, normals * np.where(towards < 0, -1, 1), strengths, np.zeros(len(points)), on))
    return replace(views, edgels=Edgels.of_views(columns))


def test_what_lies_outside_of_the_outline_is_hardly_an_edge(taichi, generator):
    """As the line does about which the contours of a round lie. Without outlines nothing is outside."""
    views, outside = views_of([A, RIM], generator, apart=1.0, blur=0.0), MARKS.index("outside")
    inwards = np.array([0.0, 0.0, PIXEL])
    beyond = Line(A(np.array([0.0, 1.0])) - 0.3 * inwards)
    plain, outlined = (
        marks_of(EdgelMatching(some), [shape(A), beyond], NOISE_PX) for some in (views, with_outline(views, A, inwards))
    )
    assert (plain[:, outside] == 0).all()
    assert outlined[0, outside] < 0.05 and 0.15 < outlined[1, outside] <= MOST_OUTSIDE_PX
    np.testing.assert_allclose(np.delete(outlined, outside, axis=1), np.delete(plain, outside, axis=1), atol=1e-6)
    assert probabilities(outlined)[1] < 0.5 * probabilities(plain)[1]


def test_no_edges_get_no_verdict(taichi, generator):
    marks = marks_of(EdgelMatching(views_of([A], generator, count=4)), [], NOISE_PX)
    assert marks.shape == (0, len(MARKS)) and probabilities(marks).shape == (0,)


def test_probabilities_rise_with_what_speaks_for_an_edge():
    sure, doubtful = np.array([[1.0, 0.0, 0.5, 1.0, 0.0]]), np.array([[0.3, 0.5, 0.0, 0.3, 0.0]])
    assert probabilities(sure)[0] > 0.95 and probabilities(doubtful)[0] < 0.01
    for mark, sign in zip(range(len(MARKS)), (1, -1, 1, 1, -1), strict=True):
        more = sure.copy()
        more[0, mark] += 0.1
        assert np.sign(probabilities(more) - probabilities(sure))[0] == sign
