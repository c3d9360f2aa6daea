"""The stage `prepare`: from a source of images, maps and cameras to Views, whatever layout, lens or detector it takes.

As all stages (`stages`) it is a function of a Run, and imports what takes long where that is needed.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from taichi_edges.artefacts import replacing
from taichi_edges.edge_set import write_edges
from taichi_edges.errors import UserError, did_you_mean
from taichi_edges.findings import amount
from taichi_edges.views import write_views

WIDEST_PX = 40.0  # of a detector's lines
UNIT_CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
CALIBRATION_SEEDS = 4000  # 3D points through which a detector's biases are measured, at most


def prepare(run):
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
    frames, edge_maps, edgels = DETECTORS[detector](frames, run)
    views = _inside_the_run(run, build_views(frames, edge_maps, edgels, source, box, run.progress))
    facts = {"detector": detector, "box": np.array(box).tolist(), "box_from": box_from}
    facts |= _finish_views(run, views, frames)
    own = [path for path in views.image_paths if path and not Path(path).is_absolute()]
    return {**facts, "files": [*own, *facts["files"], *_write_points(run, frames, box)]}


def listed_frames(run, **changed):
    """What the reader found. changed: keys of the scene's source that are to be read otherwise."""
    from taichi_edges.readers import READERS

    source = run.config.source.model_copy(update=changed)
    return READERS[source.reader](run.data_path(source.path, "source.path"), source)


def posed_frames(run, frames, **changed):
    """The frames themselves; photographs without poses after structure from motion. changed: see `listed_frames`."""
    source = run.config.source.model_copy(update=changed)
    if source.reader != "images":
        return frames
    from taichi_edges.readers.photos import posed_photos

    folder = run.data_path(source.path, "source.path")
    return posed_photos(frames, folder, source, run.path("sfm"), run.config.seed, run.threads, run.progress)


def _pass_on(frames, progress):
    """Tell the user what the reader has to say."""
    for note in frames.notes:
        progress.say(note)
    for warning in frames.warnings:
        progress.warn(warning)


def _scene_box(run, frames):
    """(2, 3) corners of the scene, input units, and where they are from."""
    if run.config.box != "auto":
        return run.config.box, "scene"
    if frames.box is not None:
        corners = " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in frames.box)
        run.progress.say(
            f"scene box {corners}, in units of the cameras, as the layout has it; the key box sets another"
        )
        return frames.box, "reader"
    if frames.points is not None:  # a reader takes even points that fit badly rather than none
        found = f"only {amount(len(frames.points), 'good point')}" if len(frames.points) else "no points"
        raise UserError(f"{frames.where}: the model has {found} to tell where the scene is; set box")
    return UNIT_CUBE, "unit cube"


def _checked(run, frames, box, guessed):
    """The frames, whose cameras and box can be those of one scene; without those that do not see a guessed box."""
    from taichi_edges.readers.frames import check_before_detection, frames_in_sight
    from taichi_edges.readers.images import refuse_copies

    source = run.config.source
    if guessed:
        frames = frames_in_sight(frames, source, box, run.progress)
    check_before_detection(frames, source, box)
    refuse_copies(frames, run.progress)
    return frames


def _undistorted(run, frames):
    """The frames as pinhole cameras would have taken them, their pictures in the run's folder."""
    from taichi_edges.readers.undistortion import undistorted_frames

    source, folder = run.config.source, run.path("undistorted")
    return undistorted_frames(frames, folder, source.max_size, source.gamma, run.threads, run.progress)


def _refuse_missing_points(run, frames):
    """UserError where the training is to start from points and there are none."""
    if run.config.train.seeds == "points" and not run.config.source.points and not _has_points(frames):
        problem = "train.seeds is 'points', but the model has none that fit"
        raise UserError(f"{frames.where}: {problem}; set source.points or another train.seeds")


def _has_points(frames):
    return frames.points is not None and len(frames.points) > 0


def _inside_the_run(run, views):
    """The views with paths relative to the run's folder for pictures in it: it may be moved."""
    folder = str(run.folder)
    paths = (os.path.relpath(path, folder) if path and _lies_in(path, folder) else path for path in views.image_paths)
    return replace(views, image_paths=tuple(paths))


def _lies_in(path, folder):
    return os.path.commonpath([os.path.abspath(path), os.path.abspath(folder)]) == os.path.abspath(folder)


def _refuse_needless_calibration(run, detector):
    """UserError where the scene gives biases of maps, and there are no maps."""
    wanted = run.config.calibration
    if detector == "subpixel" and not (isinstance(wanted.shift, str) and isinstance(wanted.silhouette, str)):
        problem = "calibration: our own detector has no bias to correct"
        raise UserError(f"{problem}; leave it out, or name ready maps in source.edges")


def _finish_views(run, views, frames=None):
    """Trace and calibrate the edgels where the detector gave maps, write the views and the report; the facts.

    frames: whose masks drop edgels; None where there are none.
    """
    from taichi_edges.evaluation.held_out import choose_held_out, split_views

    facts, residuals = {"width_px": views.width, "height_px": views.height}, {}
    traced_here = views.edgels is None
    if traced_here:
        views, width = _traced(run, views)
        facts["line_width_px"] = round(width, 2)
    if frames is not None:
        views, dropped = _masked(run, views, frames, redraw=not traced_here)
        facts |= {} if dropped is None else {"masked_edgels": dropped}
    views, held_out = split_views(views, choose_held_out(views.names, run.config.evaluation.held_out))
    facts = {"views": len(views), "held_out": list(held_out.names), **facts}
    if traced_here:
        views, calibration = _calibrated(run, views)
        held_out = _corrected(run, held_out, calibration)
        if calibration is not None:
            facts["calibration"] = calibration.facts()
            residuals = {"residuals": calibration.residuals, "on_silhouette": calibration.on_silhouette}
    if run.config.source.min_chain:
        views, kept = _chained(run, views)
        residuals = {name: values[kept] for name, values in residuals.items()}
    sheet = _write_sheet(run, views, residuals)
    facts["edgels"] = len(views.edgels)
    write_views(run.path("views.npz"), views)
    write_views(run.path("held_out.npz"), held_out)
    return {**facts, "files": [sheet]}


def _chained(run, views):
    """The views with the edgels on long chains, and maps drawn through these; and which of all edgels those are."""
    from taichi_edges.detectors.chains import with_chain_strengths
    from taichi_edges.detectors.drawing import draw_edge_maps
    from taichi_edges.kernels.device import start_taichi

    start_taichi("cpu", run.threads, run.config.seed, run.kernel_cache)
    edgels, lengths = with_chain_strengths(views.edgels, views.height, views.width)
    kept = lengths >= run.config.source.min_chain
    edgels = edgels.keep(kept)
    if len(edgels) == 0:
        problem = f"no edge is {run.config.source.min_chain} px long in any of {len(views)} views"
        raise UserError(f"source.min_chain: {problem}; lower it, or look at detection.png of a run with 0")
    maps = draw_edge_maps(edgels, views.height, views.width, run.threads)
    return replace(views, edgels=edgels, edge_maps=maps), kept


def _masked(run, views, frames, redraw):
    """The views without the edgels that their masks drop, and how many those are; None without masks.

    redraw: the maps are drawn through the edgels; else they are black where masks are, and drawn anew later, or not.
    """
    from taichi_edges.detectors.drawing import draw_edge_maps
    from taichi_edges.detectors.masks import blank_outside, has_areas, within_masks

    if not has_areas(frames):
        return views, None
    kept = within_masks(views.edgels, frames, (views.width, views.height), run.progress)
    if redraw:
        maps = draw_edge_maps(kept, views.height, views.width, run.threads)
    else:
        maps = blank_outside(views.edge_maps, frames)
    return replace(views, edgels=kept, edge_maps=maps), len(views.edgels) - len(kept)


def _detected_in_pictures(run, views):
    """The views with what a detector finds in their own pictures in place of the maps that came with them."""
    from taichi_edges.detectors import DETECTORS
    from taichi_edges.readers.frames import Frames

    paths = with_whole_paths(run, views).image_paths
    cameras = list(views.intrinsics), list(views.world_to_camera)
    frames = Frames(run.path("images"), list(views.names), [""] * len(views), list(paths), *cameras, opengl=False)
    _, edge_maps, edgels = DETECTORS[run.config.source.detector](frames, run)
    return replace(views, edge_maps=edge_maps, edgels=edgels)


def with_whole_paths(run, views):
    """The views with paths that can be opened: pictures of a synthetic scene lie in the run's own folder."""
    return replace(views, image_paths=tuple(str(run.path(path)) if path else "" for path in views.image_paths))


def _traced(run, views):
    """The views with the edgels on the ridges of their maps, and the width of the maps' lines, px."""
    from taichi_edges.detectors.ridges import trace_ridges
    from taichi_edges.support import line_width

    width, _ = line_width(views, run.config.train.edge_threshold)
    if width > WIDEST_PX:
        problem = f"the lines of the edge maps are {width:.0f} px wide; are these photographs?"
        raise UserError(f"{problem} Then name their folder as source.images, and set source.detector: subpixel")
    return replace(
        views, edgels=trace_ridges(views.edge_maps, width, run.config.source.thin_threshold, run.threads)
    ), width


def _calibrated(run, views):
    """The views with unbiased edgels, and their maps drawn through these if the scene wants that; the Calibration."""
    from taichi_edges.detectors.drawing import draw_edge_maps

    def redrawn(edgels):
        maps = draw_edge_maps(edgels, views.height, views.width, run.threads)
        return replace(views, edgels=edgels, edge_maps=maps)

    wanted, calibration = run.config.calibration, None
    edgels = views.edgels
    if (wanted.shift, wanted.silhouette) != ("off", "off") and len(edgels):
        edgels, calibration = _calibrate(run, views, redrawn(edgels))
    if run.config.source.thin:
        return redrawn(edgels), calibration
    if calibration is not None and (calibration.shift_applied or calibration.silhouette_applied):
        run.progress.warn(
            "source.thin is false: the training learns from the maps as they are, only the edgels are corrected"
        )
    return replace(views, edgels=edgels), calibration


def _calibrate(run, views, thin):
    """The edgels without the detector's biases, and the Calibration. thin: the views with maps drawn thin."""
    from taichi_edges.detectors.calibration import calibrate
    from taichi_edges.kernels.device import start_taichi
    from taichi_edges.splatting.voting import vote_seeds

    start_taichi("cpu", run.threads, run.config.seed, run.kernel_cache)  # here as everywhere: prepare is no GPU's work
    generator = np.random.default_rng(run.config.seed)
    seeds = vote_seeds(thin, run.config.train.edge_threshold, generator, CALIBRATION_SEEDS)
    fixed = {"off": 0.0, "auto": None}
    wanted = run.config.calibration
    shift, silhouette = (
        fixed[value] if isinstance(value, str) else value for value in (wanted.shift, wanted.silhouette)
    )
    shift = (0.0, 0.0) if shift == 0.0 else shift
    return calibrate(
        with_whole_paths(run, views), views.edgels, seeds.points, seeds.directions, shift, silhouette, run.threads
    )


def _corrected(run, views, calibration):
    """Held-out views, their edgels without the biases that the Calibration, None for none, has found in the others."""
    from taichi_edges.detectors.calibration import sides_of
    from taichi_edges.detectors.drawing import draw_edge_maps

    edgels = views.edgels
    if not len(views):
        return views
    if calibration is not None and len(edgels):
        silhouette = calibration.silhouette_applied * calibration.silhouette
        values = np.array([silhouette, *(calibration.shift_applied * calibration.shift)])
        edgels = sides_of(with_whole_paths(run, views), edgels, run.threads).correct(edgels, values)[0]
    maps = draw_edge_maps(edgels, views.height, views.width, run.threads) if run.config.source.thin else views.edge_maps
    return replace(views, edgels=edgels, edge_maps=maps)


def _write_sheet(run, views, residuals):
    """The picture of what the detector gave; its name."""
    from taichi_edges.exporters.detection_sheet import write_detection_sheet

    write_detection_sheet(run.path("detection.png"), with_whole_paths(run, views), **residuals)
    return "detection.png"


def _write_points(run, frames, box):
    """The points the scene or the layout has, those inside the box, to `seeds.ply`. Returns the files written.

    box: (2, 3) corners, input units.
    """
    from taichi_edges.exporters.ply import write_float_vertices
    from taichi_edges.readers.points import inside_box, read_points

    if run.config.source.points:
        points = read_points(run.data_path(run.config.source.points, "source.points"), box)
    else:
        points = inside_box(frames.points, box) if frames is not None and _has_points(frames) else []
    if len(points) == 0:
        run.path("seeds.ply").unlink(missing_ok=True)  # of an older run with other settings
        return []
    write_float_vertices(run.path("seeds.ply"), ("x", "y", "z"), points)
    return ["seeds.ply"]


def _prepare_synthetic(run):
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
            unfinished.write_bytes(cv2.imencode(".png", picture[:, :, ::-1])[1])
    views = replace(views, image_paths=tuple(files))
    if source.detector in ("subpixel", "onnx"):
        views = _detected_in_pictures(run, views)
    write_edges(run.path("truth.json"), part.edges, {"part": part.name})
    facts = _finish_views(run, views)
    points = _write_points(run, None, UNIT_CUBE)
    return {"part": part.name, **facts, "files": ["truth.json", *files, *facts["files"], *points]}


def source_files(run):
    """Every file the prepare stage reads, so that a changed input is noticed."""
    source = run.config.source
    points = [run.data_path(source.points, "source.points")] if source.points else []
    models = [_model_file(run)] if source.detector == "onnx" else []
    if source.reader == "synthetic":
        return [*points, *models]
    frames = listed_frames(run)
    paths = {Path(path) for path in (*frames.edge_paths, *frames.image_paths, *frames.mask_paths) if path}
    own = dict.fromkeys(path for path in (frames.where, *frames.files) if path.is_file())
    return [*own, *sorted(path for path in paths if path.is_file()), *points, *models]


def _model_file(run):
    """The ONNX file the scene names."""
    path = run.data_path(run.config.source.onnx.model, "source.onnx.model")
    if not path.is_file():
        raise UserError(f"source.onnx.model: {path} is a folder; name the ONNX file")
    return path
