"""COLMAP projects: which model, which images, masks, points and box; and that edges come out in COLMAP's frame."""

import re
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
from colmap_projects import LENSES, SIZE, camera, picture_of, write_model
from told import Told

from taichi_edges.corridor import evaluate, prepare, train
from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.pipeline import Run, run_stages
from taichi_edges.errors import UserError
from taichi_edges.geometry.edge_set import read_edges
from taichi_edges.readers.colmap import read_colmap
from taichi_edges.readers.photogrammetry import Lens, undistorted
from taichi_edges.readers.scene_box import scene_box
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import look_at, ring_cameras
from taichi_edges.synthetic.visibility import ray_scene
from taichi_edges.views.cameras import invert_pose
from taichi_edges.views.views import read_views

VIEWS = 6


def scene(folder, source=None, **sections):
    source = {"reader": "colmap", "path": str(folder), **(source or {})}
    return check_scene({"name": "test", "source": source, **sections}, Path("test.yaml"))


def read(folder, **source):
    return read_colmap(Path(folder), scene(folder, source).source)


def refusal(folder, **source):
    with pytest.raises(UserError) as refused:
        read(folder, **source)
    return str(refused.value)


@pytest.fixture
def poses():
    """(V, 3, 4) world_to_camera."""
    return ring_cameras(VIEWS, 200)[1]


@pytest.fixture
def points(generator):
    return generator.uniform(0.2, 0.8, (60, 3))


@pytest.fixture
def project(tmp_path, poses, points):
    """project(names, where, text, cameras): a COLMAP project with blank images; its folder."""

    def make(names=None, where="sparse/0", text=False, cameras=None, count=VIEWS, images=True):
        names = names or [f"{view:04d}.jpg" for view in range(count)]
        cameras = cameras or [camera()] * len(names)
        write_model(tmp_path / where, names, cameras, poses[: len(names)], points, text)
        for name in names if images else ():
            path = tmp_path / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.zeros(SIZE[::-1], np.uint8))
        return tmp_path

    return make


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("where", ["sparse/0", "sparse", "", "colmap/sparse/0"])
def test_a_model_is_found_and_read_as_text_and_binary(project, poses, points, text, where):
    folder = project(where=where, text=text)
    frames = read(folder)
    assert frames.where == folder / where / ("images.txt" if text else "images.bin") and not frames.notes
    assert frames.names == [f"{view:04d}" for view in range(VIEWS)] and not frames.opengl
    assert np.allclose(invert_pose(np.stack(frames.camera_to_world)), poses, atol=1e-9)
    assert np.allclose(np.sort(frames.points, axis=0), np.sort(points, axis=0), atol=1e-9)
    assert all(lens.model == "OPENCV" and lens.params == LENSES["OPENCV"] for lens in frames.lenses)
    assert {path.stem for path in frames.files} >= {"cameras", "images", "points3D"}


@pytest.mark.parametrize("model", LENSES)
def test_every_camera_model_is_read_as_it_was_written(project, model):
    frames = read(project(cameras=[camera(model)] * VIEWS))
    lens = frames.lenses[0]
    assert (lens.model, lens.width, lens.height) == (model, *SIZE) and lens.params == LENSES[model]


def test_panoramas_are_refused_before_anything_else(project, tmp_path):
    folder = project(cameras=[camera("EQUIRECTANGULAR", size=(640, 320), params=(640, 320))] * VIEWS)
    (tmp_path / "run").mkdir()
    with pytest.raises(UserError, match="panorama"):
        prepare.prepare(Run(scene(folder), tmp_path / "run"))


def test_of_several_models_the_largest_is_taken_and_it_is_said(project):
    project(where="sparse/0", count=4, images=False)
    folder = project(where="sparse/1")
    frames = read(folder)
    assert len(frames.names) == VIEWS and frames.where.parent == folder / "sparse" / "1"
    assert "sparse/0 with 4, sparse/1 with 6; sparse/1 is used, source.model names another" in frames.notes[0]
    assert len(read(folder, model="sparse/0").names) == 4
    assert "sparse/7 holds no COLMAP model" in refusal(folder, model="sparse/7")


def test_images_of_two_folders_may_have_the_same_name(project):
    names = [f"cam{camera_number}/{view:04d}.jpg" for camera_number in (1, 2) for view in range(3)]
    folder = project(names)
    for name in names:
        path = (folder / "edges" / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros(SIZE[::-1], np.uint8))
    frames = read(folder, edges="edges")
    assert frames.names == [name.removesuffix(".jpg") for name in names]
    assert frames.edge_paths == [folder / "edges" / f"{name}.png" for name in frames.names]
    assert frames.image_paths == [folder / "images" / name for name in names]


def test_names_that_differ_in_their_suffix_alone_keep_it(project):
    assert read(project(["a.jpg", "a.png", "b.png"])).names == ["a.jpg", "a.png", "b.png"]


def test_missing_and_unregistered_images_are_named_and_left_out(project):
    folder = project()
    (folder / "images" / "0002.jpg").unlink()
    cv2.imwrite(str(folder / "images" / "blurred.jpg"), np.zeros((9, 9), np.uint8))
    frames = read(folder)
    assert frames.names == ["0000", "0001", "0003", "0004", "0005"] and len(frames.lenses) == 5
    missing, unregistered = frames.warnings
    assert "1 of 6 images" in missing and "0002.jpg" in missing
    assert "1 of 6 images have no pose" in unregistered and "blurred.jpg" in unregistered


def test_a_project_without_its_images_is_refused(project):
    assert "none of the model's images is there (e.g. 0000.jpg); set source.images" in refusal(project(images=False))


@pytest.mark.parametrize("suffix", [".jpg.png", ".png"])
def test_masks_are_found_by_either_name(project, suffix):
    folder = project()
    (folder / "masks").mkdir()
    for view in range(VIEWS - 1):
        cv2.imwrite(str(folder / "masks" / f"{view:04d}{suffix}"), np.full(SIZE[::-1], 255, np.uint8))
    frames = read(folder)
    assert frames.mask_paths == [*(folder / "masks" / f"{view:04d}{suffix}" for view in range(VIEWS - 1)), ""]
    assert "1 of 6 views have no mask" in frames.warnings[0] and "0005" in frames.warnings[0]
    assert not any(read(folder, masks="none").mask_paths)
    assert "mask_s is no folder" in refusal(folder, masks="mask_s")


@pytest.mark.parametrize("lost", ["cameras", "points3D"])
def test_half_a_model_is_refused_and_what_is_missing_named(project, lost):
    folder = project()
    (folder / "sparse" / "0" / f"{lost}.bin").unlink()
    assert f"a COLMAP model without {lost}.bin" in refusal(folder)


@pytest.mark.parametrize("damaged", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("text", [False, True])
def test_a_damaged_model_is_refused_in_one_line(project, damaged, text):
    folder = project(text=text)
    path = folder / "sparse" / "0" / f"{damaged}.{'txt' if text else 'bin'}"
    content = path.read_bytes()
    path.write_bytes(b"1 2 3 no numbers\n" if text else content[: len(content) // 2])
    assert "not a COLMAP model that can be read" in refusal(folder)


def test_a_model_without_points_needs_a_box_from_the_scene(tmp_path, poses):
    names = ["a.png", "b.png", "c.png"]
    write_model(tmp_path / "sparse", names, [camera("PINHOLE")] * 3, poses[:3], np.zeros((0, 3)))
    (tmp_path / "images").mkdir()
    for view, name in enumerate(names):
        picture = cv2.rectangle(np.zeros(SIZE[::-1], np.uint8), (100 + view, 70), (220, 170), 200, -1)
        cv2.imwrite(str(tmp_path / "images" / name), picture)
    (tmp_path / "run").mkdir()
    with pytest.raises(UserError, match="images.bin: the model has no points to tell where the scene is; set box"):
        prepare.prepare(Run(scene(tmp_path), tmp_path / "run"))
    with pytest.raises(UserError, match="train.seeds is 'points', but the model has none"):
        box = [[0, 0, 0], [1, 1, 1]]
        prepare.prepare(Run(scene(tmp_path, box=box, train={"seeds": "points"}), tmp_path / "run"))
    facts = prepare.prepare(Run(scene(tmp_path, box=[[0, 0, 0], [1, 1, 1]]), tmp_path / "run"))
    assert facts["box_from"] == "scene" and "seeds.ply" not in facts["files"]


def test_points_that_fit_badly_or_few_images_see_are_left_out(tmp_path, poses, points):
    names = [f"{view}.jpg" for view in range(VIEWS)]
    write_model(tmp_path / "sparse", names, [camera()] * VIEWS, poses, points)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse"))
    numbers = sorted(model.points3D)
    for number, point in zip(numbers[:5], [[2.0, 0, 0]] * 5, strict=True):
        model.points3D[number].xyz = point  # which no image shows there
    for number in numbers[5:9]:
        elements = [(element.image_id, element.point2D_idx) for element in model.points3D[number].track.elements]
        for element in elements[2:]:
            model.delete_observation(*element)
    model.update_point_3d_errors()
    model.write(str(tmp_path / "sparse"))
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.jpg"), np.zeros(SIZE[::-1], np.uint8))
    assert len(read(tmp_path).points) == len(points) - 9
    assert len(read(tmp_path, min_track=2).points) == len(points) - 5
    assert len(read(tmp_path, max_point_error=1e9).points) == len(points) - 4


def ring(count, radius, generator, outward=False):
    """(V, 4, 4) camera-to-world on a ring, looking at its centre or away from it."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2 * np.pi, count, endpoint=False), strict=True):
        centre = radius * np.array([np.cos(angle), np.sin(angle), 0.3])
        pose[:3] = np.array(invert_pose(look_at(centre, 2 * centre if outward else np.zeros(3))))
    return poses


def test_the_box_of_a_room_holds_its_walls_whichever_way_cameras_look(generator):
    walls = generator.uniform(-4, 4, (3000, 3)) * [1, 1, 0.3]
    side = generator.integers(0, 2, 3000)
    walls[np.arange(3000), side] = np.sign(walls[np.arange(3000), side]) * 4
    far = generator.normal(0, 60, (40, 3))  # through windows, and wrong
    for outward in (False, True):
        box = scene_box(np.concatenate([walls, far]), ring(12, 3.0, generator, outward))
        assert (box[0] <= [-4, -4, -1]).all() and (box[1] >= [4, 4, 1]).all()
        assert np.abs(box).max() < 7


def test_the_box_of_an_object_leaves_out_the_room_around_it(generator):
    thing = generator.uniform(-0.5, 0.5, (1500, 3))
    room = generator.uniform(-8, 8, (1500, 3))
    box = scene_box(np.concatenate([thing, room]), ring(20, 2.0, generator))
    assert (box[0] <= -0.5).all() and (box[1] >= 0.5).all()
    assert np.abs(box).max() < 2.0


def test_the_box_of_a_facade_holds_it_and_has_some_depth(generator):
    wall = generator.uniform([-10, -3, 0], [10, 3, 0.1], (2000, 3))
    poses = np.tile(np.diag([1.0, 1, 1, 1]), (8, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = np.linspace(-8, 8, 8), -7  # in a row, all looking straight at it
    box = scene_box(wall, poses)
    assert (box[0] <= [-10, -3, 0]).all() and (box[1] >= [10, 3, 0.1]).all()
    assert 0.5 < box[1, 2] - box[0, 2] < 4 and np.abs(box[:, 0]).max() < 12


def test_the_box_follows_the_points_scale_and_place(generator):
    points, poses = generator.normal(0, 1, (500, 3)), ring(12, 4.0, generator)
    box = scene_box(points, poses)
    moved = poses.copy()
    moved[:, :3, 3] = 1000 * poses[:, :3, 3] + [5, 6, 7]
    assert np.allclose(scene_box(1000 * points + [5, 6, 7], moved), 1000 * box + [5, 6, 7], rtol=1e-9)


def test_few_points_give_a_box_and_fewer_none(generator):
    points = generator.uniform(-1, 1, (25, 3))
    box = scene_box(points, ring(5, 3.0, generator))
    inside = ((points >= box[0]) & (points <= box[1])).all(axis=1)
    assert inside.mean() > 0.9
    assert scene_box(points[:5], ring(5, 3.0, generator)) is None


def test_views_that_look_away_from_a_box_nobody_has_set_are_left_out(tmp_path, generator):
    """Five cameras look at the object, one turns its back on it."""
    names = [f"{view}.png" for view in range(6)]
    poses = np.stack([invert_pose(pose) for pose in ring(6, 4.0, generator)])
    points = generator.uniform(-0.5, 0.5, (60, 3))
    write_model(tmp_path / "sparse", names, [camera("PINHOLE")] * 6, poses, points)
    poses[5, [0, 2]] *= -1  # turned about its y axis
    model = pycolmap.Reconstruction(str(tmp_path / "sparse"))
    model.frame(6).rig_from_world = pycolmap.Rigid3d(poses[5])
    model.write(str(tmp_path / "sparse"))
    (tmp_path / "images").mkdir()
    for view, name in enumerate(names):
        picture = cv2.rectangle(np.zeros(SIZE[::-1], np.uint8), (100 + view, 70), (220, 170), 200, -1)
        cv2.imwrite(str(tmp_path / "images" / name), picture)
    (tmp_path / "run").mkdir()
    told = Told()
    facts = prepare.prepare(Run(scene(tmp_path, {"max_point_error": 1e9}), tmp_path / "run", progress=told))
    assert facts["views"] == 5 and facts["box_from"] == "reader"
    assert any("1 of 6 views see nothing of the scene box, left out: 5" in text for text in told.warnings)


@pytest.fixture(scope="module")
def part_project(tmp_path_factory):
    """A project of the block in a frame turned, moved and 40 times as large, seen through a lens with distortion.

    Returns its folder, the Part, and the function from the part's frame to COLMAP's.
    """
    folder, part, size = tmp_path_factory.mktemp("part"), PARTS["block"](), 260
    angle = 0.7
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turn = turn @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    scale, offset = 40.0, np.array([100.0, -20.0, 300.0])
    poses = ring_cameras(12, size)[1]
    moved = poses.copy()  # x_camera = R (x - offset) / scale + t, in camera units 40 times as small
    moved[:, :, :3] = poses[:, :, :3] @ turn.T
    moved[:, :, 3] = scale * poses[:, :, 3] - moved[:, :, :3] @ offset
    focal = size / 2 / np.tan(np.radians(21))
    lens = camera(size=(size, size), params=(focal, 1.01 * focal, 132, 128, -0.12, 0.03, 0.002, -0.001))
    names = [f"cam/{view:02d}.png" for view in range(12)]
    rays = ray_scene(part)
    for name, pose in zip(names, poses, strict=True):
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), picture_of(part, lens, pose, rays))

    def into_colmap(points):
        return scale * points @ turn.T + offset

    write_model(folder / "sparse" / "0", names, [lens] * 12, moved, into_colmap(part.edges.sample(0.05)[0]))
    return folder, part, into_colmap


@pytest.mark.slow(reason="runs the corridor")
def test_edges_come_out_in_the_frame_and_scale_of_colmap(part_project, tmp_path):
    folder, part, into_colmap = part_project
    told = Told()
    source = f"source: {{reader: colmap, path: {folder}}}"
    (tmp_path / "part.yaml").write_text(f"scale: part\n{source}\ntrain: {{steps: 120}}\n")
    run = Run(load_scene(tmp_path / "part.yaml"), tmp_path / "run", threads=2, progress=told)
    record = run_stages(run, until="refine")
    facts = record["stages"]["prepare"]["facts"]
    truth = part.edges.transformed(into_colmap).sample(0.2)[0]
    assert facts["box_from"] == "reader"
    low, high = np.array(facts["box"])
    assert (low < truth.min(axis=0)).all() and (high > truth.max(axis=0)).all()
    edges = read_edges(run.path("edges.json"))
    found = edges.sample(0.2)[0]
    away = np.linalg.norm(found[:, None] - truth[None], axis=2)
    # 40 units are the unit cube; a pixel is 0.17 units. The block has 12 edges.
    assert np.median(away.min(axis=1)) < 0.1 and (away.min(axis=1) < 0.3).mean() > 0.95
    assert (away.min(axis=0) < 0.3).mean() > 0.9
    views = read_views(run.path("views.npz"))
    assert all(not Path(path).is_absolute() and run.path(path).is_file() for path in views.image_paths)
    found = r"scene box \(.*\) to \(.*\), taken from the input and in its units; if it is wrong, set box"
    assert "seeds.ply" in facts["files"] and any(re.fullmatch(found, text) for text in told.notes)
    seeds = views.similarity.to_unit(into_colmap(part.edges.sample(0.05)[0]))
    paper = load_scene(tmp_path / "part.yaml", preset="paper", settings=["train.gaussians=500"])
    started = train.start_of_training(Run(paper, run.folder), views, np.random.default_rng(0))[0].means
    # The paper starts from the model's points; where there are fewer than it wants, random ones join them.
    assert len(seeds) < 400 and len(started) == 500
    assert np.allclose(np.sort(started[: len(seeds)], axis=0), np.sort(seeds, axis=0), atol=1e-5)
    again = run_stages(Run(run.config, run.folder, threads=2), until="refine")
    assert again["ran"] == []


def test_maps_for_a_scan_go_the_way_of_the_images_that_prepare_has_kept(project, tmp_path):
    """One camera of two sees what prepare leaves out: its larger pictures make no larger canvas."""
    small, large = camera(), camera("OPENCV", 2, (400, 300), (375, 388, 200.5, 149, -0.1, 0.02, 0.003, -0.002))
    folder = project(cameras=[small] * (VIEWS - 1) + [large])
    cv2.imwrite(str(folder / "images" / "0005.jpg"), np.zeros((300, 400), np.uint8))
    (folder / "maps").mkdir()
    for view in range(VIEWS):
        drawn = cv2.rectangle(np.zeros((120, 160), np.uint8), (40, 30), (110, 80), 255, 2)  # half as large
        cv2.imwrite(str(folder / "maps" / f"{view:04d}.png"), drawn)
    evaluation = {"kind": "scan", "truth": "scan.ply", "scan": {"edges": "maps"}}
    run = Run(scene(folder, evaluation=evaluation), tmp_path / "run", threads=2, progress=Told())
    size = undistorted(Lens("OPENCV", *SIZE, LENSES["OPENCV"]))[1]
    names = [f"{view:04d}" for view in range(VIEWS - 1)]
    views = SimpleNamespace(names=names[1:], edge_maps=np.zeros((1, *size[::-1]), np.uint8))
    maps = evaluate.scan_maps(run, views, SimpleNamespace(names=names[:1]))
    assert set(maps) == set(names) and all(each.shape == size[::-1] and each.max() > 200 for each in maps.values())
    assert not (run.path("undistorted_for_scan") / "images").exists()
