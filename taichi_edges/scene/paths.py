"""Where things are: paths as a user writes them, the data root, and the scenes that come along."""

import os
from pathlib import Path

from taichi_edges.errors import UserError

DATA_ROOT = "TAICHI_EDGES_DATA"
PACKAGE = Path(__file__).parent.parent
INSTALLED, BESIDE = PACKAGE / "scenes", PACKAGE.parent / "scenes"  # in a checkout the scenes lie beside the package
SHIPPED = INSTALLED if INSTALLED.is_dir() else BESIDE


def expand(text: Path | str, origin: str) -> Path:
    """A path as the user wrote it, with `~` replaced; `origin` is where it was written, for the message."""
    if not isinstance(text, (str, os.PathLike)):
        raise UserError(f"{origin}: must be a path, not {text!r}")
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise UserError(f"{origin}: {text}: '~' and what follows it name no user; write the path out") from error


def data_folder(given: Path | str | None = None, origin: str = "data_root") -> Path | None:
    """The folder in which relative paths of scenes start: that given, or else of TAICHI_EDGES_DATA; None without.

    origin: what the user calls it, for the message.
    """
    origin, data = (origin, given) if given else (DATA_ROOT, os.environ.get(DATA_ROOT))
    if not data:
        return None
    folder = expand(data, origin)
    if not folder.is_dir():
        raise UserError(f"{origin}: {data} is not a folder; name the folder that holds the scenes' data")
    return folder.resolve()


def shipped_scenes() -> dict[str, Path]:
    """{name: path} of the scene files that come along."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.yaml"))}


def scene_path(text: Path | str) -> Path:
    """What the user names as a scene: a path, or the name of a scene that comes along where nothing lies there.

    The results of that scene are not taken for its source: without a folder for them they lie under its name.
    """
    path = expand(text, "scene")
    if path.name != str(path) or (path.exists() and not (path / "run.json").is_file()):
        return path
    return shipped_scenes().get(path.name.removesuffix(".yaml"), path)
