"""What people open must hold exactly what was written, and the pictures must show edges where they are."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from taichi_edges.errors import UserError
from taichi_edges.exporters import EXPORTERS
from taichi_edges.exporters.line_sets import (
    CURVE_SEGMENTS,
    edge_paths,
    line_set_arrays,
    write_line_set_obj,
    write_line_set_ply,
)
from taichi_edges.exporters.overlays import (
    FADED_TO,
    FAINTEST,
    IMAGE_FADE,
    background,
    caption,
    clip_segments,
    contact_sheet,
    draw_overlays,
)
from taichi_edges.exporters.viewer import build_geometries, show
from taichi_edges.files.palette import CLUSTER_COLOURS, CURVE_COLOUR, LINE_COLOUR, UNLABELLED_COLOUR, label_colours
from taichi_edges.files.point_cloud import read_oriented_points, write_oriented_points
from taichi_edges.files.splats import FIELDS, HARMONIC_0, read_gaussians, read_strokes, write_gaussians
from taichi_edges.geometry.shapes import EllipticArc, Line, Spline, polyline
from taichi_edges.geometry.wireframe import Edge, Evidence, Wireframe
from taichi_edges.views.cameras import Similarity, frustum_planes
from taichi_edges.views.views import Views, choose_views

FOCAL = 100.0  # pixels
WIDTH, HEIGHT = 160, 120


@pytest.fixture
def rng():
    return np.random.default_rng(7)


NOTHING = Wireframe.loose([])


@pytest.fixture
def edges(rng):
    """A bent path of two lines and a spline of two cubics, and a circle; two edges are judged, two are not."""
    vertices, control = rng.normal(size=(4, 3)), rng.normal(size=(5, 3))
    spline = np.array([[vertices[2], *control[:3]], [control[2], *control[3:], vertices[3]]])
    circle = EllipticArc(rng.normal(size=3), np.eye(3)[1:], 0.0, 2 * np.pi)
    graph = (
        Edge(Line(vertices[:2]), (0, 1), Evidence(41, 1.5, 0.25, 0.75)),
        Edge(Spline(spline), (2, 3)),
        Edge(Line(vertices[[2, 1]]), (2, 1), Evidence(1, 0.5, 0.5, 0.125)),
        Edge(circle),
    )
    return Wireframe(vertices, graph, np.zeros((0, 2), np.int64))


def lines_between(*ends, confidence=None):
    """Loose lines, all of one confidence."""
    loose = Wireframe.loose([Line(np.array(pair, float)) for pair in ends])
    evidence = None if confidence is None else Evidence(9, 1.0, 0.2, confidence)
    return Wireframe(loose.vertices, tuple(replace(edge, evidence=evidence) for edge in loose.edges), loose.contacts)


def draw_gaussians(rng, count):
    """Random Gaussians with values of every sign and size."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,))
    return [(rng.normal(size=shape) * 10.0 ** rng.integers(-6, 6, shape)).astype(np.float32) for shape in shapes]


def make_views(world_to_camera, edge_maps=None, image_paths=None):
    """Views of WIDTH x HEIGHT with the principal point in the middle of the picture."""
    count = len(world_to_camera)
    intrinsics = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    return Views(
        names=tuple(f"view {index}" for index in range(count)),
        edge_maps=np.zeros((count, HEIGHT, WIDTH), np.uint8) if edge_maps is None else edge_maps,
        intrinsics=np.repeat(intrinsics[None], count, axis=0),
        world_to_camera=np.asarray(world_to_camera),
        image_paths=("",) * count if image_paths is None else image_paths,
        similarity=Similarity(),
    )


def one_view(**more):
    """A camera at the origin that looks along +z."""
    return make_views(np.eye(3, 4)[None], **more)


def read_picture(path):
    """The picture of the view without the caption, (HEIGHT, WIDTH, 3) int RGB."""
    return cv2.imread(str(path))[:HEIGHT, :, ::-1].astype(int)


def at_pixel(u, v, depth):
    """The world point that `one_view` sees at pixel (u, v)."""
    return [(u - (WIDTH - 1) / 2) * depth / FOCAL, (v - (HEIGHT - 1) / 2) * depth / FOCAL, depth]


def distance_to_segment(start, end):
    """(HEIGHT, WIDTH) distance in pixels of every pixel centre to a 2D segment."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([u, v], axis=-1).astype(float)
    along = np.clip((pixels - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    return np.linalg.norm(pixels - start - along[..., None] * (end - start), axis=-1)


@pytest.mark.parametrize("count", [0, 1, 257])
def test_gaussians_come_back_bit_for_bit(tmp_path, rng, count):
    written = draw_gaussians(rng, count)
    write_gaussians(tmp_path / "gaussians.ply", *written)
    for before, after in zip(written, read_gaussians(tmp_path / "gaussians.ply"), strict=True):
        assert after.dtype == np.float32 and after.shape == before.shape
        assert after.tobytes() == before.tobytes()


def test_gaussian_file_is_what_splat_viewers_expect(tmp_path, rng):
    written = draw_gaussians(rng, 3)
    path = write_gaussians(tmp_path / "gaussians.ply", *written)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    assert lines[3:] == [f"property float {name}" for name in FIELDS]
    table = dict(zip(FIELDS, np.frombuffer(body, "<f4").reshape(3, len(FIELDS)).T, strict=True))
    np.testing.assert_array_equal(table["rot_0"], written[2][:, 0])
    np.testing.assert_array_equal(table["opacity"], written[3])
    rgb = 0.5 + HARMONIC_0 * np.array([table[f"f_dc_{axis}"][0] for axis in range(3)])
    assert (rgb >= -1e-6).all() and (rgb <= 1 + 1e-6).all() and np.ptp(rgb) > 0.5  # seen on black and on white


def test_gaussians_of_another_program_are_read(tmp_path, rng):
    """Further fields, other order, a comment: as the original 3DGS writes with its 45 higher harmonics."""
    names = ["f_rest_0", *reversed(FIELDS), "f_rest_1"]
    table = rng.normal(size=(5, len(names))).astype("<f4")
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex 5\n{properties}end_header\n"
    (tmp_path / "other.ply").write_bytes(header.encode() + table.tobytes())
    means, log_scales, quaternions, opacities = read_gaussians(tmp_path / "other.ply")
    np.testing.assert_array_equal(means[:, 2], table[:, names.index("z")])
    np.testing.assert_array_equal(log_scales[:, 0], table[:, names.index("scale_0")])
    np.testing.assert_array_equal(quaternions[:, 3], table[:, names.index("rot_3")])
    np.testing.assert_array_equal(opacities, table[:, names.index("opacity")])


@pytest.mark.parametrize("count", [0, 257])
def test_strokes_of_gaussians_come_back_and_other_files_have_none(tmp_path, rng, count):
    written, strokes = draw_gaussians(rng, count), np.sort(rng.integers(0, 2**24, count))
    path = write_gaussians(tmp_path / "gaussians.ply", *written, strokes)
    found = read_strokes(path)
    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, strokes)
    for before, after in zip(written, read_gaussians(path), strict=True):
        assert after.tobytes() == before.tobytes()
    header = path.read_bytes().partition(b"end_header\n")[0].decode()
    assert header.splitlines()[3:] == [f"property float {name}" for name in (*FIELDS, "stroke")]
    assert read_strokes(write_gaussians(tmp_path / "without.ply", *written)) is None


@pytest.mark.parametrize("away, kind", [(0.0, np.float32), (4.5e5, np.float64)], ids=["near", "far"])
def test_means_are_float64_where_float32_would_move_them(tmp_path, rng, away, kind):
    """As with coordinates of a land survey: 32 mm is the step of float32 at 450 km."""
    _, _, quaternions, opacities = draw_gaussians(rng, 40)
    means = rng.normal(size=(40, 3)) + [away, 0, 0]
    means = means if away else means.astype(np.float32)
    path = write_gaussians(tmp_path / "gaussians.ply", means, np.full((40, 3), np.log(0.01)), quaternions, opacities)
    found, *others = read_gaussians(path)
    assert found.dtype == kind and all(array.dtype == np.float32 for array in others)
    np.testing.assert_array_equal(found, means)
    np.testing.assert_array_equal(others[1], quaternions)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "does not begin with 'ply'"),
        (b"\x89PNG\r\n\x1a\n" * 9, "does not begin with 'ply'"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "binary_little_endian"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n", "no end"),
        (b"ply\n\n\n", "no end"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 3\nend_header\n", "first element"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex x\nend_header\n", "with a count"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex\nend_header\n", "with a count"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex -1\nend_header\n", "with a count"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list int int x\nend_header\n", "plain num"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n", "y, z, scale_0"),
    ],
)
def test_damaged_gaussian_files_are_refused_in_one_line(tmp_path, content, complaint):
    path = tmp_path / "gaussians.ply"
    path.write_bytes(content)
    with pytest.raises(UserError, match=complaint) as caught:
        read_gaussians(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_and_cut_files_are_refused(tmp_path, rng):
    with pytest.raises(UserError, match=r"gone\.ply: cannot be read"):
        read_gaussians(tmp_path / "gone.ply")
    path = write_gaussians(tmp_path / "gaussians.ply", *draw_gaussians(rng, 10))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(UserError, match="cut short, 9 of 10 vertices"):
        read_gaussians(path)
    path = write_oriented_points(tmp_path / "points.ply", rng.normal(size=(10, 3)), rng.normal(size=(10, 3)))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(UserError, match="cut short, 9 of 10 vertices"):
        read_oriented_points(path)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("labelled", [False, True])
def test_oriented_points_come_back_bit_for_bit(tmp_path, rng, dtype, labelled):
    points, directions = rng.normal(size=(2, 50, 3)).astype(dtype)
    labels = rng.integers(-1, 40, 50) if labelled else None
    path = write_oriented_points(tmp_path / "points.ply", points, directions, labels)
    for before, after in zip((points, directions), read_oriented_points(path), strict=True):
        assert after.dtype == dtype and after.tobytes() == before.tobytes()


def test_oriented_points_open_in_open3d_coloured_by_cluster(tmp_path, rng):
    import open3d as o3d

    points, directions = rng.normal(size=(2, 4, 3))
    path = write_oriented_points(tmp_path / "points.ply", points, directions, [-1, 0, 1, len(CLUSTER_COLOURS)])
    cloud = o3d.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(np.asarray(cloud.points), points)
    np.testing.assert_array_equal(np.asarray(cloud.normals), directions)
    expected = [UNLABELLED_COLOUR, CLUSTER_COLOURS[0], CLUSTER_COLOURS[1], CLUSTER_COLOURS[0]]
    np.testing.assert_array_equal(np.rint(np.asarray(cloud.colors) * 255), expected)


def test_no_points_is_said_plainly(tmp_path):
    with pytest.raises(UserError, match=r"points\.ply: there are no points"):
        write_oriented_points(tmp_path / "points.ply", np.zeros((0, 3)), np.zeros((0, 3)))
    assert not list(tmp_path.iterdir())


def test_cluster_colours_are_told_apart():
    palette = np.concatenate([CLUSTER_COLOURS, [UNLABELLED_COLOUR]]).astype(float)
    apart = np.linalg.norm(palette[:, None] - palette[None], axis=2) + 1e9 * np.eye(len(palette))
    assert apart.min() > 40  # of 255: no two entries are shades of one colour
    assert label_colours([]).shape == (0, 3)


def test_edges_that_meet_share_points(edges):
    points, paths = edge_paths(edges)
    np.testing.assert_array_equal(points[:4], edges.vertices)
    assert [len(path) for path in paths] == [2, 2 * CURVE_SEGMENTS + 1, 2, 4 * CURVE_SEGMENTS + 1]
    assert len(points) == 4 + 2 * CURVE_SEGMENTS - 1 + 4 * CURVE_SEGMENTS  # none twice
    assert paths[0][1] == paths[2][1] == 1 and paths[1][0] == paths[2][0] == 2 and paths[3][0] == paths[3][-1]
    for path, shape in zip(paths, edges.shapes, strict=True):
        np.testing.assert_allclose(points[path], polyline(shape, CURVE_SEGMENTS), rtol=0, atol=1e-12)


def test_open3d_reads_the_line_set_back(tmp_path, edges):
    import open3d as o3d

    path = write_line_set_ply(tmp_path / "edges.ply", edges)
    line_set = o3d.io.read_line_set(str(path))
    points, segments, owners = line_set_arrays(edges)
    np.testing.assert_array_equal(np.asarray(line_set.points), points)
    np.testing.assert_array_equal(np.asarray(line_set.lines), segments)
    assert len(segments) == 2 + 6 * CURVE_SEGMENTS
    np.testing.assert_array_equal(np.rint(np.asarray(line_set.colors) * 255), CLUSTER_COLOURS[owners])


def test_line_set_says_of_each_segment_its_edge_and_confidence(tmp_path, edges):
    content = write_line_set_ply(tmp_path / "edges.ply", edges).read_bytes()
    header, body = content.split(b"end_header\n", 1)
    assert header.endswith(b"property float confidence\nproperty int edge\n")
    _, _, owners = line_set_arrays(edges)
    fields = [("ends", "<i4", 2), ("colour", "u1", 3), ("confidence", "<f4"), ("edge", "<i4")]
    segments = np.frombuffer(body[-len(owners) * np.dtype(fields).itemsize :], fields)
    np.testing.assert_array_equal(segments["edge"], owners)
    np.testing.assert_array_equal(segments["confidence"], np.array([0.75, np.nan, 0.125, np.nan])[owners])


def test_obj_holds_every_edge_as_an_object_to_the_last_digit(tmp_path, edges):
    path = write_line_set_obj(tmp_path / "edges.obj", edges)
    vertices, objects, said, name = [], {}, {}, None
    for line in path.read_text().splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "o":
            name = rest
        elif kind == "v":
            vertices.append([float(number) for number in rest.split()])
        elif kind == "l":
            objects[name] = np.array(rest.split(), int) - 1
        elif name:
            said[name] = rest
    assert list(objects) == ["line_0", "spline_1", "line_2", "circle_3"]
    points, paths = edge_paths(edges)
    np.testing.assert_array_equal(vertices, points)
    for written, path in zip(objects.values(), paths, strict=True):
        np.testing.assert_array_equal(written, path)
    assert said == {
        "line_0": "confidence 0.75, 41 views, residual 0.25 px",
        "line_2": "confidence 0.12, 1 view, residual 0.50 px",
    }


@pytest.mark.parametrize("suffix", EXPORTERS)
def test_exporters_say_when_there_are_no_edges(tmp_path, suffix):
    with pytest.raises(UserError, match="there are no edges to write"):
        EXPORTERS[suffix](tmp_path / f"edges{suffix}", NOTHING)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", EXPORTERS)
def test_exporters_write_lines_without_curves_and_curves_without_lines(tmp_path, edges, suffix):
    for part in (edges.edges[::2], edges.edges[1:2], edges.edges[3:]):
        written = EXPORTERS[suffix](tmp_path / f"edges{suffix}", Wireframe(edges.vertices, part, edges.contacts))
        assert written.stat().st_size > 100


@pytest.mark.parametrize("suffix", EXPORTERS)
def test_interrupted_write_leaves_the_old_file(tmp_path, edges, suffix, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    path = EXPORTERS[suffix](tmp_path / f"edges{suffix}", edges)
    before = path.read_bytes()
    monkeypatch.setattr("os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        EXPORTERS[suffix](path, lines_between([[0, 0, 0], [1, 1, 1]]))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_interrupted_cloud_leaves_the_old_file(tmp_path, rng, monkeypatch):
    import open3d as o3d

    def interrupted(path, *_):
        with open(path, "wb") as file:
            file.write(b"half a fi")
        raise KeyboardInterrupt

    points = rng.normal(size=(5, 3))
    cloud = write_oriented_points(tmp_path / "points.ply", points, points)
    before = cloud.read_bytes()
    monkeypatch.setattr(o3d.t.io, "write_point_cloud", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_oriented_points(cloud, 2 * points, points)
    assert cloud.read_bytes() == before and list(tmp_path.iterdir()) == [cloud]


def test_overlay_draws_edges_where_they_project_and_nothing_elsewhere(tmp_path):
    line = [at_pixel(20, 30, 1.0), at_pixel(90, 40, 3.0)]
    start, end = np.array([40.0, 100.0]), np.array([130.0, 70.0])
    straight = [at_pixel(*(start + step / 3 * (end - start)), 2.0) for step in range(4)]  # a curve, but easy to check
    shapes = [Line(np.array(line)), Spline(np.array([straight]))]
    (path,) = draw_overlays(tmp_path, one_view(), Wireframe.loose(shapes))
    picture = read_picture(path)
    to_line, to_curve = distance_to_segment((20, 30), (90, 40)), distance_to_segment(start, end)
    to_dots = np.min([distance_to_segment(p, np.add(p, 1e-6)) for p in ((20, 30), (90, 40), start, end)], axis=0)
    for distance, colour in ((to_line, LINE_COLOUR), (to_curve, CURVE_COLOUR)):
        # The stroke is 1.25 px wide at this size: a pixel within 0.2 px of its axis is covered at least to four fifths.
        core = (distance < 0.2) & (to_dots > 4)
        assert core.sum() > 5
        assert np.abs(picture[core] - colour).max() < 60
    away = np.minimum(np.minimum(to_line, to_curve), to_dots - 1) > 2.0
    assert (picture[away] == 255).all()


def test_overlay_marks_shared_vertices_by_dots_and_free_ends_by_rings(tmp_path):
    """Two lines that meet, and a third that ends on the first."""
    pixels = np.array([(20, 20), (100, 20), (140, 90), (60, 20), (60, 100)])
    vertices = np.array([at_pixel(u, v, 2.0) for u, v in pixels])
    joins = ((0, 1), (1, 2), (3, 4))
    graph = tuple(Edge(Line(vertices[list(ends)]), ends) for ends in joins)
    (path,) = draw_overlays(tmp_path, one_view(), Wireframe(vertices, graph, np.array([[3, 0]])))
    picture = read_picture(path)
    shared, free = pixels[[1, 3]], pixels[[0, 2, 4]]
    assert (picture[shared[:, 1], shared[:, 0]] < 60).all()
    assert (picture[free[:, 1], free[:, 0]] > 180).all()
    for u, v in free:  # around the hole there is ink on all sides
        around = picture[v - 3 : v + 4, u - 3 : u + 4].min(axis=2)
        assert (np.array([half.min() for half in (around[:3], around[4:], around[:, :3], around[:, 4:])]) < 150).all()


@pytest.mark.parametrize(("confidence", "opacity"), [(1.0, 1.0), (0.5, 0.65), (0.0, FAINTEST)])
def test_overlay_draws_doubtful_edges_fainter(tmp_path, confidence, opacity):
    """Than an edge that nobody has judged."""
    across = [at_pixel(-50, 60, 2.0), at_pixel(300, 60, 2.0)]
    inks = []
    for wireframe in (lines_between(across), lines_between(across, confidence=confidence)):
        (path,) = draw_overlays(tmp_path, one_view(), wireframe)
        inks.append((255 - read_picture(path)[50:70, 80, 2]).sum())
    assert inks[1] / inks[0] == pytest.approx(opacity, abs=0.02)  # grey levels are rounded


def test_caption_counts_edges_and_what_is_drawn(edges, monkeypatch):
    """Not pieces: the spline and the circle are six cubics."""
    said = []
    monkeypatch.setattr(cv2, "putText", lambda strip, words, *_: said.append(words))
    caption(800, "a view", edges)
    counts = ["curves 2", "free ends 2", "lines 2", "shared vertices 2"]
    assert sorted(said) == sorted(["a view", *counts, "fainter: less certain"])
    said.clear()
    caption(800, "a view", lines_between([[0, 0, 0], [1, 1, 1]]))
    assert sorted(said) == ["a view", "curves 0", "free ends 2", "lines 1", "shared vertices 0"]  # nothing is faint


@pytest.mark.parametrize("width", [200, 400, 800, 3000])
def test_caption_has_room_for_names_and_the_whole_legend(edges, monkeypatch, width):
    def write_inside(strip, words, origin, font, scale, colour, thickness, *_):
        (wide, high), below = cv2.getTextSize(words, font, scale, thickness)
        assert origin[0] >= 0 and origin[0] + wide <= width and origin[1] >= high and origin[1] + below <= len(strip)

    monkeypatch.setattr(cv2, "putText", write_inside)
    long_name = "from_the_left_" * 20
    assert caption(width, "v1", edges).shape == caption(width, long_name, edges).shape


def test_overlay_places_strokes_to_a_fraction_of_a_pixel(tmp_path):
    """Pixel centres at integers: the middle of the ink is the projected position."""
    for u in (50.0, 50.3, 50.5):
        line = [at_pixel(u, -50, 2.0), at_pixel(u, 300, 2.0)]
        (path,) = draw_overlays(tmp_path, one_view(), lines_between(line))
        ink = 255.0 - read_picture(path)[60, :, 2]
        assert abs((ink * np.arange(WIDTH)).sum() / ink.sum() - u) < 0.15  # the mask is four times finer: 1/8 pixel


def test_edge_that_passes_behind_the_camera_is_cut_there(tmp_path):
    """Seen from the origin the line goes right and out of the picture; its far end is behind the camera."""
    front, behind = np.array(at_pixel(100, 60, 2.0)), np.array([0.6, 0.02, -3.0])
    (path,) = draw_overlays(tmp_path, one_view(), lines_between([front, behind]))
    picture = read_picture(path)
    samples = front + np.linspace(0, 1, 2001)[:, None] * (behind - front)
    pixels, _ = one_view().project(samples, 0)
    pixels = pixels[np.isfinite(pixels[:, 0]) & (pixels[:, 0] < WIDTH)]
    assert len(pixels) > 20
    v, u = np.nonzero((picture < 255).any(axis=2))
    nearest = np.linalg.norm(np.stack([u, v], 1)[:, None] - pixels[None], axis=2).min(axis=1)
    assert nearest.max() < 3.0
    assert u.max() == WIDTH - 1 and u.min() > 96
    # One that is behind all the way leaves no ink.
    (path,) = draw_overlays(tmp_path, one_view(), lines_between([behind, -front]))
    assert (read_picture(path) == 255).all()


def test_clipping_agrees_with_brute_force(rng):
    """Slow twin: walk along each segment and see which samples are in the region."""
    planes = frustum_planes(WIDTH, HEIGHT, margin=5)
    projection = one_view().intrinsics[0]
    segments = rng.normal(size=(300, 2, 3)) * [2.0, 2.0, 2.0]
    homogeneous = np.concatenate([segments @ projection.T, np.ones((300, 2, 1))], axis=2)
    at = np.linspace(0, 1, 4001)
    walked = homogeneous[:, :1] + at[:, None] * (homogeneous[:, 1:] - homogeneous[:, :1])  # (300, 4001, 4)
    values = walked @ planes.T
    inside = (values >= 0).all(axis=2)
    clipped = clip_segments(homogeneous, planes)
    long_enough = inside.sum(axis=1) > 1
    assert 20 < long_enough.sum() <= len(clipped) <= (inside.sum(axis=1) > 0).sum() + 5
    lengths = np.linalg.norm(clipped[:, 1] - clipped[:, 0], axis=1)
    whole = np.linalg.norm(homogeneous[:, 1] - homogeneous[:, 0], axis=1)
    expected = (inside.sum(axis=1) / len(at) * whole)[long_enough]
    # Sampling misses at most one step at either end; segments shorter than a step may be seen by the clip only.
    assert abs(lengths.sum() - expected.sum()) < 2 * whole.sum() / len(at)


def test_overlay_uses_the_colour_image_on_white(tmp_path):
    rgba = np.zeros((2 * HEIGHT, 2 * WIDTH, 4), np.uint8)  # twice the size of the view
    rgba[:, :WIDTH] = (10, 100, 200, 255)
    cv2.imwrite(str(tmp_path / "colour.png"), rgba)
    views = one_view(image_paths=(str(tmp_path / "colour.png"),))
    picture = background(views, 0)
    faded = np.rint(np.array([10, 100, 200]) * (1 - IMAGE_FADE) + 255 * IMAGE_FADE)
    np.testing.assert_allclose(picture[50, 10], faded, atol=1)
    assert (picture[50, WIDTH - 10] == 255).all()


@pytest.mark.parametrize("content", [None, b"", b"not a picture", "another shape"])
def test_overlay_falls_back_to_the_edge_map(tmp_path, content):
    path = tmp_path / "colour.png"
    if content == "another shape":
        cv2.imwrite(str(path), np.zeros((HEIGHT, HEIGHT, 3), np.uint8))
    elif content is not None:
        path.write_bytes(content)
    edge_maps = np.zeros((1, HEIGHT, WIDTH), np.uint8)
    edge_maps[0, 40] = 255
    picture = background(one_view(edge_maps=edge_maps, image_paths=(str(path),)), 0)
    assert (picture[39] == 255).all() and (picture[40] == round(255 * (1 - FADED_TO))).all()


def turned(angle):
    """world_to_camera of a camera that is turned about the y axis; angle in degrees."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return [[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, 0]]


def test_overlay_views_look_in_different_directions():
    views = make_views([turned(angle) for angle in (0, 1, 2, 90, 91, 180, 181, 270)])
    assert choose_views(views, 4) == [0, 3, 5, 7]
    assert choose_views(views, 99) == list(range(8))
    same_way = make_views([turned(0)] * 9)
    assert choose_views(same_way, 3) == [0, 4, 8]  # no difference in direction: spread over the sequence


def test_overlays_have_names_captions_and_fit_on_a_sheet(tmp_path):
    views = make_views([turned(angle) for angle in (0, 90, 180)], edge_maps=np.zeros((3, HEIGHT, 640), np.uint8))
    paths = draw_overlays(tmp_path / "overlays", views, NOTHING, count=3)
    assert [path.name for path in paths] == [f"overlay_000{index}_view_{index}.png" for index in range(3)]
    pictures = [cv2.imread(str(path)) for path in paths]
    captions = [picture[HEIGHT:] for picture in pictures]
    assert all(len(strip) > 10 and strip.min() < 128 for strip in captions)
    assert (captions[0] != captions[1]).any()  # the name of the view
    sheet = cv2.imread(str(contact_sheet(paths, tmp_path / "sheet.png")))
    height, width = pictures[0].shape[:2]
    assert sheet.shape[0] > 2 * height and sheet.shape[1] > 2 * width
    assert sorted(path.name for path in tmp_path.iterdir()) == ["overlays", "sheet.png"]


def test_contact_sheet_names_the_picture_it_cannot_read(tmp_path):
    with pytest.raises(UserError, match=r"gone\.png: not a readable picture"):
        contact_sheet([tmp_path / "gone.png"], tmp_path / "sheet.png")


def test_viewer_without_a_display_says_what_to_open_instead(edges, rng, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    points = rng.normal(size=(5, 3))
    with pytest.raises(UserError, match=r"no display .* open points\.ply, runs/nut/edges\.obj instead") as caught:
        show(points, points, edges, ["points.ply", "runs/nut/edges.obj"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("opened", [False, True])
def test_viewer_whose_window_cannot_be_made_says_so(edges, rng, monkeypatch, capsys, opened):
    """A display that is named but not there: older Open3D fails, 0.20 goes offscreen and would draw for ever."""
    import open3d as o3d

    class NoWindow:
        def create_window(self, *_):
            print("[Visualizer] No display detected, falling back to EGL offscreen rendering.")
            return opened

        def destroy_window(self):
            pass

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(o3d.visualization, "Visualizer", NoWindow)
    points = rng.normal(size=(5, 3))
    with pytest.raises(UserError, match=r"cannot be reached or has no OpenGL; open points\.ply instead"):
        show(points, points, edges, ["points.ply"])
    assert capsys.readouterr().out == ""


def test_viewer_geometries_hold_points_directions_and_edges(edges, rng):
    points = rng.uniform(size=(20, 3))
    directions = np.tile([0.0, 0.0, 1.0], (20, 1))
    cloud, ticks, line_set = build_geometries(points, directions, edges)
    np.testing.assert_array_equal(np.asarray(cloud.points), points)
    ends = np.asarray(ticks.points)[np.asarray(ticks.lines)]
    np.testing.assert_allclose(ends.mean(axis=1), points, atol=1e-12)
    np.testing.assert_allclose((ends[:, 1] - ends[:, 0])[:, :2], 0, atol=1e-12)
    assert (ends[:, 1, 2] > ends[:, 0, 2]).all()
    assert len(line_set.lines) == len(line_set_arrays(edges)[1]) == len(line_set.colors)
    assert build_geometries(np.zeros((0, 3)), np.zeros((0, 3)), NOTHING) == []


def test_exporters_are_imported_without_open3d():
    """A run on a cluster that never exports must not pay for, or fail on, a graphics library."""
    code = (
        "import sys; from taichi_edges.exporters import line_sets, overlays, viewer; "
        "from taichi_edges.files import point_cloud, splats; sys.exit('open3d' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
