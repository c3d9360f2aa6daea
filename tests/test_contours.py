"""Contours of a cylinder come in a file of their own with its radius; edges do not, and nobody gets them unasked."""

import json
from dataclasses import replace

import numpy as np
import pytest
from edgel_scenes import CylinderContour, arc, centre, line, views_of
from told import Told

from taichi_edges.corridor.findings import FINDINGS
from taichi_edges.corridor.pipeline import Run
from taichi_edges.corridor.refine import refine
from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.fitting.distances import distances_to
from taichi_edges.geometry.shapes import EllipticArc, Line, middles_of
from taichi_edges.geometry.wireframe import Wireframe, read_wireframe, wireframe_and_about, write_wireframe
from taichi_edges.refinement.contours import found_contours
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.scene.settings import RefineConfig
from taichi_edges.views.cameras import Similarity
from taichi_edges.views.views import write_views

PIXEL = 0.004608  # of the default views, unit-cube units
MIDDLE, LOW, HIGH = [0.6, 0.5], 0.2, 0.8  # of the cylinder
SEEN_FROM = (0, 7, 14)  # views whose contours are strokes
LINES = [Line(np.array(ends)) for ends in ([[0.2, 0.3, 0.3], [0.8, 0.35, 0.4]], [[0.2, 0.3, 0.3], [0.3, 0.8, 0.25]])]
RIM = EllipticArc(np.array([0.5, 0.5, 0.85]), 0.25 * np.eye(3)[:2], 0.0, 2 * np.pi)
CURVES = [*(line(*edge.points) for edge in LINES), arc(RIM.centre, 0.25)]


def cylinder_scene(generator, radius_px):
    """Views of two lines, a rim and a cylinder; strokes along all of them, those of the contours in two pieces."""
    sides = [CylinderContour(MIDDLE, radius_px * PIXEL, LOW, HIGH, side) for side in (1, -1)]
    views = views_of([*CURVES, *sides], generator, noise_px=0.1, apart=1.0)
    contours = [side.seen_from(centre(views, view)) for side in sides for view in SEEN_FROM]
    pieces = [Line(curve(np.array(ends))) for curve in contours for ends in ((0.02, 0.48), (0.52, 0.97))]
    return views, Wireframe.loose([*LINES, RIM, *pieces])


@pytest.mark.parametrize("radius_px", [8, 20])
def test_a_cylinder_has_contours_of_its_radius_and_edges_are_none(taichi, generator, radius_px):
    views, loose = cylinder_scene(generator, radius_px)
    shapes, rounding, _ = found_contours(loose, Wireframe.loose([*LINES, RIM]), views, RefineConfig())
    assert len(shapes) == 2 * len(SEEN_FROM)  # the pieces are joined
    for shape in shapes:
        assert shape.length > 0.9 * (HIGH - LOW) and abs(shape.tangents(0.5)[2]) > 0.999
        away = np.linalg.norm(shape.at(np.array([0.5]))[0, :2] - MIDDLE)
        assert away == pytest.approx(radius_px * PIXEL, abs=0.5 * PIXEL)
    assert (np.abs(rounding.radius_px - radius_px) <= rounding.uncertainty_px).mean() >= 0.8
    assert (np.abs(rounding.radius_px - radius_px) <= 2 * rounding.uncertainty_px).all()


def test_what_lies_on_an_edge_that_is_kept_is_no_contour(taichi, generator):
    views, loose = cylinder_scene(generator, 8)
    kept = loose.shapes[3:5]  # both pieces of one contour
    shapes, *_ = found_contours(loose, Wireframe.loose(kept), views, RefineConfig())
    assert len(shapes) == 2 * len(SEEN_FROM) - 1
    assert min(distances_to(shape, kept[0].points).max() for shape in shapes) > 2 * PIXEL


@pytest.mark.parametrize("radius_px", [2, 100])
def test_a_radius_that_cannot_be_told_is_not(taichi, generator, radius_px):
    views, loose = cylinder_scene(generator, radius_px)
    shapes, rounding, _ = found_contours(loose, Wireframe.loose(LINES), views, RefineConfig())
    assert shapes == [] and rounding.radius_px.shape == (0,)


def run_of(folder, views, loose, **settings):
    """A Run before its refine stage. views, loose: in the unit cube."""
    write_views(folder / "views.npz", views)
    loose = loose.transformed(views.similarity.to_input, 1 / views.similarity.scale)
    write_wireframe(folder / "edges_fit.json", loose, {"frame": "input"})
    scene = check_scene({"source": {"reader": "synthetic", "part": "block"}, "refine": settings}, "test")
    return Run(scene, folder, progress=Told(), threads=2)


def test_stage_writes_contours_where_it_is_asked_to_and_removes_older_ones(taichi, generator, tmp_path):
    views, loose = cylinder_scene(generator, 8)
    views = replace(views, similarity=Similarity(0.01, (0.1, 0.2, 0.3)))  # the input is 100 units large
    plain = refine(run_of(tmp_path, views, loose))
    edges = (tmp_path / "edges.json").read_bytes()
    assert "files" not in plain and "contours in a file" not in FINDINGS["refine"](plain)
    assert not (tmp_path / "contours.json").exists()

    asked = run_of(tmp_path, views, loose, contours=True)
    facts = refine(asked)
    assert not any("refine.contours" in text for text in asked.progress.warnings)
    assert facts["files"] == ["contours.json"] and facts["contours"] == 2 * len(SEEN_FROM)
    assert "; 6 contours in a file of their own" in FINDINGS["refine"](facts)
    assert (tmp_path / "edges.json").read_bytes() == edges
    contours, about = wireframe_and_about(tmp_path / "contours.json")
    assert about["kind"] == "contour" and about["frame"] == "input" and set(contours.degrees.tolist()) == {1}
    lists = [about[name] for name in ("radius", "radius_px", "radius_uncertainty_px")]
    assert [len(values) for values in lists] == [len(contours)] * 3
    pixels = EdgelMatching(views).pixel_at(
        middles_of([s.transformed(views.similarity.to_unit) for s in contours.shapes])
    )
    np.testing.assert_allclose(about["radius"], np.array(about["radius_px"]) * pixels / 0.01, rtol=1e-6)
    for shape in contours.shapes:
        away = np.linalg.norm(views.similarity.to_unit(shape.ends)[:, :2] - MIDDLE, axis=1)
        np.testing.assert_allclose(away, 8 * PIXEL, atol=0.5 * PIXEL)

    refine(run_of(tmp_path, views, loose))
    assert not (tmp_path / "contours.json").exists()


@pytest.mark.parametrize("settings", [{"verdict": False}, {"enabled": False}])
def test_without_a_verdict_there_are_no_contours(taichi, generator, tmp_path, settings):
    views, loose = cylinder_scene(generator, 8)
    run = run_of(tmp_path, views, Wireframe.loose(loose.shapes[:1]), contours=True, **settings)
    facts = refine(run)
    assert any("refine.contours" in text and "refine.verdict" in text for text in run.progress.warnings)
    assert "contours" not in facts and not (tmp_path / "contours.json").exists()


def test_no_strokes_have_no_contours(taichi, generator, tmp_path):
    views, _ = cylinder_scene(generator, 8)
    assert "contours" not in refine(run_of(tmp_path, views, Wireframe.loose([]), contours=True))
    refine(run_of(tmp_path, views, Wireframe.loose(LINES), contours=True))
    assert len(read_wireframe(tmp_path / "contours.json")) == 0
    assert json.loads((tmp_path / "contours.json").read_text())["radius_px"] == []
