"""Photographs without poses: structure from motion of a scene whose cameras are known, and what to do without it."""

import json
import shutil
import struct
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
from told import Told

from taichi_edges.corridor import evaluate, prepare, sources
from taichi_edges.corridor.pipeline import Run
from taichi_edges.errors import UserError
from taichi_edges.readers import photogrammetry, photos
from taichi_edges.readers.images import read_grey
from taichi_edges.readers.photogrammetry import image_pairs
from taichi_edges.readers.photos import posed_photos, read_photos
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.synthetic.rendering import look_at
from taichi_edges.views.cameras import invert_pose
from taichi_edges.views.picture_sizes import picture_size

SIZE, FOCAL = (320, 240), 330.0
VIEWS = 6


def texture(generator, side=512):
    """(side, side) uint8 of blobs of all sizes."""
    layers = [generator.normal(0, 1, (side >> shift, side >> shift)).astype(np.float32) for shift in range(2, 7)]
    mixed = sum(cv2.resize(layer, (side, side), interpolation=cv2.INTER_CUBIC) for layer in layers)
    return np.clip(128 + 40 * mixed, 0, 255).astype(np.uint8)


def corner_of_a_room(pose, textures):
    """(H, W) uint8: three square walls with textures that meet at the origin, from inside. pose: world_to_camera."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([(u - 159.5) / FOCAL, (v - 119.5) / FOCAL, np.ones(u.shape)], axis=-1) @ pose[:, :3]
    centre = invert_pose(pose)[:, 3]
    picture = np.full(u.shape, 90, np.uint8)
    for axis, wall in enumerate(textures):
        hits = centre + rays * (-centre[axis] / rays[..., axis])[..., None]
        along = np.delete(hits, axis, axis=-1).astype(np.float32)
        on = ((along > 0) & (along < 1)).all(axis=-1) & (rays[..., axis] < 0)
        painted = cv2.remap(wall, along * np.float32(511), None, cv2.INTER_LINEAR)
        picture[on] = painted[on]
    return picture


@pytest.fixture(scope="module")
def album(tmp_path_factory):
    """A folder of VIEWS photographs of the corner, and one of something else; world_to_camera by name."""
    folder, generator = tmp_path_factory.mktemp("album"), np.random.default_rng(5)
    textures = [texture(generator) for _ in range(3)]
    poses = {}
    for view, angle in enumerate(np.radians(np.linspace(22, 68, VIEWS))):
        centre = 2.2 * np.array([np.cos(angle), np.sin(angle), 0.55 + 0.1 * (view % 2)])
        name = f"photo {view}"
        poses[name] = look_at(centre, np.array([0.3, 0.3, 0.35]))
        cv2.imwrite(str(folder / f"{name}.png"), corner_of_a_room(poses[name], textures))
    cv2.imwrite(str(folder / "thumb.png"), cv2.GaussianBlur(textures[0], (0, 0), 9)[: SIZE[1], : SIZE[0]])
    return folder, poses


def config_of(folder, **source):
    scene = {"source": {"reader": "images", "path": str(folder), **source}}
    return check_scene(scene, Path("test.yaml")).source


def posed(folder, cache, threads=2, **source):
    """The posed Frames and what was said."""
    told, config = Told(), config_of(folder, **source)
    frames = read_photos(folder, config)
    return posed_photos(frames, folder, config, cache, 0, threads, told), told


@pytest.fixture(scope="module")
def solved(album, tmp_path_factory):
    cache = tmp_path_factory.mktemp("cache")
    return *posed(album[0], cache), cache


def test_cameras_are_where_the_photographs_were_taken(album, solved):
    frames, told, _ = solved
    assert frames.names == sorted(album[1])  # but not the one of something else
    centres = np.stack(frames.camera_to_world)[:, :3, 3]
    truth = np.array([invert_pose(album[1][name])[:, 3] for name in frames.names])
    aligned = similar(centres, truth)
    # 240 rows at 2.4 units of depth: a pixel is 0.007 units; the baseline is 1.7.
    assert np.linalg.norm(aligned(centres) - truth, axis=1).max() < 0.03
    walls = aligned(frames.points)
    assert np.median(np.abs(walls).min(axis=1)) < 0.007 and len(walls) > 100
    assert any("6 of 7 photographs" in text and "thumb.png" in text for text in told.warnings)
    assert any("scale and axes are its own" in text for text in told.notes)
    assert frames.box is not None and all(lens.model == "SIMPLE_RADIAL" for lens in frames.lenses)


def similar(points, targets):
    """The similarity, a function, that brings (n, 3) points onto the targets best (Umeyama 1991)."""
    a, b = points - points.mean(axis=0), targets - targets.mean(axis=0)
    u, stretch, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = (u * signs) @ vt, (stretch * signs).sum() / (a**2).sum()
    return lambda x: scale * (x - points.mean(axis=0)) @ rotation.T + targets.mean(axis=0)


def test_the_same_photographs_are_not_solved_again(album, solved, monkeypatch):
    monkeypatch.setattr(photos, "solve_poses", None)  # whoever calls it, fails
    again, _ = posed(album[0], solved[2])
    assert (np.stack(again.camera_to_world) == np.stack(solved[0].camera_to_world)).all()
    with pytest.raises(TypeError):
        told, config = Told(), config_of(album[0])
        posed_photos(read_photos(album[0], config), album[0], config, solved[2], 1, 2, told)  # another seed
    monkeypatch.setattr(photos, "colmap_version", lambda: "another")
    with pytest.raises(TypeError):
        posed(album[0], solved[2])


def test_threads_and_repetition_do_not_change_a_bit(album, solved, tmp_path):
    other, _ = posed(album[0], tmp_path, threads=1)
    assert (np.stack(other.camera_to_world) == np.stack(solved[0].camera_to_world)).all()
    assert (other.points == solved[0].points).all() and other.lenses == solved[0].lenses


def test_edges_are_prepared_from_photographs_alone(album, solved, tmp_path):
    shutil.copytree(solved[2], tmp_path / "run" / "sfm")
    scene = {"name": "album", "source": {"reader": "images", "path": str(album[0])}}
    told = Told()
    run = Run(check_scene(scene, Path("album.yaml")), tmp_path / "run", threads=2, progress=told)
    facts = prepare.prepare(run)
    assert facts["views"] + len(facts["held_out"]) == VIEWS and facts["box_from"] == "reader" and facts["edgels"] > 1000
    assert "seeds.ply" in facts["files"] and (run.folder / "undistorted" / "images" / "photo 0.png").is_file()
    assert any(
        str(path).endswith("thumb.png") for path in sources.source_files(run)
    )  # it may register when others change


def test_a_note_on_how_the_camera_was_held_turns_no_pixel(tmp_path):
    """COLMAP and OpenCV must see the same pixels; EXIF's orientation 6 asks viewers for a quarter turn."""
    picture = cv2.imencode(".jpg", np.zeros((40, 60), np.uint8))[1].tobytes()
    tag = struct.pack(">HHHIHH", 1, 0x112, 3, 1, 6, 0)  # one entry: orientation, a short, one of them
    note = b"Exif\0\0MM\0*\0\0\0\x08" + tag + bytes(4)
    path = tmp_path / "a.jpg"
    path.write_bytes(picture[:2] + b"\xff\xe1" + struct.pack(">H", len(note) + 2) + note + picture[2:])
    assert cv2.imread(str(path)).shape[:2] == (60, 40)  # the note is understood, where it is heeded
    lens = pycolmap.infer_camera_from_image(str(path))
    assert (lens.width, lens.height) == picture_size(path) == (60, 40)
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape[:2] == read_grey(path).shape == (40, 60)


def test_photographs_that_show_nothing_in_common_are_refused_with_advice(tmp_path, generator):
    for view in range(3):
        cv2.imwrite(str(tmp_path / f"{view}.png"), texture(generator)[:120, :160])
    with pytest.raises(UserError, match="only 0 of 3 photographs .* overlap by 60 to 80 %") as refused:
        posed(tmp_path, tmp_path / "cache")
    assert "\n" not in str(refused.value)


def test_too_few_photographs_are_refused(tmp_path):
    for view in range(2):
        cv2.imwrite(str(tmp_path / f"{view}.png"), np.zeros((9, 9), np.uint8))
    with pytest.raises(UserError, match="2 photographs are too few"):
        posed(tmp_path, tmp_path / "cache")


def test_a_folder_without_images_is_refused_and_what_it_holds_is_said(tmp_path):
    with pytest.raises(UserError, match="no PNG, JPEG or TIFF image here, it is empty"):
        read_photos(tmp_path, config_of(tmp_path))
    (tmp_path / "a.HEIC").write_bytes(b"")
    with pytest.raises(UserError, match="files of the kinds .HEIC; convert them"):
        read_photos(tmp_path, config_of(tmp_path))


def test_masked_parts_of_photographs_have_no_say_in_where_they_were_taken(album, solved, tmp_path):
    """The textures are kept on two walls of three."""
    folder, poses = album
    for name in poses:
        kept = corner_of_a_room(poses[name], [np.full((512, 512), grey, np.uint8) for grey in (255, 255, 0)])
        (tmp_path / "masks").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), np.where(kept == 255, 255, 0))
        (tmp_path / f"{name}.png").write_bytes((folder / f"{name}.png").read_bytes())
    frames, _ = posed(tmp_path, tmp_path / "cache")
    aligned = similar(
        np.stack(frames.camera_to_world)[:, :3, 3], np.array([invert_pose(poses[n])[:, 3] for n in frames.names])
    )
    points = aligned(frames.points)
    on_third = (np.abs(points[:, 2]) < 0.02) & (points[:, :2] > 0.06).all(axis=1)
    assert len(points) > 50 and on_third.mean() < 0.02


def test_masks_and_edge_maps_below_the_folder_are_no_photographs(tmp_path):
    for name in ("a/1.jpg", "b/1.jpg", "masks/a/1.png", "edges/a/1.png", ".thumbs/1.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.zeros((9, 9), np.uint8))
    frames = read_photos(tmp_path, config_of(tmp_path, edges="edges"))
    assert frames.names == ["a/1", "b/1"]
    assert frames.mask_paths == [tmp_path / "masks" / "a" / "1.png", ""]
    assert frames.edge_paths[0] == tmp_path / "edges" / "a" / "1.png"


def test_cameras_are_shared_within_a_folder_by_photographs_of_one_size(tmp_path):
    for name, shape in (("a/1.png", (9, 12)), ("a/2.png", (9, 12)), ("a/3.png", (12, 9)), ("b/4.png", (9, 12))):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.zeros(shape, np.uint8))
    groups = photos.by_camera(tmp_path, ["a/1.png", "a/2.png", "a/3.png", "b/4.png"], 1)
    assert groups == [["a/1.png", "a/2.png"], ["a/3.png"], ["b/4.png"]]


def test_every_pair_of_few_photographs_is_matched_and_of_many_a_number_that_grows_linearly():
    assert len(image_pairs([str(i) for i in range(80)])) == 80 * 79 / 2
    pairs = image_pairs([str(i) for i in range(500)])
    assert len(set(pairs)) == len(pairs) < 500 * 20
    assert {("0", "1"), ("0", "10"), ("100", "356")} <= set(pairs)


def test_a_damaged_record_is_no_obstacle(album, solved, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(photos, "solve_poses", lambda *arguments: calls.append(arguments) or [])
    (tmp_path / "photographs.json").write_text("{")
    with pytest.raises(UserError, match="only 0 of 7"):
        posed(album[0], tmp_path)
    assert len(calls) == 1 and json.loads((tmp_path / "photographs.json").read_text())["registered"] == []


def test_the_module_is_imported_without_pycolmap():
    assert "pycolmap" not in vars(photogrammetry)


def test_files_that_are_no_images_are_left_out_by_name(album, tmp_path, monkeypatch):
    for name in album[1]:
        shutil.copy(album[0] / f"{name}.png", tmp_path)
    (tmp_path / "notes.tif").write_text("no picture")
    (tmp_path / "text.jpg").write_bytes(b"no picture\xff\xd9")
    given = []
    monkeypatch.setattr(photos, "solve_poses", lambda images, names, groups, *rest: given.extend(names) or [])
    for _ in range(2):  # the second time as it is recorded
        told, config = Told(), config_of(tmp_path)
        with pytest.raises(UserError, match="only 0 of 6"):
            posed_photos(read_photos(tmp_path, config), tmp_path, config, tmp_path / "cache", 0, 2, told)
        assert told.warnings == ["2 of 8 photographs are no images that can be read, left out: notes.tif, text.jpg"]
    assert given == sorted(f"{name}.png" for name in album[1])


@pytest.mark.parametrize("damage", ["cut", "lost", "another"])
def test_a_damaged_model_of_an_earlier_run_is_made_anew(album, solved, tmp_path, monkeypatch, damage):
    shutil.copytree(solved[2], tmp_path / "cache")
    path, whole = tmp_path / "cache" / "sparse" / "images.bin", solved[2] / "sparse" / "images.bin"
    if damage == "lost":
        path.unlink()
    else:
        path.write_bytes(whole.read_bytes()[:-100] if damage == "cut" else whole.read_bytes()[:-1] + b"\1")

    def remade(images, names, groups, cache, *rest):
        shutil.copy(whole, path)
        return json.loads((cache / "photographs.json").read_text())["registered"]

    monkeypatch.setattr(photos, "solve_poses", remade)
    frames, told = posed(album[0], tmp_path / "cache")
    assert frames.names == solved[0].names and any("structure from motion from 7" in text for text in told.notes)


def test_maps_for_a_scan_are_found_where_photographs_have_no_poses(album, solved, tmp_path):
    """They go the way of the photographs: undistorted with the lenses that structure from motion has found."""
    for folder in ("photos", "maps"):
        shutil.copytree(album[0], tmp_path / folder)
    shutil.copytree(solved[2], tmp_path / "run" / "sfm")
    source = {"reader": "images", "path": str(tmp_path), "images": "photos"}
    evaluation = {"kind": "scan", "truth": "scan.ply", "scan": {"edges": "maps"}}
    scene = {"name": "album", "source": source, "evaluation": evaluation}
    run = Run(check_scene(scene, Path("album.yaml")), tmp_path / "run", threads=2, progress=Told())
    frames = sources.posed_frames(run, sources.listed_frames(run))
    names = frames.names[1:]  # prepare has left one out
    size = photogrammetry.undistorted(frames.lenses[0])[1]
    views = SimpleNamespace(names=names[:-1], edge_maps=np.zeros((1, *size[::-1]), np.uint8))
    maps = evaluate.scan_maps(run, views, SimpleNamespace(names=names[-1:]))
    assert list(maps) == names and all(found.shape == size[::-1] and found.max() > 100 for found in maps.values())
    made = run.path("undistorted_for_scan")
    assert len(list(made.glob("edges/*.png"))) == len(names) and not (made / "images").exists()
