"""What a scene file may say: one YAML file = one scene. Unknown and mistyped keys are refused by name."""

import difflib
import re
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from pydantic import ValidationError

from taichi_edges.errors import UserError, did_you_mean
from taichi_edges.scene.settings import SceneConfig, Section

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


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


# Keys that a scene does not have any more, or never had, and what to do instead.
_NO_KEYS = {
    **dict.fromkeys(
        ("filter.grow", "filter.grow_step", "filter.harvest"),
        "it is gone, for the strokes of train.seeds: lift reach the ends of their edges; leave it out",
    ),
    **dict.fromkeys(
        ("filter.min_steadiness", "filter.min_evidence", "filter.min_angle"),
        "it is gone, for refine.verdict tells edges from what is none; leave it out",
    ),
    "stage": "the stage to start with is --stage on the command line, the argument start from Python",
    "show": "the window is opened by the command line alone, with --show",
}


def _describe(problem: "ErrorDetails", count: int, where: Path | str) -> str:
    """One line for pydantic's first finding."""
    location, context = problem["loc"], problem.get("ctx", {})
    key = ".".join(str(part) for part in location)
    more = f" (and {count - 1} more mistake{'s' if count > 2 else ''})" if count > 1 else ""
    if problem["type"] == "extra_forbidden":
        hint = f"; {_NO_KEYS[key]}" if key in _NO_KEYS else _nearest_key(location)
        return f"{where}: {key}: unknown key{hint}{more}"
    message = _WORDS.get(problem["type"], problem["msg"].removeprefix("Value error, ")).format(**context)
    value = problem.get("input")
    simple = isinstance(value, (str, int, float, type(None))) and problem["type"] != "invalid_key"
    given = f", not {in_yaml(value)}" if simple else ""
    meaning = _meaning(location)
    place = f"{key}: " if key else ""
    return f"{where}: {place}{message}{given}{f' ({meaning})' if meaning else ''}{more}"


def in_yaml(value: object) -> str:
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
