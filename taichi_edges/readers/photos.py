"""A folder of photographs without poses: structure from motion first, then as any COLMAP project."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.errors import UserError, name_some
from taichi_edges.files.artefacts import digest, digest_file, write_json
from taichi_edges.progress import Progress
from taichi_edges.readers.colmap import frames_of_model
from taichi_edges.readers.companions import edge_paths, is_picture, mask_folder, mask_paths
from taichi_edges.readers.frames import Frames, is_usable
from taichi_edges.readers.images import read_mask
from taichi_edges.readers.photogrammetry import colmap_version, known_focal_length, model_files, solve_poses
from taichi_edges.views.picture_sizes import picture_size

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

METHOD = 1  # raised when the same photographs give another reconstruction
FEWEST = 3  # views; fewer show no edge surely
MOST = 0.8  # share of the photographs that should find their place
ADVICE = (
    "take photographs that overlap by 60 to 80 %, sharp, of one exposure, all around, with texture in sight"
    " (a newspaper under a plain object)"
)


def read_photos(folder: Path, config: "SourceConfig") -> Frames:
    """Frames of all photographs below a folder, still without poses. config: the scene's `source` section."""
    images = folder / config.images if config.images else folder
    names = [path.relative_to(images).as_posix() for path in _photos(images, folder, config)]
    if not names:
        others = sorted({path.suffix for path in images.glob("*") if path.is_file()})
        found = f"it has files of the kinds {name_some(others)}" if others else "it is empty"
        raise UserError(f"{images}: no PNG, JPEG or TIFF image here, {found}; convert them, or set source.path")
    stems = [name.rpartition(".")[0] for name in names]
    return Frames(
        where=images,
        names=stems if len(set(stems)) == len(stems) else names,
        edge_paths=edge_paths(folder, config, names),
        image_paths=[images / name for name in names],
        intrinsics=[None] * len(names),
        camera_to_world=[None] * len(names),
        opengl=False,
        mask_paths=mask_paths(folder, config, names)[0],
    )


def _photos(images: Path, folder: Path, config: "SourceConfig") -> list[Path]:
    """The photographs below a folder, in order; not masks, edge maps and what is hidden."""
    if not images.is_dir():
        raise UserError(f"{images}: no such folder; set source.path to the folder of the photographs")
    apart = [folder / config.edges] if config.edges else []
    apart += [masks] if (masks := mask_folder(folder, config)) else []
    files = (path for path in images.rglob("*") if is_picture(path) and path.is_file())
    return sorted(
        path
        for path in files
        if not any(path.is_relative_to(other) for other in apart)
        and not any(part.startswith(".") for part in path.relative_to(images).parts)
    )


def posed_photos(
    frames: Frames, folder: Path, config: "SourceConfig", cache: Path, seed: int, threads: int, progress: Progress
) -> Frames:
    """The Frames of `read_photos` with poses, from structure from motion that is done once and kept in `cache`.

    folder: of edge maps and masks. config: the scene's `source` section.
    """
    images, names = frames.where, _whole(frames, progress)
    _refuse_few(images, names)
    masks = {name: path for name, path in zip(_names(frames), frames.mask_paths, strict=True) if path}
    seen = [(name, *map(digest_file, [images / name, *([masks[name]] if name in masks else [])])) for name in names]
    key = digest([METHOD, colmap_version(), seed, seen])
    record = cache / "photographs.json"
    known = _known(record, key, cache)
    if known is None:
        progress.say(f"structure from motion from {len(names)} photographs, once")
        known = {"key": key, **_solved(images, names, masks, cache, seed, threads, progress)}
        write_json(record, known)
    if known["unreadable"]:
        lost = f"{len(known['unreadable'])} of {len(names)} photographs are no images that can be read, left out"
        progress.warn(f"{lost}: {name_some(known['unreadable'])}")
    readable = [name for name in names if name not in set(known["unreadable"])]
    _check_registered(images, readable, known["registered"], progress)
    found = frames_of_model(folder, cache / "sparse", images, config)
    progress.say("the edges will be in the frame of this reconstruction, whose scale and axes are its own")
    return found


def _solved(
    images: Path,
    names: list[str],
    masks: dict[str, Path | str],
    cache: Path,
    seed: int,
    threads: int,
    progress: Progress,
) -> dict[str, Any]:
    """Structure from motion, its model in `cache`: what is recorded of it.

    registered, unreadable: names of photographs. files: {name: digest} of the model's.
    """
    groups = by_camera(images, names, threads)
    grouped = {name for group in groups for name in group}
    readable = [name for name in names if name in grouped]
    _refuse_few(images, readable)
    with TemporaryDirectory() as folder_of_masks:
        named = _named_masks(masks, Path(folder_of_masks)) if masks else None
        registered = solve_poses(images, readable, groups, cache, seed, threads, progress, named)
    return {
        "registered": registered,
        "unreadable": [name for name in names if name not in grouped],
        "files": _digests(cache / "sparse") if registered else {},
    }


def _refuse_few(images: Path, names: list[str]) -> None:
    if len(names) < FEWEST:
        raise UserError(f"{images}: {len(names)} photographs are too few to find where they were taken; {ADVICE}")


def _named_masks(masks: dict[str, Path | str], folder: Path) -> Path:
    """The masks, {name of the photograph: path}, in a folder where COLMAP finds them: PNG files `<name>.png`."""
    import cv2

    for name, path in masks.items():
        target = folder / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(cv2.imencode(".png", np.uint8(255) * read_mask(path))[1].tobytes())
    return folder


def _names(frames: Frames) -> list[str]:
    """(V,) paths of the photographs, relative to their folder."""
    return [Path(path).relative_to(frames.where).as_posix() for path in frames.image_paths]


def _whole(frames: Frames, progress: Progress) -> list[str]:
    """Names of the photographs that are whole; the others are named in a warning."""
    names = _names(frames)
    whole = [name for name, path in zip(names, frames.image_paths, strict=True) if is_usable(path)]
    if len(whole) < len(names):
        lost = [name for name in names if name not in set(whole)]
        progress.warn(f"{len(lost)} of {len(names)} photographs are truncated, left out: {name_some(lost)}")
    return whole


def _known(record: Path, key: str, cache: Path) -> dict[str, Any] | None:
    """What `_solved` gave for the same photographs; None where it did not, or its model is not as it was written."""
    try:
        content = json.loads(record.read_text(encoding="utf-8"))
        files = _digests(cache / "sparse") if content["registered"] else {}
        same = content["key"] == key and content["files"] == files and isinstance(content["unreadable"], list)
    except (OSError, ValueError, KeyError, TypeError, UserError):
        return None
    return content if same else None


def _digests(folder: Path) -> dict[str, str]:
    """{name: digest} of the files of the COLMAP model in a folder."""
    return {path.name: digest_file(path) for path in model_files(folder)}


def by_camera(images: Path, names: list[str], threads: int) -> list[list[str]]:
    """Lists of names that share a camera: of one folder, one size, one focal length; without what is no image."""

    def kind(name: str) -> tuple[str, tuple[int, int] | None, float | None] | None:
        try:
            focal = known_focal_length(images / name)
        except UserError:
            return None
        return str(Path(name).parent), picture_size(images / name), focal and round(focal, 1)

    with ThreadPoolExecutor(threads) as pool:
        kinds = list(pool.map(kind, names))
    different = dict.fromkeys(filter(None, kinds))
    return [[name for name, other in zip(names, kinds, strict=True) if other == each] for each in different]


def _check_registered(images: Path, names: list[str], registered: list[str], progress: Progress) -> None:
    """UserError or a warning where too few photographs found their place, with what to do about it."""
    lost = [name for name in names if name not in set(registered)]
    found = f"{len(registered)} of {len(names)} photographs were found to show the same scene"
    if len(registered) < FEWEST:
        raise UserError(f"{images}: only {found}: {ADVICE}")
    if lost:
        advice = f"; {ADVICE}" if len(registered) < MOST * len(names) else ""
        progress.warn(f"{found}, left out: {name_some(lost)}{advice}")
