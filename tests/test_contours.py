"""Edges told from occluding contours by where their edgels lie as the viewpoint moves."""

from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import CylinderContour, arc, centre, either_errors, line, pixel_of, tangents, views_of

from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.evidence.explaining import explain
from taichi_edges.evidence.viewing_planes import refine_points
from taichi_edges.fitting.arcs import Arc
from taichi_edges.scene.settings import FilterConfig
from taichi_edges.strokes.clusters import Clusters
from taichi_edges.strokes.contours import CONTOUR_SHARE, likelihood_ratio, steady_edges, without_contours

A = line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])
RIM = arc([0.5, 0.5, 0.6], 0.25)
LEAST = FilterConfig().min_evidence
NOISE_PX = 0.05  # of our own detector
PIXEL = 0.0046  # of these views, unit-cube units


pytestmark = pytest.mark.usefixtures("taichi")


def judged(views, curves, radii=(1.0,), moved=True):
    """(m,) bool: which of the clusters of points along some curves, `moved` to their edgels or not, pass for edges."""
    s = np.linspace(0.1, 0.9, 40)
    places, along = (np.concatenate([of(curve, s) for curve in curves]) for of in (lambda c, s: c(s), tangents))
    matching = EdgelMatching(views)
    found = refine_points(matching, places, along, radii)
    found = found if moved else replace(found, points=places, directions=along)
    labels = np.repeat(np.arange(len(curves)), len(s))
    return steady_edges(matching, Clusters.of(found.points, found.directions, labels), explain(matching, found), LEAST)


def lines_on(contour, views, every):
    """The lines in which every so many views see a cylinder's contour: what a reconstruction takes for edges."""
    return [contour.seen_from(centre(views, view)) for view in range(0, len(views), every)]


@either_errors()
@pytest.mark.parametrize("radius_px", [6, 12, 26])
def test_contours_are_no_edges_and_do_not_explain_each_other(generator, radius_px, errors):
    contour = CylinderContour([0.6, 0.5], radius_px * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, contour], generator, noise_px=NOISE_PX, errors=errors)
    assert pixel_of(views) == pytest.approx(PIXEL, rel=0.01)
    edges = judged(views, [A, RIM, *lines_on(contour, views, every=3)], radii=(3.0, 2.0, 1.0))
    assert edges[:2].all()
    assert edges[2:].mean() <= 0.25  # three views always meet in a line, and may be the only ones nearby


class Rounding(CylinderContour):
    """The contour of an edge's rounding, seen from where neither of its two faces turns away; else a line elsewhere."""

    def seen_from(self, camera):
        bearing = np.arctan2(*(camera[:2] - self.middle)[::-1])
        elsewhere = line([0.1, 0.1, 0.1], [0.1, 0.1, 0.3])
        return super().seen_from(camera) if np.abs(bearing) < np.radians(60) else elsewhere


@either_errors()
def test_an_edge_rounded_by_less_than_a_pixel_is_an_edge(generator, errors):
    """Its contour moves by 0.9 px (1 - cos 60 degrees), less than half a pixel, half of it to either side."""
    rounded = Rounding([0.6, 0.5], 0.9 * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, rounded], generator, noise_px=NOISE_PX, count=48, errors=errors)
    middle = line([0.6, 0.5 + 0.9 * PIXEL, 0.2], [0.6, 0.5 + 0.9 * PIXEL, 0.8])
    assert judged(views, [A, RIM, middle], radii=(2.0, 1.0, 1.0)).all()


@either_errors()
def test_close_parallel_edges_stay(generator, errors):
    """2 pixels apart, each hidden in a third of the views, in which the edgels of the other are all there is."""
    pair = [line([0.2, y, 0.5], [0.8, y, 0.5]) for y in (0.5, 0.5 + 2 * PIXEL)]
    views = views_of([*pair, RIM], generator, noise_px=NOISE_PX, hidden=0.33, errors=errors)
    assert judged(views, [*pair, RIM]).all()


@either_errors()
def test_a_line_whose_edgels_others_explain_is_none(generator, errors):
    """A second line 2/3 of a pixel beside an edge lies on the edgels of that one only."""
    views = views_of([A, RIM], generator, noise_px=NOISE_PX, errors=errors)
    beside = line(np.array([0.2, 0.3, 0.303]), np.array([0.8, 0.35, 0.403]))
    np.testing.assert_array_equal(judged(views, [A, beside, RIM], moved=False), [True, False, True])


def test_evidence_grows_with_the_share_and_with_the_views():
    usual = CONTOUR_SHARE
    assert likelihood_ratio(0.0, 0.0, usual) == 0.0 and likelihood_ratio(usual * 20, 20, usual) == pytest.approx(
        0.0, abs=1e-9
    )
    assert likelihood_ratio(3, 20, usual) == 0.0  # fewer than a contour has
    assert likelihood_ratio(8, 10, usual) > likelihood_ratio(7, 10, usual)
    assert likelihood_ratio(16, 20, usual) == pytest.approx(2 * likelihood_ratio(8, 10, usual))
    assert likelihood_ratio(2, 2, usual) == pytest.approx(-2 * np.log(usual), rel=1e-3)


@either_errors()
def test_clusters_are_left_without_contours(generator, errors):
    contour = CylinderContour([0.6, 0.5], 12 * PIXEL, 0.2, 0.8)
    views = views_of([A, contour], generator, noise_px=NOISE_PX, errors=errors)
    limb, s = lines_on(contour, views, every=24)[0], np.linspace(0.1, 0.9, 40)
    matching = EdgelMatching(views)
    found = refine_points(
        matching, np.concatenate([limb(s), A(s)]), np.concatenate([tangents(limb, s), tangents(A, s)]), (3.0, 1.0)
    )
    arcs = tuple(Arc(np.full(3, float(number)), np.ones(3), np.ones(3)) for number in range(2))
    labels, shared = np.repeat([0, 1], 40), np.array([[0, 1], [79, 0]])
    clusters = Clusters(found.points, found.directions, labels, shared, arcs)
    kept, contours = without_contours(clusters, explain(matching, found), views, FilterConfig())
    assert contours == 1 and kept.arcs == arcs[1:]
    np.testing.assert_array_equal(kept.labels, np.repeat([-1, 0], 40))
    np.testing.assert_array_equal(kept.shared, [[0, 0]])
    untouched, contours = without_contours(clusters, None, views, FilterConfig())
    assert untouched is clusters and contours == 0


@pytest.mark.slow(reason="starts Taichi anew")
def test_the_result_does_not_depend_on_threads(start_taichi, generator):
    contour = CylinderContour([0.6, 0.5], 6 * PIXEL, 0.2, 0.8)
    views = views_of([A, RIM, contour], generator, noise_px=0.2, hidden=0.4)
    found = []
    for threads in (1, 2):
        start_taichi("f32", threads)
        found.append(judged(views, [A, RIM, *lines_on(contour, views, every=2)], radii=(3.0, 1.0)))
    np.testing.assert_array_equal(*found)
