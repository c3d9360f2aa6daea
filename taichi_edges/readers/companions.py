"""Files that belong to a picture: its edge map and its mask, at the same relative path in another folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_edges.errors import UserError, name_some

if TYPE_CHECKING:
    from taichi_edges.scene.settings import SourceConfig

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
MASK_FOLDERS = ("masks", "mask")
NO_MASKS = "none"  # `source.masks`: do not use those that are there


def is_picture(path: Path) -> bool:
    """Does its name end as that of an image does?"""
    return path.suffix.lower() in (*PICTURE_SUFFIXES, ".tif", ".tiff", ".bmp", ".webp")


def companion(folder: Path | str, name: Path | str) -> Path | None:
    """The file in `folder` that belongs to the picture `name`, a relative path; None where there is none.

    `cam1/0001.jpg` has `cam1/0001.png` or any other kind of image, or, as COLMAP names masks, `cam1/0001.jpg.png`.
    """
    plain = Path(folder) / name
    endings = [ending for suffix in PICTURE_SUFFIXES for ending in (suffix, suffix.upper())]
    candidates = [plain.with_name(plain.name + ".png"), *(plain.with_suffix(ending) for ending in endings)]
    return next((path for path in candidates if path.is_file()), None)


def edge_paths(folder: Path, config: "SourceConfig", names: Sequence[str]) -> Sequence[Path | str]:
    """(V,) edge maps of pictures by name, '' where the scene names no folder of them.

    Where one is missing, the path is where it would be, which a message can say.
    """
    if not config.edges:
        return [""] * len(names)
    maps = folder / config.edges
    return [companion(maps, name) or (maps / name).with_suffix(".png") for name in names]


def mask_folder(folder: Path, config: "SourceConfig") -> Path | None:
    """The folder of masks that `source.masks` names, or else one that is there; None without masks."""
    if config.masks == NO_MASKS:
        return None
    if config.masks:
        if not (folder / config.masks).is_dir():
            there = name_some(sorted(path.name for path in folder.iterdir() if path.is_dir()), 8) or "no folders"
            raise UserError(f"source.masks: {folder / config.masks} is no folder; {folder} has: {there}")
        return folder / config.masks
    return next((folder / name for name in MASK_FOLDERS if (folder / name).is_dir()), None)


def mask_paths(
    folder: Path, config: "SourceConfig", names: Sequence[str]
) -> tuple[Sequence[Path | str], tuple[str, ...]]:
    """(V,) masks of pictures by name, '' where one has none; and warnings about those that have none."""
    masks = mask_folder(folder, config)
    if masks is None:
        return [""] * len(names), ()
    found = [companion(masks, name) or "" for name in names]
    lost = [name for name, path in zip(names, found, strict=True) if not path]
    if len(lost) == len(names):
        if not config.masks:
            return found, (f"{masks}: no mask is named as an image ({names[0]}), so none is used",)
        raise UserError(f"source.masks: {masks} holds no mask named as an image, e.g. {names[0]}.png; rename them")
    return found, (f"{len(lost)} of {len(names)} views have no mask in {masks}: {name_some(lost)}",) if lost else ()
