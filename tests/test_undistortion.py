"""Lenses and sizes: what the undistorted pictures show, where, and that they are made once."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from colmap_projects import LENSES, SIZE, camera, picture_of_polygon

from taichi_edges.detectors.subpixel import detect_edgels
from taichi_edges.errors import UserError
from taichi_edges.progress import Progress
from taichi_edges.readers import undistortion
from taichi_edges.readers.frames import Frames
from taichi_edges.readers.photogrammetry import Lens, undistorted
from taichi_edges.readers.undistortion import undistorted_frames, undistortion_map
from taichi_edges.views.picture_sizes import picture_size

POLYGON = np.array([[-0.3, -0.2], [0.25, -0.28], [0.33, 0.1], [0.05, 0.3], [-0.33, 0.15]])
DISTORTED = [name for name in LENSES if not name.endswith("PINHOLE")]


class Spoken(Progress):
    """Keeps what was said, and how many steps each task had."""

    def __init__(self):
        self.texts, self.steps = [], {}

    def say(self, text):
        self.texts.append(text)

    def _update(self, task, done, note):
        self.steps[task.title] = done


def lens_of(model="OPENCV", size=SIZE):
    return Lens(model, *size, tuple(float(value) for value in LENSES[model]))


@pytest.fixture
def make(tmp_path):
    """make({name: image}, lenses, edges, masks, max_size) -> (Frames, what was said), its folder of files kept."""

    def run_make(images, lenses, edges=None, masks=None, max_size=0, threads=2, intrinsics=None):
        paths = {}
        for kind, files in (("images", images), ("edges", edges or {}), ("masks", masks or {})):
            paths[kind] = [tmp_path / kind / f"{name}.png" if name in files else "" for name in images]
            for name, picture in files.items():
                path = tmp_path / kind / f"{name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                if not path.is_file() or (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) != picture).any():
                    cv2.imwrite(str(path), picture)
        frames = Frames(
            where=tmp_path / "images.bin",
            names=list(images),
            edge_paths=paths["edges"],
            image_paths=paths["images"],
            intrinsics=intrinsics or [None] * len(images),
            camera_to_world=[np.eye(4)] * len(images),
            opengl=False,
            lenses=lenses,
            mask_paths=paths["masks"],
        )
        said = Spoken()
        return undistorted_frames(frames, tmp_path / "run", max_size, threads=threads, progress=said), said

    return run_make


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def off_the_polygon(picture, intrinsics):
    """(n,) px: how far the edgels found in a picture are from the polygon's sides; and the polygon's share found."""
    points = detect_edgels(picture)[0].astype(float)
    corners = POLYGON @ np.diag(intrinsics[[0, 1], [0, 1]]) + intrinsics[:2, 2]
    distances, found = np.full(len(points), np.inf), []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / np.linalg.norm(end - start)
        lengths = (points - start) @ along
        on = (lengths > 4) & (lengths < np.linalg.norm(end - start) - 4)  # at corners every detector rounds
        across = np.abs((points - start) @ [along[1], -along[0]])
        distances[on] = np.minimum(distances[on], across[on])
        found.append(np.ptp(lengths[on & (across < 1)]) / np.linalg.norm(end - start))
    near_corner = np.linalg.norm(points[:, None] - corners, axis=2).min(axis=1) < 6
    return distances[~near_corner], min(found)


@pytest.mark.parametrize("model", LENSES)
def test_points_in_space_fall_where_the_map_takes_them_from(model, generator):
    lens = lens_of(model)
    intrinsics, size = undistorted(lens)
    pixels, valid = undistortion_map(lens, intrinsics, size, SIZE)
    points = np.column_stack([generator.uniform(-0.35, 0.35, (500, 2)), np.ones(500)]) * generator.uniform(
        1, 9, (500, 1)
    )
    # COLMAP's own projection, from pixels whose first centre is (0.5, 0.5).
    seen = lens.camera().img_from_cam(points) - 0.5
    u, v = (points @ intrinsics.T)[:, :2].T / points[:, 2]
    inside = (u >= 0) & (v >= 0) & (u <= size[0] - 1) & (v <= size[1] - 1)
    assert inside.mean() > 0.5 and valid.mean() > 0.99
    taken = cv2.remap(pixels, u[inside, None].astype(np.float32), v[inside, None].astype(np.float32), cv2.INTER_LINEAR)
    # remap interpolates in steps of 1/32 px.
    assert np.abs(taken[:, 0] - seen[inside]).max() < 0.03


@pytest.mark.parametrize(
    "model, max_size", [*((model, 0) for model in DISTORTED), ("OPENCV", 200), ("FISHEYE", 200), ("EUCM", 131)]
)
def test_edges_of_an_undistorted_picture_are_where_a_pinhole_camera_sees_them(make, model, max_size):
    drawn = picture_of_polygon(camera(model), POLYGON)
    frames, _ = make({"a": drawn}, [lens_of(model)], max_size=max_size)
    picture = read(frames.image_paths[0])
    distances, found = off_the_polygon(picture, frames.intrinsics[0](*picture.shape[1::-1]))
    assert np.quantile(distances, 0.95) < 0.1 and np.median(distances) < 0.04 and found > 0.7
    assert not max_size or max(picture.shape) < 1.3 * max_size


def test_a_picture_that_needs_nothing_is_used_in_place(make, tmp_path):
    drawn = picture_of_polygon(camera("PINHOLE"), POLYGON)
    frames, _ = make({"a": drawn}, [lens_of("PINHOLE")], max_size=1600)
    assert frames.image_paths == [tmp_path / "images" / "a.png"] and frames.valid_paths == [""]
    expected = np.array([[300, 0, 160], [0, 310, 118.5], [0, 0, 1]])
    assert np.allclose(frames.intrinsics[0](*SIZE), expected, atol=1e-12)


@pytest.mark.parametrize("size", [(160, 120), (640, 480), (107, 80)])
def test_pictures_resized_since_the_cameras_were_made_scale_the_intrinsics(make, size):
    resized = camera("OPENCV")
    resized.rescale(*size)
    drawn = picture_of_polygon(resized, POLYGON)
    frames, said = make({"a": drawn}, [lens_of("OPENCV")])
    picture = read(frames.image_paths[0])
    distances, found = off_the_polygon(picture, frames.intrinsics[0](*picture.shape[1::-1]))
    assert np.quantile(distances, 0.95) < 0.1 and found > 0.6  # the shortest side of the smallest has 20 px
    assert f"images of {size[0]} x {size[1]} px for cameras of 320 x 240 px" in said.texts[0]


def test_large_pictures_without_a_lens_are_made_smaller_with_their_intrinsics(make):
    own = np.array([[300.0, 0, 160], [0, 310, 118.5], [0, 0, 1]])
    drawn = picture_of_polygon(camera("PINHOLE"), POLYGON)
    frames, _ = make({"a": drawn, "b": drawn}, [], max_size=200, intrinsics=[lambda width, height: own] * 2)
    picture = read(frames.image_paths[1])
    assert picture.shape == (150, 200) and frames.size == (200, 150)
    given = frames.intrinsics[1](200, 150)
    assert np.allclose(given, [[187.5, 0, 160.5 * 0.625 - 0.5], [0, 193.75, 119 * 0.625 - 0.5], [0, 0, 1]])
    distances, found = off_the_polygon(picture, given)
    assert np.quantile(distances, 0.95) < 0.1 and found > 0.7


def test_turned_pictures_are_refused_and_the_cause_is_named(make):
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    with pytest.raises(UserError, match=r"1 of 2 views \(b\): the image is 240 x 320 px, .* EXIF"):
        make({"a": drawn, "b": np.rot90(drawn).copy()}, [lens_of("OPENCV")] * 2)


def test_pictures_of_another_shape_are_refused_with_both_sizes(make):
    with pytest.raises(UserError, match="the image is 320 x 200 px, but its camera is 320 x 240 px"):
        make({"a": np.zeros((200, 320), np.uint8)}, [lens_of("OPENCV")])


def test_an_edge_map_of_another_shape_is_refused_by_name(make):
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    with pytest.raises(UserError, match=r"edges/a.png: this is 320 x 200 px, but its image is 320 x 240 px"):
        make({"a": drawn}, [lens_of("OPENCV")], edges={"a": np.zeros((200, 320), np.uint8)})


def test_landscape_and_portrait_come_to_one_canvas_and_principal_points_stay(make):
    turned = (300.0, 310.0, 119.0, 160.5, *LENSES["OPENCV"][4:])
    portrait = Lens("OPENCV", 240, 320, turned)
    corners = POLYGON[:, ::-1][::-1]
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    upright = picture_of_polygon(camera("OPENCV", size=(240, 320), params=turned), corners)
    frames, _ = make({"wide": drawn, "tall": upright}, [lens_of("OPENCV"), portrait])
    pictures = [read(path) for path in frames.image_paths]
    alone = [undistorted(lens) for lens in (lens_of("OPENCV"), portrait)]
    canvas = tuple(max(size[axis] for _, size in alone) for axis in (1, 0))
    assert [picture.shape for picture in pictures] == [canvas, canvas]
    for picture, valid, (intrinsics, size), given in zip(
        pictures, map(read, frames.valid_paths), alone, frames.intrinsics, strict=True
    ):
        assert np.allclose(given(*canvas), intrinsics)
        shown = np.zeros(canvas, bool)
        shown[: size[1], : size[0]] = True
        assert (picture[~shown] == 0).all() and ((valid == 255) == shown).all()


def test_edge_maps_and_masks_go_the_way_of_their_picture(make):
    """The polygon as an edge map of half the size and as a mask: both must lie on the undistorted picture's."""
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    mask = np.uint8(255) * (drawn > 150)
    outline = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3)))
    half = cv2.resize(outline, (160, 120), interpolation=cv2.INTER_AREA)
    frames, _ = make({"a": drawn}, [lens_of("OPENCV")], {"a": half}, {"a": mask})
    picture, edges, kept = (read(paths[0]) for paths in (frames.image_paths, frames.edge_paths, frames.mask_paths))
    assert picture.shape == edges.shape == kept.shape
    assert ((kept >= 128) == (picture > 150)).mean() > 0.995
    away = cv2.distanceTransform(255 - cv2.morphologyEx(kept, cv2.MORPH_GRADIENT, np.ones((3, 3))), cv2.DIST_L2, 5)
    assert away[edges > 128].max() < 2.0 and (edges > 128).sum() > 300


def test_pictures_are_made_once_and_again_when_one_changes(make):
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    images, lenses = {"a": drawn, "sub/b": 255 - drawn}, [lens_of("OPENCV")] * 2
    first, said = make(images, lenses)
    assert said.steps["undistort"] == 2
    times = [Path(path).stat().st_mtime_ns for path in first.image_paths]
    again, said = make(images, lenses, threads=1)
    assert said.steps == {} and again.image_paths == first.image_paths
    edges = {"a": drawn}
    _, said = make(images, lenses, edges)  # another detector's maps leave the images alone
    assert said.steps["undistort"] == 1
    assert times == [Path(path).stat().st_mtime_ns for path in first.image_paths]
    _, said = make({**images, "a": drawn // 2}, lenses, edges)
    assert said.steps["undistort"] == 1
    _, said = make({**images, "a": drawn // 2}, lenses, edges, max_size=200)
    assert said.steps["undistort"] == 3


def test_the_number_of_threads_does_not_change_a_byte(make, tmp_path):
    images = {f"{i}": picture_of_polygon(camera("OPENCV"), POLYGON * (0.6 + 0.1 * i)) for i in range(4)}
    written = []
    for threads in (1, 3):
        frames, _ = make(images, [lens_of("OPENCV")] * 4, threads=threads)
        written.append([Path(path).read_bytes() for path in frames.image_paths])
        (tmp_path / "run" / "index.json").unlink()
    assert written[0] == written[1]


def test_where_a_lens_folds_the_picture_over_nothing_is_shown(make):
    """Strong barrel distortion turns back at r = 0.976, well inside what the undistorted picture would cover."""
    lens = Lens("SIMPLE_RADIAL", 320, 240, (190.0, 160.0, 120.0, -0.35))
    intrinsics, size = undistorted(lens)
    _, valid = undistortion_map(lens, intrinsics, size, SIZE)
    v, u = np.indices(valid.shape)
    radii = np.hypot((u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1])
    turning = (3 * 0.35) ** -0.5
    assert not valid[radii > turning + 0.02].any()
    assert valid[(radii < turning - 0.02) & (np.abs(v - intrinsics[1, 2]) < 60)].all()


def test_transparent_pictures_keep_the_colour_of_the_object_along_its_outline(make):
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    alpha = np.where(drawn > 150, 255, 0).astype(np.uint8)
    colour = np.where(alpha[:, :, None] > 0, np.uint8([40, 120, 200]), np.uint8(0))
    frames, _ = make({"a": np.dstack([colour, alpha])}, [lens_of("OPENCV")])
    picture = read(frames.image_paths[0])
    assert picture.shape[2] == 4
    assert np.abs(picture[picture[:, :, 3] > 64][:, :3].astype(int) - [40, 120, 200]).max() <= 2


@pytest.mark.parametrize("kind", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("shape", [(7, 13), (250, 31, 3)])
def test_the_size_of_a_picture_is_read_without_decoding_it(tmp_path, kind, shape):
    path = tmp_path / f"a{kind}"
    cv2.imwrite(str(path), np.zeros(shape, np.uint8))
    assert picture_size(path) == shape[1::-1]
    path.write_bytes(b"nothing")
    assert picture_size(path) is None


def test_what_no_pinhole_camera_can_show_is_refused_in_one_line():
    with pytest.raises(UserError, match="panorama"):
        undistorted(Lens("EQUIRECTANGULAR", 640, 320, (640.0, 320.0)))
    with pytest.raises(UserError, match="did you mean 'OPENCV'"):
        undistorted(Lens("OPENVC", 640, 320, (1.0,)))
    with pytest.raises(UserError, match="fx, fy, cx, cy"):
        undistorted(Lens("PINHOLE", 640, 320, (1.0, 2.0)))


@pytest.mark.parametrize("kind", ["images", "valid"])
def test_a_damaged_or_replaced_picture_is_made_again(make, kind):
    lens = Lens("SIMPLE_RADIAL", 320, 240, (190.0, 160.0, 120.0, -0.35))  # shows nothing in the corners
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    frames, _ = make({"a": drawn}, [lens])
    path = Path((frames.image_paths if kind == "images" else frames.valid_paths)[0])
    good = path.read_bytes()
    for bad in (good[: len(good) // 2], cv2.imencode(".png", np.zeros((9, 9), np.uint8))[1].tobytes()):
        path.write_bytes(bad)
        make({"a": drawn}, [lens])
        assert path.read_bytes() == good


def test_another_version_of_colmap_may_know_lenses_better(make, monkeypatch):
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    make({"a": drawn}, [lens_of("OPENCV")])
    monkeypatch.setattr(undistortion, "colmap_version", lambda: "another")
    assert make({"a": drawn}, [lens_of("OPENCV")])[1].steps["undistort"] == 1


def test_views_whose_names_make_one_file_name_get_one_each(make):
    drawn = picture_of_polygon(camera("OPENCV"), POLYGON)
    images = {"b": drawn, "./b": 255 - drawn, "b-2": drawn // 2}
    frames, _ = make(images, [lens_of("OPENCV")] * 3)
    assert [Path(path).stem for path in frames.image_paths] == ["b", "b-3", "b-2"]
