"""Pictures as a pinhole camera of one common size would have taken them, made once and kept in the run's folder.

Images, edge maps and masks are freed of the distortion of their lens, large ones are made smaller, and where views
differ in size all are brought to one canvas, padded at the right and at the bottom, so that principal points stay.
What needs none of it is used where it lies.
"""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import count
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import digest, digest_file, replacing, write_json
from taichi_edges.progress import Progress
from taichi_edges.readers.frames import LEAVE_OUT, Frames, is_usable, refuse_views
from taichi_edges.readers.photogrammetry import Lens, colmap_version, distorted_pixels, undistorted
from taichi_edges.views.light import light_of_srgb, srgb_of_light
from taichi_edges.views.picture_sizes import picture_size

METHOD = 1  # raised when the same inputs give other pictures
FOLDERS = {"image_paths": "images", "edge_paths": "edges", "mask_paths": "masks"}
ROUNDING = 1.0  # px by which the aspect of a resized picture may be off
OUTSIDE = 1.0  # px beyond the outermost centres of a picture; nearer, its border can be repeated
# Edges keep to 0.014 px (median). Linear interpolation blurs them, here more and there less: 0.025 px. The overshoot of
# OpenCV's cubics (0.016 px) is found as a faint edge 3 px beside a strong one.
SHARP = cv2.INTER_LANCZOS4
FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
LIGHT = 65535  # of a white pixel, while light is averaged


@dataclass(frozen=True)
class Plan:
    """How the pictures of a view come to what a pinhole camera would show.

    lens: None for a pinhole camera. picture: (width, height) px of the photograph; shrunk: what it is made smaller to,
    first; size: of the result; canvas: to which it is padded. intrinsics: (3, 3) as tuples, of the result.
    """

    lens: Lens | None
    picture: tuple[int, int]
    shrunk: tuple[int, int]
    size: tuple[int, int]
    intrinsics: tuple[tuple[float, ...], ...]
    canvas: tuple[int, int] = (0, 0)

    @property
    def changes_nothing(self) -> bool:
        """Whether a picture in the size of the photograph can stay as it is."""
        return self.lens is None and self.picture == self.shrunk == self.canvas

    def intrinsics_for(self, width: int, height: int) -> np.ndarray:
        """(3, 3); there is but one size."""
        return np.array(self.intrinsics)


Job = tuple[Path, Path, str, Plan]  # a picture to make: its source, its target, its kind


def undistorted_frames(
    frames: Frames,
    folder: Path | str,
    max_size: int,
    gamma: float | None = None,
    threads: int | None = None,
    progress: Progress = Progress(),
    kinds: Sequence[str] = tuple(FOLDERS),
) -> Frames:
    """Frames whose pictures pinhole cameras took, all of one size; written to `folder` where they were not.

    max_size: px of the longest side from which on photographs are made smaller, 0: never. gamma: see `as_picture`.
    kinds: the fields of Frames whose pictures are wanted, of FOLDERS; where others would be made, there are none.
    """
    sizes = _picture_sizes(frames, threads)
    as_told = len(set(sizes)) == 1 and frames.size in (None, sizes[0])
    if not any(frames.lenses) and not (as_told and 0 < max_size < max(sizes[0])):
        return frames  # small ones need nothing, and what is not as the layout says is refused later
    _check_lenses(frames, sizes, progress)
    plans = _plans(frames, sizes, max_size)
    made: dict[str, Any] = _make_all(frames, plans, kinds, Path(folder), gamma, threads, progress)
    return replace(
        frames,
        intrinsics=[plan.intrinsics_for for plan in plans],
        lenses=[None] * len(plans),
        size=plans[0].canvas,
        **made,
    )


def _picture_sizes(frames: Frames, threads: int | None) -> list[tuple[int, int]]:
    """(V,) (width, height) of each view's photograph, else of its edge map, else of its lens."""

    def size_of(view: int) -> tuple[int, int]:
        usable = (path for path in (frames.image_paths[view], frames.edge_paths[view]) if is_usable(path))
        found = next(filter(None, map(picture_size, usable)), None)
        lens = frames.lenses[view]
        return found or ((lens.width, lens.height) if lens else (0, 0))

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(size_of, range(len(frames.names))))


def _check_lenses(frames: Frames, sizes: list[tuple[int, int]], progress: Progress) -> None:
    """UserError where a photograph cannot be what its camera took; a word on those that were resized."""
    lenses = [(lens.width, lens.height) if lens else size for lens, size in zip(frames.lenses, sizes, strict=True)]
    pairs = list(zip(sizes, lenses, strict=True))
    wrong = np.array([not _same_aspect(*pair) for pair in pairs])
    turned = np.array([_same_aspect(size, lens[::-1]) for size, lens in pairs]) & wrong
    problem = "{} is {} x {} px, but its camera is {} x {} px"
    if wrong.any():
        first = int((turned if turned.any() else wrong).argmax())
        problem = problem.format("the image", *sizes[first], *lenses[first])
    cure = "turned: a program has rotated the file by its EXIF orientation; use the images that the cameras are of"
    refuse_views(frames, turned, f"{problem}, {cure}, or export both again, {LEAVE_OUT}")
    refuse_views(frames, wrong, f"{problem}, of another shape; use the images that the cameras are of, {LEAVE_OUT}")
    resized = [pair for pair in pairs if pair[0] != pair[1]]
    if resized:
        size, lens = resized[0]
        what = f"images of {size[0]} x {size[1]} px for cameras of {lens[0]} x {lens[1]} px"
        progress.say(f"{len(resized)} of {len(pairs)} views have {what}: the intrinsics are scaled to them")


def _same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Can one be the other resized, sides rounded to whole pixels?"""
    small, large = sorted((size, other))
    (width, height), (full_width, full_height) = small, large
    if not all((*size, *other)):
        return False
    across, down = width / full_width, height / full_height
    return abs(full_width * down - width) <= ROUNDING or abs(full_height * across - height) <= ROUNDING


def _plans(frames: Frames, sizes: list[tuple[int, int]], max_size: int) -> list[Plan]:
    """(V,) Plan, with one canvas."""
    of_lens = lru_cache(maxsize=None)(_plan_of_lens)
    alone = [
        of_lens(lens, size, max_size) if lens else _plan_of_pinhole(frames.intrinsics_of(view, *size), size, max_size)
        for view, (lens, size) in enumerate(zip(frames.lenses, sizes, strict=True))
    ]
    canvas = max(each.size[0] for each in alone), max(each.size[1] for each in alone)
    return [replace(each, canvas=canvas) for each in alone]


def _plan_of_pinhole(intrinsics: np.ndarray, picture: tuple[int, int], max_size: int) -> Plan:
    shrunk = _shrunk(picture, max_size)
    return Plan(None, picture, shrunk, shrunk, _as_tuples(_scaled(intrinsics, picture, shrunk)))


def _plan_of_lens(lens: Lens, picture: tuple[int, int], max_size: int) -> Plan:
    shrunk, own = _shrunk(picture, max_size), (lens.width, lens.height)
    intrinsics, full = undistorted(lens)
    scaled = _as_tuples(_scaled(intrinsics, own, shrunk))
    if lens.is_pinhole:
        return Plan(None, picture, shrunk, shrunk, scaled)
    width, height = (max(round(side * new / old), 1) for side, new, old in zip(full, shrunk, own, strict=True))
    return Plan(lens, picture, shrunk, (width, height), scaled)


def _shrunk(picture: tuple[int, int], max_size: int) -> tuple[int, int]:
    """(width, height) of a photograph whose longest side is to have `max_size` px at most, 0: any."""
    shrink = min(1.0, max_size / max(picture)) if max_size else 1.0
    width, height = (max(round(side * shrink), 1) for side in picture)
    return width, height


def _scaled(intrinsics: np.ndarray, old: tuple[int, int], new: tuple[int, int]) -> np.ndarray:
    """Intrinsics for pictures resized from the old (width, height) to the new: borders stay borders.

    Pixel centres are at integers, so a coordinate c becomes (c + 0.5) s - 0.5.
    """
    scale = np.array([new[0] / old[0], new[1] / old[1]])
    scaled = np.array(intrinsics, dtype=np.float64)
    scaled[:2, 2] += 0.5
    scaled[:2] *= scale[:, None]
    scaled[:2, 2] -= 0.5
    return scaled


def _as_tuples(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in matrix)


class _Maps:
    """The maps of lenses, each computed once; some are kept while the views that share them are made."""

    def __init__(self, kept: int) -> None:
        self.lock, self.find = Lock(), lru_cache(maxsize=kept)(undistortion_map)

    def __call__(self, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
        with self.lock:
            return self.find(plan.lens, plan.intrinsics, plan.size, plan.shrunk)


def undistortion_map(
    lens: Lens, intrinsics: ArrayLike, size: tuple[int, int], picture: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Where in the picture of a lens each pixel of the undistorted picture lies, as cv2.remap wants; and where not.

    intrinsics, size: of the undistorted picture. picture: (width, height) of the lens's, whatever it was resized to.
    Returns (H, W, 2) float32 pixels and (H, W) bool, False where the picture shows nothing.
    """
    (width, height), scale = size, np.array(picture) / (lens.width, lens.height)
    inverse = np.linalg.inv(np.array(intrinsics))
    pixels = np.empty((height, width, 2), np.float32)
    columns = np.arange(width)
    for row in range(height):  # one row at a time, or doubles take many times the memory of a picture
        rays = np.stack([columns, np.full(width, row), np.ones(width)], axis=1) @ inverse.T
        pixels[row] = (distorted_pixels(lens, rays) + 0.5) * scale - 0.5
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -OUTSIDE) & (pixels <= np.array(picture) - 1 + OUTSIDE)).all(axis=2)
    valid = inside & _unfolded(pixels, np.array(intrinsics)[:2, 2])
    return np.where(valid[:, :, None], pixels, np.float32(-2 * OUTSIDE)), valid


def _unfolded(pixels: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(H, W) bool: the part about the principal point in which the map (H, W, 2) does not turn back.

    Polynomials for distortion hold for the field of view that they were fitted in; beyond, they fold the picture over.
    """
    right, down = np.gradient(pixels, axis=1), np.gradient(pixels, axis=0)
    with np.errstate(invalid="ignore"):
        forward = right[:, :, 0] * down[:, :, 1] - right[:, :, 1] * down[:, :, 0] > 0
    if forward.all():
        return forward
    _, labels = cv2.connectedComponents(forward.astype(np.uint8), connectivity=4)
    column, row = (int(np.clip(np.rint(c), 0, s - 1)) for c, s in zip(centre, forward.shape[::-1], strict=True))
    return forward & (labels == labels[row, column])


def _make_all(
    frames: Frames,
    plans: list[Plan],
    kinds: Sequence[str],
    folder: Path,
    gamma: float | None,
    threads: int | None,
    progress: Progress,
) -> dict[str, list[Path | str]]:
    """The paths of the pictures, by field of Frames: those that were made, and those that need not be."""
    index = folder / "index.json"
    known = _known(index)
    valid = _valid_areas(plans, folder, known)
    paths: dict[str, list[Path | str]] = {key: list(getattr(frames, key)) for key in FOLDERS}
    paths["valid_paths"] = valid
    jobs: list[Job] = []
    for view, (name, plan) in enumerate(zip(_file_names(frames.names), plans, strict=True)):
        for key, kind in FOLDERS.items():
            source = paths[key][view]
            if is_usable(source) and not (plan.changes_nothing and picture_size(source) == plan.canvas):
                paths[key][view] = ""
                if key in kinds:
                    paths[key][view] = target = folder / kind / f"{name}.png"
                    jobs.append((Path(source), target, kind, plan))
    _make(jobs, folder, known, gamma, threads, progress)
    return paths


def _file_names(names: Sequence[str]) -> list[str]:
    """The views' names as paths that stay in their folder; those that would be the same are numbered."""
    safe = [_safe(name) for name in names]
    found: list[str] = []
    used: set[str] = set()
    wanted = set(safe)
    for name in safe:
        if name in used:
            name = next(new for k in count(2) if (new := f"{name}-{k}") not in used | wanted)
        used.add(name)
        found.append(name)
    return found


def _safe(name: str) -> str:
    """A view's name as a path that stays in its folder."""
    return "/".join(part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "..", "."))


def _known(index: Path) -> dict[str, Any]:
    try:
        content = json.loads(index.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _make(
    jobs: list[Job], folder: Path, known: dict[str, Any], gamma: float | None, threads: int | None, progress: Progress
) -> None:
    """Make the pictures that are not there as they should be."""
    keys = [_key(source, kind, plan, gamma) for source, _, kind, plan in jobs]
    labels = [target.relative_to(folder).as_posix() for _, target, _, _ in jobs]
    due = [i for i, (_, target, _, _) in enumerate(jobs) if not _is_as_made(target, known.get(labels[i]), keys[i])]
    if not due:
        return
    maps, exponent = _Maps(kept=threads or os.cpu_count() or 1), gamma or None

    def make(i: int) -> int:
        source, target, kind, plan = jobs[i]
        image = _read(source)
        _check_fits(source, image, plan)
        _write(target, brought(image, plan, kind, maps, exponent))
        return i

    try:
        with progress.track("undistort", len(due)) as report, ThreadPoolExecutor(threads) as pool:
            for done, i in enumerate(pool.map(make, due)):
                known[labels[i]] = _entry(keys[i], jobs[i][1])
                report(done + 1)
    finally:
        write_json(folder / "index.json", known)


def _entry(key: str, target: Path) -> dict[str, str]:
    """What the index holds about a picture: what it was made from, and what was written."""
    return {"key": key, "digest": digest_file(target)}


def _is_as_made(target: Path, entry: Any, key: str) -> bool:
    """Whether a picture is there, made from the same, and still what was written."""
    return target.is_file() and entry == {"key": key, "digest": digest_file(target)}


def _key(source: Path, kind: str, plan: Plan, gamma: float | None) -> str:
    return digest([*_method(plan), kind, digest_file(source), asdict(plan), gamma if kind == "images" else None])


def _method(plan: Plan) -> tuple[int, str | None]:
    """What determines the result beside its inputs; COLMAP's lenses where there is one."""
    return METHOD, colmap_version() if plan.lens else None


def _read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise UserError(f"{path}: not an image that can be read; write it again, {LEAVE_OUT}")
    return image


def _check_fits(path: Path, image: np.ndarray, plan: Plan) -> None:
    """UserError where an edge map or a mask cannot be of its image."""
    size = (image.shape[1], image.shape[0])
    if not _same_aspect(size, plan.picture):
        what = f"{size[0]} x {size[1]} px, but its image is {plan.picture[0]} x {plan.picture[1]} px"
        turned = _same_aspect(size[::-1], plan.picture)
        why = "turned by the image's EXIF orientation, which cameras do not know" if turned else "of another shape"
        raise UserError(f"{path}: this is {what}, {why}; write it in that size, {LEAVE_OUT}")


def _write(path: Path, image: np.ndarray) -> None:
    with replacing(path) as unfinished:
        unfinished.write_bytes(cv2.imencode(".png", image, FAST_PNG)[1].tobytes())


def brought(
    image: np.ndarray,
    plan: Plan,
    kind: str,
    maps: Callable[[Plan], tuple[np.ndarray, np.ndarray]],
    exponent: float | None = None,
) -> np.ndarray:
    """One picture as its Plan says: an image (in linear light, as a camera would), an edge map or a mask.

    Edge maps and masks need not be in the size of the image, but show the same.
    """
    if kind != "images":
        return _warped(image, plan, maps, cv2.INTER_LINEAR if kind == "masks" else cv2.INTER_CUBIC)
    if image.dtype != np.uint8:
        return _warped(image, plan, maps, SHARP)
    into_light, from_light = _tables(exponent)
    light = cv2.LUT(image, into_light) if image.ndim == 2 or image.shape[2] == 3 else _covered(image, into_light)
    warped = _warped(light, plan, maps, SHARP)
    return from_light[warped] if warped.ndim == 2 or warped.shape[2] == 3 else _uncovered(warped, from_light)


@lru_cache(maxsize=4)
def _tables(exponent: float | None) -> tuple[np.ndarray, np.ndarray]:
    """From 8-bit values to light, (256,) uint16, and back, (65536,) uint8."""
    shades, light = np.linspace(0, 1, 256), np.linspace(0, 1, LIGHT + 1)
    into = light_of_srgb(shades) if exponent is None else shades**exponent
    back = srgb_of_light(light) if exponent is None else light ** (1 / exponent)
    return np.rint(LIGHT * into).astype(np.uint16), np.rint(255 * back).astype(np.uint8)


def _covered(image: np.ndarray, into_light: np.ndarray) -> np.ndarray:
    """Light times alpha, and alpha, (H, W, 4) float32: the colours of what is transparent mean nothing."""
    alpha = image[:, :, -1:].astype(np.float32) / 255
    return np.concatenate([into_light[image[:, :, :-1]] * alpha, LIGHT * alpha], axis=2)


def _uncovered(warped: np.ndarray, from_light: np.ndarray) -> np.ndarray:
    alpha = warped[:, :, -1:] / LIGHT
    light = np.clip(warped[:, :, :-1] / np.maximum(alpha, 1 / LIGHT), 0, LIGHT)  # both overshoot alike
    alpha = np.rint(255 * np.clip(alpha, 0, 1)).astype(np.uint8)
    return np.concatenate([from_light[np.rint(light).astype(np.uint16)], alpha], axis=2)


def _warped(
    image: np.ndarray, plan: Plan, maps: Callable[[Plan], tuple[np.ndarray, np.ndarray]], interpolation: int
) -> np.ndarray:
    """A picture shrunk, undistorted, and padded with zeros to the canvas."""
    image = _resized(image, plan.shrunk)
    if plan.lens is not None:
        pixels, _ = maps(plan)
        # OpenCV's types do not know that one map of both coordinates needs no second.
        image = cv2.remap(image, pixels, None, interpolation, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    right, bottom = (canvas - size for canvas, size in zip(plan.canvas, plan.size, strict=True))
    return cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_CONSTANT, value=0) if right or bottom else image


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """cv2.resize lays borders over each other, not the centres of the first pixels, as `_scaled` does."""
    if (image.shape[1], image.shape[0]) == size:
        return image
    smaller = size[0] <= image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def _valid_areas(plans: list[Plan], folder: Path, known: dict[str, Any]) -> list[Path | str]:
    """(V,) pictures of where each view shows something, 255, or nothing, 0; '' where it does everywhere."""
    paths: dict[Plan, Path | str] = {}
    for plan in dict.fromkeys(plans):
        key = digest([*_method(plan), asdict(plan)])
        target = folder / "valid" / f"{key[:16]}.png"
        label = f"valid/{target.name}"
        if known.get(label) != "" and not _is_as_made(target, known.get(label), key):
            area = _valid_area(plan)
            if not area.all():
                _write(target, np.uint8(255) * area)
            known[label] = "" if area.all() else _entry(key, target)
            write_json(folder / "index.json", known)
        paths[plan] = target if known[label] else ""
    return [paths[plan] for plan in plans]


def _valid_area(plan: Plan) -> np.ndarray:
    valid = np.zeros(plan.canvas[::-1], bool)
    width, height = plan.size
    lens = plan.lens
    valid[:height, :width] = (
        True if lens is None else undistortion_map(lens, plan.intrinsics, plan.size, plan.shrunk)[1]
    )
    return valid
