"""Readers: the right pixels for known 3D points, and one line that names the view for every mistake."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from taichi_edges.errors import UserError
from taichi_edges.progress import Progress
from taichi_edges.readers import READERS
from taichi_edges.readers.frames import build_views, chosen_frames
from taichi_edges.readers.images import read_edge_maps, read_grey
from taichi_edges.scene.settings import SourceConfig
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import Imperfections, render_edge_maps, ring_cameras
from taichi_edges.views.cameras import OPENGL_TO_OPENCV, inside_image, invert_pose, project

SIZE = 64
VIEWS = 4
UNIT_BOX = np.array([[0.0, 0, 0], [1, 1, 1]])
KINDS = ("nerf", "emap")
LISTING = {"nerf": "transforms_train.json", "emap": "meta_data.json"}
EDGES = {"nerf": "train", "emap": "edge"}
POSE = {"nerf": "transform_matrix", "emap": "camtoworld"}
INTRINSICS = {"nerf": "camera_intrinsics", "emap": "intrinsics"}
IMAGE = {"nerf": "file_path", "emap": "rgb_path"}
POINTS = np.random.default_rng(0).uniform(0.1, 0.9, (50, 3))


class Warnings(Progress):
    """Keeps what the reader warns about."""

    def __init__(self):
        self.texts = []

    def warn(self, text):
        self.texts.append(text)


def views_of_maps(frames, config, box, warnings):
    """Views with the ready edge maps of the frames, as the prepare stage reads them."""
    frames = chosen_frames(frames, config.skip)
    return build_views(frames, read_edge_maps(frames, warnings), None, config, np.asarray(box, float), warnings)


@pytest.fixture(scope="module")
def block():
    """Intrinsics (V, 3, 3), all different, world_to_camera (V, 3, 4) and edge maps (V, H, W) of the synthetic block."""
    intrinsics, poses = ring_cameras(VIEWS, SIZE)
    intrinsics = intrinsics.copy()
    intrinsics[:, 0, 0] *= 1 + 0.05 * np.arange(VIEWS)
    intrinsics[:, 0, 2] += np.arange(VIEWS)
    maps = render_edge_maps(PARTS["block"](), intrinsics, poses, SIZE, Imperfections.none(), np.random.default_rng(0))
    return intrinsics, poses, maps


class Folder:
    """A source folder of one of the layouts, to be spoilt and read. `content` is its JSON."""

    def __init__(self, path, kind, block, scale=1.0, shift=(0.0, 0.0, 0.0)):
        """scale, shift: x_input = scale * x_unit + shift."""
        self.path, self.kind, self.warnings = path, kind, Warnings()
        intrinsics, poses, maps = block
        (path / EDGES[kind]).mkdir(parents=True)
        frames = []
        for view in range(VIEWS):
            cv2.imwrite(str(self.edge_map(view)), maps[view])
            camera_to_world = np.eye(4)
            camera_to_world[:3] = invert_pose(poses[view])
            camera_to_world[:3, 3] = scale * camera_to_world[:3, 3] + shift
            if kind == "nerf":
                camera_to_world = camera_to_world @ OPENGL_TO_OPENCV
            name = f"./train/v{view}" if kind == "nerf" else f"v{view}.png"
            pose, lens = camera_to_world.tolist(), intrinsics[view].tolist()
            frames.append({IMAGE[kind]: name, INTRINSICS[kind]: lens, POSE[kind]: pose})
        self.content = {"frames": frames}

    def edge_map(self, view):
        return self.path / EDGES[self.kind] / f"v{view}.png"

    @property
    def listing(self):
        return self.path / LISTING[self.kind]

    def change_pose(self, function, views=(1,)):
        """function: (4, 4) -> array; lists of one view become those of the result."""
        for view in views:
            frame = self.content["frames"][view]
            frame[POSE[self.kind]] = np.asarray(function(np.array(frame[POSE[self.kind]]))).tolist()

    def change_maps(self, function, views=range(VIEWS)):
        for view in views:
            cv2.imwrite(str(self.edge_map(view)), function(cv2.imread(str(self.edge_map(view)), cv2.IMREAD_UNCHANGED)))

    def read(self, box=UNIT_BOX, text=None, **source):
        """The Views, with the listing written first (or `text` in its place)."""
        self.listing.write_text(json.dumps(self.content) if text is None else text)
        edges = {"edges": "edge"} if self.kind == "emap" else {}
        config = SourceConfig(reader=self.kind, path="unused", **{**edges, **source})
        return views_of_maps(READERS[self.kind](self.path, config), config, box, self.warnings)

    def refusal(self, *arguments, **options):
        """The message with which the folder is refused: one line."""
        with pytest.raises(UserError) as refused:
            self.read(*arguments, **options)
        text = str(refused.value)
        assert "\n" not in text
        return text


@pytest.fixture(params=KINDS)
def folder(request, tmp_path, block):
    return Folder(tmp_path / request.param, request.param, block)


@pytest.fixture
def nerf(tmp_path, block):
    return Folder(tmp_path / "nerf", "nerf", block)


@pytest.fixture
def emap(tmp_path, block):
    return Folder(tmp_path / "emap", "emap", block)


# ------------------------------------------------------------------------------------------------- the right pixels


def test_known_points_land_on_their_pixels(folder, block):
    intrinsics, poses, maps = block
    views = folder.read()
    assert views.names == ("v0", "v1", "v2", "v3") and folder.warnings.texts == []
    np.testing.assert_array_equal(views.edge_maps, maps)
    for view in range(VIEWS):
        expected, expected_depths = project(POINTS, intrinsics[view], poses[view])
        pixels, depths = views.project(POINTS, view)
        np.testing.assert_allclose(pixels, expected, atol=1e-9)
        np.testing.assert_allclose(depths, expected_depths, atol=1e-12)


def test_opengl_axes_look_along_minus_z(nerf):
    """Written out by hand: a camera at z = 3 that looks down on the cube, x to the right, y up."""
    lens = [[64.0, 0, 31.5], [0, 64.0, 31.5], [0, 0, 1]]
    pose = [[1.0, 0, 0, 0.5], [0, 1, 0, 0.5], [0, 0, 1, 3], [0, 0, 0, 1]]
    nerf.content["frames"][0].update(camera_intrinsics=lens, transform_matrix=pose)
    pixels, depths = nerf.read().project(np.array([[0.5, 0.5, 1.0], [0.75, 0.5, 1], [0.5, 0.75, 1]]), 0)
    np.testing.assert_allclose(pixels, [[31.5, 31.5], [39.5, 31.5], [31.5, 23.5]])  # 0.25 right: +8 px; 0.25 up: -8 px
    np.testing.assert_allclose(depths, 2.0)


def test_a_listing_can_be_named_in_place_of_its_folder(folder):
    expected = folder.read()
    other = folder.listing.rename(folder.path / "other.json")
    config = SourceConfig(reader=folder.kind, path="unused", **({"edges": "edge"} if folder.kind == "emap" else {}))
    views = views_of_maps(READERS[folder.kind](other, config), config, UNIT_BOX, folder.warnings)
    assert views.names == expected.names
    np.testing.assert_array_equal(views.world_to_camera, expected.world_to_camera)


def test_opencv_axes_look_along_z(emap):
    """Written out by hand: a camera at z = -2 that looks up at the cube from below, x to the right, y down."""
    lens = [[64.0, 0, 31.5], [0, 64.0, 31.5], [0, 0, 1]]
    pose = [[1.0, 0, 0, 0.5], [0, 1, 0, 0.5], [0, 0, 1, -2], [0, 0, 0, 1]]
    emap.content["frames"][0].update(intrinsics=lens, camtoworld=pose)
    pixels, depths = emap.read().project(np.array([[0.5, 0.5, 0.0], [0.75, 0.5, 0], [0.5, 0.75, 0]]), 0)
    np.testing.assert_allclose(pixels, [[31.5, 31.5], [39.5, 31.5], [31.5, 39.5]])
    np.testing.assert_allclose(depths, 2.0)


@pytest.mark.parametrize("axes", ["opengl", "opencv"])
def test_axes_can_be_overridden(folder, block, axes):
    if (axes == "opengl") == (folder.kind == "emap"):
        folder.change_pose(lambda pose: pose @ OPENGL_TO_OPENCV, range(VIEWS))
    expected, _ = project(POINTS, block[0][2], block[1][2])
    np.testing.assert_allclose(folder.read(axes=axes).project(POINTS, 2)[0], expected, atol=1e-9)


def test_field_of_view_has_its_centre_between_the_middle_pixels(nerf):
    for frame in nerf.content["frames"]:
        del frame["camera_intrinsics"]
    nerf.content["camera_angle_x"] = np.radians(60)
    nerf.change_maps(lambda edge_map: cv2.copyMakeBorder(edge_map, 0, 10, 0, 0, cv2.BORDER_CONSTANT))
    lens = nerf.read().intrinsics[1]
    focal = 32 / np.tan(np.radians(30))
    np.testing.assert_allclose(lens, [[focal, 0, 31.5], [0, focal, 36.5], [0, 0, 1]])
    # The rays at half the field of view meet the outer borders of the outer pixels: -0.5 and 63.5.
    assert lens[0, 2] - focal * np.tan(np.radians(30)) == pytest.approx(-0.5)


def test_emap_accepts_4x4_intrinsics(emap, block):
    for frame, lens in zip(emap.content["frames"], block[0], strict=True):
        larger = np.eye(4)
        larger[:3, :3] = lens
        frame["intrinsics"] = larger.tolist()
    np.testing.assert_allclose(emap.read().intrinsics, block[0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", [0.001, 40.0, 1000.0])
def test_any_box_is_brought_into_the_unit_cube_and_seen_in_the_same_pixels(kind, scale, tmp_path, block):
    """Cameras a few thousandths from the box are not too near where that is the size of the box."""
    shift = scale * np.array([-0.2, 2.5, 0.1])
    folder = Folder(tmp_path / "big", kind, block, scale, shift)
    box = scale * np.array([[0.1, 0.0, 0.2], [0.9, 1.0, 0.7]]) + shift
    views = folder.read(box=box)
    unit = views.similarity.to_unit(box)
    assert unit.min() >= -1e-12 and (unit[1] - unit[0]).max() == pytest.approx(1.0)
    np.testing.assert_allclose(views.box, unit)
    inputs = scale * POINTS + shift
    np.testing.assert_allclose(views.similarity.to_input(views.similarity.to_unit(inputs)), inputs, atol=1e-12 * scale)
    for view in range(VIEWS):
        expected, _ = project(POINTS, block[0][view], block[1][view])
        np.testing.assert_allclose(views.project(views.similarity.to_unit(inputs), view)[0], expected, atol=1e-6)
        rotation = views.world_to_camera[view, :, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_worldtogt_is_kept(emap):
    moved = np.eye(4)
    moved[0, 3] = 0.25
    emap.content["worldtogt"] = moved.tolist()
    np.testing.assert_array_equal(emap.read().input_to_truth, moved)


def test_skip_leaves_views_out_with_all_their_mistakes(folder, block):
    folder.edge_map(1).unlink()
    folder.content["frames"][1][POSE[folder.kind]] = "nonsense"
    folder.content["frames"][1][INTRINSICS[folder.kind]] = None
    views = folder.read(skip=["v1"])
    assert views.names == ("v0", "v2", "v3")
    np.testing.assert_allclose(views.intrinsics, block[0][[0, 2, 3]])
    np.testing.assert_array_equal(views.edge_maps, block[2][[0, 2, 3]])


def test_the_box_of_an_emap_folder_is_its_own(emap, block):
    read = READERS["emap"]

    def box():
        emap.listing.write_text(json.dumps(emap.content))
        return read(emap.path, SourceConfig(reader="emap", path="unused", edges="edge")).box

    assert box() is None
    emap.content["scene_box"] = {"aabb": [[-1, -1, -1], [1, 1, 1]], "near": 0.05, "far": 2.5}
    np.testing.assert_array_equal(box(), [[-1, -1, -1], [1, 1, 1]])
    for wrong in ([[1, 1, 1], [-1, -1, -1]], [[0, 0], [1, 1]], "box"):
        emap.content["scene_box"] = {"aabb": wrong}
        with pytest.raises(UserError, match="scene_box.aabb"):
            box()


def test_replica_has_jpeg_images_and_png_edge_maps(tmp_path, block):
    """EMAP's Replica_Edge: frames of 1200 x 680 px, 4x4 intrinsics, PiDiNet's maps beside JPEG images, worldtogt."""
    folder = Folder(tmp_path / "room0", "emap", block)
    shutil.rmtree(folder.path / "edge")
    for name, suffix in (("color", "jpg"), ("edge_PidiNet", "png"), ("edge_DexiNed", "jpg")):
        (folder.path / name).mkdir()
        for view in range(VIEWS):
            grey = np.zeros((680, 1200), np.uint8)
            grey[300:303] = 255
            cv2.imwrite(str(folder.path / name / f"frame{view:06d}.{suffix}"), grey)
    for view, frame in enumerate(folder.content["frames"]):
        lens = np.eye(4)
        lens[:3, :3] = [[600, 0, 599.5], [0, 600, 339.5], [0, 0, 1]]
        frame |= {"rgb_path": f"frame{view:06d}.jpg", "intrinsics": lens.tolist()}
    to_truth = np.diag([3.5, 3.5, 3.5, 1.0])
    box = {"aabb": [[-1, -1, -1], [1, 1, 1]], "near": 0.05, "far": 2.5, "radius": 1.0}
    folder.content |= {"width": 1200, "height": 680, "worldtogt": to_truth.tolist(), "scene_box": box}
    for edges in ("edge_PidiNet", "edge_DexiNed"):
        views = folder.read(edges=edges)
        assert (views.width, views.height, views.names[0]) == (1200, 680, "frame000000")
        assert [Path(path).name for path in views.image_paths][:2] == ["frame000000.jpg", "frame000001.jpg"]
        np.testing.assert_array_equal(views.input_to_truth, to_truth)
    assert folder.warnings.texts == []


@pytest.mark.parametrize(
    "stored",
    [
        lambda grey: grey.astype(np.uint16) * 257,
        lambda grey: np.dstack([grey] * 3),
        lambda grey: np.dstack([grey] * 3 + [np.full_like(grey, 255)]),
    ],
    ids=["16 bit", "RGB", "RGBA"],
)
def test_edge_maps_of_other_depths_and_channels_are_read(tmp_path, block, stored):
    path = tmp_path / "map.png"
    cv2.imwrite(str(path), stored(block[2][0]))
    np.testing.assert_array_equal(read_grey(path), block[2][0])


# ------------------------------------------------------------------------------------------- mistakes in the listing


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_folder_is_named(kind, tmp_path):
    where = tmp_path / "nowhere"
    with pytest.raises(UserError, match="not found; a.* folder holds .*check source.path") as refused:
        READERS[kind](where, SourceConfig(reader=kind, path="unused", edges="edge"))
    assert str(refused.value).startswith(str(where / LISTING[kind]))


@pytest.mark.parametrize("where", ["masks", "masks/train"])
def test_masks_of_nerf_are_found(nerf, where):
    (nerf.path / where).mkdir(parents=True)
    for view in range(VIEWS - 1):
        cv2.imwrite(str(nerf.path / where / f"v{view}.png"), np.full((4, 4), 255, np.uint8))
    nerf.read()
    frames = READERS["nerf"](nerf.path, SourceConfig(reader="nerf", path="unused"))
    assert frames.mask_paths == [*(nerf.path / where / f"v{view}.png" for view in range(VIEWS - 1)), ""]
    assert "1 of" in frames.warnings[0] and f"v{VIEWS - 1}" in frames.warnings[0]
    assert not any(READERS["nerf"](nerf.path, SourceConfig(reader="nerf", path="unused", masks="none")).mask_paths)


def test_a_missing_split_is_named_with_the_one_there_is(nerf):
    nerf.listing.write_text("{}")
    assert "transforms_val.json: not found; did you mean 'transforms_train.json'?" in nerf.refusal(split="val")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"frames": [', "cannot be read as JSON (Expecting value: line 1 column 13"),
        ("", "cannot be read as JSON"),
        ("{}", "has no 'frames'"),
        ("[]", "has no 'frames'"),
        ('{"frames": []}', "has no 'frames'"),
        ('{"frames": {}}', "has no 'frames'"),
        ('{"frames": [3]}', "a frame without"),
    ],
)
def test_a_broken_listing_is_named(folder, text, says):
    message = folder.refusal(text=text)
    assert message.startswith(f"{folder.listing}: ") and says in message


@pytest.mark.parametrize("name", ["", 3, None])
def test_a_frame_without_a_name_is_refused(folder, name):
    folder.content["frames"][1][IMAGE[folder.kind]] = name
    assert "every frame names its image" in folder.refusal()


def test_two_frames_of_one_name_are_refused(folder):
    folder.content["frames"][1][IMAGE[folder.kind]] = folder.content["frames"][0][IMAGE[folder.kind]]
    assert "listed more than once: v0" in folder.refusal()


def test_skipping_an_unknown_view_is_refused_with_the_nearest(folder):
    message = folder.refusal(skip=["v1.png"])
    assert "source.skip" in message and "no view 'v1.png'; did you mean 'v1'?" in message


def test_skipping_everything_is_refused(folder):
    assert "leaves out all of its 4 views" in folder.refusal(skip=["v0", "v1", "v2", "v3"])


def test_emap_without_a_folder_of_edges_is_refused(emap):
    assert "no edge maps: set source.edges to their folder, or source.images" in emap.refusal(edges="")


@pytest.mark.parametrize(
    "size", [{"width": "a", "height": 64}, {"width": 64}, {"width": 64.5, "height": 64}, {"width": 0, "height": 0}]
)
def test_emap_sizes_that_are_no_sizes_are_refused(emap, size):
    emap.content.update(size)
    assert "width and height must both be whole numbers of pixels" in emap.refusal()


@pytest.mark.parametrize("values", [[1], "x", (np.eye(4) * np.nan).tolist(), np.zeros((4, 4)).tolist()])
def test_emap_worldtogt_that_is_no_matrix_is_refused(emap, values):
    emap.content["worldtogt"] = values
    assert "worldtogt" in emap.refusal()


# --------------------------------------------------------------------------------------------------- wrong cameras


def scaled(pose):
    return pose @ np.diag([2.0, 2, 2, 1])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda pose: pose * np.nan, "the pose is not finite"),
        (lambda pose: pose + 0.1 * np.eye(4, k=1), "not orthonormal; export the poses again"),
        (scaled, "not orthonormal; divide the scale out of it"),
        (lambda pose: pose @ np.diag([0.0, 0, 0, 1]), "not orthonormal; export the poses again"),
        (lambda pose: pose @ np.diag([-1.0, 1, 1, 1]), "is a mirror (determinant -1)"),
        (lambda pose: pose.T, "the last row of the pose is not 0 0 0 1"),
    ],
    ids=["nan", "sheared", "scaled", "flat", "mirrored", "transposed"],
)
def test_a_wrong_pose_is_named_with_its_view(folder, change, says):
    folder.change_pose(change)
    message = folder.refusal()
    assert message.startswith(f"{folder.listing}: 1 of 4 views (v1): ") and says in message
    assert message.endswith("or leave such views out with source.skip")


def test_scaled_poses_are_all_counted(folder):
    folder.change_pose(scaled, range(1, VIEWS))
    assert "3 of 4 views (v1, v2, v3): the rotation of the pose is not orthonormal; divide" in folder.refusal()


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        (np.eye(3).tolist(), "must be a 4 x 4 matrix of numbers, but its shape is 3 x 3"),
        (np.eye(4)[:3].tolist(), "must be a 4 x 4 matrix of numbers, but its shape is 3 x 4"),
        ([[1, 2], [3]], "is not a matrix of numbers"),
        ("text", "is not a matrix of numbers"),
        (None, "is missing"),
    ],
)
def test_a_pose_that_is_no_4x4_matrix_is_named(folder, pose, says):
    folder.content["frames"][1][POSE[folder.kind]] = pose
    assert f"the pose of v1 {says}" in folder.refusal()


def test_one_view_that_looks_away_is_named(folder):
    folder.change_pose(lambda pose: pose @ OPENGL_TO_OPENCV)
    assert "1 of 4 views (v1): the scene box (0, 0, 0) to (1, 1, 1) is not in sight" in folder.refusal()


def test_views_that_all_look_away_hint_at_the_axes(folder):
    folder.change_pose(lambda pose: pose @ OPENGL_TO_OPENCV, range(VIEWS))
    other = "opencv" if folder.kind == "nerf" else "opengl"
    message = folder.refusal()
    assert "0 of 4 views see the scene box" in message and f"set source.axes: {other}" in message
    assert len(folder.read(axes=other)) == VIEWS  # what the message says helps


def test_poses_the_wrong_way_round_are_recognised(folder):
    folder.change_pose(np.linalg.inv, range(VIEWS))
    assert "seem to be world-to-camera" in folder.refusal()


def test_a_box_that_no_view_sees_is_blamed_on_the_box(folder):
    message = folder.refusal(box=UNIT_BOX + 100)
    assert "see the scene box (100, 100, 100) to (101, 101, 101): correct the box (the cameras are around (" in message


@pytest.mark.parametrize(
    ("lens", "says"),
    [
        ([[0, 0, 32], [0, 0, 32], [0, 0, 1]], "the focal length is not a positive number"),
        ([[-50, 0, 32], [0, 50, 32], [0, 0, 1]], "the focal length is not a positive number"),
        ([[float("nan"), 0, 32], [0, 50, 32], [0, 0, 1]], "the focal length is not a positive number"),
        ([[50, 0, 400], [0, 50, 32], [0, 0, 1]], "the principal point is outside the 64 x 64 px image"),
        ([[50, 5, 32], [0, 50, 32], [0, 0, 1]], "have skew, which is not supported"),
        ([[50, 0, 0], [0, 50, 0], [32, 32, 1]], "row by row"),
    ],
    ids=["zero", "negative", "nan", "resized", "skewed", "transposed"],
)
def test_wrong_intrinsics_are_named_with_their_view(folder, lens, says):
    folder.content["frames"][1][INTRINSICS[folder.kind]] = lens
    message = folder.refusal()
    assert "1 of 4 views (v1): " in message and says in message


@pytest.mark.parametrize("lens", [[50, 50, 32, 32], "text"])
def test_intrinsics_that_are_no_matrix_are_named(folder, lens):
    folder.content["frames"][1][INTRINSICS[folder.kind]] = lens
    assert "intrinsics of v1" in folder.refusal()


@pytest.mark.parametrize("angle", [None, 40, 0, "wide", True])
def test_a_field_of_view_that_is_no_angle_is_refused(nerf, angle):
    for frame in nerf.content["frames"]:
        del frame["camera_intrinsics"]
    nerf.content["camera_angle_x"] = angle
    assert "camera_angle_x" in nerf.refusal()


def test_maps_of_another_size_than_the_calibration_are_warned_about(folder):
    folder.change_maps(lambda edge_map: cv2.resize(edge_map, (256, 256)))
    folder.read()
    assert (
        "4 of 4 views: the principal point is far from the centre of the 256 x 256 px image" in folder.warnings.texts[0]
    )


# -------------------------------------------------------------------------------------------------- wrong edge maps


def truncate(path):
    path.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])


@pytest.mark.parametrize(
    "spoil",
    [truncate, lambda path: path.write_text("no image"), lambda path: path.write_bytes(b"")],
    ids=["truncated", "text", "empty"],
)
def test_a_damaged_edge_map_is_named(folder, spoil):
    spoil(folder.edge_map(1))
    message = folder.refusal()
    assert (
        f"1 of 4 views (v1): the edge map is truncated or not an 8- or 16-bit image ({folder.edge_map(1)})" in message
    )


@pytest.mark.parametrize("share", [0.3, 0.9, 0.99])
def test_a_truncated_jpeg_is_noticed(tmp_path, block, share):
    path = tmp_path / "map.jpg"
    cv2.imwrite(str(path), block[2][0])
    assert read_grey(path).shape == (SIZE, SIZE)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert read_grey(path) is None


def test_a_missing_edge_map_is_named(folder):
    folder.edge_map(1).unlink()
    assert f"1 of 4 views (v1): the edge map is missing ({folder.edge_map(1)})" in folder.refusal()


def test_a_missing_folder_of_edge_maps_is_named_with_those_there_are(folder):
    (folder.path / "edge_other").mkdir()
    message = folder.refusal(edges="edge_nowhere")
    assert "edge_nowhere: no edge map found here; check source.edges" in message and "edge_other" in message


def test_an_edge_map_of_another_size_is_named(folder):
    folder.change_maps(lambda edge_map: edge_map[:50], [1])
    assert "1 of 4 views (v1): the edge map is 64 x 50 px, but the others are 64 x 64 px" in folder.refusal()


def test_edge_maps_of_mixed_sizes_are_refused(folder):
    folder.change_maps(lambda edge_map: edge_map[:50], [0, 1])
    assert "2 of 4 views" in folder.refusal()


def test_the_size_in_the_listing_counts(emap):
    emap.content.update(width=100, height=80)
    assert "4 of 4 views" in emap.refusal() and "meta_data.json says 100 x 80 px" in emap.refusal()


def test_edge_maps_without_an_edge_are_refused(folder):
    folder.change_maps(lambda edge_map: edge_map // 255)  # 0 and 1, as binary masks are often stored
    assert "no edge map has an edge pixel, a value of 128 or more; scale the maps" in folder.refusal()


def test_one_edge_map_without_an_edge_is_warned_about(folder):
    folder.change_maps(lambda edge_map: 0 * edge_map, [1])
    assert len(folder.read()) == VIEWS
    assert folder.warnings.texts == ["1 of 4 edge maps have no edge pixel and teach nothing: v1"]


def test_one_white_edge_map_is_refused_by_name(folder):
    folder.change_maps(lambda edge_map: 0 * edge_map + 255, [1])
    assert "1 of 4 views (v1): most of the edge map is edge pixels" in folder.refusal()


def test_black_on_white_is_refused(folder):
    folder.change_maps(lambda edge_map: 255 - edge_map)
    assert "edges must be white on black: invert the maps" in folder.refusal()


# ---------------------------------------------------------------------------------------------------- colour images


def test_colour_images_are_found(folder):
    shutil.copytree(folder.path / EDGES[folder.kind], folder.path / "color")
    assert folder.read(images="color").image_paths == tuple(
        str(folder.path / "color" / f"v{i}.png") for i in range(VIEWS)
    )
    assert folder.warnings.texts == []


def test_missing_and_truncated_colour_images_are_only_warned_about(folder):
    shutil.copytree(folder.path / EDGES[folder.kind], folder.path / "color")
    (folder.path / "color" / "v1.png").unlink()
    truncate(folder.path / "color" / "v3.png")
    paths = folder.read(images="color").image_paths
    assert [bool(path) for path in paths] == [True, False, True, False]
    assert len(folder.warnings.texts) == 1 and "the colour image is missing or truncated" in folder.warnings.texts[0]
    assert folder.warnings.texts[0].endswith("v1, v3")


# -------------------------------------------------------------------------------------------------------- real data

REAL = {
    "nerf": ("abc_nef/00000006", {}),
    "emap": ("abc_nef_edge/00004926", {"edges": "edge_DexiNed", "images": "color"}),
}


@pytest.mark.slow(reason="reads real scenes")
@pytest.mark.parametrize("kind", REAL)
def test_true_edges_of_the_real_scenes_fall_on_edge_pixels(kind):
    root = os.environ.get("TAICHI_EDGES_DATA")
    if not root:
        pytest.skip("TAICHI_EDGES_DATA is not set: the real scenes are not here")
    from taichi_edges.evaluation.ground_truth import read_ground_truth

    path, source = REAL[kind]
    config = SourceConfig(reader=kind, path=path, skip=[], **source)
    views = views_of_maps(READERS[kind](Path(root) / path, config), config, UNIT_BOX, Warnings())
    assert (len(views), views.width, views.height) == (50, 800, 800)
    points = read_ground_truth(Path(root) / path / "gt").points
    near = []
    for view in range(0, len(views), 5):
        pixels, _ = views.project(points, view)
        inside = inside_image(pixels, views.width, views.height)
        assert inside.mean() > 0.95
        columns, rows = np.rint(pixels[inside]).astype(int).T
        near.append((distance_transform_edt(views.edge_maps[view] < 128)[rows, columns] <= 3).mean())
    # Hidden edges are in no map, about a third of them; two axes swapped or half the size leave a fifth or less.
    assert np.mean(near) > 0.5
