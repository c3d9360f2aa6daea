"""Scene files: one YAML file = one scene.

Unknown and mistyped keys are refused by name. Precedence: defaults < preset < scale < scene file < `--preset` and
`--scale` given on the command line < `--set key=value`. A folder in place of a scene file is a scene without keys; the
name of a scene that comes along stands for its file.
"""

import difflib
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from pydantic import ValidationError

from taichi_edges.errors import UserError, did_you_mean, refuse_unknown
from taichi_edges.scene.paths import data_folder, expand, scene_path, shipped_scenes
from taichi_edges.scene.presets import PRESETS, SCALES, SCALES_OF_READERS
from taichi_edges.scene.settings import SceneConfig, Section

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Setting = tuple[tuple[str, ...], Any, str]  # the names on the way to a key, its value, and where that was given
LISTING_SUFFIXES = (".json", ".npz", ".bin", ".txt")  # of files that list the views of a source


class _SceneLoader(yaml.SafeLoader):
    """YAML 1.1 reads 1e-3 as a string; a number in a scene file is a number. Repeated keys are refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key.value, str) and key.value in seen:
                problem = f"the key '{key.value}' is given twice; leave one of them out"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


_FLOAT = re.compile(
    r"^[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"
)
# YAML 1.1 also reads 010 as eight and 1:30 as ninety; here they stay texts, and are refused where a number belongs.
_INT = re.compile(r"^[-+]?(0|[1-9][0-9_]*|0x[0-9a-fA-F_]+)$")
_NUMBERS = ("tag:yaml.org,2002:float", "tag:yaml.org,2002:int")
_SceneLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _NUMBERS]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_SceneLoader.add_implicit_resolver("tag:yaml.org,2002:int", _INT, list("-+0123456789"))
_SceneLoader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))


def parse_yaml(text: str, where: Path | str) -> Any:
    """YAML to Python; a syntax error becomes one line that names file, line and column."""
    try:
        return yaml.load(text, _SceneLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it holds control characters; is it a text file?"
        raise UserError(f"{where}:{place}{':' if place else ''} not valid YAML: {problem}") from error
    except RecursionError as error:
        raise UserError(f"{where}: not valid YAML: nested too deeply; is a bracket left open?") from error


def merge(base: Any, over: Any) -> Any:
    """Nested dicts: what `over` names replaces what `base` has."""
    if not (isinstance(base, dict) and isinstance(over, dict)):
        return over
    return {
        key: merge(base[key], over[key]) if key in base and key in over else over.get(key, base.get(key))
        for key in base | over
    }


def overlay(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`merge`, where a length of the training given in epochs replaces one in steps and the other way round."""
    merged, train = merge(base, over), over.get("train")
    given = [key for key in ("epochs", "steps") if isinstance(train, dict) and train.get(key)]
    if len(given) == 1:
        merged["train"] = {**merged["train"], "steps" if given == ["epochs"] else "epochs": 0}
    return merged


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
    {"train.steps": 300, "fit": {"delta": 0.3}}. seed: overrides the scene's.
    data_root: folder in which a relative source.path starts, None for that of TAICHI_EDGES_DATA; a scene that names no
    scale gets that of the layout found there. Returns the SceneConfig.
    """
    path = scene_path(path)
    content = _folder_content(path) if is_source(path) else _file_content(path)
    refuse_unknown("--preset", preset, "preset", PRESETS)
    refuse_unknown("--scale", scale, "scale", SCALES)
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
        content["seed"] = seed
        origins[("seed",)] = f"--seed {seed}"
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
        what = "a scene is a YAML file, see scenes/, or a folder of photographs"
        raise UserError(f"{path}: is not a text file; {what}") from error
    except OSError as error:
        raise UserError(f"{path}: {_why_unreadable(path, error)}") from error
    content = parse_yaml(text, path)
    if not isinstance(content, dict):
        what = "it is empty" if content is None else f"this is {_in_yaml(content)}"
        raise UserError(f"{path}: {what}, but a scene is a mapping of keys; see scenes/demo.yaml for an example")
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
    if not isinstance(settings, Mapping):
        return [_parse_setting(setting) for setting in settings]
    parsed = [(tuple(key.split(".")), value, f"{key}={value!r}") for key, value in settings.items()]
    for keys, value, origin in parsed:
        _refuse_bundle(keys, value, origin)
    return parsed


def _parse_setting(setting: str) -> Setting:
    """'train.epochs=100' -> (('train', 'epochs'), 100, '--set train.epochs=100')."""
    key, equals, value = setting.partition("=")
    keys, origin = tuple(key.strip().split(".")), f"--set {setting}"
    if not equals or not all(keys):
        raise UserError(f"{origin}: write key=value, e.g. --set train.epochs=100")
    _refuse_bundle(keys, value, origin)
    return keys, parse_yaml(value, f"--set {key.strip()}"), origin


def _refuse_bundle(keys: tuple[str, ...], value: Any, origin: str) -> None:
    """UserError where a setting is a preset or a scale."""
    if keys in (("preset",), ("scale",)):
        option = keys[0]
        raise UserError(f"{origin}: a {option} brings many values with it; use --{option}{value and ' '}{value}")


def check_scene(
    content: dict[str, Any], where: Path | str, origins: Mapping[tuple[str, ...], str] | None = None
) -> SceneConfig:
    """A dict -> SceneConfig; the first mistake becomes one line with file, key and what to do.

    where: the file, for the message. origins: {keys: text} names other places that values come from, e.g. `--set`.
    """
    try:
        return SceneConfig.model_validate(content)
    except ValidationError as error:
        problem = error.errors()[0]
        for keys, text in (origins or {}).items():
            if all(mine == theirs for mine, theirs in zip(keys, problem["loc"], strict=False)) and problem["loc"]:
                where = text
        raise UserError(_describe(problem, len(error.errors()), where)) from error


# Pydantic's types of mistakes in the words of a scene file; {} are the values pydantic gives with the mistake.
_WORDS = {
    "int_type": "must be a whole number",
    "float_type": "must be a number",
    "bool_type": "must be true or false",
    "string_type": "must be a text, in quotes",
    "list_type": "must be a list, [...]",
    "model_type": "must be a section with keys of its own",
    "finite_number": "must be a finite number",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "too_short": "must have {min_length} entries, not {actual_length}",
    "too_long": "must have {max_length} entries, not {actual_length}",
    "literal_error": "must be {expected}",
    "string_pattern_mismatch": "may hold only letters, digits, '.', '_' and '-', and must start with a letter or digit",
    "invalid_key": "a key must be a text",
}


def _describe(problem: "ErrorDetails", count: int, where: Path | str) -> str:
    """One line for pydantic's first finding."""
    location, context = problem["loc"], problem.get("ctx", {})
    key = ".".join(str(part) for part in location)
    more = f" (and {count - 1} more mistake{'s' if count > 2 else ''})" if count > 1 else ""
    if problem["type"] == "extra_forbidden":
        return f"{where}: {key}: unknown key{_nearest_key(location)}{more}"
    message = _WORDS.get(problem["type"], problem["msg"].removeprefix("Value error, ")).format(**context)
    value = problem.get("input")
    simple = isinstance(value, (str, int, float, type(None))) and problem["type"] != "invalid_key"
    given = f", not {_in_yaml(value)}" if simple else ""
    meaning = _meaning(location)
    place = f"{key}: " if key else ""
    return f"{where}: {place}{message}{given}{f' ({meaning})' if meaning else ''}{more}"


def _in_yaml(value: object) -> str:
    """A value as the user would write it: true, null, 'text'."""
    if isinstance(value, (dict, list)):
        return "a mapping" if isinstance(value, dict) else "a list"
    return {True: "true", False: "false", None: "null"}[value] if isinstance(value, (bool, type(None))) else repr(value)


def _section_at(location: Sequence[int | str]) -> type[Section] | None:
    """The Section class at `location`, the names on the way to it; None where there is none."""
    section: type[Section] = SceneConfig
    for name in location:
        field = section.model_fields.get(str(name))
        inside = field.annotation if field else None
        if not (isinstance(inside, type) and issubclass(inside, Section)):
            return None
        section = inside
    return section


def _meaning(location: Sequence[int | str]) -> str:
    """What the key at `location` means, with its unit, as its field says."""
    names = [part for part in location if isinstance(part, str)]
    section = _section_at(names[:-1]) if names else None
    field = section.model_fields.get(names[-1]) if section else None
    return (field.description or "") if field else ""


def _nearest_key(location: Sequence[int | str]) -> str:
    """A hint for an unknown key: the same key in another section, a similar one here or elsewhere, or all there are."""
    name, section_here = str(location[-1]), _section_at(location[:-1])
    assert section_here is not None  # nothing else refuses keys
    known, places = list(section_here.model_fields), dict[str, str]()

    def collect(section: type[Section], prefix: str) -> None:
        for key, value in section.model_fields.items():
            places.setdefault(key, f"{prefix}{key}")
            if isinstance(value.annotation, type) and issubclass(value.annotation, Section):
                collect(value.annotation, f"{prefix}{key}.")

    collect(SceneConfig, "")
    closeness = {key: difflib.SequenceMatcher(None, name, key).ratio() for key in places}
    here = max(known, key=closeness.__getitem__)
    anywhere = max(places, key=closeness.__getitem__)
    if closeness[anywhere] > max(closeness[here], 0.7):
        return f"; did you mean '{places[anywhere]}'?"
    return did_you_mean(name, [here]) or f"; known here: {', '.join(known)}"
