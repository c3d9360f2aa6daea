"""Masks: edgels that do not count are dropped, after they were traced and before anything is made of them.

A mask shows what of the scene matters, 128 or more. Its border runs along the outlines of that, which must stay, so it
grows before it cuts. What undistortion left empty is an area of its own: its border is no edge, so it grows as well.
"""

from pathlib import Path

import cv2
import numpy as np

from taichi_edges.errors import UserError, name_some
from taichi_edges.progress import Progress
from taichi_edges.readers.frames import Frames
from taichi_edges.readers.images import read_mask
from taichi_edges.views.edgels import Edgels

RIM_PX = 6  # by which a mask grows: masks are drawn, or made by a network, to some pixels
EMPTY_RIM_PX = 6  # by which what is empty grows: so far its border disturbs an edge detector


def has_areas(frames: Frames) -> bool:
    """Whether any view of the frames has a mask, or empty places."""
    return any(frames.mask_paths) or any(frames.valid_paths)


def kept_area(mask_path: Path | str, valid_path: Path | str, size: tuple[int, int]) -> np.ndarray | None:
    """(H, W) bool: where in a view edgels count; None where they do everywhere. size: (width, height) px."""
    area = None
    if mask_path:
        area = cv2.dilate(read_mask(mask_path, size), _disc(RIM_PX)).astype(bool)
    if valid_path:
        valid = read_mask(valid_path, size)
        # Beyond the picture's own border nothing is empty.
        valid = cv2.erode(valid, _disc(EMPTY_RIM_PX), borderType=cv2.BORDER_CONSTANT, borderValue=1).astype(bool)
        area = valid if area is None else area & valid
    return area


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def within_masks(edgels: Edgels, frames: Frames, size: tuple[int, int], progress: Progress) -> Edgels:
    """The edgels that count, of the frames' views. size: (width, height) px. UserError where none does."""
    keep, masked_out = np.ones(len(edgels), bool), []
    for view, (mask_path, valid_path) in enumerate(zip(frames.mask_paths, frames.valid_paths, strict=True)):
        area = kept_area(mask_path, valid_path, size)
        if area is None:
            continue
        part = slice(edgels.starts[view], edgels.starts[view + 1])
        columns, rows = np.rint(edgels.points[part]).astype(np.int64).T
        keep[part] = area[rows.clip(0, size[1] - 1), columns.clip(0, size[0] - 1)]
        if part.stop > part.start and not keep[part].any():
            masked_out.append(frames.names[view])
    if len(edgels) and not keep.any():
        problem = "source.masks: the masks leave no edge in any view; white (128 and more of 255) is kept"
        raise UserError(f"{frames.where}: {problem}: invert or scale them, or set source.masks: none")
    if masked_out:
        progress.warn(f"{len(masked_out)} of {len(frames.names)} masks leave no edge: {name_some(masked_out)}")
    return edgels.keep(keep)


def blank_outside(edge_maps: np.ndarray, frames: Frames) -> np.ndarray:
    """The (V, H, W) edge maps, black where edges do not count."""
    blanked = edge_maps.copy()
    height, width = edge_maps.shape[1:]
    for view, (mask_path, valid_path) in enumerate(zip(frames.mask_paths, frames.valid_paths, strict=True)):
        area = kept_area(mask_path, valid_path, (width, height))
        if area is not None:
            blanked[view][~area] = 0
    return blanked
