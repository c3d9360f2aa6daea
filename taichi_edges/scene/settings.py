"""SceneConfig: what a scene consists of. Every key has its unit, its default and its meaning here.

The defaults are the preset `fast` for a part. `presets` holds what another preset or scale sets otherwise; `scene_file`
reads a scene from YAML.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    WrapValidator,
    field_validator,
    model_validator,
)

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]
Box = Annotated[list[Point], Field(min_length=2, max_length=2)]


WITH_POINTS = ("auto", "colmap", "images", "nerfstudio")  # readers of layouts that may hold points of their own
MOST_BIAS = 20.0  # px; a map that is farther off belongs to another image


class Section(BaseModel):
    """A part of the scene file: frozen, strict about types, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class OnnxConfig(Section):
    """A learned detector from an ONNX file, with `source.detector: onnx`."""

    model: str = Field("", description="the ONNX file, relative to the data root or absolute")
    network: str = Field("", description="which network it is, e.g. pidinet; '': as the file's name says")
    scale: Annotated[float, Field(gt=0, le=4)] = Field(1.0, description="the network sees the image so much larger")
    flip: bool | Literal["both"] = Field(False, description="average with the mirrored image; both: in both directions")


class SourceConfig(Section):
    """Where edge maps and cameras come from."""

    reader: Literal["auto", "colmap", "emap", "idr", "images", "nerf", "nerfstudio", "synthetic"] = Field(
        "auto", description="layout of the folder, see docs/inputs.md; auto: recognised from what is in it"
    )
    path: str = Field(
        "", description="folder, or the file in it that lists the views; relative to the data root or absolute"
    )
    edges: str = Field("", description="folder of ready edge maps inside `path`, e.g. edge_DexiNed")
    images: str = Field("", description="folder of the colour images inside `path`; '': where the layout has them")
    masks: str = Field(
        "", description="folder of masks inside `path`, 128 and more is kept; '': masks or mask if there is one; none"
    )
    max_size: Annotated[int, Field(ge=0)] = Field(
        1600, description="longest side of photographs, pixels: larger ones are made smaller; 0: keep them"
    )
    detector: Literal["auto", "maps", "subpixel", "onnx"] = Field(
        "auto", description="ready maps, our own detector, or a network; auto: maps if `edges` is given, else subpixel"
    )
    gamma: Annotated[float, Field(ge=0, le=10)] = Field(
        0.0, description="how images encode light, for `subpixel`: value = light^(1/gamma); 0: sRGB, as PNG and JPEG do"
    )
    onnx: OnnxConfig = Field(default_factory=OnnxConfig)
    split: str = Field("train", description="nerf: which transforms_<split>.json")
    axes: Literal["auto", "opengl", "opencv"] = Field("auto", description="camera axes; auto: what the layout means")
    model: str = Field("", description="colmap: folder of the model inside `path`, e.g. sparse/1; '': the largest")
    max_point_error: Positive = Field(2.0, description="colmap: mean reprojection error of the points used, pixels")
    min_track: Annotated[int, Field(ge=2)] = Field(3, description="colmap: images that see a point, at least")
    points: str = Field("", description="point cloud to start from with train.seeds: points; relative to the data root")
    thin: bool = Field(True, description="reduce the lines of the edge maps to their ridges and redraw them thin")
    thin_threshold: Share = Field(0.3, description="of full scale; ridges of the edge maps below are dropped")
    min_chain: Annotated[int, Field(ge=0)] = Field(
        0, description="px; edgels on shorter chains are taken for texture, longer ones tell directions; 0: all count"
    )
    tolerance_px: Positive = Field(0.5, description="by which edgels may be off, detector and poses together, px")
    skip: list[str] = Field([], description="names of views to leave out")
    part: str = Field("demo", description="synthetic: which of the generator's parts")
    views: Count = Field(30, description="synthetic: number of views")
    size: Annotated[int, Field(ge=16)] = Field(400, description="synthetic: width and height of the views, pixels")


def _measured_or(given: Callable[[Any], bool], what: str) -> PlainValidator:
    """A validator that lets 'auto', 'off' (YAML reads it as false) and what `given` accepts pass."""

    def check(value: Any) -> Any:
        if value is False or value == "off":
            return "off"
        if value is True or value == "auto":
            return "auto"
        if not given(value):
            raise ValueError(f"must be auto, off or {what}")
        return value

    return PlainValidator(check)


def _is_length(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < MOST_BIAS


def _is_shift(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_length, value))


class CalibrationConfig(Section):
    """Biases of ready or learned edge maps, see calibration/calibration.py. `calibration: off` switches both off."""

    shift: Annotated[
        str | list[float], _measured_or(_is_shift, f"[right, down] in pixels, less than {MOST_BIAS:g} each")
    ] = Field(
        "auto", description="by which the maps are shifted against the images: measured, [right, down] px, or off"
    )
    silhouette: Annotated[str | float, _measured_or(_is_length, f"a number of pixels below {MOST_BIAS:g}")] = Field(
        "auto", description="by which silhouettes lie outside the true ones: measured, px, or off"
    )


class LearningRates(Section):
    """Adam's rates."""

    means: NotNegative = Field(1e-4, description="unit-cube units per step")
    scales: NotNegative = Field(5e-3, description="of the logarithm, per step")
    opacities: NotNegative = Field(3e-2, description="of the logit, per step")
    quaternions: NotNegative = Field(5e-3, description="per step")


class DensityConfig(Section):
    """Culling and duplication "at regular intervals" (supplement): the shares of the run after which they happen."""

    duplicate_at: list[Share] = Field([], description="shares of the run")
    duplicate_gradient: Share = Field(0.5, description="relative positional gradient from which on to duplicate")
    duplicate_copies: Annotated[int, Field(ge=0)] = Field(2, description="copies of each")
    duplicate_distance: NotNegative = Field(0.01, description="standard deviation of a copy's offset, unit-cube units")
    max_gaussians: Count = Field(50_000, description="no duplication beyond this number")
    cull_opacity_at: list[Share] = Field([], description="shares of the run")
    min_opacity: Share = Field(0.05, description="Gaussians below are culled")
    cull_support_at: list[Share] = Field([], description="shares of the run")
    min_support: Share = Field(0.05, description="share of the views whose edge pixels a centre must hit")
    reset_opacity: bool = Field(False, description="opacities down to the initial one after a cull")

    @property
    def changes_number(self) -> bool:
        """Whether there are other Gaussians at the end than at the start."""
        return bool(self.duplicate_at or self.cull_opacity_at or self.cull_support_at)


class TrainConfig(Section):
    """Training of the Gaussians (paper 3.1, 3.2, supplement).

    A run is as long as `epochs` or `steps` says; when things happen in it is written in shares of the run. Seeded where
    the views agree, a few passes are enough: fast rates, one smooth decay, no duplication.
    """

    enabled: bool = Field(
        True, description="false: Gaussians laid along strokes stay there, as for photographs; others are trained"
    )
    epochs: Annotated[int, Field(ge=0)] = Field(0, description="passes over all views; 0: train.steps counts")
    steps: Annotated[int, Field(ge=0)] = Field(100, description="view steps, at least one pass; 0: train.epochs counts")
    settled: Share = Field(
        0.01, description="stop when the last two passes lowered the loss by no more than this share each; 0: never"
    )
    gaussians: Count = Field(30_000, description="to start from, at most; random: so many")
    seeds: Literal["auto", "random", "points", "lift", "pair"] = Field(
        "lift",
        description="random points in the box; points: source.points or the model's; lift: along strokes of edgels that"
        " other views agree with; pair: along straight 2D runs, matched whole; auto: points as far as there are any,"
        " else random",
    )
    initial_scale: Positive = Field(0.004, description="standard deviation, unit-cube units")
    initial_opacity: Annotated[float, Field(gt=0, lt=1)] = Field(0.3)
    edge_threshold: Annotated[float, Field(gt=0, le=1)] = Field(
        0.5, description="of full scale; from here on a pixel is an edge pixel"
    )
    loss: Literal["balanced", "class_weighted", "whole_image"] = Field("balanced", description="balanced is eq. 3")
    strength_weight: Share = Field(
        0.5, description="share of an edge pixel's weight in the loss that is its edgel's strength; 0: all weigh alike"
    )
    flanks_from: Share = Field(
        1.0, description="share of the run after which the mask takes in the flanks of the lines; 1: never"
    )
    established_support: Share = Field(
        0.1,
        description="share of the views that supports an edge, so that where it is hidden, flanks spare it; 0: never",
    )
    only_means: Share = Field(0.15, description="share of the run that trains positions only")
    learning_rates: LearningRates = LearningRates()
    means_decay: Positive = Field(0.84, description="factor on the rate of the means")
    means_decay_every: Positive = Field(0.05, description="share of the run between two decays")
    means_decays: Annotated[int, Field(ge=0)] = Field(20, description="number of decays")
    regularize_from: Share = Field(0.5, description="share of the run after which L_orient and L_shape start")
    regularize_every: Count = Field(10, description="steps")
    orient_weight: NotNegative = Field(0.1, description="lambda_1 of eq. 6; 0.01 for large scenes")
    shape_weight: NotNegative = Field(0.1, description="lambda_2 of eq. 6; 0.01 for large scenes")
    neighbors: Annotated[int, Field(ge=1, le=16)] = Field(4, description="k of eq. 4")
    neighbors_refresh_steps: Count = Field(100, description="steps between two neighbour searches")
    density: DensityConfig = DensityConfig()

    @model_validator(mode="after")
    def _has_one_length(self) -> "TrainConfig":
        if bool(self.epochs) == bool(self.steps):
            raise ValueError("the length is given in epochs or in steps; set one of them, and the other to 0")
        return self

    @property
    def takes_in_flanks(self) -> bool:
        """Whether the mask of eq. 3 takes in the flanks of the lines; a whole image has them anyway."""
        return self.loss == "balanced" and self.flanks_from < 1


class FilterConfig(Section):
    """Which trained Gaussians become oriented points."""

    min_opacity: Share = Field(0.02)
    min_support: Share = Field(
        0.05, description="share of the views that see a point and have an edge pixel (refine: edgel) of its own there"
    )
    refine: bool = Field(True, description="move points to where the viewing planes of their edgels meet")
    min_views: Positive = Field(2.5, description="refine: views that must show an edge, each counted by how closely")
    outlier_neighbors: Annotated[int, Field(ge=0)] = Field(3, description="statistical outliers: neighbours; 0: off")
    outlier_deviations: Positive = Field(5.0, description="mean neighbour distance allowed, standard deviations")


class ClusterConfig(Section):
    """How points become edges: lines and arcs that claim them, and graph traversal (paper 3.3)."""

    theta: Share = Field(0.8, description="|cos| from which on orientations agree; 0.6 for curved objects")
    neighbors: Count = Field(10, description="spatial neighbours of a point")
    max_gap: Positive = Field(0.03, description="neighbours are no farther apart, unit-cube units")
    min_points: Annotated[int, Field(ge=2)] = Field(10, description="smaller clusters are reported and left out")


class FitConfig(Section):
    """Lines and cubic Bezier curves (paper 3.3) for what no line or arc claims."""

    delta: NotNegative = Field(0.5, description="a curve is kept when its error <= delta * the line's; 1 for DTU")
    line_tolerance: Positive = Field(0.005, description="inlier distance of the robust line, unit-cube units")
    min_length: NotNegative = Field(0.01, description="shorter edges are reported and left out, unit-cube units")


class RefineConfig(Section):
    """From single edges to a connected wireframe that agrees with the images (beyond the paper)."""

    enabled: bool = Field(True, description="false: the edges stay as they were fitted")
    min_support: Share = Field(0.0, description="share of the views with an edge in their image that must show it")
    min_views: Positive = Field(2.5, description="views that must show an edge, each counted by its strength")
    min_steadiness: Share = Field(
        0.0, description="share of the edgels about an edge that lie on it; contours have half"
    )
    verdict: bool = Field(
        True, description="confidence is a probability, from all that the edgels say, fitted to parts without texture"
    )
    min_confidence: Share = Field(0.5, description="verdict: of an edge that is kept")
    contours: bool = Field(
        False, description="verdict: write contours of rounded surfaces, which are no edges, to a file of their own"
    )
    anchor: bool = Field(
        False, description="anchor straight edges whose depth the views cannot tell to known edges that they meet"
    )
    regularise: bool = Field(
        False, description="make edges parallel, perpendicular, coplanar, coaxial, of equal radius, if images allow"
    )


def _auto_or(value: Any, check: Callable[[Any], Any]) -> Any:
    return value if value == "auto" else check(value)


if TYPE_CHECKING:
    BoxOrAuto = Box | Literal["auto"]
else:  # as a union its messages would name the alternatives, not what is wrong with the list
    BoxOrAuto = Annotated[Box, WrapValidator(_auto_or), PlainSerializer(lambda box: box)]


def _is_held_out(value: Any) -> bool:
    names = isinstance(value, list) and value and all(isinstance(name, str) for name in value)
    return bool(names) or (type(value) is int and value > 0)


class ScanConfig(Section):
    """Which points of a scan are on edges, see evaluation/pseudo_truth.py."""

    edges: str = Field("", description="folder of ready edge maps to judge by, like source.edges; '': the scene's own")
    threshold: Share = Field(0.5, description="of full scale, that an edge pixel of those maps exceeds")
    share: Share = Field(0.5, description="of the views that see a point, in more than which it is on an edge")
    views: Count = Field(3, description="that see a point, at least")


class EvaluationConfig(Section):
    """Ground truth, where there is one, and views that only the evaluation sees."""

    truth: str = Field("", description="ABC folder, PLY or edge JSON, relative to the data root; '': there is none")
    kind: Literal["edges", "scan"] = Field(
        "edges",
        description="what truth holds: edges, or the points of a scanned surface, those on edges being the truth",
    )
    scan: ScanConfig = ScanConfig()
    held_out: Annotated[str | int | list[str], _measured_or(_is_held_out, "a number, or a list of names, of views")] = (
        Field("auto", description="views kept for the evaluation: their number or names; auto: one in ten, at most 3")
    )

    @model_validator(mode="after")
    def _scan_is_there(self) -> "EvaluationConfig":
        if self.kind == "scan" and not self.truth.lower().endswith(".ply"):
            raise ValueError("kind is 'scan', so truth must name the PLY with the points of the scan")
        return self


class SceneConfig(Section):
    """A whole scene."""

    name: Name = Field("scene", description="folder of the results; the file's name unless set")
    preset: Literal["fast", "paper"] = Field("fast", description="the schedule the scene starts from")
    scale: Literal["part", "object", "building", "room"] = Field(
        "part", description="settings for a part without texture, a photographed object, what surrounds the camera"
    )
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(0, description="of every random choice")
    box: BoxOrAuto = Field(
        "auto", description="opposite corners of the scene, input units; auto: the layout's, else the unit cube"
    )
    source: SourceConfig = SourceConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    train: TrainConfig = TrainConfig()
    filter: FilterConfig = FilterConfig()
    cluster: ClusterConfig = ClusterConfig()
    fit: FitConfig = FitConfig()
    refine: RefineConfig = RefineConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @field_validator("calibration", mode="before")
    @classmethod
    def _all_or_nothing(cls, value: Any) -> Any:
        if value is False or value == "off":
            return {"shift": "off", "silhouette": "off"}
        return {} if value is True or value == "auto" else value

    @field_validator("box")
    @classmethod
    def _box_has_volume(cls, box: BoxOrAuto) -> BoxOrAuto:
        if box != "auto" and any(high <= low for low, high in zip(*box, strict=True)):
            raise ValueError("the second corner must be greater than the first in x, y and z")
        return box

    @model_validator(mode="after")
    def _source_is_complete(self) -> "SceneConfig":
        if self.source.reader != "synthetic" and not self.source.path:
            raise ValueError("source.path is missing; set it to the folder with the images and cameras")
        if self.train.seeds == "points" and not self.source.points and self.source.reader not in WITH_POINTS:
            raise ValueError("train.seeds is 'points', but source.points names no file to take them from")
        if self.source.detector == "onnx" and not self.source.onnx.model:
            raise ValueError("source.detector is 'onnx', but source.onnx.model names no ONNX file")
        return self
