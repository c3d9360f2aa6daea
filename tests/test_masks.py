"""Masks: what they keep, whatever finds the edges, and how mistakes in them are named."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colmap_projects import camera, picture_of_polygon, write_model
from onnx_networks import write_sides

from taichi_edges.corridor import prepare
from taichi_edges.corridor.pipeline import Run
from taichi_edges.detectors.masks import EMPTY_RIM_PX, RIM_PX, kept_area, within_masks
from taichi_edges.errors import UserError
from taichi_edges.progress import Progress
from taichi_edges.readers.frames import Frames
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import read_views

LEFT = np.array([[-0.4, -0.3], [-0.1, -0.3], [-0.1, 0.3], [-0.4, 0.3]])
RIGHT = LEFT + [0.5, 0]
MIDDLE = 160  # px, between the two


class Warnings(Progress):
    """Keeps the warnings."""

    def __init__(self):
        self.texts = []

    def warn(self, text):
        self.texts.append(text)


def frames_with(tmp_path, masks=(), valid=()):
    """Frames of as many views as there are masks, None for a view without one."""
    paths = {}
    for kind, images in (("mask", masks), ("valid", valid)):
        paths[kind] = ["" if image is None else tmp_path / f"{kind}{i}.png" for i, image in enumerate(images)]
        for path, image in zip(paths[kind], images, strict=True):
            if image is not None:
                cv2.imwrite(str(path), image)
    names = [f"view{i}" for i in range(max(len(masks), len(valid)))]
    frames = Frames(tmp_path / "images.bin", names, names, names, [None] * len(names), [np.eye(4)] * len(names), False)
    return replace(frames, mask_paths=paths["mask"], valid_paths=paths["valid"])


def edgels_at(*views):
    return Edgels.of_views((points, np.tile([1.0, 0], (len(points), 1)), np.ones(len(points))) for points in views)


def disc(radius=30, value=255, dtype=np.uint8):
    return cv2.circle(np.zeros((100, 120), dtype), (60, 50), radius, value, -1)


def test_a_mask_keeps_what_lies_on_its_border_and_drops_what_does_not(tmp_path):
    frames = frames_with(tmp_path, [disc(), None])
    points = np.array([[60, 50], [60 + 30 + RIM_PX - 1, 50], [60 + 30 + RIM_PX + 2, 50], [0, 0]], np.float32)
    kept = within_masks(edgels_at(points, points), frames, (120, 100), Progress())
    assert kept.of_view(0)[0].tolist() == points[:2].tolist()
    assert kept.of_view(1)[0].tolist() == points.tolist()


def test_what_undistortion_left_empty_and_its_border_is_dropped_and_the_borders_of_the_picture_stay(tmp_path):
    valid = np.full((100, 120), 255, np.uint8)
    valid[:, 80:] = 0
    area = kept_area("", frames_with(tmp_path, valid=[valid]).valid_paths[0], (120, 100))
    assert area[:, : 80 - EMPTY_RIM_PX].all() and not area[:, 80 - EMPTY_RIM_PX :].any()


@pytest.mark.parametrize("mask", [disc(), np.dstack([disc()] * 3), disc(value=65535, dtype=np.uint16), disc(value=128)])
def test_masks_of_any_depth_mean_the_same(tmp_path, mask):
    frames = frames_with(tmp_path, [mask])
    expected = kept_area(frames_with(tmp_path, [disc()]).mask_paths[0], "", (120, 100))
    assert (kept_area(frames.mask_paths[0], "", (120, 100)) == expected).all()


def test_a_mask_of_another_size_is_brought_to_the_picture(tmp_path):
    twice = cv2.resize(disc(), (240, 200), interpolation=cv2.INTER_NEAREST)
    area = kept_area(frames_with(tmp_path, [twice]).mask_paths[0], "", (120, 100))
    assert (area == kept_area(frames_with(tmp_path, [disc()]).mask_paths[0], "", (120, 100))).mean() > 0.99


def test_wrong_masks_are_refused_in_one_line(tmp_path):
    points = np.array([[60.0, 50]])
    for mask, says in (
        (np.zeros((100, 120), np.uint8), "the masks leave no edge in any view"),
        (disc(value=1), "images.bin: source.masks: .*: invert or scale them"),  # not where undistortion put it
        (np.zeros((100, 100), np.uint8), "the mask is 100 x 100 px, its image 120 x 100 px"),
    ):
        with pytest.raises(UserError, match=says):
            within_masks(edgels_at(points), frames_with(tmp_path, [mask]), (120, 100), Progress())
    frames = frames_with(tmp_path, [disc()])
    Path(frames.mask_paths[0]).write_bytes(Path(frames.mask_paths[0]).read_bytes()[:50])
    with pytest.raises(UserError, match="truncated or not an image"):
        within_masks(edgels_at(points), frames, (120, 100), Progress())


def test_a_view_that_is_masked_out_is_named(tmp_path):
    points, told = np.array([[60.0, 50]]), Warnings()
    within_masks(edgels_at(points, points), frames_with(tmp_path, [disc(), 0 * disc()]), (120, 100), told)
    assert told.texts == ["1 of 2 masks leave no edge: view1"]


@pytest.fixture
def project(tmp_path):
    """Two rectangles through a lens with distortion; masks that keep the left one; maps of both."""
    names, lens = ["0.png", "1.png", "2.png"], camera("OPENCV")
    picture = np.maximum(picture_of_polygon(lens, LEFT), picture_of_polygon(lens, RIGHT))
    mask = np.where(picture_of_polygon(lens, LEFT) > 150, 255, 0).astype(np.uint8)
    pictures = {
        "images": picture,
        "masks": mask,
        "edges": cv2.morphologyEx(picture, cv2.MORPH_GRADIENT, np.ones((3, 3))),
    }
    for kind, image in pictures.items():
        (tmp_path / kind).mkdir()
        for view, name in enumerate(names):
            image[0, 0] = view  # no two files are the same
            cv2.imwrite(str(tmp_path / kind / name), image)
    points = np.column_stack([np.tile(LEFT, (3, 1)), np.ones(12)]) * np.repeat([0.9, 1, 1.1], 4)[:, None]
    poses = np.tile(np.eye(3, 4), (3, 1, 1))
    poses[:, 0, 3] = 0, 0.01, 0.02
    write_model(tmp_path / "sparse", names, [lens] * 3, poses, points)
    return tmp_path


@pytest.mark.parametrize(
    "source",
    [
        {"detector": "subpixel"},
        {"edges": "edges"},
        {"edges": "edges", "thin": False},
        {"detector": "onnx", "onnx": {"model": "dexined_sides.onnx"}},
    ],
    ids=["subpixel", "maps", "maps as they are", "onnx"],
)
def test_every_detector_heeds_the_masks(project, tmp_path, source):
    write_sides(tmp_path / "dexined_sides.onnx")
    (tmp_path / "run").mkdir()
    config = check_scene(
        {
            "name": "t",
            "box": [[-1, -1, 0.5], [1, 1, 1.5]],
            "calibration": "off",
            "source": {"reader": "colmap", "path": str(project), **source},
        },
        Path("t.yaml"),
    )
    facts = prepare.prepare(Run(config, tmp_path / "run", data_root=tmp_path, threads=2))
    views = read_views(tmp_path / "run" / "views.npz")
    assert facts["masked_edgels"] > 100
    for view in range(3):
        points = views.edgels.of_view(view)[0]
        assert len(points) > 100 and (points[:, 0] < MIDDLE).all()
        assert (views.edge_maps[view][:, :MIDDLE] >= 128).any() and not (views.edge_maps[view][:, MIDDLE:] >= 128).any()
