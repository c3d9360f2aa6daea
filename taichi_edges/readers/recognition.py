"""What a folder holds: which reader its layout wants. For `source.reader: auto`, and for a folder in place of a scene."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

from taichi_edges.errors import UserError, name_some
from taichi_edges.readers.colmap import MODEL_FOLDERS
from taichi_edges.readers.frames import read_json
from taichi_edges.readers.idr import CAMERA_FILES, IMAGE_FOLDERS
from taichi_edges.readers.image_files import first_folder, image_files

KNOWN = (
    "a COLMAP model (sparse/0), transforms.json (nerfstudio, instant-ngp), transforms_train.json (NeRF, NEF),"
    " meta_data.json (EMAP), cameras_sphere.npz or cameras.npz (IDR, NeuS), or photographs alone"
)
SPLITS = ("train", "val", "test")
PHOTO_FOLDERS = ("", "images", "photos", "image", "rgb", "color")
PARTS_OF_A_PROJECT = ("sparse", "colmap", "dense", "images", "image", "photos", "rgb", "color")  # folders that name none
MOST_LISTED = 8


@dataclass(frozen=True)
class Found:
    """A layout that was recognised.

    reader: of READERS. layout: what it is, in words. folder: of the scene. listing: the file or folder that lists its
    views, relative to `folder`. source: more keys of the section `source`. views: how many it lists.
    """

    reader: str
    layout: str
    folder: Path
    listing: str
    views: int
    source: dict

    def __str__(self):
        what = "photographs" if self.reader == "images" else "images"
        listing = "" if self.listing in ("", ".") else f"{self.listing}, "
        return f"{self.layout} ({listing}{self.views} {what})"


def recognise(path):
    """The Found of a folder, or of the file in it that lists the views; UserError where it is none, or several."""
    path = Path(path)
    if path.is_file():
        return _of_file(path)
    found = [layout for find in FINDERS for layout in [find(path)] if layout]
    if len(found) > 1:
        listings = " or ".join(str(layout.folder / layout.listing) for layout in found)
        kinds = ", ".join(f"{layout.layout} ({layout.listing})" for layout in found)
        raise UserError(f"{path}: holds {kinds}: set source.reader, or name one of them: {listings}")
    if found:
        return found[0]
    photographs = _photographs(path)
    if photographs:
        return photographs
    raise UserError(
        f"{path}: is a folder, not a scene file, and of no known layout; it holds {_contents(path)}; known: {KNOWN}"
    )


def recognised_source(path, source):
    """The `source` section of a scene with the reader that fits what is at `path`, and the Found."""
    found = recognise(path)
    changes = {key: value for key, value in found.source.items() if not getattr(source, key)} | {"reader": found.reader}
    if "split" in found.source:
        changes["split"] = found.source["split"]
    if found.folder != path:
        changes["path"] = str(found.folder.resolve())
    return source.model_copy(update=changes), found


def scene_name(folder):
    """A name for a scene that is but a folder: the folder's, or that of the project which the folder is a part of."""
    folder = Path(folder).resolve()
    while folder.parent != folder and (folder.name.lower() in PARTS_OF_A_PROJECT or folder.name.isdigit()):
        folder = folder.parent
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", folder.name).lstrip("._-").rstrip("-")
    return name or "scene"


def _contents(folder):
    """What is in a folder, in words: folders end in a slash."""
    names = sorted(f"{entry.name}/" if entry.is_dir() else entry.name for entry in folder.iterdir())
    return name_some(names, MOST_LISTED) or "nothing"


def _of_file(path):
    """The Found of a file that lists the views of the folder it is in."""
    name, folder = path.name, path.parent
    if name.endswith(".npz"):
        return _cameras(path)
    if path.suffix in (".bin", ".txt") and path.stem in ("cameras", "images", "points3D", "frames", "rigs"):
        return recognise(folder)
    if name == "meta_data.json":
        return _meta_data(folder)
    split = re.fullmatch(r"transforms_(.+)\.json", name)
    if split:
        return _transforms_of_split(folder, split[1])
    if name.endswith(".json") and "frames" in _json_keys(path):
        return _transforms(path)
    raise UserError(f"{path}: is neither a scene file nor a file that lists views; known: {KNOWN}")


def _json_keys(path):
    content = read_json(path, "a file that lists views")
    return content if isinstance(content, dict) else {}


def _frames_in(path):
    frames = _json_keys(path).get("frames")
    return len(frames) if isinstance(frames, list) else 0


# ------------------------------------------------------------------------------------------------------- the layouts


def find_colmap(folder):
    """A COLMAP project, or a model in it. nerfstudio keeps the model that its transforms.json comes from in colmap/."""
    own = [name for name in MODEL_FOLDERS if not (name.startswith("colmap") and (folder / "transforms.json").is_file())]
    model = next((folder / name for name in (*own, "0") if _is_model(folder / name)), None)
    if model is None:
        return None
    project = _project_of(model)
    listing = os.path.relpath(model, project)
    images = _count_below(project / "images")
    if listing in MODEL_FOLDERS:
        return Found("colmap", "a COLMAP project", project, listing, images, {})
    beside = os.path.relpath(project / "images", model)  # one of several models: sparse/1
    return Found("colmap", "a COLMAP model", model, "", images, {"images": beside})


def _is_model(folder):
    return any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt"))


def _project_of(model):
    """The folder around a model that holds its images; the model's own where there is none."""
    around = [model, *list(model.resolve().parents)[:3]]
    return next((folder for folder in around if (folder / "images").is_dir()), model)


def _count_below(folder):
    """Image files in a folder and those below it, as COLMAP lists them."""
    return sum(len(image_files(path)) for path in [folder, *(p for p in folder.rglob("*") if p.is_dir())])


def find_transforms(folder):
    """nerfstudio's and instant-ngp's transforms.json."""
    path = folder / "transforms.json"
    return _transforms(path) if path.is_file() else None


def _transforms(path):
    layout = "nerfstudio's transforms.json" if path.name == "transforms.json" else "a listing like nerfstudio's"
    folder = path.parent if path.name == "transforms.json" else path
    return Found("nerfstudio", layout, folder, path.name if folder != path else "", _frames_in(path), {})


def find_transforms_of_splits(folder):
    """NeRF's and NEF's transforms_train.json; another split where that is missing."""
    split = next((split for split in SPLITS if (folder / f"transforms_{split}.json").is_file()), None)
    return _transforms_of_split(folder, split) if split else None


def _transforms_of_split(folder, split):
    """nerfstudio's keys stand in files of splits, too."""
    path = folder / f"transforms_{split}.json"
    content = _json_keys(path)
    frames = content.get("frames")
    first = frames[0] if isinstance(frames, list) and frames and isinstance(frames[0], dict) else {}
    if "fl_x" in content or "fl_x" in first:
        return Found("nerfstudio", f"nerfstudio's {path.name}", path, "", _frames_in(path), {})
    return Found("nerf", "a NeRF (Blender) scene", folder, path.name, _frames_in(path), {"split": split})


def find_meta_data(folder):
    """EMAP's meta_data.json."""
    return _meta_data(folder) if (folder / "meta_data.json").is_file() else None


def _meta_data(folder):
    return Found("emap", "an EMAP folder", folder, "meta_data.json", _frames_in(folder / "meta_data.json"), {})


def find_cameras(folder):
    """The cameras of IDR and NeuS."""
    path = next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)
    return _cameras(path) if path else None


def _cameras(path):
    folder = path.parent
    views = len(image_files(first_folder(folder, IMAGE_FOLDERS)))
    chosen = next((name for name in CAMERA_FILES if (folder / name).is_file()), None)
    if path.name == chosen:
        return Found("idr", "DTU's layout of IDR and NeuS", folder, path.name, views, {})
    return Found("idr", "DTU's layout of IDR and NeuS", path, "", views, {})


def _photographs(folder):
    """Photographs without any poses."""
    place = next((name for name in PHOTO_FOLDERS if image_files(folder / name)), None)
    if place is None:
        return None
    return Found("images", "photographs without poses", folder / place, "", len(image_files(folder / place)), {})


FINDERS = (find_colmap, find_transforms, find_transforms_of_splits, find_meta_data, find_cameras)
