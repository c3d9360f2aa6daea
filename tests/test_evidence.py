"""Samples of edges, who owns an edgel, and what the views say about edges."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import CylinderContour, arc, either_errors, line, pixel_of, views_of

from taichi_edges.evidence.edge_support import (
    Claims,
    EdgeSamples,
    claims_of,
    evidence_of,
    spaced,
    support_along,
    support_of,
    support_share,
)
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.geometry.shapes import EllipticArc, Line, Spline

START, END = np.array([0.2, 0.3, 0.3]), np.array([0.8, 0.35, 0.4])
A = line(START, END)
RIM = arc([0.5, 0.5, 0.6], 0.25)
CIRCLE = EllipticArc(np.array([0.5, 0.5, 0.6]), 0.25 * np.eye(3)[:2], 0.0, 2 * np.pi)


def matching_of(curves, generator, **settings):
    """EdgelMatching of views of curves."""
    return EdgelMatching(views_of(curves, generator, **settings))


def test_pixel_is_that_of_the_place_and_that_of_the_scene_where_no_view_has_it(taichi, generator):
    matching = matching_of([A], generator)
    near, nowhere = np.full(3, 0.5), np.array([0.5, 0.5, 90.0])
    assert matching.pixel_at(np.array([near, nowhere])).tolist() == [pytest.approx(matching.pixel), matching.pixel]


def supported(matching, shapes):
    """The Evidence of each shape."""
    return evidence_of(support_of(matching, shapes))


def moved(shape, offset):
    """A shape moved by (3,)."""
    return shape.transformed(lambda points: points + offset)


def test_samples_are_evenly_spaced():
    ellipse = EllipticArc(np.zeros(3), np.diag([0.5, 0.1, 0])[:2], 0.1, 2.5)
    uneven = Spline(np.array([[[0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [0.9, 0.5, 0]]]))
    for shape in (Line(np.array([START, END])), CIRCLE, ellipse, uneven):
        samples = EdgeSamples.along([shape], 0.005)
        steps = np.linalg.norm(np.diff(samples.points, axis=0), axis=1)
        # the spline hardly moves at its start: its speed doubles from one of the 64 chords to the next
        assert np.ptp(steps) < 0.05 * steps.mean()
        assert samples.lengths.sum() == pytest.approx(shape.length)
    assert len(spaced(Line(np.array([START, START + 1e-6])), 0.005)) == 1
    assert len(EdgeSamples.along([], 0.005)) == 0


def test_sums_are_by_edge():
    samples = EdgeSamples.along([Line(np.array([START, END])), CIRCLE], 0.01)
    np.testing.assert_allclose(samples.sums(samples.lengths), [np.linalg.norm(END - START), CIRCLE.length])
    assert samples.sums(samples.points).shape == (2, 3)


def test_nearest_edge_owns_the_edgel():
    claims = Claims.of(4, np.array([0, 0, 0, 2, 2]), np.array([1, 0, 1, 5, 3]), np.array([0.5, 0.2, 0.1, 0.3, 0.3]))
    np.testing.assert_array_equal(claims.owners, [1, -1, 3, -1])
    np.testing.assert_array_equal(claims.distances, [0.1, np.inf, 0.3, np.inf])
    np.testing.assert_array_equal(claims.rivals, [0.2, np.inf, 0.3, np.inf])
    np.testing.assert_array_equal(claims.beside(1), [0.2, np.inf, 0.3, np.inf])


@either_errors()
def test_true_edges_are_confirmed(taichi, generator, errors):
    shapes = [Line(np.array([START, END])), CIRCLE]
    found = supported(matching_of([A, RIM], generator, noise_px=0.1, errors=errors), shapes)
    for shape, evidence in zip(shapes, found, strict=True):
        assert evidence.views == 24
        assert evidence.supported_length == pytest.approx(shape.length, rel=0.02)
        assert evidence.residual_px == pytest.approx(0.1, rel=0.2)
        assert evidence.confidence > 0.99


@either_errors()
def test_noise_is_measured(taichi, generator, errors):
    for noise in (0.05, 0.3):
        support = support_of(
            matching_of([A, RIM], generator, noise_px=noise, errors=errors), [Line(np.array([START, END])), CIRCLE]
        )
        assert 0.65 * noise < support.noise_px < 1.1 * noise  # a sample's edgel is the nearest of some


@either_errors()
def test_hidden_views_say_nothing_against_an_edge(taichi, generator, errors):
    half = matching_of([A, RIM], generator, noise_px=0.1, hidden=0.5, errors=errors)
    found = supported(half, [Line(np.array([START, END])), CIRCLE])
    assert all(evidence.confidence > 0.98 for evidence in found)


@either_errors()
def test_neighbour_does_not_support_an_edge(taichi, generator, errors):
    matching = matching_of([A], generator, noise_px=0.05, errors=errors)
    true = Line(np.array([START, END]))
    beside = moved(true, 0.6 * matching.pixel * np.array([0.0, 0.6, 0.8]))
    alone, (owner, neighbour) = supported(matching, [beside])[0], supported(matching, [true, beside])
    assert alone.supported_length > 0.8 * beside.length  # nobody else explains these edgels
    assert owner.confidence > 0.99 and owner.supported_length > 0.95 * true.length
    assert neighbour.supported_length < 0.1 * beside.length and neighbour.confidence < 0.1


@either_errors()
def test_two_close_parallel_edges_are_both_confirmed(taichi, generator, errors):
    apart = np.array([0.0, 0.0, 0.012])  # 2 px of these views
    shapes = [Line(np.array([START, END])), Line(np.array([START, END]) + apart)]
    matching = matching_of([A, line(START + apart, END + apart)], generator, noise_px=0.1, errors=errors)
    assert 1.0 < 0.012 / matching.pixel < 3.0
    assert all(evidence.confidence > 0.9 for evidence in supported(matching, shapes))


def test_two_views_confirm_nothing(taichi, generator):
    views = matching_of([A], generator, count=2)
    found = supported(views, [Line(np.array([START, END]))])[0]
    assert found.views == 2 and found.supported_length == 0 and found.confidence < 0.05


@either_errors()
def test_share_of_the_views_with_an_edge_in_the_image_that_support_it(taichi, generator, errors):
    views = views_of([A, RIM], generator, noise_px=0.05, count=10, errors=errors)
    chosen = views.edgels.views < 3  # the others show nothing
    few = EdgelMatching(replace(views, edgels=views.edgels.keep(chosen)))
    shapes = [Line(np.array([START, END])), CIRCLE]
    np.testing.assert_allclose(support_share(few, support_of(few, shapes)), 0.3, atol=0.02)
    every = EdgelMatching(views)
    np.testing.assert_allclose(support_share(every, support_of(every, shapes)), 1.0, atol=0.03)
    # Where three views look another way, those left have it in their image: 3 of 7.
    away = views.world_to_camera.copy()
    away[7:, :, :3], away[7:, :, 3] = np.diag([-1, 1, -1]) @ away[7:, :, :3], away[7:, :, 3] * [-1, 1, -1]
    turned = EdgelMatching(replace(views, edgels=views.edgels.keep(chosen), world_to_camera=away))
    np.testing.assert_allclose(support_share(turned, support_of(turned, shapes)), 3 / 7, atol=0.03)
    none = moved(shapes[0], np.array([50.0, 0, 0]))  # in no image
    assert support_share(few, support_of(few, [none])).tolist() == [0.0]
    assert len(support_share(few, support_of(few, []))) == 0


def test_contour_is_not_sure(taichi, generator):
    contour = CylinderContour([0.5, 0.5], 0.15, 0.2, 0.8)
    seen = contour.seen_from(np.array([3.0, 0.5, 0.5]))(np.array([0.0, 1.0]))
    found = supported(matching_of([contour, A], generator), [Line(seen), Line(np.array([START, END]))])
    assert found[0].confidence < 0.3 < 0.98 < found[1].confidence


@either_errors()
def test_support_ends_where_the_edge_ends(taichi, generator, errors):
    matching = matching_of([A], generator, noise_px=0.05, errors=errors)
    short = Line(A(np.array([0.2, 0.6])))
    views = support_along(matching, short, np.array([-0.8, -0.3, 0.5, 1.5, 2.2]), claims_of(matching, [short]), own=0)
    assert (views[1:4] > 20).all() and (views[[0, 4]] == 0).all()


@either_errors()
def test_what_others_own_supports_no_extension(taichi, generator, errors):
    matching = matching_of([A], generator, noise_px=0.05, errors=errors)
    first, second = Line(A(np.array([0.0, 0.4]))), Line(A(np.array([0.6, 1.0])))
    claims = claims_of(matching, [first, second])
    views = support_along(matching, first, np.array([0.5, 1.25, 2.0]), claims, own=0)
    assert views[0] > 20 and views[1] > 20 and views[2] < 8
    assert support_along(matching, first, np.array([2.0]))[0] > 20


def test_no_edges_and_no_edgels(taichi, generator):
    assert supported(matching_of([A], generator), []) == []
    none = supported(matching_of([], generator), [Line(np.array([START, END]))])[0]
    assert (none.views, none.supported_length, none.residual_px, none.confidence) == (0, 0, 0, 0)


def test_same_twice(taichi, generator):
    matching = matching_of([A, RIM], generator, noise_px=0.2, hidden=0.3)
    shapes = [Line(np.array([START, END])), CIRCLE, moved(CIRCLE, matching.pixel)]
    assert supported(matching, shapes) == supported(matching, shapes)


def test_samples_are_a_pixel_apart_at_most(taichi, generator):
    views = views_of([A], generator)
    samples = support_of(EdgelMatching(views), [CIRCLE]).samples
    assert np.linalg.norm(np.diff(samples.points, axis=0), axis=1).max() < pixel_of(views)
