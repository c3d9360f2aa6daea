"""The file between the stages `cluster` and `fit`: all of it comes back; what is wrong with it is said in a line."""

import numpy as np
import pytest

from taichi_edges.corridor.fit import fit
from taichi_edges.corridor.pipeline import Run
from taichi_edges.errors import UserError
from taichi_edges.fitting.arcs import Arc
from taichi_edges.scene.settings import SceneConfig
from taichi_edges.strokes.clusters import Clusters, read_clusters, write_clusters
from taichi_edges.views.views import Views, write_views

FIELDS = ("origin", "tangent", "bend", "low", "high", "closed")


@pytest.fixture
def clusters(generator):
    """An arc, a free curve and a closed circle; points of none of them, and a shared one."""
    points, directions = generator.normal(size=(2, 8, 3))
    arc = Arc(points[0], directions[0], np.zeros(3), -0.1, 0.2)
    circle = Arc(points[1], directions[1], directions[2], np.float64(-0.3), np.float64(0.3), True)
    labels = np.array([0, 0, 1, 1, -1, 2, 2, -1])
    return Clusters(points, directions, labels, np.array([[2, 0]]), (arc, None, circle), 0.4)


def assert_same(found, expected):
    """Two Clusters agree to the last bit."""
    for name in ("points", "directions", "labels", "shared"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.noise_px == expected.noise_px
    assert [arc is None for arc in found.arcs] == [arc is None for arc in expected.arcs]
    for one, other in zip(found.arcs, expected.arcs, strict=True):
        for name in FIELDS if one is not None else ():
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_clusters_outlive_the_file(tmp_path, clusters):
    assert_same(read_clusters(write_clusters(tmp_path / "clusters.npz", clusters)), clusters)


def test_no_clusters_outlive_it_as_well(tmp_path):
    nothing = Clusters.of(np.zeros((2, 3)), np.zeros((2, 3)), np.full(2, -1))
    assert_same(read_clusters(write_clusters(tmp_path / "clusters.npz", nothing)), nothing)


def test_chosen_edges_are_renumbered(clusters):
    kept = clusters.keep(np.array([False, True, True]))
    assert kept.labels.tolist() == [-1, -1, 0, 0, -1, 1, 1, -1]
    assert kept.arcs == clusters.arcs[1:] and len(kept.shared) == 0 and kept.points is clusters.points


DAMAGES = {
    "of another version": ("has_arc", None, "has_arc"),
    "short": ("labels", lambda labels: labels[:-1], "different lengths"),
    "arcs": ("arc_low", lambda low: low[:1], "different lengths"),
    "flat": ("points", lambda points: points.ravel(), r"points is float64 \(24,\)"),
    "kind": ("labels", lambda labels: labels.astype(float), r"labels is float64 \(8,\)"),
    "NaN": ("directions", lambda directions: directions * np.nan, "directions is not finite"),
    "unknown edge": ("labels", lambda labels: labels + 1, "labels are not those of its edges"),
    "edge without points": ("labels", lambda labels: np.minimum(labels, 1), "labels are not those of its edges"),
    "shares": ("shared", lambda shared: shared + [[8, 0]], "points or edges that it has not"),
}


def assert_refused(path, said):
    """The stage `fit` says what is wrong with its file, and what to do, in one line."""
    empty = np.zeros((0, 4, 4), np.uint8)
    write_views(path.with_name("views.npz"), Views((), empty, np.zeros((0, 3, 3)), np.zeros((0, 3, 4)), ()))
    with pytest.raises(UserError, match=said) as error:
        fit(Run(SceneConfig(source={"path": "."}), path.parent))
    text = str(error.value)
    assert text.startswith(f"{path}: ") and text.endswith("; run again with --stage cluster") and "\n" not in text


@pytest.mark.parametrize("damage", DAMAGES)
def test_arrays_that_do_not_fit_together_are_refused(tmp_path, clusters, damage):
    name, change, said = DAMAGES[damage]
    path = write_clusters(tmp_path / "clusters.npz", clusters)
    with np.load(path) as archive:
        arrays = dict(archive)
    changed = arrays.pop(name)
    np.savez(path, **arrays, **({name: change(changed)} if change else {}))
    assert_refused(path, said)


@pytest.mark.parametrize("content", [b"", b"no archive"])
def test_a_file_that_is_no_archive_is_refused(tmp_path, content):
    path = tmp_path / "clusters.npz"
    path.write_bytes(content)
    assert_refused(path, "it is no archive")


def test_a_file_that_is_not_there_is_refused(tmp_path):
    assert_refused(tmp_path / "clusters.npz", "No such file")


@pytest.mark.parametrize("seed", range(20))
def test_a_file_with_some_bytes_changed_or_cut_off_is_refused_or_read_as_it_was(tmp_path, clusters, generator, seed):
    path = write_clusters(tmp_path / "clusters.npz", clusters)
    content = bytearray(path.read_bytes())
    if seed % 2:
        start = generator.integers(0, len(content) - 8)
        content[start : start + 8] = generator.bytes(8)
    else:
        del content[generator.integers(0, len(content)) :]
    path.write_bytes(content)
    try:
        found = read_clusters(path)
    except UserError:
        return
    assert_same(found, clusters)
