"""The stage `prepare`: from a source of images, maps and cameras to Views, whatever layout, lens or detector."""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taichi_edges.corridor.edgels_of_views import finish_views, with_whole_paths
from taichi_edges.corridor.sources import listed_frames, model_file, posed_frames
from taichi_edges.errors import UserError, amount, did_you_mean
from taichi_edges.files.artefacts import replacing
from taichi_edges.geometry.edge_set import write_edges
from taichi_edges.views.views import Views

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.detectors import DetectionTask
    from taichi_edges.progress import Progress
    from taichi_edges.readers.frames import Frames

UNIT_CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def prepare(run: "Run") -> dict[str, Any]:
    """Source -> `views.npz`, `held_out.npz` (views for the evaluation alone) and `detection.png`.

    Of synthetic scenes also `truth.json` and pictures in `images/`.
    """
    if run.config.source.reader == "synthetic":
        return _prepare_synthetic(run)
    from taichi_edges.detectors import DETECTORS, choose_detector
    from taichi_edges.readers.frames import build_views, camera_poses, chosen_frames

    source = run.config.source
    frames = posed_frames(run, chosen_frames(listed_frames(run), source.skip))
    _pass_on(frames, run.progress)
    camera_poses(frames)  # a mistake in them shall not wait for the detector
    box, box_from = _scene_box(run, frames)
    _refuse_missing_points(run, frames)
    frames = _checked(run, frames, box, guessed=box_from == "reader")
    detector = choose_detector(source, frames)
    _refuse_needless_calibration(run, detector)
    frames = _undistorted(run, frames)
    frames, edge_maps, edgels = DETECTORS[detector](frames, _task(run, detector))
    views = _inside_the_run(run, build_views(frames, edge_maps, edgels, source, box, run.progress))
    facts = {"detector": detector, "box": np.array(box).tolist(), "box_from": box_from}
    facts |= finish_views(run, views, frames)
    own = [path for path in views.image_paths if path and not Path(path).is_absolute()]
    return {**facts, "files": [*own, *facts["files"], *_write_points(run, frames, box)]}


def _pass_on(frames: "Frames", progress: "Progress") -> None:
    """Tell the user what the reader has to say."""
    for note in frames.notes:
        progress.say(note)
    for warning in frames.warnings:
        progress.warn(warning)


def _scene_box(run: "Run", frames: "Frames") -> "tuple[ArrayLike, str]":
    """(2, 3) corners of the scene, input units, and where they are from."""
    if run.config.box != "auto":
        return run.config.box, "scene"
    if frames.box is not None:
        corners = " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in frames.box)
        run.progress.say(f"scene box {corners}, taken from the input and in its units; if it is wrong, set box")
        return frames.box, "reader"
    if frames.points is not None:  # a reader takes even points that fit badly rather than none
        found = f"only {amount(len(frames.points), 'good point')}" if len(frames.points) else "no points"
        raise UserError(f"{frames.where}: the model has {found} to tell where the scene is; set box")
    return UNIT_CUBE, "unit cube"


def _checked(run: "Run", frames: "Frames", box: "ArrayLike", guessed: bool) -> "Frames":
    """The frames, whose cameras and box can be those of one scene; without those that do not see a guessed box."""
    from taichi_edges.readers.frames import check_before_detection, frames_in_sight
    from taichi_edges.readers.images import refuse_copies

    source = run.config.source
    if guessed:
        frames = frames_in_sight(frames, source, box, run.progress)
    check_before_detection(frames, source, box)
    refuse_copies(frames, run.progress)
    return frames


def _undistorted(run: "Run", frames: "Frames") -> "Frames":
    """The frames as pinhole cameras would have taken them, their pictures in the run's folder."""
    from taichi_edges.readers.undistortion import undistorted_frames

    source, folder = run.config.source, run.path("undistorted")
    return undistorted_frames(frames, folder, source.max_size, source.gamma, run.threads, run.progress)


def _refuse_missing_points(run: "Run", frames: "Frames") -> None:
    """UserError where the training is to start from points and there are none."""
    if run.config.train.seeds == "points" and not run.config.source.points and not len(_points_of(frames)):
        problem = "train.seeds is 'points', but the model has none that fit"
        raise UserError(f"{frames.where}: {problem}; set source.points or another train.seeds")


def _points_of(frames: "Frames | None") -> np.ndarray:
    """(n, 3) points that the layout has, input units; none without frames."""
    return np.zeros((0, 3)) if frames is None or frames.points is None else frames.points


def _task(run: "Run", detector: str) -> "DetectionTask":
    from taichi_edges.detectors import DetectionTask

    model = model_file(run) if detector == "onnx" else None
    return DetectionTask(run.config.source, model, run.threads, run.progress)


def _inside_the_run(run: "Run", views: Views) -> Views:
    """The views with paths relative to the run's folder for pictures in it: it may be moved."""
    return replace(views, image_paths=tuple(relative_path(path, str(run.folder)) for path in views.image_paths))


def relative_path(path: str, folder: str) -> str:
    """A path as it is seen from a folder that it lies in, with slashes; another as it is, '' for none as well."""
    whole, around = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    return whole.relative_to(around).as_posix() if path and whole.is_relative_to(around) else path


def _refuse_needless_calibration(run: "Run", detector: str) -> None:
    """UserError where the scene gives biases of maps, and there are no maps."""
    wanted = run.config.calibration
    if detector == "subpixel" and not (isinstance(wanted.shift, str) and isinstance(wanted.silhouette, str)):
        problem = "calibration: our own detector has no bias to correct"
        raise UserError(f"{problem}; leave it out, or name ready maps in source.edges")


def _detected_in_pictures(run: "Run", views: Views) -> Views:
    """The views with what a detector finds in their own pictures in place of the maps that came with them."""
    from taichi_edges.detectors import DETECTORS
    from taichi_edges.readers.frames import Frames

    paths = with_whole_paths(run, views).image_paths
    nothing = [None] * len(views)  # is known of the cameras here, nor needed
    frames = Frames(run.path("images"), views.names, [""] * len(views), paths, nothing, nothing, opengl=False)
    _, edge_maps, edgels = DETECTORS[run.config.source.detector](frames, _task(run, run.config.source.detector))
    return replace(views, edge_maps=edge_maps, edgels=edgels)


def _write_points(run: "Run", frames: "Frames | None", box: "ArrayLike") -> list[str]:
    """The points the scene or the layout has, those inside the box, to `seeds.ply`. Returns the files written.

    box: (2, 3) corners, input units.
    """
    from taichi_edges.files.ply import write_float_vertices
    from taichi_edges.readers.points import inside_box, read_points

    if run.config.source.points:
        points = read_points(run.data_path(run.config.source.points, "source.points"), box)
    else:
        points = inside_box(_points_of(frames), box)
    if len(points) == 0:
        run.path("seeds.ply").unlink(missing_ok=True)  # of an older run with other settings
        return []
    write_float_vertices(run.path("seeds.ply"), ("x", "y", "z"), points)
    return ["seeds.ply"]


def _prepare_synthetic(run: "Run") -> dict[str, Any]:
    """Render the embedded part; every random choice follows the scene's seed."""
    import cv2

    from taichi_edges.synthetic.drawing import Imperfections
    from taichi_edges.synthetic.parts import PARTS
    from taichi_edges.synthetic.rendering import render_views

    source = run.config.source
    if source.part not in PARTS:
        hint = did_you_mean(source.part, PARTS) or f"; there is {', '.join(PARTS)}"
        raise UserError(f"source.part: there is no part '{source.part}'{hint}")
    _refuse_needless_calibration(run, source.detector)
    part = PARTS[source.part]()
    generator = np.random.default_rng(run.config.seed)
    views, pictures = render_views(part, source.views, source.size, Imperfections(), generator)
    files = [f"images/{name}.png" for name in views.names]
    for stale in run.path("images").glob("*.png"):
        stale.unlink()
    for file, picture in zip(files, pictures, strict=True):
        with replacing(run.path(file)) as unfinished:
            unfinished.write_bytes(cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes())
    views = replace(views, image_paths=tuple(files))
    if source.detector not in ("auto", "maps"):
        views = _detected_in_pictures(run, views)
    write_edges(run.path("truth.json"), part.edges, {"part": part.name})
    facts = finish_views(run, views)
    points = _write_points(run, None, UNIT_CUBE)
    return {"part": part.name, **facts, "files": ["truth.json", *files, *facts["files"], *points]}
