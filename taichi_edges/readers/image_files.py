"""Which image files there are in a folder, and which of them belongs to which view."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from taichi_edges.errors import UserError, name_some
from taichi_edges.readers.companions import is_picture


def image_files(folder: Path | str) -> list[Path]:
    """The image files in a folder, sorted by name; hidden ones do not count, nor what is no folder."""
    folder = Path(folder)
    if not folder.is_dir():
        return []
    files = (path for path in folder.iterdir() if is_picture(path) and not path.name.startswith("."))
    return sorted(path for path in files if path.is_file())


def first_folder(folder: Path, names: Sequence[str]) -> Path:
    """The first of the folders that holds images, or the first one where none does."""
    return next((folder / name for name in names if image_files(folder / name)), folder / names[0])


def files_of_views(folder: Path, names: Sequence[str], what: str) -> list[Path]:
    """The image file in a folder of each of the (V,) views: of its name, else of its number, else in order.

    DTU's masks are 000.png, its images 000000.jpg. what: the files are, for messages. A view without a file gets the
    path at which one of its name would be.
    """
    files, expected = image_files(folder), [folder / f"{name}.png" for name in names]
    keys_of_names: tuple[Callable[[str], str | int], ...] = (str, _number)
    for key in keys_of_names:
        known = {key(path.stem): path for path in files}
        keys = [key(name) for name in names]
        if len(known) == len(files) and len(set(keys)) == len(keys) and any(each in known for each in keys):
            return [known.get(each, path) for each, path in zip(keys, expected, strict=True)]
    if len(files) not in (0, len(names)):
        problem = f"{len(files)} {what}s for {len(names)} images, and they are not named alike"
        raise UserError(f"{folder}: {problem}; name each {what} like its image")
    return files or expected


def refuse_missing(folder: Path, paths: Sequence[Path], names: Sequence[str], what: str, skip: Sequence[str]) -> None:
    """UserError that names the views, but those to skip, whose file is not there."""
    lacking = [name for name, path in zip(names, paths, strict=True) if name not in skip and not path.is_file()]
    if lacking:
        problem = f"{len(lacking)} of {len(names)} views have no {what} here: {name_some(lacking)}"
        raise UserError(f"{folder}: {problem}; add them, or leave these views out with source.skip")


def _number(name: str) -> int | str:
    """The last number in a name; the name itself where it has none."""
    digits = re.findall(r"\d+", name)
    return int(digits[-1]) if digits else name
