"""IDR's layout: projections taken apart whatever their scale, files matched, one line for every mistake."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from taichi_edges.errors import UserError
from taichi_edges.readers.idr import decompose, read_idr
from taichi_edges.scene.settings import SourceConfig
from taichi_edges.views.cameras import inside_image, invert_pose, project

VIEWS, WIDTH, HEIGHT = 4, 40, 30
RADIUS, CENTRE = 250.0, np.array([-27.0, -44.0, 740.0])  # millimetres, as in DTU


def random_camera(generator):
    """Intrinsics (3, 3) without skew and camera-to-world (4, 4), anywhere, looking anywhere."""
    intrinsics = np.array([[generator.uniform(20, 3000), 0, generator.uniform(-50, 900)], [0, 0, 0], [0, 0, 1.0]])
    intrinsics[1, 1:] = generator.uniform(20, 3000), generator.uniform(-50, 900)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=generator).as_matrix()
    pose[:3, 3] = generator.uniform(-1000, 1000, 3)
    return intrinsics, pose


@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-3, -2.5e4])
def test_a_projection_of_any_scale_and_sign_is_taken_apart(generator, factor):
    for _ in range(50):
        intrinsics, pose = random_camera(generator)
        found, found_pose = decompose(factor * intrinsics @ invert_pose(pose))
        np.testing.assert_allclose(found, intrinsics, rtol=1e-8, atol=1e-6)
        np.testing.assert_allclose(found_pose, pose, atol=1e-6)
        assert np.linalg.det(found_pose[:3, :3]) == pytest.approx(1.0)


def test_the_rounding_of_a_stored_matrix_is_no_skew(generator):
    intrinsics, pose = np.array([[2892.3, 0, 823.2], [0, 2883.2, 619.1], [0, 0, 1]]), random_camera(generator)[1]
    assert decompose((intrinsics @ invert_pose(pose)).astype(np.float32).astype(np.float64))[0][0, 1] == 0
    skewed = intrinsics + [[0, 3.0, 0], [0, 0, 0], [0, 0, 0]]
    assert decompose(skewed @ invert_pose(pose))[0][0, 1] == pytest.approx(3.0)


class Folder:
    """A folder of that layout, to be spoilt and read; cameras: {key: array} of its npz."""

    def __init__(self, path, generator):
        self.path, self.cameras, self.truth = path, {}, []
        scale = np.diag([RADIUS, RADIUS, RADIUS, 1.0])
        scale[:3, 3] = CENTRE
        for view in range(VIEWS):
            self.image("image", f"{view:06d}.jpg")
            self.image("mask", f"{view:03d}.png")
            self.image("edge_test", f"{view:06d}.png")
            intrinsics, pose = random_camera(generator)
            self.truth.append((intrinsics, pose))
            world = np.eye(4)
            world[:3] = intrinsics @ invert_pose(pose)
            self.cameras |= {f"world_mat_{view}": world, f"scale_mat_{view}": scale, f"world_mat_inv_{view}": world}

    def image(self, folder, name):
        (self.path / folder).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(self.path / folder / name), np.zeros((HEIGHT, WIDTH), np.uint8))

    def read(self, listing="cameras_sphere.npz", **source):
        np.savez(self.path / listing, **self.cameras)
        return read_idr(self.path, SourceConfig(reader="idr", path="unused", **source))

    def refusal(self, **options):
        with pytest.raises(UserError) as refused:
            self.read(**options)
        assert "\n" not in str(refused.value)
        return str(refused.value)


@pytest.fixture
def folder(tmp_path, generator):
    return Folder(tmp_path / "scan", generator)


def test_cameras_are_in_the_frame_of_the_world(folder, generator):
    frames = folder.read()
    points = generator.normal(size=(20, 3)) + CENTRE
    for view, (intrinsics, pose) in enumerate(folder.truth):
        expected, _ = project(points, intrinsics, invert_pose(pose))
        found, _ = project(points, frames.intrinsics[view](WIDTH, HEIGHT), invert_pose(frames.camera_to_world[view]))
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-4)


def test_the_box_is_that_of_the_sphere(folder):
    np.testing.assert_allclose(folder.read().box, [CENTRE - RADIUS, CENTRE + RADIUS])


@pytest.mark.parametrize("listing", ["cameras.npz", "cameras_large.npz"])
def test_other_names_of_the_cameras_and_of_the_images_are_known(folder, listing):
    (folder.path / "image").rename(folder.path / "rgb")
    assert folder.read(listing).names == [f"{view:06d}" for view in range(VIEWS)]


def test_a_camera_file_can_be_named(folder):
    folder.read()
    listing = folder.path / "cameras_large.npz"
    np.savez(listing, **{**folder.cameras, "scale_mat_0": 2 * folder.cameras["scale_mat_0"]})
    assert read_idr(listing, SourceConfig(path="unused")).where == listing


def test_masks_and_maps_are_matched_by_name_number_or_order(folder):
    def matched(kind):
        return [path.name for path in getattr(folder.read(edges="edge_test"), kind)]

    numbered = [f"{view:03d}.png" for view in range(VIEWS)]
    assert matched("mask_paths") == numbered  # 000.png belongs to 000000.jpg
    assert matched("edge_paths") == [f"{view:06d}.png" for view in range(VIEWS)]
    for path in (folder.path / "image").iterdir():
        path.rename(path.with_name(f"photo_{int(path.stem) + 1}.jpg"))  # numbered otherwise, in the same order
    for path in (folder.path / "mask").iterdir():
        path.rename(path.with_name(f"{'abcd'[int(path.stem)]}.png"))
    assert matched("mask_paths") == ["a.png", "b.png", "c.png", "d.png"]


def test_a_missing_mask_is_named_unless_its_view_is_skipped(folder):
    (folder.path / "mask" / "002.png").unlink()
    message = folder.refusal()
    assert message.startswith(f"{folder.path / 'mask'}: 1 of 4 views have no mask here: 000002; ")
    assert len(folder.read(skip=["000002"]).mask_paths) == VIEWS


def test_masks_of_another_number_and_other_names_are_refused(folder):
    for path in (folder.path / "mask").iterdir():
        path.rename(path.with_name(f"{'abcd'[int(path.stem)]}.png"))
    (folder.path / "mask" / "a.png").unlink()
    assert "3 masks for 4 images, and they are not named alike" in folder.refusal()


def test_without_masks_there_are_none(folder):
    for path in (folder.path / "mask").iterdir():
        path.unlink()
    assert not any(folder.read().mask_paths)


def test_an_image_without_its_camera_is_refused(folder):
    (folder.path / "image" / "000001.jpg").unlink()
    assert "4 cameras (world_mat_i) for 3 images in image" in folder.refusal()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda cameras: cameras.pop("scale_mat_0"), "scale_mat_0 is missing"),
        (lambda cameras: cameras.update(world_mat_9=cameras.pop("world_mat_2")), "world_mat_2, of 000002, is missing"),
        (lambda cameras: cameras["world_mat_1"].__setitem__((0, 0), np.nan), "world_mat_1, of 000001, is not finite"),
        (lambda cameras: cameras.update(world_mat_1=np.zeros((4, 4))), "world_mat_1, of 000001, is no camera's"),
        (lambda cameras: cameras.update(world_mat_1=np.eye(3)), "world_mat_1, of 000001, must be a 4 x 4 matrix"),
        (lambda cameras: cameras.update(world_mat_1="text"), "world_mat_1, of 000001, is not a matrix of numbers"),
        (lambda cameras: cameras.update(scale_mat_0=np.zeros((4, 4))), "scale_mat_0 holds values that are no sphere's"),
        (lambda cameras: cameras.clear(), "holds no world_mat_0"),
    ],
    ids=["no scale", "lost", "nan", "zero", "3 x 3", "text", "flat", "empty"],
)
def test_broken_cameras_are_named(folder, change, says):
    change(folder.cameras)
    message = folder.refusal()
    assert message.startswith(f"{folder.path / 'cameras_sphere.npz'}: ") and says in message


def test_a_broken_camera_of_a_view_to_skip_is_no_trouble(folder):
    folder.cameras["world_mat_1"][:] = np.nan
    assert len(folder.read(skip=["000001"]).names) == VIEWS


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 half an archive", b"nothing of that kind", "array"])
def test_a_file_that_is_no_archive_is_refused(folder, content):
    listing = folder.path / "cameras_sphere.npz"
    if content == "array":
        with open(listing, "wb") as file:
            np.save(file, np.eye(4))
    else:
        listing.write_bytes(content)
    with pytest.raises(UserError, match="not an .npz archive that can be read"):
        read_idr(folder.path, SourceConfig(path="unused"))


def test_a_truncated_archive_is_refused(folder):
    folder.read()
    listing = folder.path / "cameras_sphere.npz"
    listing.write_bytes(listing.read_bytes()[:-200])
    with pytest.raises(UserError, match="not an .npz archive that can be read"):
        read_idr(folder.path, SourceConfig(path="unused"))


def test_missing_cameras_and_images_are_named(folder):
    with pytest.raises(UserError, match="cameras_sphere.npz: not found; IDR's folders hold"):
        read_idr(folder.path, SourceConfig(path="unused"))
    for path in (folder.path / "image").iterdir():
        path.unlink()
    assert (
        "no images in image or images or rgb; set source.images (there are: edge_test, image, mask)" in folder.refusal()
    )


def test_scan37_is_read():
    root = os.environ.get("TAICHI_EDGES_DATA")
    if not root or not (Path(root) / "dtu" / "scan37").is_dir():
        pytest.skip("TAICHI_EDGES_DATA is not set: scan 37 is not here")
    frames = read_idr(Path(root) / "dtu" / "scan37", SourceConfig(path="unused", edges="edge_PidiNet"))
    assert len(frames.names) == 49 and frames.mask_paths[7].name == "007.png"
    side = frames.box[1] - frames.box[0]
    np.testing.assert_allclose(side, 512.1, atol=0.1)  # millimetres
    # DTU's robot looks at the object: the box's centre is in every image.
    for intrinsics, pose in zip(frames.intrinsics, frames.camera_to_world, strict=True):
        pixel, depth = project(frames.box.mean(axis=0)[None], intrinsics(1600, 1200), invert_pose(pose))
        assert depth[0] > 500 and inside_image(pixel, 1600, 1200)[0]
