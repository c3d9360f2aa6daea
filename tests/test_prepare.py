"""The prepare stage: which detector sees what, what is calibrated, and how mistakes are named."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx_networks import write_sides

from taichi_edges.corridor import prepare as stage
from taichi_edges.corridor.pipeline import Run
from taichi_edges.errors import UserError
from taichi_edges.progress import Progress
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.views.cameras import invert_pose
from taichi_edges.views.views import read_views

VIEWS, SIZE = 6, 160


class Warnings(Progress):
    """Keeps the warnings."""

    def __init__(self):
        self.texts = []

    def warn(self, text):
        self.texts.append(text)


@pytest.fixture
def rendered(clean_block):
    """Views of the block with clean edge maps, and pictures."""
    return clean_block(VIEWS, SIZE)


@pytest.fixture
def folder(tmp_path, rendered):
    """An EMAP folder with colour images and edge maps."""
    views, pictures = rendered
    frames = []
    for directory in ("color", "edge_test"):
        (tmp_path / "data" / directory).mkdir(parents=True)
    for view, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / "data" / "color" / f"v{view}.png"), picture[:, :, ::-1])
        cv2.imwrite(str(tmp_path / "data" / "edge_test" / f"v{view}.png"), views.edge_maps[view])
        pose = np.eye(4)
        pose[:3] = invert_pose(views.world_to_camera[view])
        frames.append(
            {"rgb_path": f"v{view}.png", "camtoworld": pose.tolist(), "intrinsics": views.intrinsics[view].tolist()}
        )
    (tmp_path / "data" / "meta_data.json").write_text(json.dumps({"frames": frames}))
    return tmp_path / "data"


@pytest.fixture
def prepare(tmp_path, folder):
    """prepare(source, **scene) -> (facts, views, warnings) of the folder's scene."""

    def run_prepare(source=None, **scene):
        source = {"reader": "emap", "path": str(folder), **(source or {})}
        config = check_scene({"name": "test", "source": source, **scene}, Path("test.yaml"))
        (tmp_path / "run").mkdir(exist_ok=True)
        run = Run(config, tmp_path / "run", threads=2, progress=Warnings())
        facts = stage.prepare(run)
        return facts, read_views(run.path("views.npz")), run.progress.texts

    return run_prepare


def refusal(prepare, *arguments, **options):
    with pytest.raises(UserError) as refused:
        prepare(*arguments, **options)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_images_alone_are_enough(prepare, tmp_path, rendered):
    facts, views, _ = prepare()
    assert facts["detector"] == "subpixel" and "calibration" not in facts
    assert facts["edgels"] == len(views.edgels) > 100 * VIEWS
    assert (tmp_path / "run" / "detection.png").is_file() and "detection.png" in facts["files"]
    truth = rendered[0]
    for view in range(VIEWS):  # where the true maps have lines, to a pixel
        near = cv2.dilate((truth.edge_maps[view] >= 128).astype(np.uint8), np.ones((3, 3)))
        places = np.rint(views.edgels.of_view(view)[0]).astype(int)
        # Steps of rounding in smooth shading look like faint edges.
        assert near[places[:, 1], places[:, 0]].mean() > 0.82
        assert (views.edge_maps[view] >= 128).any()


@pytest.mark.slow(reason="calibrates many views")
def test_named_edge_maps_go_before_images(prepare):
    facts, _views, _ = prepare({"edges": "edge_test"})
    assert facts["detector"] == "maps" and facts["line_width_px"] > 1
    assert prepare({"edges": "edge_test", "detector": "subpixel"})[0]["detector"] == "subpixel"


def test_a_view_without_its_image_is_named_and_left_out(prepare, folder):
    (folder / "color" / "v2.png").unlink()
    whole = (folder / "color" / "v4.png").read_bytes()
    (folder / "color" / "v4.png").write_bytes(whole[: len(whole) // 2])
    facts, views, warnings = prepare()
    assert facts["views"] == VIEWS - 2 and "v2" not in views.names and "v4" not in views.names
    assert any("2 of 6 views left out" in text and "v2, v4" in text for text in warnings)


def test_without_images_or_maps_there_is_one_line(prepare, folder):
    shutil.rmtree(folder / "color")
    message = refusal(prepare)
    assert "set source.edges" in message and "edge_test" in message
    assert "set source.images" in refusal(prepare, {"detector": "subpixel"})
    assert "colours: no such folder; check source.images" in refusal(prepare, {"images": "colours"})


def test_images_of_two_sizes_are_refused(prepare, folder):
    cv2.imwrite(str(folder / "color" / "v1.png"), np.zeros((SIZE, SIZE + 8, 3), np.uint8))
    assert f"(v1): the colour image is {SIZE + 8} x {SIZE} px" in refusal(prepare)


def test_images_without_an_edge_are_refused(prepare, folder):
    for path in (folder / "color").iterdir():
        cv2.imwrite(str(path), np.full((SIZE, SIZE, 3), 90, np.uint8))
    assert "no edge found in any of 6 images" in refusal(prepare)


def test_a_wrong_pose_is_named_before_edges_are_looked_for(prepare, folder, monkeypatch):
    content = json.loads((folder / "meta_data.json").read_text())
    content["frames"][3]["camtoworld"][0][0] = 7.0
    (folder / "meta_data.json").write_text(json.dumps(content))
    monkeypatch.setattr("taichi_edges.detectors.subpixel.trace_pictures", lambda *_: pytest.fail("too late"))
    assert "v3" in refusal(prepare)


@pytest.mark.slow(reason="calibrates many views")
def test_fixed_biases_are_taken_as_they_are(prepare):
    plain = prepare({"edges": "edge_test"}, calibration="off")
    moved = prepare({"edges": "edge_test"}, calibration={"shift": [0.5, -0.25], "silhouette": "off"})
    assert "calibration" not in plain[0]
    assert moved[0]["calibration"]["shift_method"] == "fixed"
    np.testing.assert_allclose(moved[1].edgels.points, plain[1].edgels.points - [0.5, -0.25], atol=1e-4)
    outward = prepare({"edges": "edge_test"}, calibration={"shift": "off", "silhouette": 1.5})
    distances = np.linalg.norm(outward[1].edgels.points - plain[1].edgels.points, axis=1)
    assert np.quantile(distances, 0.5) == pytest.approx(1.5, abs=0.05)  # most edgels of a box in view are outlines
    assert np.quantile(distances, 0.05) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("written", "shift", "silhouette"),
    [
        ("off", "off", "off"),
        (False, "off", "off"),
        ("auto", "auto", "auto"),
        ({"shift": False}, "off", "auto"),
        ({"shift": [1, -0.5], "silhouette": 2}, [1, -0.5], 2),
    ],
)
def test_calibration_in_the_scene(written, shift, silhouette):
    scene = {"source": {"reader": "synthetic"}, "calibration": written}
    config = check_scene(scene, Path("x.yaml")).calibration
    assert (config.shift, config.silhouette) == (shift, silhouette)


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        ({"shift": 3}, "calibration.shift: must be auto, off or [right, down] in pixels"),
        ({"shift": [1, 2, 3]}, "[right, down]"),
        ({"silhouette": "much"}, "calibration.silhouette: must be auto, off or a number of pixels"),
        ({"silhouette": 1e6}, "a number of pixels"),
        ({"shift": [float("nan"), 0]}, "[right, down]"),
        ({"width": 1}, "unknown key"),
    ],
)
def test_mistakes_in_the_calibration_are_named(calibration, words):
    with pytest.raises(UserError) as refused:
        check_scene({"source": {"reader": "synthetic"}, "calibration": calibration}, Path("x.yaml"))
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_a_network_from_a_file(prepare, tmp_path):
    onnx = {"model": str(write_sides(tmp_path / "dexined_sides.onnx"))}
    facts, views, _ = prepare({"detector": "onnx", "onnx": onnx}, calibration="off")
    assert facts["detector"] == "onnx" and facts["edgels"] > 0
    assert (np.abs(views.edgels.normals[:, 0]) > 0.5).mean() > 0.6  # vertical edges
    assert "names no ONNX file" in refusal(prepare, {"detector": "onnx"})
    assert "source.onnx.model" in refusal(prepare, {"detector": "onnx", "onnx": {"model": str(tmp_path / "no.onnx")}})


def test_a_synthetic_scene_can_be_traced_in_its_own_pictures(tmp_path):
    source = {"reader": "synthetic", "part": "block", "views": 4, "size": 120, "detector": "subpixel"}
    run = Run(check_scene({"name": "test", "source": source}, Path("x.yaml")), tmp_path, threads=1)
    facts = stage.prepare(run)
    assert facts["part"] == "block" and "line_width_px" not in facts and facts["edgels"] > 200
    assert (tmp_path / "truth.json").is_file()


@pytest.mark.slow(reason="calibrates many views")
def test_lines_that_leave_the_image_when_they_are_moved_are_no_trouble(prepare, folder):
    for path in (folder / "edge_test").iterdir():
        edge_map = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        edge_map[:, 79:81] = 255
        edge_map[79:81] = 255
        cv2.imwrite(str(path), edge_map)
    for shift in ([-9.0, -9.0], [9.0, 9.0], [0.0, -0.9]):
        facts, views, _ = prepare({"edges": "edge_test"}, calibration={"shift": shift, "silhouette": "off"})
        assert facts["edgels"] == len(views.edgels) and (views.edge_maps >= 128).any()


@pytest.mark.slow(reason="calibrates many views")
def test_a_calibration_where_there_is_none_is_refused(prepare):
    assert "our own detector has no bias" in refusal(prepare, calibration={"shift": [3, 3]})
    _, _, warnings = prepare({"edges": "edge_test", "thin": False}, calibration={"shift": [3, 3]})
    assert any("source.thin is false" in text for text in warnings)


def test_photographs_are_not_taken_for_edge_maps(prepare, folder):
    for path in (folder / "edge_test").iterdir():
        cv2.imwrite(str(path), np.where(np.arange(SIZE) < SIZE // 3, 255, 60)[None].repeat(SIZE, 0).astype(np.uint8))
    assert "px wide; are these photographs?" in refusal(prepare, {"edges": "edge_test"})


@pytest.mark.slow(reason="calibrates many views")
def test_a_nerf_folder_of_photographs_needs_no_key_to_say_so(prepare, folder, tmp_path):
    content = json.loads((folder / "meta_data.json").read_text())
    flip = np.diag([1.0, -1, -1, 1])
    frames = [
        {
            "file_path": f"./{kind}/{Path(frame['rgb_path']).stem}",
            "transform_matrix": (np.array(frame["camtoworld"]) @ flip).tolist(),
            "camera_intrinsics": frame["intrinsics"],
        }
        for kind in ("color",)
        for frame in content["frames"]
    ]
    (folder / "transforms_train.json").write_text(json.dumps({"frames": frames}))
    assert prepare({"reader": "nerf"})[0]["detector"] == "subpixel"
    for frame in frames:
        frame["file_path"] = frame["file_path"].replace("color", "edge_test")
    (folder / "transforms_train.json").write_text(json.dumps({"frames": frames}))
    assert prepare({"reader": "nerf"})[0]["detector"] == "maps"


def test_a_needless_calibration_is_refused_before_edges_are_looked_for(prepare, monkeypatch):
    monkeypatch.setattr("taichi_edges.detectors.subpixel.trace_pictures", lambda *_: pytest.fail("too late"))
    assert "our own detector has no bias" in refusal(prepare, calibration={"silhouette": 1.3})


@pytest.mark.slow(reason="calibrates many views")
def test_images_of_16_bits_calibrate_as_those_of_8_do(prepare, folder):
    known = {"edges": "edge_test"}
    shallow = prepare(known)[0]["calibration"]
    for path in (folder / "color").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path)).astype(np.uint16) * 257)
    assert prepare(known)[0]["calibration"] == shallow


@pytest.mark.slow(reason="calibrates many views")
@pytest.mark.parametrize("source", [{"edges": "edge_test"}, {"detector": "subpixel"}], ids=["calibrated", "subpixel"])
def test_the_sheet_shows_what_the_training_gets(prepare, monkeypatch, source):
    shown = {}
    monkeypatch.setattr(
        "taichi_edges.detectors.detection_sheet.write_detection_sheet",
        lambda path, views, **residuals: shown.update(views=views, residuals=residuals),
    )
    facts, views, _ = prepare({**source, "min_chain": 30})
    assert len(shown["views"].edgels) == len(views.edgels) == facts["edgels"] > 0
    np.testing.assert_array_equal(shown["views"].edgels.points, views.edgels.points)
    np.testing.assert_array_equal(shown["views"].edge_maps, views.edge_maps)
    assert set(shown["residuals"]) == ({"residuals", "on_silhouette"} if "calibration" in facts else set())
    assert all(len(values) == len(views.edgels) for values in shown["residuals"].values())
    assert ("edges" in source) == ("calibration" in facts)
