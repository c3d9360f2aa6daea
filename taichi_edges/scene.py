"""SceneConfig: one YAML file = one scene. Every key has its unit, its default and its meaning here.

Unknown and mistyped keys are refused by name. Precedence: defaults < preset < scene file < `--preset` given on the
command line < `--set key=value`.
"""

import difflib
import re
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from taichi_edges.errors import UserError, did_you_mean

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]


class Section(BaseModel):
    """A part of the scene file: frozen, strict about types, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class SourceConfig(Section):
    """Where edge maps and cameras come from."""

    reader: Literal["nerf", "emap", "synthetic"] = Field("emap", description="layout of the folder, see README")
    path: str = Field("", description="folder, relative to the data root (--data or TAICHI_EDGES_DATA) or absolute")
    edges: str = Field("", description="folder of the edge maps inside `path`, e.g. edge_DexiNed")
    images: str = Field("", description="folder of the colour images inside `path`; optional, for the overlays")
    split: str = Field("train", description="nerf: which transforms_<split>.json")
    axes: Literal["auto", "opengl", "opencv"] = Field("auto", description="camera axes; auto: what the layout means")
    points: str = Field("", description="point cloud to start from with train.seeds: points; relative to the data root")
    thin: bool = Field(True, description="reduce the lines of the edge maps to their ridges and redraw them thin")
    thin_threshold: Share = Field(0.3, description="of full scale; ridges of the edge maps below are dropped")
    skip: list[str] = Field([], description="names of views to leave out")
    part: str = Field("demo", description="synthetic: which of the generator's parts")
    views: Count = Field(30, description="synthetic: number of views")
    size: Annotated[int, Field(ge=16)] = Field(400, description="synthetic: width and height of the views, pixels")


class LearningRates(Section):
    """Adam's rates (supplement, "Training")."""

    means: NotNegative = Field(1e-3, description="unit-cube units per step")
    scales: NotNegative = Field(2e-4, description="of the logarithm, per step")
    opacities: NotNegative = Field(3e-2, description="of the logit, per step")
    quaternions: NotNegative = Field(1e-3, description="per step")


class DensityConfig(Section):
    """Culling and duplication "at regular intervals" (supplement): the epochs after which they happen."""

    duplicate_epochs: list[Count] = Field([*range(40, 161, 10)], description="epochs")
    duplicate_gradient: Share = Field(0.5, description="relative positional gradient from which on to duplicate")
    duplicate_copies: Annotated[int, Field(ge=0)] = Field(2, description="copies of each")
    duplicate_distance: NotNegative = Field(0.01, description="standard deviation of a copy's offset, unit-cube units")
    max_gaussians: Count = Field(50_000, description="no duplication beyond this number")
    cull_opacity_epochs: list[Count] = Field([125, 310, 450], description="epochs")
    min_opacity: Share = Field(0.05, description="Gaussians below are culled")
    cull_support_epochs: list[Count] = Field([100, 150, 200, 250, 350, 450], description="epochs")
    min_support: Share = Field(0.05, description="share of the views whose edge pixels a centre must hit")
    reset_opacity: bool = Field(True, description="opacities down to the initial one after a cull")


class TrainConfig(Section):
    """Training of the Gaussians (paper 3.1, 3.2, supplement)."""

    epochs: Count = Field(500, description="passes over all views")
    gaussians: Count = Field(10_000, description="number of random points to start from")
    seeds: Literal["random", "points", "votes"] = Field(
        "random", description="random points in the box, source.points, or where many views agree on an edge"
    )
    initial_scale: Positive = Field(0.004, description="standard deviation, unit-cube units")
    initial_opacity: Annotated[float, Field(gt=0, lt=1)] = Field(0.08)
    edge_threshold: Annotated[float, Field(gt=0, le=1)] = Field(
        0.5, description="of full scale; from here on a pixel is an edge pixel"
    )
    loss: Literal["balanced", "class_weighted", "whole_image"] = Field("balanced", description="balanced is eq. 3")
    only_means_epochs: Annotated[int, Field(ge=0)] = Field(30, description="epochs that train positions only")
    learning_rates: LearningRates = LearningRates()
    means_decay: Positive = Field(0.75, description="factor on the rate of the means")
    means_decay_epochs: Count = Field(10, description="epochs between two decays")
    means_decays: Annotated[int, Field(ge=0)] = Field(5, description="number of decays")
    regularize_from_epoch: Annotated[int, Field(ge=0)] = Field(300, description="L_orient and L_shape start here")
    regularize_every: Count = Field(10, description="steps")
    orient_weight: NotNegative = Field(0.1, description="lambda_1 of eq. 6; 0.01 for large scenes")
    shape_weight: NotNegative = Field(0.1, description="lambda_2 of eq. 6; 0.01 for large scenes")
    neighbors: Annotated[int, Field(ge=1, le=16)] = Field(4, description="k of eq. 4")
    neighbors_refresh_steps: Count = Field(100, description="steps between two neighbour searches")
    density: DensityConfig = DensityConfig()


class FilterConfig(Section):
    """Which trained Gaussians become oriented points."""

    min_opacity: Share = Field(0.2)
    min_support: Share = Field(0.05, description="share of the views that see a point and have an edge pixel there")
    outlier_neighbors: Annotated[int, Field(ge=0)] = Field(3, description="statistical outliers: neighbours; 0: off")
    outlier_deviations: Positive = Field(5.0, description="mean neighbour distance allowed, standard deviations")


class ClusterConfig(Section):
    """Graph traversal (paper 3.3)."""

    theta: Share = Field(0.8, description="|cos| from which on orientations agree; 0.6 for curved objects")
    neighbors: Count = Field(10, description="spatial neighbours of a point")
    max_gap: Positive = Field(0.03, description="neighbours are no farther apart, unit-cube units")
    min_points: Annotated[int, Field(ge=2)] = Field(10, description="smaller clusters are reported and left out")


class FitConfig(Section):
    """Lines and cubic Bezier curves (paper 3.3)."""

    delta: NotNegative = Field(0.5, description="a curve is kept when its error <= delta * the line's; 1 for DTU")
    line_tolerance: Positive = Field(0.005, description="inlier distance of the robust line, unit-cube units")
    min_length: NotNegative = Field(0.01, description="shorter edges are reported and left out, unit-cube units")


class EvaluationConfig(Section):
    """Ground truth, where there is one."""

    truth: str = Field("", description="ABC folder, PLY or edge JSON, relative to the data root; '': no evaluation")


class SceneConfig(Section):
    """A whole scene."""

    name: Name = Field("scene", description="folder of the results; the file's name unless set")
    preset: Literal["paper", "fast"] = Field("paper", description="the schedule the scene starts from")
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(0, description="of every random choice")
    box: Annotated[list[Point], Field(min_length=2, max_length=2)] = Field(
        [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], description="opposite corners of the scene, input units"
    )
    source: SourceConfig = SourceConfig()
    train: TrainConfig = TrainConfig()
    filter: FilterConfig = FilterConfig()
    cluster: ClusterConfig = ClusterConfig()
    fit: FitConfig = FitConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @field_validator("box")
    @classmethod
    def _box_has_volume(cls, box):
        if any(high <= low for low, high in zip(*box)):
            raise ValueError("the second corner must be greater than the first in x, y and z")
        return box

    @model_validator(mode="after")
    def _source_has_path(self):
        if self.source.reader != "synthetic" and not self.source.path:
            raise ValueError("source.path is missing; set it to the folder with the images and cameras")
        return self


# The schedule of the paper and its supplement, key by key; what it does not name keeps the scene's value.
PRESETS = {
    "paper": {
        "train": {
            "epochs": 500,
            "gaussians": 10_000,
            "seeds": "random",
            "initial_scale": 0.004,
            "initial_opacity": 0.08,
            "loss": "balanced",
            "only_means_epochs": 30,
            "learning_rates": {"means": 1e-3, "scales": 2e-4, "opacities": 3e-2, "quaternions": 1e-3},
            "means_decay": 0.75,
            "means_decay_epochs": 10,
            "means_decays": 5,
            "regularize_from_epoch": 300,
            "regularize_every": 10,
            "orient_weight": 0.1,
            "shape_weight": 0.1,
            "neighbors": 4,
            # The paper leaves the intervals open; those in epochs belong to its 500 epochs.
            "density": DensityConfig().model_dump(),
        }
    },
    # Seeded where the views agree, so that a few passes are enough: faster rates, one smooth decay, no duplication.
    "fast": {
        "train": {
            "epochs": 20,
            "gaussians": 10_000,
            "seeds": "votes",
            "initial_opacity": 0.3,
            "loss": "balanced",
            "only_means_epochs": 3,
            "learning_rates": {"means": 2e-3, "scales": 5e-3, "opacities": 3e-2, "quaternions": 5e-3},
            "means_decay": 0.84,
            "means_decay_epochs": 1,
            "means_decays": 20,
            "regularize_from_epoch": 10,
            "density": {
                "duplicate_epochs": [],
                "cull_opacity_epochs": [14],
                "cull_support_epochs": [10, 15],
                "reset_opacity": False,
            },
        }
    },
}


class _SceneLoader(yaml.SafeLoader):
    """YAML 1.1 reads 1e-3 as a string; a number in a scene file is a number. Repeated keys are refused."""

    def construct_mapping(self, node, deep=False):
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


def parse_yaml(text, where):
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


def merge(base, over):
    """Nested dicts: what `over` names replaces what `base` has."""
    if not (isinstance(base, dict) and isinstance(over, dict)):
        return over
    return {
        key: merge(base[key], over[key]) if key in base and key in over else over.get(key, base.get(key))
        for key in base | over
    }


def load_scene(path, preset=None, settings=(), seed=None):
    """Read and check a scene file.

    preset: overrides the scene's preset, and the scene's own values where the preset names them.
    settings: 'key.subkey=value' strings, YAML values. seed: overrides the scene's.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not a text file; a scene is a YAML file, see scenes/") from error
    except OSError as error:
        raise UserError(f"{path}: {_why_unreadable(path, error)}") from error
    content = parse_yaml(text, path)
    if not isinstance(content, dict):
        what = "it is empty" if content is None else f"this is {_in_yaml(content)}"
        raise UserError(f"{path}: {what}, but a scene is a mapping of keys; see scenes/demo.yaml for an example")
    content = {"name": path.stem, **content}
    base = content.get("preset", "paper")
    content = merge(PRESETS.get(base, {}) if isinstance(base, str) else {}, content)
    if preset is not None:
        if preset not in PRESETS:
            raise UserError(f"--preset {preset}: there is no such preset; there is {', '.join(PRESETS)}")
        content = merge(content, {"preset": preset, **PRESETS[preset]})
    origins = {}
    for setting in settings:
        keys, value = _parse_setting(setting)
        origins[keys] = f"--set {setting}"
        for name in reversed(keys):
            value = {name: value}
        content = merge(content, value)
    if seed is not None:
        content["seed"] = seed
        origins[("seed",)] = f"--seed {seed}"
    return check_scene(content, path, origins)


def _why_unreadable(path, error):
    """What is wrong with a scene's path; a scene of a similar name in the same folder is named."""
    elsewhere = "; the scenes that come along are in scenes/"
    if path.is_dir():
        return f"is a folder, not a scene file{elsewhere}"
    near = did_you_mean(path.name, [p.name for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else [])
    return f"{error.strerror}{near or elsewhere}"


def _parse_setting(setting):
    """'train.epochs=100' -> (('train', 'epochs'), 100)."""
    key, equals, value = setting.partition("=")
    keys = tuple(key.strip().split("."))
    if not equals or not all(keys):
        raise UserError(f"--set {setting}: write key=value, e.g. --set train.epochs=100")
    if keys == ("preset",):
        raise UserError(f"--set {setting}: a preset brings many values with it; use --preset{value and ' '}{value}")
    return keys, parse_yaml(value, f"--set {key.strip()}")


def check_scene(content, where, origins=None):
    """A dict -> SceneConfig; the first mistake becomes one line with file, key and what to do.

    where: the file, for the message. origins: {keys: text} names other places that values come from, e.g. `--set`.
    """
    try:
        return SceneConfig.model_validate(content)
    except ValidationError as error:
        problem = error.errors()[0]
        for keys, text in (origins or {}).items():
            if all(mine == theirs for mine, theirs in zip(keys, problem["loc"])) and problem["loc"]:
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


def _describe(problem, count, where):
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


def _in_yaml(value):
    """A value as the user would write it: true, null, 'text'."""
    if isinstance(value, (dict, list)):
        return "a mapping" if isinstance(value, dict) else "a list"
    return {True: "true", False: "false", None: "null"}[value] if isinstance(value, (bool, type(None))) else repr(value)


def _section_at(location):
    """The Section class at `location`, a tuple of names; None where there is none."""
    section = SceneConfig
    for name in location:
        field = section.model_fields.get(name)
        section = field.annotation if field else None
        if not (isinstance(section, type) and issubclass(section, Section)):
            return None
    return section


def _meaning(location):
    """What the key at `location` means, with its unit, as its field says."""
    names = [part for part in location if isinstance(part, str)]
    section = _section_at(names[:-1]) if names else None
    field = section.model_fields.get(names[-1]) if section else None
    return (field.description or "") if field else ""


def _nearest_key(location):
    """A hint for an unknown key: the same key in another section, a similar one here or elsewhere, or all there are."""
    name, known = str(location[-1]), list(_section_at(location[:-1]).model_fields)
    places = {}

    def collect(section, prefix):
        for key, value in section.model_fields.items():
            places.setdefault(key, f"{prefix}{key}")
            if isinstance(value.annotation, type) and issubclass(value.annotation, Section):
                collect(value.annotation, f"{prefix}{key}.")

    collect(SceneConfig, "")
    closeness = {key: difflib.SequenceMatcher(None, name, key).ratio() for key in places}
    here = max(known, key=closeness.get)
    anywhere = max(places, key=closeness.get)
    if closeness[anywhere] > max(closeness[here], 0.7):
        return f"; did you mean '{places[anywhere]}'?"
    return did_you_mean(name, [here]) or f"; known here: {', '.join(known)}"
