"""Which files a scene consists of: what its reader lists, and what each stage depends on."""

from pathlib import Path
from typing import TYPE_CHECKING

from taichi_edges.errors import UserError

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run
    from taichi_edges.readers.frames import Frames


def listed_frames(run: "Run", **changed: str) -> "Frames":
    """What the reader found. changed: keys of the scene's source that are to be read otherwise."""
    from taichi_edges.readers import READERS

    source = run.config.source.model_copy(update=changed)
    return READERS[source.reader](run.data_path(source.path, "source.path"), source)


def posed_frames(run: "Run", frames: "Frames", **changed: str) -> "Frames":
    """The frames themselves; photographs without poses after structure from motion. changed: see `listed_frames`."""
    source = run.config.source.model_copy(update=changed)
    if source.reader != "images":
        return frames
    from taichi_edges.readers.photos import posed_photos

    folder = run.data_path(source.path, "source.path")
    return posed_photos(frames, folder, source, run.path("sfm"), run.config.seed, run.threads, run.progress)


def source_files(run: "Run") -> list[Path]:
    """Every file the prepare stage reads, so that a changed input is noticed."""
    source = run.config.source
    points = [run.data_path(source.points, "source.points")] if source.points else []
    models = [model_file(run)] if source.detector == "onnx" else []
    if source.reader == "synthetic":
        return [*points, *models]
    frames = listed_frames(run)
    paths = {Path(path) for path in (*frames.edge_paths, *frames.image_paths, *frames.mask_paths) if path}
    own = dict.fromkeys(path for path in (frames.where, *frames.files) if path.is_file())
    return [*own, *sorted(path for path in paths if path.is_file()), *points, *models]


def model_file(run: "Run") -> Path:
    """The ONNX file the scene names."""
    path = run.data_path(run.config.source.onnx.model, "source.onnx.model")
    if not path.is_file():
        raise UserError(f"source.onnx.model: {path} is a folder; name the ONNX file")
    return path


def seed_files(run: "Run") -> list[Path]:
    """The points that training may start from, where the scene or the layout has some."""
    return [run.path("seeds.ply")]


def truth_path(run: "Run") -> Path | None:
    """The ground truth of the scene, or None: what the scene names, or what the synthetic source wrote."""
    if run.config.evaluation.truth:
        return run.data_path(run.config.evaluation.truth, "evaluation.truth")
    return run.path("truth.json") if run.config.source.reader == "synthetic" else None


def picture_files(run: "Run") -> list[Path]:
    """The colour images that the overlays are drawn on; those of a synthetic scene are its own."""
    source = run.config.source
    if source.reader == "synthetic":
        return []
    return [Path(path) for path in listed_frames(run).image_paths if path and Path(path).is_file()]


def export_files(run: "Run") -> list[Path]:
    """What the export shows beside the edges: the colour images, and contours where they are asked for."""
    return [*picture_files(run), *([run.path("contours.json")] if run.config.refine.contours else [])]


def truth_files(run: "Run") -> list[Path]:
    """Every file the ground truth consists of."""
    from taichi_edges.evaluation.ground_truth import check_truth_path

    path = truth_path(run)
    if path is None:
        return []
    if run.config.evaluation.truth:  # that of a synthetic scene may still have to be written
        check_truth_path(path)
    truth = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    return truth + _scan_map_files(run)


def _scan_map_files(run: "Run") -> list[Path]:
    """The edge maps that the points of a scan are held against, where the scene names a folder of its own for them."""
    source, config = run.config.source, run.config.evaluation
    if config.kind != "scan" or not config.scan.edges or source.reader == "synthetic":
        return []
    frames = listed_frames(run, edges=config.scan.edges)
    return [Path(path) for path in frames.edge_paths if path and Path(path).is_file()]
