"""From strokes to a wireframe: a box with a hole out of what fits find of it, in the views of known edges."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from edgel_scenes import either_errors, views_of

from taichi_edges.corridor.pipeline import Run
from taichi_edges.corridor.refine import refine
from taichi_edges.fitting.distances import distances_to
from taichi_edges.geometry.shapes import EllipticArc, Line, polyline
from taichi_edges.geometry.wireframe import Wireframe, read_wireframe, write_wireframe
from taichi_edges.progress import Progress
from taichi_edges.refinement.stage import RefineCounts, refine_wireframe
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.scene.settings import RefineConfig
from taichi_edges.views.views import pixel_size, write_views

LOW, HIGH, RADIUS = np.array([0.3, 0.35, 0.4]), np.array([0.7, 0.65, 0.55]), 0.08
ENABLED = RefineConfig(enabled=True)
NOISE_PX, VIEWS = 0.1, 12  # of the edgels; half of the usual views, as each takes its time


class Box:
    """A box with a round hole in its top, turned about the upright axis, the views of it, and strokes along it."""

    def __init__(self, generator, hidden=0.2, errors="white"):
        angle, unit = (
            generator.uniform(0, 2 * np.pi),
            np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]),
        )
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        self.corners = (LOW + unit * (HIGH - LOW) - 0.5) @ turn.T + 0.5
        pairs = [pair for pair in combinations(range(8), 2) if np.abs(unit[pair[0]] - unit[pair[1]]).sum() == 1]
        self.lines = [Line(self.corners[list(pair)]) for pair in pairs]
        centre = np.array([*(0.5 * (LOW + HIGH))[:2], HIGH[2]])
        self.rim = EllipticArc((centre - 0.5) @ turn.T + 0.5, RADIUS * turn.T[:2], 0.0, 2 * np.pi)
        curves = [lambda s, shape=shape: shape.at(np.asarray(s)) for shape in (*self.lines, self.rim)]
        self.views = views_of(curves, generator, noise_px=NOISE_PX, hidden=hidden, count=VIEWS, errors=errors)
        self.pixel = pixel_size(self.views)

    def strokes(self, generator):
        """Loose edges: ends off by some pixels, places by tenths; lines and the rim cut, one doubled, in any order."""
        cut = generator.uniform(0.35, 0.65, 2)
        gap = 2 * self.pixel / self.lines[0].length
        pieces = [part(self.lines[0], 0, cut[0]), part(self.lines[0], cut[0] + gap, 1), *self.lines[1:]]
        pieces += [part(self.lines[5], 0.2, 0.7), part(self.rim, 0, cut[1] - 0.01), part(self.rim, cut[1], 0.98)]
        moved = [self.disturbed(piece, generator) for piece in pieces]
        return Wireframe.loose([moved[n] for n in generator.permutation(len(moved))])

    def disturbed(self, shape, generator):
        """A shape, its ends moved along it by up to two pixels, all of it by a tenth."""
        shift = generator.uniform(-2, 2, 2) * self.pixel / shape.length
        step = 0.1 * self.pixel * generator.normal(size=3)
        return part(shape, shift[0], 1 + shift[1]).transformed(lambda points: points + step)


def part(shape, low, high):
    """The part of a line or an arc between two parameters, or more of it."""
    wanted = np.array([low, high])
    return Line(shape.at(wanted)) if shape.kind == "line" else shape.over(*shape.angles(wanted))


def kinds_of(wireframe):
    return sorted(shape.kind for shape in wireframe.shapes)


def off(points, wanted):
    """The greatest distance of wanted points from the nearest of others."""
    return np.linalg.norm(np.asarray(wanted)[:, None] - points, axis=2).min(axis=1).max()


@either_errors()
@pytest.mark.parametrize("seed", range(2))
def test_strokes_along_a_box_with_a_hole_become_its_wireframe(taichi, generator, seed, errors):
    box = Box(generator, errors=errors)
    found, counts = refine_wireframe(box.strokes(generator), box.views, ENABLED)
    assert kinds_of(found) == ["circle"] + ["line"] * 12
    assert len(found.vertices) == 8 and (found.degrees == 3).all() and len(found.contacts) == 0
    # A dozen views of 0.1 px each and two lines at least say where a corner is: hundredths of a pixel, tenfold.
    assert off(found.vertices, box.corners) < 0.2 * box.pixel
    (rim,) = (shape for shape in found.shapes if shape.kind == "circle")
    assert np.linalg.norm(rim.centre - box.rim.centre) < 0.1 * box.pixel
    assert abs(rim.radii[0] - RADIUS) < 0.1 * box.pixel
    assert counts.circles == 1 and counts.joined == 2 and counts.duplicates == 1 and counts.unsupported == 0
    for edge in found.edges:
        assert edge.evidence.views >= 5 and edge.evidence.confidence > 0.8
        assert edge.evidence.supported_length > 0.8 * edge.shape.length and edge.evidence.residual_px < 3 * NOISE_PX
        if edge.vertices:
            np.testing.assert_allclose(edge.shape.ends, found.vertices[list(edge.vertices)], atol=1e-12)


def test_same_twice_bit_for_bit(taichi, generator):
    box = Box(generator)
    strokes = box.strokes(generator)
    one, other = (refine_wireframe(strokes, box.views, ENABLED)[0] for _ in range(2))
    np.testing.assert_array_equal(one.vertices, other.vertices)
    for a, b in zip(one.edges, other.edges, strict=True):
        assert a.vertices == b.vertices and a.evidence == b.evidence
        np.testing.assert_array_equal(polyline(a.shape), polyline(b.shape))


@either_errors()
def test_refined_twice_is_as_once(taichi, generator, errors):
    box = Box(generator, errors=errors)
    once, _ = refine_wireframe(box.strokes(generator), box.views, ENABLED)
    twice, counts = refine_wireframe(Wireframe.loose(once.shapes), box.views, ENABLED)
    shares = counts.likely_percent, counts.shown_percent
    assert replace(counts, relations={}, likely_percent=None, shown_percent=None) == RefineCounts()
    assert min(shares) > 90
    assert kinds_of(twice) == kinds_of(once) and off(twice.vertices, once.vertices) < 0.02 * box.pixel


@either_errors()
def test_edge_that_no_image_shows_is_removed_and_counted(taichi, generator, errors):
    box = Box(generator, errors=errors)
    ghost = Line(box.rim.centre + np.array([[-0.05, 0.02, 0.15], [0.1, 0.05, 0.2]]))
    loose = Wireframe.loose([*box.strokes(generator).shapes, ghost])
    found, counts = refine_wireframe(loose, box.views, ENABLED)
    assert counts.unsupported + sum(counts.doubted.values()) == 1 and kinds_of(found) == ["circle"] + ["line"] * 12
    assert min(distances_to(shape, ghost.points).min() for shape in found.shapes) > 0.02


@either_errors()
def test_short_edge_that_nobody_found_is_added(taichi, generator, errors):
    """The upright lines of a low box."""
    box = Box(generator, errors=errors)
    upright = [number for number, line in enumerate(box.lines) if abs(line.tangents(0.5)[2]) > 0.9]
    lines = [line for number, line in enumerate(box.lines) if number != upright[0]]
    loose = Wireframe.loose([box.disturbed(line, generator) for line in lines])
    found, counts = refine_wireframe(loose, box.views, ENABLED)
    assert counts.lines == 1 and kinds_of(found) == ["line"] * 12 and (found.degrees == 3).all()


@pytest.mark.parametrize("enabled", [False, True])
def test_no_edges_are_none(taichi, generator, enabled):
    nothing = Wireframe.loose([])
    found, counts = refine_wireframe(nothing, views_of([], generator), RefineConfig(enabled=enabled))
    assert len(found) == 0 and found.vertices.shape == (0, 3) and counts == RefineCounts()


def test_disabled_leaves_everything_as_it_is(generator):
    box = Box(generator)
    strokes = box.strokes(generator)
    assert refine_wireframe(strokes, box.views, RefineConfig(enabled=False)) == (strokes, RefineCounts())


def test_edges_in_views_that_show_nothing_are_none(taichi, generator):
    box = Box(generator)
    found, counts = refine_wireframe(Wireframe.loose(box.lines), views_of([], generator), ENABLED)
    assert len(found) == 0 and counts.unsupported == 12


class Warnings(Progress):
    """Keeps the warnings."""

    def __init__(self):
        self.texts = []

    def warn(self, text):
        self.texts.append(text)


def run_of(folder, loose, views, **settings):
    """A Run before its refine stage."""
    write_views(folder / "views.npz", views)
    write_wireframe(folder / "edges_fit.json", loose, {})
    scene = check_scene({"source": {"reader": "synthetic", "part": "block"}, "refine": settings}, "test")
    return Run(scene, folder, progress=Warnings())


def test_stage_warns_when_no_edge_is_left(start_taichi, tmp_path, monkeypatch, generator):
    monkeypatch.setattr("taichi_edges.kernels.device.start_taichi", lambda *_: start_taichi("f32", 1))
    lines = [Line(np.array([[0.2, 0.3, 0.4], [0.7, 0.6, 0.5]]))] * 2
    run = run_of(tmp_path, Wireframe.loose(lines), views_of([], generator, count=4), enabled=True)
    assert refine(run)["edges"] == 0 and len(read_wireframe(tmp_path / "edges.json")) == 0
    (text,) = run.progress.texts
    assert "the images support none of the 2 edges that were fitted" in text and "refine.enabled: false" in text


@pytest.mark.parametrize(("enabled", "count"), [(False, 1), (True, 0)])
def test_stage_without_work_waits_for_no_device_and_warns_of_nothing(tmp_path, monkeypatch, generator, enabled, count):
    monkeypatch.setattr("taichi_edges.kernels.device.start_taichi", lambda *_: pytest.fail("Taichi was started"))
    monkeypatch.setattr("taichi_edges.kernels.device.is_running", lambda *_: False)
    loose = Wireframe.loose([Line(np.array([[0.2, 0.3, 0.4], [0.7, 0.6, 0.5]]))] * count)
    run = run_of(tmp_path, loose, views_of([], generator, count=4), enabled=enabled)
    assert refine(run)["edges"] == count and run.progress.texts == []
