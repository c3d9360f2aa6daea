"""What the frames' image files hold: ready edge maps, decoded and checked; and which frames have a colour image."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from taichi_edges.errors import UserError, name_some
from taichi_edges.files.artefacts import digest_file
from taichi_edges.progress import Progress
from taichi_edges.readers.frames import (
    LEAVE_OUT,
    TURNED_BY_EXIF,
    Frames,
    folders_beside,
    is_usable,
    refuse_views,
    subset,
)
from taichi_edges.views.pictures import is_whole

MASK_KEEPS = 128  # of 255, from here on
MOSTLY_EDGES = 0.5  # share of edge pixels from which on the maps must be black on white


def frames_with_images(frames: Frames, progress: Progress) -> Frames:
    """The frames whose colour image is there and whole; the others are named in a warning."""
    if not any(frames.image_paths):
        folders = f"{frames.where.parent} has: {folders_beside(frames)}"
        raise UserError(f"{frames.where}: no colour images to detect edges in; set source.images ({folders})")
    usable = [is_usable(path) for path in frames.image_paths]
    if not any(usable):
        folder = Path(frames.image_paths[0]).parent
        problem = "no colour image that can be read" if folder.is_dir() else "no such folder"
        folders = f"{frames.where.parent} has: {folders_beside(frames)}"
        raise UserError(f"{folder}: {problem}; check source.images ({folders})")
    lost = [name for name, ok in zip(frames.names, usable, strict=True) if not ok]
    if lost:
        progress.warn(
            f"{len(lost)} of {len(usable)} views left out, their colour image is missing or truncated: "
            f"{name_some(lost)}"
        )
    return subset(frames, [i for i, ok in enumerate(usable) if ok])


def refuse_copies(frames: Frames, progress: Progress) -> None:
    """UserError where all pictures are one and the same file; copies among others are named in a warning."""
    paths = [
        next((Path(p) for p in pair if is_usable(p)), None)
        for pair in zip(frames.image_paths, frames.edge_paths, strict=True)
    ]
    kinds: dict[str, list[str]] = {}
    for name, path in zip(frames.names, paths, strict=True):
        if path is not None:
            kinds.setdefault(digest_file(path), []).append(name)
    first = next((path for path in paths if path is not None), None)
    if first is not None and len(kinds) == 1 and len(frames.names) > 1:
        if _is_blank(first):
            return  # which is worse, and said by whoever looks for edges
        count = len(frames.names)
        raise UserError(f"{first.parent}: all {count} pictures are copies of one file; check how they were written")
    copies = [name for names in kinds.values() for name in names[1:]]
    if copies:
        progress.warn(f"{len(copies)} of {len(frames.names)} pictures are copies of others: {name_some(copies)}")


def _is_blank(path: Path) -> bool:
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return image is None or bool((image == image[:1, :1]).all())


def name_edgeless(names: Sequence[str], counts: np.ndarray, progress: Progress) -> None:
    """A warning that names the views whose picture shows no edge. counts: (V,) of edge pixels or edgels."""
    empty = [name for name, count in zip(names, counts, strict=True) if not count]
    if empty:
        progress.warn(f"{len(empty)} of {len(names)} pictures show no edge and teach nothing: {name_some(empty)}")


def check_sizes(frames: Frames, sizes: Sequence[tuple[int, int]], what: str) -> None:
    """UserError where the (width, height) of some image, `what` it is, is not that of the others or of the file."""
    size = frames.size or max(set(sizes), key=sizes.count)
    wrong = np.array([s != size for s in sizes])
    if wrong.any():
        width, height = sizes[int(wrong.argmax())]
        expected = f"{frames.where.name} says" if frames.size else "the others are"
        problem = f"the {what} is {width} x {height} px, but {expected} {size[0]} x {size[1]} px"
        cure = f"turned: {TURNED_BY_EXIF}" if (height, width) == tuple(size) else "write it in that size"
        refuse_views(frames, wrong, f"{problem}; {cure}, {LEAVE_OUT}")


def read_edge_maps(frames: Frames, progress: Progress, threads: int | None = None) -> np.ndarray:
    """(V, H, W) uint8, decoded in parallel; missing, damaged and wrongly sized maps are named."""
    if not any(frames.edge_paths):
        folders = f"{frames.where.parent} has: {folders_beside(frames)}"
        raise UserError(f"{frames.where}: no edge maps: set source.edges to their folder, or source.images ({folders})")
    paths = [Path(path) for path in frames.edge_paths]
    missing = np.array([not path.is_file() for path in paths])
    if missing.all():
        folders = f"{frames.where.parent} has: {folders_beside(frames)}"
        raise UserError(f"{paths[0].parent}: no edge map found here; check source.edges ({folders})")
    problem = f"the edge map is missing ({paths[int(missing.argmax())]})"
    refuse_views(frames, missing, f"{problem}; run the detector on it, {LEAVE_OUT}")
    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(read_grey, paths))
    broken = np.array([edge_map is None for edge_map in found])
    problem = f"the edge map is truncated or not an 8- or 16-bit image ({paths[int(broken.argmax())]})"
    refuse_views(frames, broken, f"{problem}; write it again, {LEAVE_OUT}")
    whole = [edge_map for edge_map in found if edge_map is not None]
    check_sizes(frames, [(edge_map.shape[1], edge_map.shape[0]) for edge_map in whole], "edge map")
    maps = np.stack(whole)
    _check_edge_shares(frames, maps, progress, paths[0].parent)
    return maps


def _check_edge_shares(frames: Frames, maps: np.ndarray, progress: Progress, where: Path) -> None:
    """Refuse maps (V, H, W) that cannot be edge maps; name those that are empty. where: their folder."""
    shares = np.array([np.count_nonzero(edge_map >= 128) for edge_map in maps]) / maps[0].size
    empty = shares == 0
    if empty.all():
        problem = "no edge map has an edge pixel, a value of 128 or more; scale the maps to 0..255"
        raise UserError(f"{where}: {problem}, or check source.edges")
    if shares.mean() > MOSTLY_EDGES:
        problem = (
            f"{100 * shares.mean():.0f} % of all pixels are edge pixels; edges must be white on black: invert the maps"
        )
        raise UserError(f"{where}: {problem}, or check source.edges")
    problem = "most of the edge map is edge pixels, white; edges are thin lines: write it again"
    refuse_views(frames, shares > MOSTLY_EDGES, f"{problem}, {LEAVE_OUT}")
    if empty.any():
        names = [name for name, is_empty in zip(frames.names, empty, strict=True) if is_empty]
        progress.warn(f"{len(names)} of {len(maps)} edge maps have no edge pixel and teach nothing: {name_some(names)}")


def read_grey(path: Path) -> np.ndarray | None:
    """(H, W) uint8 of an image file: one channel, or the brightest of three; None where it is damaged.

    16-bit maps are brought to 8 bits.
    """
    import cv2

    if not is_whole(path):
        return None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        return None
    if image.dtype == np.uint16:
        image = (image // 257).astype(np.uint8)
    if image.dtype != np.uint8:
        return None
    return image if image.ndim == 2 else np.ascontiguousarray(image[:, :, :3].max(axis=2))


def read_mask(path: Path | str, size: tuple[int, int] | None = None) -> np.ndarray:
    """(H, W) uint8, 1 where a mask keeps. size: (width, height) px of the view, to which the mask is brought."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if is_usable(path) else None
    if image is None:
        raise UserError(
            f"{path}: the mask is missing, truncated or not an image; write it again, or correct source.masks"
        )
    grey = image if image.ndim == 2 else image[:, :, : min(image.shape[2], 3)].max(axis=2)
    full = np.iinfo(grey.dtype).max if grey.dtype.kind == "u" else 1.0
    kept = (grey >= full * (MASK_KEEPS / 255)).astype(np.uint8)
    height, width = kept.shape
    if size is None or (width, height) == tuple(size):
        return kept
    if abs(width * size[1] / size[0] - height) > 1 and abs(height * size[0] / size[1] - width) > 1:
        problem = f"the mask is {width} x {height} px, its image {size[0]} x {size[1]} px"
        raise UserError(f"{path}: {problem}; write it in that size, or set source.masks: none")
    return cv2.resize(kept, tuple(size), interpolation=cv2.INTER_NEAREST)
