"""From what the user names to a checked scene.

That is a scene file; the name of a scene that comes along; or a folder that the readers know, a scene without keys.
Precedence: defaults < preset < scale < scene file < `--preset` and `--scale` given on the command line <
`--set key=value`.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from taichi_edges.errors import UserError, did_you_mean, refuse_unknown
from taichi_edges.scene.paths import SHIPPED, data_folder, expand, scene_path, shipped_scenes
from taichi_edges.scene.presets import PRESETS, SCALES, SCALES_OF_READERS
from taichi_edges.scene.scene_file import check_scene, in_yaml, overlay, parse_yaml
from taichi_edges.scene.settings import SceneConfig

Setting = tuple[tuple[str, ...], Any, str]  # the names on the way to a key, its value, and where that was given
BUNDLES = (("preset",), ("scale",))  # keys that stand for many
EXAMPLE = SHIPPED / "demo.yaml"
LISTING_SUFFIXES = (".json", ".npz", ".bin", ".txt")  # of files that list the views of a source


def load_scene(
    path: Path | str,
    preset: str | None = None,
    settings: Iterable[str] | Mapping[str, Any] = (),
    seed: int | None = None,
    scale: str | None = None,
    data_root: Path | str | None = None,
) -> SceneConfig:
    """Read and check a scene: a YAML file, the name of one that comes along, or a folder that the readers know.

    preset, scale: override the scene's, and the scene's own values where they name them.
    settings: 'key.subkey=value' strings, YAML values; or a dict of values and sections by key, such as
    {"train.steps": 300, "fit": {"delta": 0.3}}; tuples, arrays, NumPy's numbers and paths are values, too.
    seed: overrides the scene's.
    data_root: folder in which a relative source.path starts, None for that of TAICHI_EDGES_DATA; a scene that names no
    scale gets that of the layout found there. Returns the SceneConfig.
    """
    path = scene_path(path)
    content = _folder_content(path) if is_source(path) else _file_content(path)
    refuse_unknown("preset", preset, "preset", PRESETS)
    refuse_unknown("scale", scale, "scale", SCALES)
    parsed = _parse_settings(settings)
    if scale is None and "scale" not in content:
        content |= _scale_of_source({**_section(content), **_settings_of_source(parsed)}, data_root)
    content = overlay(_starting_values(preset or content.get("preset"), scale or content.get("scale")), content)
    content = _overridden(content, preset, scale)
    origins: dict[tuple[str, ...], str] = {}
    for keys, value, origin in parsed:
        origins[keys] = origin
        content = overlay(content, _nested(keys, value))
    if seed is not None:
        content["seed"] = _plain(seed)
        origins[("seed",)] = f"seed {seed}"
    return check_scene(content, path, origins)


def _section(content: dict[str, Any]) -> dict[str, Any]:
    """The section `source` as the scene has it; {} where there is none."""
    source = content.get("source")
    return source if isinstance(source, dict) else {}


def _settings_of_source(parsed: Iterable[Setting]) -> dict[str, Any]:
    """The keys of the section `source` that settings name."""
    found: dict[str, Any] = {}
    for keys, value, _ in parsed:
        found |= _section(_nested(keys, value))
    return found


def _nested(keys: tuple[str, ...], value: Any) -> Any:
    """('train', 'steps'), 300 -> {'train': {'steps': 300}}."""
    for name in reversed(keys):
        value = {name: value}
    return value


def _scale_of_source(source: dict[str, Any], data_root: Path | str | None) -> dict[str, str]:
    """{'scale': ...} for a scene of photographs, as its reader tells, named or recognised; {} for others."""
    reader = source.get("reader", "auto")
    if reader == "auto":
        reader = _recognised_reader(source.get("path"), data_root)
    scale = SCALES_OF_READERS.get(reader) if isinstance(reader, str) else None
    return {} if scale is None else {"scale": scale}


def _recognised_reader(text: Any, data_root: Path | str | None) -> str | None:
    """The reader that fits what is at a source.path; None where that is unknown: the stage that reads it says why."""
    from taichi_edges.readers.recognition import recognise

    if not isinstance(text, str) or not text:
        return None
    try:
        path = expand(text, "source.path")
        if not path.is_absolute():
            data_root = data_folder(data_root)
            if data_root is None:
                return None
            path = data_root / path
        return recognise(path).reader
    except (UserError, OSError, ValueError):
        return None


def is_source(path: Path) -> bool:
    """Whether what was given in place of a scene file is the source itself: a folder, or a file that lists views."""
    return path.is_dir() or (path.suffix.lower() in LISTING_SUFFIXES and path.is_file())


def _folder_content(path: Path) -> dict[str, Any]:
    """The scene that a folder without a scene file is: its own path and name, everything else as by default."""
    from taichi_edges.readers.recognition import scene_name

    return {"name": scene_name(path), "source": {"reader": "auto", "path": str(path.resolve())}}


def _file_content(path: Path) -> dict[str, Any]:
    """What a scene file says, with the file's name where it names no scene."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        what = f"a scene is a YAML file, as {EXAMPLE} is, or a folder of photographs"
        raise UserError(f"{path}: is not a text file; {what}") from error
    except OSError as error:
        raise UserError(f"{path}: {_why_unreadable(path, error)}") from error
    content = parse_yaml(text, path)
    if not isinstance(content, dict):
        what = "it is empty" if content is None else f"this is {in_yaml(content)}"
        raise UserError(f"{path}: {what}, but a scene is a mapping of keys; see {EXAMPLE} for an example")
    return {"name": path.stem, **content}


def _starting_values(preset: Any, scale: Any) -> dict[str, Any]:
    """What a scene starts from: its preset, and over it what the preset says for scenes of this scale."""
    preset = SceneConfig.model_fields["preset"].default if preset is None else preset
    scale = SceneConfig.model_fields["scale"].default if scale is None else scale
    if not (isinstance(preset, str) and preset in PRESETS):
        return {}  # refused below, as every value of a wrong type
    of_scale = SCALES.get(scale, {}) if isinstance(scale, str) else {}
    return overlay(PRESETS[preset], of_scale.get(preset, {}))


def _overridden(content: dict[str, Any], preset: str | None, scale: str | None) -> dict[str, Any]:
    """The scene with the preset and the scale of the command line, where there are any, over its own values."""
    of_scale = scale or content.get("scale")
    if preset is not None:
        content = overlay(content, {"preset": preset, **_starting_values(preset, of_scale)})
    if scale is not None:
        preset = content.get("preset", SceneConfig.model_fields["preset"].default)
        values = SCALES[scale].get(preset, {}) if isinstance(preset, str) else {}
        content = overlay(content, {"scale": scale, **values})
    return content


def _why_unreadable(path: Path, error: OSError) -> str:
    """What is wrong with a scene's path; one of a like name that comes along or lies in the same folder is named."""
    shipped = shipped_scenes()
    if path.stem in shipped:
        return f"{error.strerror}; for the scene that comes along give its name alone: {path.stem}"
    known = [p.name for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    near = did_you_mean(path.name, known) or did_you_mean(path.stem, shipped)
    return f"{error.strerror}{near or '; scenes that come along: ' + ', '.join(shipped)}"


def _parse_settings(settings: Iterable[str] | Mapping[str, Any]) -> list[Setting]:
    """(('train', 'steps'), 300, 'train.steps=300') of each. settings: as `load_scene` takes."""
    if isinstance(settings, Mapping):
        return [_named_setting(key, _plain(value)) for key, value in settings.items()]
    listed = None if isinstance(settings, str) or not isinstance(settings, Iterable) else list(settings)
    if listed is None or not all(isinstance(setting, str) for setting in listed):
        raise UserError(f"settings: must be a dict, or a list of 'key=value', not {settings!r}")
    return [_parse_setting(setting) for setting in listed]


def _named_setting(key: Any, value: Any) -> Setting:
    """'train.epochs', 100 -> (('train', 'epochs'), 100, 'train.epochs=100')."""
    origin = f"{key}={value!r}"
    keys = tuple(key.split(".")) if isinstance(key, str) else ()
    if not keys or not all(keys):
        raise UserError(f"{origin}: a key is a text, names with one dot between them, e.g. 'train.epochs'")
    if keys in BUNDLES:
        raise UserError(f"{origin}: a {key} brings many values with it; give it as the argument {key}")
    return keys, value, origin


def _plain(value: Any) -> Any:
    """A value from Python as a scene file would give it: lists for tuples and arrays, texts for paths."""
    if isinstance(value, Mapping):
        return {key: _plain(below) for key, below in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.tolist() if hasattr(value, "tolist") else value  # NumPy, which is not imported for it


def _parse_setting(setting: str) -> Setting:
    """'train.epochs=100' -> (('train', 'epochs'), 100, '--set train.epochs=100')."""
    key, equals, value = setting.partition("=")
    keys, origin = tuple(key.strip().split(".")), f"--set {setting}"
    if not equals or not all(keys):
        raise UserError(f"{origin}: write key=value, e.g. --set train.epochs=100")
    if keys in BUNDLES:
        option = keys[0]
        raise UserError(f"{origin}: a {option} brings many values with it; use --{option}{value and ' '}{value}")
    return keys, parse_yaml(value, f"--set {key.strip()}"), origin
