"""Which reader a folder wants, from what is in it: for `source.reader: auto`, and for a folder in place of a scene."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_edges.errors import UserError, name_some
from taichi_edges.readers.colmap import MODEL_FOLDERS
from taichi_edges.readers.frames import read_json
from taichi_edges.readers.idr import IMAGE_FOLDERS, camera_file
from taichi_edges.readers.image_files import first_folder, image_files

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

KNOWN = (
    "a COLMAP model (sparse/0), transforms.json (nerfstudio, instant-ngp), transforms_train.json (NeRF, NEF),"
    " meta_data.json (EMAP), cameras_sphere.npz or cameras.npz (IDR, NeuS), or photographs alone"
)
SPLITS = ("train", "val", "test")
PHOTO_FOLDERS = ("", "images", "photos", "image", "rgb", "color")
OTHER_PHOTOS = {".heic", ".heif", ".avif", ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2"}
FILMS = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm"}
PARTS_OF_A_PROJECT = (
    "sparse",
    "colmap",
    "dense",
    "images",
    "image",
    "photos",
    "rgb",
    "color",
)  # no names of scenes
MOST_LISTED = 8


@dataclass(frozen=True)
class Found:
    """A layout that was recognised.

    reader: of READERS. layout: what it is, in words. path: the source.path for it, a folder or a file that lists views.
    listing: the file or folder that lists them. views: how many. source: more keys for the section `source`.
    """

    reader: str
    layout: str
    path: Path
    listing: Path
    views: int
    source: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        if self.reader == "images":
            return f"{self.views} {self.layout}"
        inside = self.listing != self.path and self.listing.is_relative_to(self.path)
        listing = self.listing.relative_to(self.path) if inside else self.listing.name
        return f"{self.layout} ({listing}, {self.views} images)"


def recognise(path: Path | str) -> Found:
    """The Found of a folder, or of the file in it that lists the views; UserError where it is none, or several."""
    path = Path(path)
    if path.is_file():
        return _of_file(path)
    found = [layout for find in FINDERS for layout in [find(path)] if layout]
    if len(found) > 1:
        kinds = " and ".join(layout.layout for layout in found)
        listings = " or ".join(str(layout.listing) for layout in found)
        raise UserError(f"{path}: holds {kinds}: give {listings} in its place, or set source.reader in a scene file")
    if found:
        return found[0]
    photographs = _photographs(path)
    if photographs:
        return photographs
    _refuse_other_pictures(path)
    unknown = "is a folder, not a scene file, and of no known layout"
    raise UserError(f"{path}: {unknown}; it holds {_contents(path)}; known are {KNOWN}")


def recognised_source(path: Path, source: "SourceConfig") -> "tuple[SourceConfig, Found]":
    """The section `source` with the reader that fits what is at `path`, and the Found."""
    found = recognise(path)
    unset = {key: value for key, value in found.source.items() if key == "split" or not getattr(source, key)}
    changes = {"reader": found.reader, **unset}
    if found.path != path:
        changes["path"] = str(found.path.resolve())
    return source.model_copy(update=changes), found


def scene_name(folder: Path | str) -> str:
    """A name for a scene that is but a folder or a file in it: that of the project which the folder is a part of."""
    folder = Path(folder).resolve()
    folder = folder.parent if folder.is_file() else folder
    while folder.parent != folder and _is_part(folder):
        folder = folder.parent
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", folder.name).lstrip("._-").rstrip("-")
    return name or "scene"


def _is_part(folder: Path) -> bool:
    """Whether the folder only holds something of a project, and thus has no name of its own: sparse, sparse/0."""
    return folder.name.lower() in PARTS_OF_A_PROJECT or (folder.name.isdigit() and folder.parent.name == "sparse")


def _contents(folder: Path) -> str:
    """What is in a folder, in words: folders end in a slash."""
    names = sorted(f"{entry.name}/" if entry.is_dir() else entry.name for entry in folder.iterdir())
    return name_some(names, MOST_LISTED) or "nothing"


def _of_file(path: Path) -> Found:
    """The Found of a file that lists the views of the folder it is in."""
    name, folder = path.name, path.parent
    if name.endswith(".npz"):
        return _cameras(path)
    if path.suffix in (".bin", ".txt") and path.stem in ("cameras", "images", "points3D", "frames", "rigs"):
        return recognise(folder)
    if name == "meta_data.json":
        return _meta_data(path)
    split = re.fullmatch(r"transforms_(.+)\.json", name)
    if split:
        return _transforms_of_split(folder, split[1])
    if name.endswith(".json") and "frames" in _json_keys(path):
        return _transforms(path)
    raise UserError(f"{path}: is neither a scene file nor a file that lists views; known: {KNOWN}")


def _json_keys(path: Path) -> dict[str, Any]:
    content = read_json(path, "a file that lists views")
    return content if isinstance(content, dict) else {}


def _frames_in(path: Path) -> int:
    frames = _json_keys(path).get("frames")
    return len(frames) if isinstance(frames, list) else 0


# ------------------------------------------------------------------------------------------------------- the layouts


def find_colmap(folder: Path) -> Found | None:
    """A COLMAP project, or a model in it. nerfstudio keeps the model that its transforms.json comes from in colmap/."""
    has_transforms = (folder / "transforms.json").is_file()
    places = [name for name in MODEL_FOLDERS if not (has_transforms and name.startswith("colmap"))]
    models = next((models for name in places for models in [_models(folder / name)] if models), None)
    if models is None:
        return None
    project = _project_of(models[0])
    listing = models[0] if len(models) == 1 else models[0].parent
    source = {"model": folder.resolve().relative_to(project).as_posix()} if models == [folder] != [project] else {}
    return Found("colmap", "a COLMAP project", project, listing, _count_views(project, models[0]), source)


def _models(folder: Path) -> list[Path]:
    """The COLMAP models in a folder: in its folders 0, 1, ... or in itself."""
    parts = sorted(folder.glob("[0-9]*"))
    return [path for path in (*parts, folder) if any((path / f"images.{kind}").is_file() for kind in ("bin", "txt"))]


def _project_of(model: Path) -> Path:
    """The folder around a model that holds its images; the model's own where there is none."""
    if (model / "images").is_dir():
        return model
    return next((folder for folder in model.resolve().parents[:3] if (folder / "images").is_dir()), model)


def _count_views(project: Path, model: Path) -> int:
    """Images of a COLMAP project: those in its folder of images, else those that the model knows, wherever they are."""
    return _count_below(project / "images") or _registered(model)


def _registered(model: Path) -> int:
    """How many images a COLMAP model says it has."""
    binary = model / "images.bin"
    if binary.is_file():
        with open(binary, "rb") as file:
            return int.from_bytes(file.read(8), "little")
    lines = (model / "images.txt").read_text(encoding="utf-8", errors="replace").splitlines()
    return sum(not line.startswith("#") for line in lines) // 2  # an image, and its points, which may be none


def _count_below(folder: Path) -> int:
    """Image files in a folder and those below it, which is how COLMAP lists them."""
    return sum(len(image_files(path)) for path in [folder, *(p for p in folder.rglob("*") if p.is_dir())])


def find_transforms(folder: Path) -> Found | None:
    """nerfstudio's and instant-ngp's transforms.json."""
    path = folder / "transforms.json"
    return _transforms(path) if path.is_file() else None


def _transforms(path: Path) -> Found:
    usual = path.name == "transforms.json"
    return Found("nerfstudio", f"nerfstudio's {path.name}", path.parent if usual else path, path, _frames_in(path))


def find_transforms_of_splits(folder: Path) -> Found | None:
    """NeRF's and NEF's transforms_train.json; another split where that is missing."""
    split = next((split for split in SPLITS if (folder / f"transforms_{split}.json").is_file()), None)
    return _transforms_of_split(folder, split) if split else None


def _transforms_of_split(folder: Path, split: str) -> Found:
    """The transforms of a split, which may have nerfstudio's keys."""
    path = folder / f"transforms_{split}.json"
    content = _json_keys(path)
    frames = content.get("frames")
    first = frames[0] if isinstance(frames, list) and frames and isinstance(frames[0], dict) else {}
    if "fl_x" in content or "fl_x" in first:
        return _transforms(path)
    return Found("nerf", "a NeRF (Blender) scene", folder, path, _frames_in(path), {"split": split})


def find_meta_data(folder: Path) -> Found | None:
    """EMAP's meta_data.json."""
    path = folder / "meta_data.json"
    return _meta_data(path) if path.is_file() else None


def _meta_data(path: Path) -> Found:
    return Found("emap", "an EMAP scene", path.parent, path, _frames_in(path))


def find_cameras(folder: Path) -> Found | None:
    """The cameras of IDR and NeuS."""
    path = camera_file(folder)
    return _cameras(path) if path.is_file() else None


def _cameras(path: Path) -> Found:
    views = len(image_files(first_folder(path.parent, IMAGE_FOLDERS)))
    usual = path.name == camera_file(path.parent).name
    return Found("idr", "a DTU scene in IDR's layout", path.parent if usual else path, path, views)


def _photographs(folder: Path) -> Found | None:
    """Photographs without any poses. Where they are part of a project that has some, that is said."""
    place = next((folder / name for name in PHOTO_FOLDERS if image_files(folder / name)), None)
    if place is None:
        return None
    project = place.resolve().parent
    around = next((found for find in FINDERS for found in [find(project)] if found), None)
    hint = f"; {project} is {around.layout}, name that to use its poses" if around else ""
    return Found("images", f"photographs without poses{hint}", place, place, len(image_files(place)))


def _refuse_other_pictures(folder: Path) -> None:
    """UserError where there are photographs or films of kinds that are not read."""
    files = [p for name in PHOTO_FOLDERS if (folder / name).is_dir() for p in (folder / name).iterdir() if p.is_file()]
    suffixes = [path.suffix.lower() for path in files]
    for kinds, cure in ((OTHER_PHOTOS, "convert them to JPEG"), (FILMS, "save single frames of them as JPEG")):
        counts = {suffix: suffixes.count(suffix) for suffix in sorted(set(suffixes) & kinds)}
        if counts:
            found = " and ".join(f"{count} {suffix}" for suffix, count in counts.items())
            raise UserError(f"{folder}: holds {found} files, which cannot be read; {cure}")


FINDERS = (find_colmap, find_transforms, find_transforms_of_splits, find_meta_data, find_cameras)
