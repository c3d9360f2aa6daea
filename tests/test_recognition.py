"""What a folder is recognised as, and what its scene is called; a folder in place of a scene file."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from taichi_edges.errors import UserError
from taichi_edges.readers import READERS
from taichi_edges.readers.recognition import recognise, recognised_source, scene_name
from taichi_edges.scene.settings import SourceConfig

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from run import main  # noqa: E402

FRAMES = json.dumps({"frames": [{}, {}]})


def build(folder, *names):
    """Files of those names in a folder: images, JSON with two frames, or empty ones."""
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix in (".png", ".jpg"):
            cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
        else:
            path.write_text(FRAMES if path.suffix == ".json" and path.name != "other.json" else "{}")
    return folder


LAYOUTS = {
    "colmap": (["images/a.jpg", "images/b.jpg", "sparse/0/images.bin"], "a COLMAP project (sparse/0, 2 images)"),
    "colmap text": (["images/s/a.jpg", "sparse/images.txt"], "a COLMAP project (sparse, 1 images)"),
    "nerfstudio": (["transforms.json", "images/a.jpg"], "nerfstudio's transforms.json (transforms.json, 2 images)"),
    "nerf": (["transforms_train.json", "transforms_val.json"], "a NeRF (Blender) scene (transforms_train.json, 2"),
    "emap": (["meta_data.json", "color/a.png"], "an EMAP scene (meta_data.json, 2 images)"),
    "idr": (["cameras_sphere.npz", "image/0.png"], "a DTU scene in IDR's layout (cameras_sphere.npz, 1 images)"),
    "idr neus": (["cameras.npz", "rgb/0.png"], "a DTU scene in IDR's layout (cameras.npz, 1 images)"),
    "images": (["a.jpg", "b.JPG", "notes.txt"], "2 photographs without poses"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_recognised(layout, tmp_path):
    names, says = LAYOUTS[layout]
    found = recognise(build(tmp_path / "scene", *[name for name in names if not name.endswith("JPG")]))
    if layout != "images":
        assert str(found).startswith(says)
    assert found.reader == layout.split()[0] and found.path == tmp_path / "scene"


def test_every_reader_has_a_layout_by_which_it_is_recognised():
    assert {layout.split()[0] for layout in LAYOUTS} == set(READERS)


def test_photographs_in_a_folder_of_their_own_are_found(tmp_path):
    found = recognise(build(tmp_path, "images/a.jpg", "images/b.jpg", "images/c.png"))
    assert str(found) == "3 photographs without poses" and found.path == tmp_path / "images"


def test_another_split_is_read_where_there_is_none_to_train_on(tmp_path):
    source, _ = recognised_source(build(tmp_path, "transforms_val.json"), SourceConfig(path="x"))
    assert (source.reader, source.split) == ("nerf", "val")


def test_transforms_of_a_split_may_have_the_keys_of_nerfstudio(tmp_path):
    (tmp_path / "transforms_train.json").write_text(json.dumps({"fl_x": 3.0, "frames": []}))
    found = recognise(tmp_path)
    assert (found.reader, found.path) == ("nerfstudio", tmp_path / "transforms_train.json")


@pytest.mark.parametrize(
    ("given", "model"),
    [("sparse/0", "sparse/0"), ("sparse", ""), ("sparse/0/images.bin", "sparse/0"), ("sparse/1", "sparse/1"), ("", "")],
)
def test_a_part_of_a_colmap_project_stands_for_the_project(tmp_path, given, model):
    build(tmp_path, "images/a.jpg", "sparse/0/images.bin", "sparse/1/images.bin")
    source, found = recognised_source(tmp_path / given, SourceConfig(path=given))
    assert (found.reader, found.path, source.model) == ("colmap", tmp_path, model)
    assert scene_name(tmp_path / given) == scene_name(tmp_path)


@pytest.mark.parametrize("name", ["meta_data.json", "transforms.json", "transforms_train.json", "cameras_sphere.npz"])
def test_the_file_that_lists_the_views_stands_for_its_folder(tmp_path, name):
    build(tmp_path, name)
    assert recognise(tmp_path / name).path == recognise(tmp_path).path == tmp_path


def test_a_file_that_is_not_the_usual_one_is_read_itself(tmp_path):
    build(tmp_path, "cameras_sphere.npz", "cameras_large.npz", "transforms.json", "transforms_half.json", "poses.json")
    assert recognise(tmp_path / "cameras_large.npz").path == tmp_path / "cameras_large.npz"
    assert recognise(tmp_path / "poses.json").path == tmp_path / "poses.json"
    source, _ = recognised_source(tmp_path / "transforms_half.json", SourceConfig(path="x"))
    assert (source.reader, source.split, source.path) == ("nerf", "half", str(tmp_path))


def test_the_model_that_nerfstudio_keeps_is_no_second_layout(tmp_path):
    build(tmp_path, "transforms.json", "images/a.jpg", "colmap/sparse/0/images.bin")
    assert recognise(tmp_path).reader == "nerfstudio"
    assert recognise(tmp_path / "colmap" / "sparse" / "0").reader == "colmap"


def test_two_layouts_in_one_folder_are_both_named(tmp_path):
    build(tmp_path, "transforms.json", "meta_data.json")
    with pytest.raises(UserError) as refused:
        recognise(tmp_path)
    message = str(refused.value)
    assert "holds nerfstudio's transforms.json and an EMAP scene" in message
    assert f"give {tmp_path / 'transforms.json'} or {tmp_path / 'meta_data.json'} in its place" in message


def test_what_is_no_layout_is_refused_with_what_is_there_and_what_is_known(tmp_path):
    build(tmp_path, "scan.ply", "photos/notes.txt")
    with pytest.raises(UserError) as refused:
        recognise(tmp_path)
    message = str(refused.value)
    assert "of no known layout; it holds photos/, scan.ply; known are a COLMAP model" in message
    assert "photographs alone" in message and "\n" not in message


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["IMG_1.HEIC", "IMG_2.heic", "IMG_3.dng"], "1 .dng and 2 .heic files, which cannot be read; convert them to"),
        (["photos/IMG_1.CR2"], "1 .cr2 files, which cannot be read; convert them to JPEG"),
        (["walk.MP4"], "1 .mp4 files, which cannot be read; save single frames of them as JPEG"),
    ],
)
def test_pictures_of_kinds_that_are_not_read_are_named_with_the_cure(tmp_path, names, says):
    build(tmp_path, *names)
    with pytest.raises(UserError) as refused:
        recognise(tmp_path)
    assert says in str(refused.value)


def test_images_of_a_model_are_counted_where_they_are_not_in_the_usual_folder(tmp_path):
    build(tmp_path, "a/x.jpg", "a/sparse/0/points3D.bin", "b/sparse/0/images.txt")
    (tmp_path / "a/sparse/0/images.bin").write_bytes((7).to_bytes(8, "little"))
    (tmp_path / "b/sparse/0/images.txt").write_text(
        "# two images\n1 1 0 0 0 0 0 0 1 x.jpg\n\n2 1 0 0 0 0 0 0 1 y.jpg\n\n"
    )
    assert [recognise(tmp_path / name).views for name in "ab"] == [7, 2]


def test_photographs_of_a_project_with_poses_say_so(tmp_path):
    build(tmp_path, "images/a.jpg", "sparse/0/images.bin")
    assert f"{tmp_path} is a COLMAP project, name that to use its poses" in str(recognise(tmp_path / "images"))


def test_keys_of_the_scene_are_kept(tmp_path):
    build(tmp_path, "images/a.jpg", "sparse/0/images.bin", "sparse/1/images.bin")
    source, _ = recognised_source(tmp_path / "sparse" / "1", SourceConfig(path="x", model="sparse/0", edges="maps"))
    assert (source.model, source.edges) == ("sparse/0", "maps")


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("castle", "castle"),
        ("my photos (2)", "my-photos-2"),
        (".hidden", "hidden"),
        ("castle/sparse/0", "castle"),
        ("castle/colmap/sparse", "castle"),
        ("castle/images", "castle"),
        ("00004926", "00004926"),
        ("...", "scene"),
        ("Burg_Süd", "Burg_S-d"),
    ],
)
def test_a_scene_is_called_like_its_folder(tmp_path, folder, name):
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    assert scene_name(tmp_path / folder) == name


def test_the_current_folder_has_a_name(tmp_path, monkeypatch):
    (tmp_path / "castle").mkdir()
    monkeypatch.chdir(tmp_path / "castle")
    assert scene_name(Path(".")) == "castle"
    assert scene_name(Path("/")) == "scene"


# ---------------------------------------------------------------------------------------------------- the command line


def run(*arguments, cwd):
    command = [sys.executable, str(ROOT / "run.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, check=False, text=True, cwd=cwd, timeout=120)


@pytest.mark.slow(reason="starts processes")
def test_a_folder_runs_without_a_scene_file(tmp_path):
    """It gets as far as the poses, which are missing; the log says what it was read as."""
    build(tmp_path / "my scene", "meta_data.json", "color/a.png")
    done = run("my scene", "--set", "fit.delta=0.3", cwd=tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.startswith(f"{tmp_path / 'my scene'}: read as an EMAP scene (meta_data.json, 2 images)\n")
    assert "a frame without rgb_path" in done.stderr


@pytest.mark.slow(reason="starts processes")
def test_an_unknown_folder_and_an_unknown_file_end_with_one_line(tmp_path):
    build(tmp_path, "empty/notes.txt", "other.json")
    for given in ("empty", "other.json"):
        done = run(given, cwd=tmp_path)
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert not (tmp_path / "runs").exists()


def test_folders_of_one_name_do_not_share_their_results(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for place in ("one", "two"):
        build(tmp_path / place / "shed", "meta_data.json", "color/a.png")
    results = tmp_path / "runs" / "shed"
    results.mkdir(parents=True)
    scene = {"name": "shed", "source": {"path": str(tmp_path / "one" / "shed")}}
    (results / "run.json").write_text(json.dumps({"scene": scene}))
    assert main(["two/shed"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"error: runs/shed: holds the results of {tmp_path / 'one' / 'shed'};"
        " name others with --out FOLDER or --set name=NAME, or delete it"
    )
    for arguments in (["one/shed"], ["two/shed", "--out", "others"], ["two/shed", "--set", "name=shed2"]):
        assert main(arguments) == 2  # for want of poses
        assert "a frame without rgb_path" in capsys.readouterr().err


def test_the_help_lists_all_stages(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "fit, refine, evaluate" in " ".join(capsys.readouterr().out.split())
