"""Wrong data: every kind ends with status 2 and one line that names the likely cause, before any training starts.

The command itself is run, on a folder of six small pictures of a block with their cameras.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from taichi_edges.files.ply import write_float_vertices
from taichi_edges.views.cameras import OPENGL_TO_OPENCV, invert_pose

sys.path.insert(0, str(Path(__file__).parent.parent))
from run import main

VIEWS, WIDTH, HEIGHT = 6, 120, 96
CUBE = "[[0, 0, 0], [1, 1, 1]]"
POINTS = np.random.default_rng(0).uniform(0.1, 0.9, (300, 3))


@pytest.fixture
def rendered(clean_block):
    """Square views, and their pictures: cut to WIDTH x HEIGHT below."""
    return clean_block(VIEWS, WIDTH)


class Scene:
    """A folder with the block's pictures and cameras, to be spoilt and run."""

    def __init__(self, path, rendered, capsys):
        self.path, self.capsys = path, capsys
        views, pictures = rendered
        self.pictures = [picture[:HEIGHT, :, ::-1] for picture in pictures]
        self.poses, self.intrinsics = np.tile(np.eye(4), (VIEWS, 1, 1)), views.intrinsics.copy()
        self.poses[:, :3] = invert_pose(views.world_to_camera)
        self.intrinsics[:, 1, 2] = (HEIGHT - 1) / 2
        self.points = None

    def write_emap(self):
        """EMAP's layout: intrinsics and poses as they are, no size."""
        self.write_pictures("color")
        frames = [
            {"rgb_path": f"v{view}.png", "camtoworld": pose.tolist(), "intrinsics": lens.tolist()}
            for view, (pose, lens) in enumerate(zip(self.poses, self.intrinsics, strict=True))
        ]
        (self.path / "meta_data.json").write_text(json.dumps({"frames": frames}))

    def write_nerfstudio(self):
        """nerfstudio's layout: sizes, and points if there are any."""
        self.write_pictures("images")
        frames = [
            {"file_path": f"images/v{view}.png", "transform_matrix": (pose @ OPENGL_TO_OPENCV).tolist()}
            for view, pose in enumerate(self.poses)
        ]
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics[0]
        content = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": WIDTH, "h": HEIGHT, "frames": frames}
        if self.points is not None:
            write_float_vertices(self.path / "points.ply", ("x", "y", "z"), self.points)
            content["ply_file_path"] = "points.ply"
        (self.path / "transforms.json").write_text(json.dumps(content))

    def write_pictures(self, folder):
        (self.path / folder).mkdir(parents=True)
        for view, picture in enumerate(self.pictures):
            cv2.imwrite(str(self.path / folder / f"v{view}.png"), picture)

    def run(self, *settings):
        """Exit status, the error line ('' without), and all else on standard error, of the command."""
        arguments = [str(self.path), "--out", str(self.path.parent / "runs"), "--threads", "2", "--until", "prepare"]
        arguments += [part for setting in settings for part in ("--set", setting)]
        status = main(arguments)
        lines = self.capsys.readouterr().err.splitlines()
        errors = [line for line in lines if line.startswith("error: ")]
        return status, "\n".join(errors), [line for line in lines if line not in errors]

    def refusal(self, *settings):
        status, error, others = self.run(*settings)
        assert status == 2 and error and "\n" not in error and "Traceback" not in "\n".join(others)
        assert list(self.path.parent.glob("runs/*/views.npz")) == []  # nothing that could be trained on
        return error


@pytest.fixture
def scene(tmp_path, rendered, capsys):
    return Scene(tmp_path / "scene", rendered, capsys)


@pytest.mark.parametrize("layout", ["emap", "nerfstudio"])
def test_the_scene_itself_is_fine(scene, layout):
    scene.points = POINTS
    getattr(scene, f"write_{layout}")()
    status, error, others = scene.run()
    assert (status, error) == (0, "") and not [line for line in others if line.startswith("warning")]


def test_the_scene_file_of_a_folder_that_was_run_runs_again_from_anywhere(scene, tmp_path, monkeypatch):
    scene.write_emap()
    monkeypatch.chdir(tmp_path)
    assert main(["scene", "--until", "prepare", "--set", "source.detector=subpixel"]) == 0
    monkeypatch.chdir(tmp_path.parent)
    scene.capsys.readouterr()
    again = tmp_path / "runs" / "scene" / "scene.yaml"
    assert main([str(again), "--out", str(tmp_path / "runs"), "--until", "prepare"]) == 0
    assert "prepare: up to date" in scene.capsys.readouterr().err


# --------------------------------------------------------------------------------------------------------------- poses


@pytest.mark.parametrize("layout", ["emap", "nerfstudio"])
def test_axes_of_another_convention(scene, layout):
    scene.poses, scene.points = scene.poses @ OPENGL_TO_OPENCV, POINTS
    getattr(scene, f"write_{layout}")()
    used, other = ("OpenCV", "opengl") if layout == "emap" else ("OpenGL", "opencv")
    assert f"the poses were read with {used} axes; set source.axes: {other}" in scene.refusal()
    assert scene.run(f"source.axes={other}", f"box={CUBE}")[0] == 0  # what the message says helps


@pytest.mark.parametrize("layout", ["emap", "nerfstudio"])
def test_poses_the_wrong_way_round(scene, layout):
    scene.poses[:, :3], scene.points = invert_pose(scene.poses), POINTS
    if layout == "nerfstudio":  # the file's matrices are to be inverses, not ours
        scene.poses = np.linalg.inv(np.linalg.inv(scene.poses) @ OPENGL_TO_OPENCV) @ OPENGL_TO_OPENCV
    getattr(scene, f"write_{layout}")()
    assert "the poses seem to be world-to-camera" in scene.refusal()


def test_all_poses_the_same(scene):
    scene.poses[:] = scene.poses[0]
    scene.write_emap()
    assert "the poses of all 6 views are the same; export the poses again" in scene.refusal()


def test_cameras_that_only_turn(scene):
    scene.poses[:, :3, 3] = scene.poses[0, :3, 3]
    scene.write_emap()
    assert "all 6 cameras stand in one place, and nothing tells depth" in scene.refusal()


# --------------------------------------------------------------------------------------------------------------- scale


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_poses_in_other_units_than_the_box(scene, factor):
    scene.poses[:, :3, 3] *= factor
    scene.write_emap()
    message = scene.refusal(f"box={CUBE}")
    assert "metres where the poses are in" in message or "is it in other units" in message
    assert "1000 times" in message or " times more" in message or "px in the images" in message
    box = str((np.array([[0, 0, 0], [1, 1, 1]]) * factor).tolist())
    assert scene.run(f"box={box}")[0] == 0


def test_a_box_far_away_is_wrong_itself(scene):
    """Of cameras all around something some look its way once they are flipped."""
    scene.write_emap()
    message = scene.refusal("box=[[1000, 1000, 1000], [1001, 1001, 1001]]")
    assert "0 of 6 views see the scene box" in message and "correct the box (the cameras are around" in message


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (1000.0, "1000 times too large, in millimetres where the poses"),
        (0.001, "1000 times too small, in metres where"),
    ],
)
def test_points_in_other_units_than_the_poses(scene, factor, says):
    scene.points = POINTS * factor
    scene.write_nerfstudio()
    message = scene.refusal()
    seen = "0 % of the 300 points are in the images of 3 views" if factor > 1 else "the box of the points"
    assert seen in message and says in message


def test_points_in_a_frame_of_their_own(scene):
    scene.points = POINTS + [30.0, 0, 0]
    scene.write_nerfstudio()
    assert "or the points are in a frame of their own" in scene.refusal()


# -------------------------------------------------------------------------------------------------------------- images


@pytest.mark.parametrize("layout", ["emap", "nerfstudio"])
def test_pictures_turned_by_exif(scene, layout):
    scene.pictures = [np.rot90(picture).copy() for picture in scene.pictures]
    getattr(scene, f"write_{layout}")()
    assert "EXIF orientation; use the images that the cameras are of" in scene.refusal()


def test_one_picture_turned_by_exif(scene):
    scene.pictures[2] = np.rot90(scene.pictures[2]).copy()
    scene.write_emap()
    message = scene.refusal()
    assert "(v2): the colour image is 96 x 120 px, but the others are 120 x 96 px; turned: " in message
    assert "EXIF" in message


def test_pictures_of_mixed_sizes(scene):
    scene.pictures[3] = scene.pictures[3][:-8]
    scene.write_emap()
    assert "(v3): the colour image is 120 x 88 px, but the others are 120 x 96 px; write it" in scene.refusal()


def test_pictures_that_are_all_the_same(scene):
    scene.pictures = scene.pictures[:1] * VIEWS
    scene.write_emap()
    assert "all 6 pictures are copies of one file" in scene.refusal()


def test_some_pictures_that_are_the_same_are_named(scene):
    scene.pictures[4] = scene.pictures[1]
    scene.write_emap()
    assert any("1 of 6 pictures are copies of others: v4" in line for line in scene.run()[2])


@pytest.mark.parametrize("grey", [0, 255])
def test_black_and_blank_pictures(scene, grey):
    scene.pictures = [np.full_like(picture, grey) for picture in scene.pictures]
    scene.write_emap()
    assert "no edge found in any of 6 images; are they black, blank" in scene.refusal()


def test_one_black_picture_is_named(scene):
    scene.pictures[1] = np.zeros_like(scene.pictures[1])
    scene.write_emap()
    assert any("1 of 6 pictures show no edge and teach nothing: v1" in line for line in scene.run()[2])


def test_empty_edge_maps(scene):
    scene.write_emap()
    (scene.path / "edges").mkdir()
    for view in range(VIEWS):
        cv2.imwrite(str(scene.path / "edges" / f"v{view}.png"), np.full((HEIGHT, WIDTH), view, np.uint8))
    assert "no edge map has an edge pixel, a value of 128 or more" in scene.refusal("source.edges=edges")


# --------------------------------------------------------------------------------------------------------------- views


@pytest.mark.parametrize(("left", "says"), [(1, "one view only"), (2, "2 views only")])
def test_too_few_views(scene, left, says):
    scene.write_emap()
    skip = json.dumps([f"v{view}" for view in range(left, VIEWS)])
    assert f"{says}: an edge in space needs at least 3; take 20 to 50 pictures" in scene.refusal(f"source.skip={skip}")


def test_too_few_pictures_that_can_be_read(scene):
    scene.write_emap()
    for view in range(2, VIEWS):
        (scene.path / "color" / f"v{view}.png").unlink()
    assert "2 views only" in scene.refusal()


def test_views_that_do_not_overlap(scene):
    """Six cameras in a row, each of which sees a sixth of the box."""
    for view in range(VIEWS):
        scene.poses[view, :3, :3] = np.eye(3)
        scene.poses[view, :3, 3] = [view, 0, -2.0]
    scene.intrinsics[:, [0, 1], [0, 1]] = 500.0
    scene.write_emap()
    message = scene.refusal("box=[[-0.5, -0.5, 0], [5.5, 0.5, 1]]")
    assert "is in sight of 3 views, the most is 1; the views do not overlap" in message
