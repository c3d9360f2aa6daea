"""PNG pictures of the edges drawn over the views, for people to judge the result by eye."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.exporters.line_sets import line_set_arrays
from taichi_edges.exporters.naming import confidence_of
from taichi_edges.files.artefacts import replacing
from taichi_edges.files.palette import CURVE_COLOUR, LINE_COLOUR
from taichi_edges.views.cameras import frustum_planes, shares_inside
from taichi_edges.views.pictures import SAME_SHAPE, read_colour
from taichi_edges.views.views import Views, choose_views

if TYPE_CHECKING:
    from taichi_edges.geometry.wireframe import Wireframe

OVERSAMPLING = 4  # the edges are drawn so many times larger and averaged
SUBPIXEL_BITS = 4  # OpenCV draws in units of 1/16 pixel
LINE_WIDTH = 2.5  # pixels at REFERENCE_WIDTH
FAINTEST = 0.3  # how opaque an edge of confidence 0 is drawn
DOT_WIDTH = 2.2  # diameter of a vertex, in line widths
DOT_COLOUR = (30, 30, 30)
RING_WIDTH, RING_STROKE = 2.8, 0.5  # a free end: diameter of the ring, and what it is drawn with, in line widths
RING_COLOUR = (255, 255, 255)  # inside
RING_SIDES = 16
FADED_TO = 0.35  # how dark an edge pixel of the map is drawn, 1 = black
IMAGE_FADE = 0.35  # how far the colour image is mixed with white, so that the edges stand out
MANY_EDGES, THINNEST = 100, 0.4  # from so many edges on strokes get thinner, down to this share
REFERENCE_WIDTH = 800  # pixels; strokes and letters grow with wider images
SHEET_WIDTH = 1600  # pixels; a contact sheet is scaled down to this
SHEET_GAP = 8  # pixels
TEXT_COLOUR = (40, 40, 40)
GREYS = np.arange(256)

Symbol = Callable[[np.ndarray, np.ndarray, float], None]  # draws on a picture, between two pixels (2, 2), with a stroke


def draw_overlays(folder: Path | str, views: Views, wireframe: "Wireframe", count: int = 4) -> list[Path]:
    """Draw the edges of a wireframe over `count` views that look in different directions, one PNG each.

    Over the view's colour image where there is a readable one, else over its edge map, faded. Hidden edges are drawn
    too. The picture is the view, pixel for pixel, with a caption below it.

    folder: where the files go. views: Views. wireframe: Wireframe in the unit cube. Returns the paths, by view.
    """
    paths = []
    for view in choose_views(views, count):
        picture = draw_edges(background(views, view), views.intrinsics[view] @ views.world_to_camera[view], wireframe)
        safe_name = re.sub(r"[^\w.-]+", "_", views.names[view])
        paths.append(Path(folder) / f"overlay_{view:04d}_{safe_name}.png")
        _write_png(paths[-1], np.concatenate([picture, caption(views.width, views.names[view], wireframe)]))
    return paths


def contact_sheet(paths: Sequence[Path | str], out: Path | str) -> Path:
    """Put pictures (paths, at least one, all of one size) side by side into one PNG, `out`, row by row."""
    pictures = []
    for path in paths:
        picture = read_colour(path)
        if picture is None:
            raise UserError(f"{path}: not a readable picture; run the export again")
        pictures.append(picture)
    columns = int(np.ceil(np.sqrt(len(pictures))))
    rows = -(-len(pictures) // columns)
    shrink = min(1.0, SHEET_WIDTH / (columns * pictures[0].shape[1]))
    height, width = (max(round(side * shrink), 1) for side in pictures[0].shape[:2])
    pitch_y, pitch_x = height + SHEET_GAP, width + SHEET_GAP
    sheet = np.full((rows * pitch_y + SHEET_GAP, columns * pitch_x + SHEET_GAP, 3), 255, np.uint8)
    for index, picture in enumerate(pictures):
        top, left = SHEET_GAP + index // columns * pitch_y, SHEET_GAP + index % columns * pitch_x
        tile = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        sheet[top : top + height, left : left + width] = tile
    _write_png(out, sheet)
    return Path(out)


def background(views: Views, view: int) -> np.ndarray:
    """What is drawn on: (H, W, 3) uint8 BGR, the colour image of the view or its edge map, mixed with white."""
    colour = read_colour(views.image_paths[view]) if views.image_paths[view] else None
    if colour is not None:
        height, width = colour.shape[:2]
        if abs(width * views.height / (height * views.width) - 1.0) < SAME_SHAPE:
            resized = cv2.resize(colour, (views.width, views.height), interpolation=cv2.INTER_AREA)
            return cv2.LUT(resized, (GREYS + IMAGE_FADE * (255.0 - GREYS)).round().astype(np.uint8))
    faded = cv2.LUT(views.edge_maps[view], (255.0 - FADED_TO * GREYS).round().astype(np.uint8))
    return np.repeat(faded[:, :, None], 3, axis=2)


def draw_edges(picture: np.ndarray, projection: np.ndarray, wireframe: "Wireframe") -> np.ndarray:
    """Draw anti-aliased edges and their vertices on a (H, W, 3) uint8 BGR picture, in place; returns it.

    The less confidence in an edge, the fainter it is. A vertex where edges meet is a dark dot, a free end an open ring.
    projection: (3, 4) intrinsics @ world_to_camera. wireframe: in the world of the projection.
    """
    height, width = picture.shape[:2]
    stroke = LINE_WIDTH * max(width / REFERENCE_WIDTH, 0.5) * _thinness(len(wireframe))
    points, segments, owners = line_set_arrays(wireframe)
    homogeneous = np.column_stack([points @ projection[:, :3].T + projection[:, 3], np.ones(len(points))])
    planes = frustum_planes(width, height, 2 * stroke)  # so that no round line cap shows inside the image
    opacities, straight = _opacities(wireframe), _are_lines(wireframe)
    for is_line, colour in ((True, LINE_COLOUR), (False, CURVE_COLOUR)):
        levels = np.unique(opacities[straight == is_line])  # rising, so that the surer edge is on top
        of_level = [segments[((straight == is_line) & (opacities == level))[owners]] for level in levels]
        clipped = [_pixels(clip_segments(homogeneous[each], planes)) for each in of_level]
        _paint(picture, colour, stroke, list(zip(levels, clipped, strict=True)))
    vertices, degrees = homogeneous[: len(wireframe.vertices)], wireframe.degrees
    visible = (vertices @ planes.T >= 0).all(axis=1)
    for ring, which in ((False, degrees > 1), (True, degrees == 1)):
        _mark(picture, _pixels(vertices[visible & which]), stroke, ring)
    return picture


def _thinness(count: int) -> float:
    """Factor on the strokes: where there are many edges they would hide each other."""
    return max(THINNEST, min(1.0, (MANY_EDGES / max(count, 1)) ** 0.5))


def _pixels(homogeneous: np.ndarray) -> np.ndarray:
    """(..., 4) homogeneous pixels, all in front of the camera -> (..., 2)."""
    return homogeneous[..., :2] / homogeneous[..., 2:3]


def _opacities(wireframe: "Wireframe") -> np.ndarray:
    """(n,) FAINTEST to 1, by confidence, in steps of 0.05; an edge that nobody has judged is opaque."""
    confidences = np.nan_to_num(np.array([confidence_of(edge) for edge in wireframe.edges], dtype=float), nan=1.0)
    return np.round(20 * (FAINTEST + (1 - FAINTEST) * np.clip(confidences, 0, 1))) / 20


def _are_lines(wireframe: "Wireframe") -> np.ndarray:
    """(n,) bool."""
    return np.array([shape.kind == "line" for shape in wireframe.shapes], dtype=bool)


def _mark(picture: np.ndarray, pixels: np.ndarray, stroke: float, ring: bool) -> None:
    """Draw vertices at the (n, 2) pixels: dots, or white discs with a dark outline."""
    if not ring:
        _paint(picture, DOT_COLOUR, DOT_WIDTH * stroke, [(1.0, np.repeat(pixels[:, None], 2, axis=1))])
        return
    _paint(picture, RING_COLOUR, RING_WIDTH * stroke, [(1.0, np.repeat(pixels[:, None], 2, axis=1))])
    round_trip = np.linspace(0, 2 * np.pi, RING_SIDES + 1)
    outline = 0.5 * RING_WIDTH * stroke * np.stack([np.cos(round_trip), np.sin(round_trip)], axis=1)
    sides = np.stack([outline[:-1], outline[1:]], axis=1)
    _paint(picture, DOT_COLOUR, RING_STROKE * stroke, [(1.0, (pixels[:, None, None] + sides).reshape(-1, 2, 2))])


def clip_segments(segments: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Cut segments to the visible region before the division by depth, so that nothing wraps round behind the camera.

    segments: (m, 2, 4) homogeneous pixels (uz, vz, z, 1). planes: (5, 4). Returns the visible parts, (k, 2, 4).
    """
    low, high = shares_inside(planes @ segments[:, 0].T, planes @ segments[:, 1].T)
    kept = low < high
    at = np.stack([low, high], axis=1)[kept, :, None]
    return segments[kept, :1] * (1.0 - at) + segments[kept, 1:] * at


def caption(width: int, name: str, wireframe: "Wireframe") -> np.ndarray:
    """The strip below the picture, (h, width, 3) uint8 BGR: the view's name, below it the legend.

    Edges are counted, not their pieces; vertices where edges meet, and free ends, as they are drawn. The height is the
    same for every name: a long one is written in smaller letters.
    """
    scale = max(0.5 * width / REFERENCE_WIDTH, 0.4)
    letter, line = _size_of("0", scale)
    rows = _rows(_legend(wireframe), width - letter, letter, scale)
    strip = np.full(((2 * len(rows) + 3) * line, width, 3), 245, np.uint8)
    smaller = min(1.0, (width - 2 * letter) / max(_size_of(name, scale)[0], 1))
    _write(strip, name, (letter, 2 * line), scale * smaller)
    for row, placed in enumerate(rows):
        baseline = 2 * (row + 2) * line
        for left, symbol, words in placed:
            middle = baseline - line / 2
            symbol(strip, np.array([[left, middle], [left + 2 * letter, middle]]), 2.0 * _thickness(scale))
            _write(strip, words, (left + 3 * letter, baseline), scale)
    return strip


def _rows(
    legend: Sequence[tuple[Symbol, str]], right: int, letter: int, scale: float
) -> list[list[tuple[int, Symbol, str]]]:
    """The legend in as many rows as it needs, which end before the pixel `right`: lists of (left, symbol, words)."""
    rows: list[list[tuple[int, Symbol, str]]] = []
    left = right
    for symbol, words in legend:
        size = 3 * letter + _size_of(words, scale)[0]
        if left + size > right:
            rows.append([])
            left = letter
        rows[-1].append((left, symbol, words))
        left += size + 2 * letter
    return rows


def _legend(wireframe: "Wireframe") -> list[tuple[Symbol, str]]:
    """What is drawn in the overlays, as (function that draws a sample between two pixels (2, 2), words)."""
    lines, degrees = int(_are_lines(wireframe).sum()), wireframe.degrees

    def stretch(colour: tuple[int, int, int], opacity: float = 1.0) -> Symbol:
        return lambda strip, ends, stroke: _paint(strip, colour, stroke, [(opacity, ends[None])])

    def mark(ring: bool) -> Symbol:
        return lambda strip, ends, stroke: _mark(strip, ends.mean(axis=0)[None], stroke, ring)

    legend = [
        (stretch(LINE_COLOUR), f"lines {lines}"),
        (stretch(CURVE_COLOUR), f"curves {len(wireframe) - lines}"),
        (mark(ring=False), f"shared vertices {(degrees > 1).sum()}"),
        (mark(ring=True), f"free ends {(degrees == 1).sum()}"),
    ]
    faint = (stretch(LINE_COLOUR, FAINTEST), "fainter: less certain")
    return [*legend, faint] if (_opacities(wireframe) < 1.0).any() else legend


def _size_of(words: str, scale: float) -> Sequence[int]:
    """(width, height above the baseline) of letters, px."""
    return cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, _thickness(scale))[0]


def _thickness(scale: float) -> int:
    return max(round(2 * scale), 1)


def _write(picture: np.ndarray, words: str, origin: tuple[int, int], scale: float) -> None:
    """Letters with their lower left corner at `origin`, (x, y) pixels."""
    cv2.putText(picture, words, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, TEXT_COLOUR, _thickness(scale), cv2.LINE_AA)


def _paint(
    picture: np.ndarray, colour: tuple[int, int, int], stroke: float, layers: Sequence[tuple[float, np.ndarray]]
) -> None:
    """Paint segments `stroke` pixels wide, with round ends; a point becomes a dot.

    layers: (opacity, (m, 2, 2) pixels), the later ones on top. Through an oversampled mask: OpenCV's own anti-aliasing
    thickens a curve wherever two of its chords overlap.
    """
    height, width = picture.shape[:2]
    mask = np.zeros((height * OVERSAMPLING, width * OVERSAMPLING), np.uint8)
    for opacity, segments in layers:
        fine = OVERSAMPLING * segments + 0.5 * (OVERSAMPLING - 1)
        ends = np.rint(fine * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.polylines(
            mask, list(ends), False, round(255 * opacity), round(stroke * OVERSAMPLING), cv2.LINE_8, SUBPIXEL_BITS
        )
    coverage = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
    touched = coverage > 0
    alpha = coverage[touched, None] / 255.0
    picture[touched] = (picture[touched] * (1.0 - alpha) + np.array(colour[::-1]) * alpha).round()


def _write_png(path: Path | str, picture: np.ndarray) -> None:
    """Write (H, W, 3) uint8 BGR as a PNG, all of it or nothing."""
    written, content = cv2.imencode(".png", picture)
    assert written
    with replacing(path) as unfinished:
        unfinished.write_bytes(content.tobytes())
