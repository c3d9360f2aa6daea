"""COLMAP projects: a folder of images beside `sparse/0`, with a model in text or binary files."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.errors import UserError, name_some
from taichi_edges.readers.companions import edge_paths, is_picture, mask_paths
from taichi_edges.readers.frames import Frames
from taichi_edges.readers.photogrammetry import SfmModel, model_files, read_model
from taichi_edges.readers.scene_box import scene_box

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

MODEL_FOLDERS = ("sparse", "colmap/sparse", "")  # each may hold a model itself, or several in folders 0, 1, ...
IMAGE_FOLDERS = ("images", "")


def read_colmap(folder: Path, config: "SourceConfig") -> Frames:
    """Frames of a COLMAP project. config: the scene's `source` section."""
    model, notes = find_model(folder, config.model)
    return frames_of_model(folder, model, _image_folder(folder, config, read_model(model)), config, notes)


def frames_of_model(
    folder: Path, model: Path, images: Path, config: "SourceConfig", notes: tuple[str, ...] = ()
) -> Frames:
    """Frames of the COLMAP model in the folder `model`. folder: of edge maps and masks. images: of the images."""
    files, found = model_files(model), read_model(model)
    where = next(path for path in files if path.stem == "images")
    if not found.names:
        raise UserError(f"{where}: the model has no registered image; run the mapper again")
    image_paths = [images / name for name in found.names]
    edges = edge_paths(folder, config, found.names)
    there = np.array([any(p and Path(p).is_file() for p in paths) for paths in zip(image_paths, edges, strict=True)])
    if not there.any():
        raise UserError(f"{images}: none of the model's images is there (e.g. {found.names[0]}); set source.images")
    keep = np.flatnonzero(there).tolist()
    masks, mask_warnings = mask_paths(folder, config, [found.names[i] for i in keep])
    points = _good_points(found, config)
    boxes = (scene_box(each, found.camera_to_world) for each in (points, found.points))  # better a rough one than none
    return Frames(
        where=where,
        names=_view_names([found.names[i] for i in keep]),
        edge_paths=[edges[i] for i in keep],
        image_paths=[image_paths[i] for i in keep],
        intrinsics=[None] * len(keep),
        camera_to_world=list(found.camera_to_world[keep]),
        opengl=False,
        lenses=[found.lenses[i] for i in keep],
        mask_paths=masks,
        points=points,
        box=next((box for box in boxes if box is not None), None),
        files=tuple(files),
        notes=notes,
        warnings=(*_missing(found.names, there, images), *_unregistered(images, found.names, folder), *mask_warnings),
    )


def find_model(folder: Path, wanted: str) -> tuple[Path, tuple[str, ...]]:
    """The folder of the model to use and a note on the choice. wanted: `source.model`, '' for the largest."""
    if wanted:
        if not model_files(folder / wanted):
            raise UserError(f"source.model: {folder / wanted} holds no COLMAP model (cameras, images, points3D)")
        return folder / wanted, ()
    for name in MODEL_FOLDERS:
        parts = sorted((path for path in (folder / name).glob("[0-9]*") if path.is_dir()), key=_numbered)
        models = [path for path in (*parts, folder / name) if model_files(path)]
        if models:
            return _largest(models, folder)
    looked = ", ".join(name or folder.name for name in ("sparse/0", *MODEL_FOLDERS))
    raise UserError(f"{folder}: no COLMAP model (cameras, images, points3D as .bin or .txt) in {looked}")


def _numbered(path: Path) -> tuple[int, str]:
    return (int(path.name), "") if path.name.isdigit() else (1 << 31, path.name)


def _largest(models: list[Path], folder: Path) -> tuple[Path, tuple[str, ...]]:
    if len(models) == 1:
        return models[0], ()
    counts = [len(read_model(model).names) for model in models]
    best = int(np.argmax(counts))
    each = ", ".join(f"{m.relative_to(folder)} with {count}" for m, count in zip(models, counts, strict=True))
    chosen = models[best].relative_to(folder)
    note = f"{len(models)} COLMAP models, images in each: {each}; {chosen} is used, source.model names another"
    return models[best], (note,)


def _image_folder(folder: Path, config: "SourceConfig", found: SfmModel) -> Path:
    """Where the images are: `source.images`, or the first usual folder that holds one of them."""
    if config.images:
        return folder / config.images
    candidates = [folder / name for name in IMAGE_FOLDERS]
    holding = [path for path in candidates if any((path / name).is_file() for name in found.names)]
    return (holding or candidates)[0]


def _view_names(names: Sequence[str]) -> list[str]:
    """The images' names without their suffixes, unless two would be the same."""
    stems = [str(PurePosixPath(name).with_suffix("")) for name in names]
    return stems if len(set(stems)) == len(stems) else list(names)


def _good_points(found: SfmModel, config: "SourceConfig") -> np.ndarray:
    """(n, 3) the points that fit and that enough images see: one seen in two lies anywhere along their rays."""
    good = (found.errors <= config.max_point_error) & (found.track_lengths >= config.min_track)
    return found.points[good & np.isfinite(found.points).all(axis=1)]


def _missing(names: Sequence[str], there: np.ndarray, images: Path) -> tuple[str, ...]:
    lost = [name for name, is_there in zip(names, there, strict=True) if not is_there]
    if not lost:
        return ()
    return (f"{len(lost)} of {len(names)} images of the model are not in {images}, left out: {name_some(lost)}",)


def _unregistered(images: Path, names: Sequence[str], folder: Path) -> tuple[str, ...]:
    """A warning about images beside those of the model that it does not know."""
    if images == folder or not images.is_dir():
        return ()
    known = {Path(name) for name in names}
    files = sorted(path.relative_to(images) for path in images.rglob("*") if is_picture(path))
    strange = [str(path) for path in files if path not in known]
    if not strange:
        return ()
    return (f"{len(strange)} of {len(files)} images have no pose in the model, left out: {name_some(strange)}",)
