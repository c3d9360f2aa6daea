"""What finds the 2D edges.

DETECTORS[name](frames, task) gives the frames it could use, edge maps (V, H, W) uint8, and Edgels or None.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from taichi_edges.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    import numpy as np

    from taichi_edges.progress import Progress
    from taichi_edges.readers.frames import Frames
    from taichi_edges.scene.settings import SourceConfig
    from taichi_edges.views.edgels import Edgels


@dataclass(frozen=True)
class DetectionTask:
    """What detectors need besides the frames. source: the section of the scene. model: its ONNX file, None without."""

    source: "SourceConfig"
    model: "Path | None"
    threads: int
    progress: "Progress"


def choose_detector(source: "SourceConfig", frames: "Frames") -> str:
    """The detector that `source.detector: auto` means: ready maps where the scene names them, else our own."""
    if source.detector != "auto":
        return source.detector
    return "maps" if source.edges or not any(frames.image_paths) else "subpixel"


def read_maps(frames: "Frames", task: "DetectionTask") -> "tuple[Frames, np.ndarray, Edgels | None]":
    """Ready edge maps. They may be biased, and have no edgels yet."""
    from taichi_edges.readers.images import read_edge_maps

    return frames, read_edge_maps(frames, task.progress, task.threads), None


def detect_subpixel(frames: "Frames", task: "DetectionTask") -> "tuple[Frames, np.ndarray, Edgels | None]":
    """Edgels by our own detector, and maps drawn through them."""
    import numpy as np

    from taichi_edges.detectors.subpixel import trace_pictures
    from taichi_edges.readers.images import check_sizes, frames_with_images, name_edgeless
    from taichi_edges.views.drawing import draw_edge_maps

    frames = frames_with_images(frames, task.progress)
    with task.progress.track("detect", len(frames.names)) as report:
        edgels, found = trace_pictures(frames.image_paths, task.threads, report, task.source.gamma or None)
    sizes = [size for size in found if size is not None]  # all of them: every frame has an image
    check_sizes(frames, sizes, "colour image")
    if len(edgels) == 0:
        problem = f"no edge found in any of {len(frames.names)} images"
        raise UserError(f"{frames.where}: {problem}; are they black, blank or out of focus? Check source.images")
    name_edgeless(frames.names, np.diff(edgels.starts), task.progress)
    width, height = sizes[0]
    return frames, draw_edge_maps(edgels, height, width, task.threads), edgels


def detect_onnx(frames: "Frames", task: "DetectionTask") -> "tuple[Frames, np.ndarray, Edgels | None]":
    """Edge maps by a learned detector, biased as such detectors are."""
    import numpy as np

    from taichi_edges.detectors.onnx import detect_maps
    from taichi_edges.readers.images import check_sizes, frames_with_images

    frames, onnx = frames_with_images(frames, task.progress), task.source.onnx
    assert task.model is not None
    images = ComposedImages(frames.image_paths)
    maps = detect_maps(images, task.model, onnx.network or None, onnx.scale, onnx.flip, task.threads, task.progress)
    check_sizes(frames, [(edge_map.shape[1], edge_map.shape[0]) for edge_map in maps], "colour image")
    return frames, np.stack(maps), None


class ComposedImages:
    """The images of some paths, each decoded when its turn comes: (H, W, 3) uint8 RGB, transparent ones over white."""

    def __init__(self, paths: "Sequence[Path | str]") -> None:
        self.paths = paths

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> "Iterator[np.ndarray]":
        from taichi_edges.views.pictures import read_colour

        for path in self.paths:
            colour = read_colour(path)
            if colour is None:
                raise UserError(f"{path}: not an image that can be read; export it again, or skip this view")
            yield colour[:, :, ::-1]


DETECTORS = {"maps": read_maps, "subpixel": detect_subpixel, "onnx": detect_onnx}
