"""nerfstudio's transforms.json: lenses, sizes, masks, points and boxes; and one line for every mistake."""

import json

import cv2
import numpy as np
import pytest

from taichi_edges.errors import UserError
from taichi_edges.files.ply import write_float_vertices
from taichi_edges.progress import Progress
from taichi_edges.readers.frames import camera_poses
from taichi_edges.readers.nerfstudio import read_nerfstudio
from taichi_edges.readers.photogrammetry import distorted_pixels
from taichi_edges.readers.undistortion import undistorted_frames
from taichi_edges.scene.settings import SourceConfig
from taichi_edges.synthetic.rendering import ring_cameras
from taichi_edges.views.cameras import OPENGL_TO_OPENCV, invert_pose

VIEWS, WIDTH, HEIGHT = 4, 64, 48
INTRINSICS = {"fl_x": 70.0, "fl_y": 68.0, "cx": 31.0, "cy": 25.0, "w": WIDTH, "h": HEIGHT}
RAYS = np.array([[x, y, 1.0] for x in (-0.4, -0.1, 0.0, 0.3) for y in (-0.3, 0.0, 0.2)])


class Folder:
    """A folder of that layout around the unit cube, to be spoilt and read; `content` is its JSON."""

    def __init__(self, path):
        self.path = path
        (path / "images").mkdir(parents=True)
        frames = []
        for view, pose in enumerate(ring_cameras(VIEWS, WIDTH)[1]):
            cv2.imwrite(str(path / "images" / f"frame_{view}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
            matrix = np.eye(4)
            matrix[:3] = invert_pose(pose)
            frames.append(
                {"file_path": f"images/frame_{view}.png", "transform_matrix": (matrix @ OPENGL_TO_OPENCV).tolist()}
            )
        self.content = {"camera_model": "OPENCV", **INTRINSICS, "frames": frames}

    def read(self, listing="transforms.json", **source):
        (self.path / listing).write_text(json.dumps(self.content))
        given = self.path if listing == "transforms.json" else self.path / listing
        return read_nerfstudio(given, SourceConfig(reader="nerfstudio", path="unused", **source))

    def lens(self):
        return self.read().lenses[0]

    def refusal(self, **source):
        with pytest.raises(UserError) as refused:
            self.read(**source)
        message = str(refused.value)
        assert "\n" not in message and message.startswith(str(self.path / "transforms.json"))
        return message


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path / "scene")


def opencv_pixels(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    """OpenCV's lens model written out; pixel centres at integers, so half a pixel less than in the file."""
    x, y = RAYS[:, 0], RAYS[:, 1]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([70 * u + 31 - 0.5, 68 * v + 25 - 0.5], axis=1)


@pytest.mark.parametrize(
    "distortion", [{}, {"k1": 0.1, "k2": -0.05, "p1": 0.01, "p2": -0.02}, {"k1": 0.1, "k2": -0.05, "k3": 0.03}]
)
def test_a_perspective_lens_bends_as_opencv_says(folder, distortion):
    folder.content |= distortion
    np.testing.assert_allclose(distorted_pixels(folder.lens(), RAYS), opencv_pixels(**distortion), atol=1e-9)


@pytest.mark.parametrize("key", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_fisheye_bends_the_angle(folder, key):
    folder.content |= {"k1": 0.1, "k2": -0.05, "k3": 0.02, "k4": -0.01, **key}
    radius = np.hypot(RAYS[:, 0], RAYS[:, 1])
    angle = np.arctan(radius)
    bent = angle * (1 + 0.1 * angle**2 - 0.05 * angle**4 + 0.02 * angle**6 - 0.01 * angle**8)
    scale = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 0)
    expected = np.stack([70 * RAYS[:, 0] * scale + 30.5, 68 * RAYS[:, 1] * scale + 24.5], axis=1)
    np.testing.assert_allclose(distorted_pixels(folder.lens(), RAYS), expected, atol=1e-9)


def test_a_lens_without_distortion_needs_no_new_pictures(folder, tmp_path):
    frames = undistorted_frames(folder.read(), tmp_path / "made", 0, progress=Progress())
    assert frames.image_paths == folder.read().image_paths
    np.testing.assert_allclose(frames.intrinsics[0](WIDTH, HEIGHT), [[70, 0, 30.5], [0, 68, 24.5], [0, 0, 1]])


def test_intrinsics_of_a_frame_go_before_those_of_the_file(folder):
    folder.content["frames"][2] |= {"fl_x": 90.0, "k1": 0.2}
    lenses = folder.read().lenses
    assert [lens.params[0] for lens in lenses] == [70, 70, 90, 70]
    assert [lens.model for lens in lenses] == ["PINHOLE", "PINHOLE", "OPENCV", "PINHOLE"]


def test_instant_ngp_gives_the_field_of_view(folder):
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
        del folder.content[key]
    folder.content |= {"camera_angle_x": np.radians(60), "aabb_scale": 4}
    focal = 0.5 * WIDTH / np.tan(np.radians(30))
    lens = folder.lens()
    assert (lens.width, lens.height, lens.model) == (WIDTH, HEIGHT, "PINHOLE")
    np.testing.assert_allclose(lens.params, [focal, focal, WIDTH / 2, HEIGHT / 2])


def test_poses_have_opengl_axes(folder):
    poses = camera_poses(folder.read()) @ OPENGL_TO_OPENCV
    towards = np.array([0.5, 0.5, 0.5]) - poses[:, :3, 3]
    assert ((towards * poses[:, :3, 2]).sum(axis=1) > 0).all()  # they look at the cube


def test_images_are_found_whatever_their_suffix_and_folder(folder):
    for view, frame in enumerate(folder.content["frames"]):
        frame["file_path"] = f"./images/frame_{view}" if view % 2 else f"images/frame_{view}.jpg"
    frames = folder.read()
    assert [path.name for path in frames.image_paths] == [f"frame_{view}.png" for view in range(VIEWS)]
    assert frames.names == [f"frame_{view}" for view in range(VIEWS)]


def test_smaller_images_of_another_folder_get_smaller_intrinsics(folder, tmp_path):
    (folder.path / "images_2").mkdir()
    for path in (folder.path / "images").iterdir():
        picture = np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8)
        cv2.imwrite(str(folder.path / "images_2" / path.name), picture)
    frames = undistorted_frames(folder.read(images="images_2"), tmp_path / "made", 0, progress=Progress())
    np.testing.assert_allclose(frames.intrinsics[0](32, 24), [[35, 0, 15], [0, 34, 12], [0, 0, 1]])


def test_images_of_several_folders_keep_them_in_their_names(folder):
    for view, frame in enumerate(folder.content["frames"]):
        target = folder.path / "images" / f"cam{view % 2}" / f"{view // 2}.png"
        target.parent.mkdir(exist_ok=True)
        (folder.path / frame["file_path"]).rename(target)
        frame["file_path"] = str(target.relative_to(folder.path))
    assert folder.read().names == ["cam0/0", "cam1/0", "cam0/1", "cam1/1"]
    assert folder.read(edges="maps").edge_paths[3] == folder.path / "maps" / "cam1" / "1.png"


def test_masks_are_those_of_the_file_unless_the_scene_names_others(folder):
    (folder.path / "masks").mkdir()
    for view, frame in enumerate(folder.content["frames"]):
        cv2.imwrite(str(folder.path / "masks" / f"frame_{view}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
        if view:
            frame["mask_path"] = f"masks/m{view}.png"
    assert folder.read().mask_paths == ["", *(folder.path / "masks" / f"m{view}.png" for view in range(1, VIEWS))]
    assert folder.read(masks="masks").mask_paths[0] == folder.path / "masks" / "frame_0.png"
    assert not any(folder.read(masks="none").mask_paths)


def test_points_are_in_the_frame_of_the_file_and_give_the_box(folder, generator):
    points = generator.uniform(0.2, 0.8, (500, 3))
    write_float_vertices(folder.path / "sparse_pc.ply", ("x", "y", "z"), points)
    folder.content |= {
        "ply_file_path": "sparse_pc.ply",
        "applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 5]],
    }
    frames = folder.read()
    np.testing.assert_allclose(frames.points, points, atol=1e-6)
    assert frames.files == (folder.path / "sparse_pc.ply",)
    assert (frames.box[0] > 0).all() and (frames.box[1] < 1).all()
    assert (frames.box[0] < 0.25).all() and (frames.box[1] > 0.75).all()


def test_without_points_the_box_is_what_the_cameras_look_at(folder):
    frames = folder.read()
    assert (frames.box[0] < 0.3).all() and (frames.box[1] > 0.7).all()  # the cube, or most of it
    np.testing.assert_allclose(frames.box.mean(axis=0), 0.5, atol=0.1)
    assert "the box is what the cameras look at" in frames.warnings[0]


def test_cameras_that_look_anywhere_tell_no_box(folder):
    for view, frame in enumerate(folder.content["frames"]):
        turned = np.eye(4)
        turned[0, 3] = view
        frame["transform_matrix"] = turned.tolist()
    frames = folder.read()
    assert frames.box is None and "set box" in frames.warnings[0]


def test_another_file_of_that_kind_can_be_named(folder):
    assert folder.read(listing="half.json").where == folder.path / "half.json"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model EQUIRECTANGULAR is not supported; OPENCV, PINHOLE"),
        ({"fl_x": None, "fl_y": None}, "has neither fl_x nor camera_angle_x"),
        ({"fl_x": "wide"}, "fl_x of images/frame_0.png must be a finite number, not 'wide'"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 40}, "must be between 0 and pi radians, not 40"),
        ({"w": 0}, "w and h of images/frame_0.png must be whole numbers of pixels, not 0 and 48"),
        ({"w": 64.5}, "must be whole numbers of pixels, not 64.5 and 48"),
        ({"k4": 0.1}, "k4 of images/frame_0.png is 0.1, which COLMAP's perspective lenses do not have"),
        ({"ply_file_path": "lost.ply"}, "lost.ply is not there; copy it, or leave the key out"),
        ({"frames": []}, "has no 'frames'"),
        ({"frames": [{"transform_matrix": []}]}, "a frame without file_path"),
    ],
)
def test_mistakes_in_the_file_are_named(folder, change, says):
    folder.content |= change
    assert says in folder.refusal()


def test_a_broken_pose_is_named_by_the_checks(folder):
    folder.content["frames"][1]["transform_matrix"] = [[1, 2], [3]]
    with pytest.raises(UserError, match="the pose of frame_1 is not a matrix of numbers"):
        camera_poses(folder.read())


def test_images_turned_by_exif_are_named(folder, tmp_path):
    for path in (folder.path / "images").iterdir():
        cv2.imwrite(str(path), np.zeros((WIDTH, HEIGHT, 3), np.uint8))
    with pytest.raises(UserError, match="the image is 48 x 64 px, but its camera is 64 x 48 px, turned: .*EXIF"):
        undistorted_frames(folder.read(), tmp_path / "made", 0, progress=Progress())
