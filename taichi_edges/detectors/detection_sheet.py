"""One PNG that shows what the detector gave: views, edge maps, edgels between the pixels, and their residuals.

It is looked at before anything is trained: a map that is shifted, an object that is dilated or a threshold that lets
half of the edges go is seen here at a glance. All colours and pictures in this module are RGB.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from taichi_edges.files.artefacts import replacing
from taichi_edges.views.pictures import SAME_SHAPE, read_colour
from taichi_edges.views.views import Views, choose_views

CELL_WIDTH = 400  # px of the sheet; six columns fit a wide screen
CELL_HEIGHTS = (240, 480)  # px; the shape of the views between these
GAP = 14  # px between cells
LINE = 22  # px from one line of text to the next
LETTERS = 0.5  # OpenCV's scale: capitals 11 px high, legible at 100 %
MAGNIFICATION = 5  # screen pixels per pixel of the view: tenths of a pixel can be told apart
OVERSAMPLING = 4  # dots are stamped so many times larger and averaged
DIMMED = 0.42  # brightness left to the picture under dots
DOT = 2.4  # px; radius of an edgel in the magnified cell
SMALL_DOT = 0.8  # px; least radius of an edgel in the whole view
THIN_DOT = 0.6  # px; half the width of a dash
DASH = 0.5  # px of the view to both sides of an edgel, along its edge
LEAST_CONTRAST = 32  # of 255; less is noise, and is left as it is
MIXED = 4  # how many edgels one of the rarer kind outweighs when the part to magnify is chosen
SCALE_BAR = 10  # px of the view
EDGE_GAIN = 1.6  # an edge map made smaller pales; the lines are drawn so many times darker then
PAPER, INK, FAINT = (255, 255, 255), (40, 40, 40), (225, 225, 225)
UNKNOWN = (150, 150, 150)  # an edgel whose residual is not known
# Blue, orange: two of Okabe and Ito's, told apart with every common colour blindness; light enough for a dark picture.
NEGATIVE, ZERO, POSITIVE = (86, 180, 233), (245, 245, 245), (255, 140, 0)
FRAME = (255, 90, 90)  # of the part that is magnified
WEAKEST = 60  # of viridis' 256 colours; those below vanish on a dark picture
LIMITS = (0.1, 0.2, 0.3, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)  # px; ends of the residuals' colour bar
COVERED = 95  # percent of the residuals that the colour bar holds
BINS = 41  # odd, so that one bin is around 0


@dataclass(frozen=True)
class Content:
    """What one row draws.

    picture, edge_map: (H, W, 3) and (H, W) uint8. is_photo: is the picture one, not the edge map? points, normals:
    (m, 2) px. strengths: (m,) 0..1. residuals: (m,) px or None. silhouette: (m,) bool or None. window: left, top,
    width, height of the magnified part, px. limit: px.
    """

    picture: np.ndarray
    is_photo: bool
    edge_map: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    strengths: np.ndarray
    residuals: np.ndarray | None
    silhouette: np.ndarray | None
    window: tuple[int, int, int, int]
    limit: float


Column = Callable[[Content, tuple[int, int]], np.ndarray]  # (content, cell) -> (h, w, 3) uint8: draws one of its cells


def write_detection_sheet(
    path: Path | str,
    views: Views,
    residuals: np.ndarray | None = None,
    on_silhouette: np.ndarray | None = None,
    picture_reader: Callable[[str], np.ndarray | None] | None = None,
    count: int = 4,
) -> Path:
    """Write the sheet: a row for each of `count` views that look in different directions. Returns the path.

    views: Views with edgels. residuals: (n,) px per edgel, signed, NaN where unknown. on_silhouette: (n,) bool, or
    weights 0..1, of which one half and more counts as silhouette. picture_reader: path -> (H, W, 3) uint8 RGB, alpha
    composited, or None; views without a picture show their edge map.
    """
    assert views.edgels is not None
    assert residuals is None or len(residuals) == len(views.edgels)
    assert on_silhouette is None or len(on_silhouette) == len(views.edgels)
    silhouette = None if on_silhouette is None else np.asarray(on_silhouette) >= 0.5
    residuals = None if residuals is None else np.asarray(residuals, dtype=np.float64)
    limit, cell = colour_limit(residuals), _cell_size(views)
    chosen = choose_views(views, count)
    rows = [_header(views, len(chosen), residuals, silhouette, limit, cell)]
    for view in chosen:
        content = content_of(views, view, residuals, silhouette, limit, cell, picture_reader or _read_picture)
        rows += [_row_title(views, view, content, cell), _row([draw(content, cell) for draw in _columns(residuals)])]
    written, encoded = cv2.imencode(".png", np.concatenate(rows)[:, :, ::-1])
    assert written
    with replacing(path) as unfinished:
        unfinished.write_bytes(encoded.tobytes())
    return Path(path)


def residual_colours(residuals: np.ndarray, limit: float) -> np.ndarray:
    """(n,) px -> (n, 3) uint8 RGB: from NEGATIVE at -limit through ZERO to POSITIVE at limit; UNKNOWN for NaN."""
    share = np.clip(np.asarray(residuals, dtype=np.float64) / limit, -1.0, 1.0)[:, None]
    ends = np.where(share < 0, NEGATIVE, POSITIVE)
    colours = np.array(ZERO) + np.abs(share) * (ends - np.array(ZERO))
    return np.where(np.isnan(share), UNKNOWN, np.rint(colours)).astype(np.uint8)


def strength_colours(strengths: np.ndarray) -> np.ndarray:
    """(n,) 0..1 -> (n, 3) uint8 RGB of viridis, without its darkest."""
    viridis = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS).reshape(256, 3)[:, ::-1]
    return viridis[np.rint(WEAKEST + (255 - WEAKEST) * np.clip(strengths, 0.0, 1.0)).astype(int)]


def median_and_mad(residuals: np.ndarray) -> tuple[float, float, int]:
    """Median and median absolute deviation, px, and number of the known ones; NaN where there is none."""
    known = residuals[np.isfinite(residuals)]
    if not len(known):
        return np.nan, np.nan, 0
    median = np.median(known)
    return float(median), float(np.median(np.abs(known - median))), len(known)


# --- What is drawn ---


def _read_picture(path: str) -> np.ndarray | None:
    picture = read_colour(path)
    return None if picture is None else picture[:, :, ::-1]


def colour_limit(residuals: np.ndarray | None) -> float:
    """px; the end of the colour bar: a round number that holds most of the residuals."""
    known = np.abs(residuals[np.isfinite(residuals)]) if residuals is not None else np.zeros(0)
    wanted = np.percentile(known, COVERED) if len(known) else LIMITS[0]
    return next((limit for limit in LIMITS if limit >= wanted), LIMITS[-1])


def _cell_size(views: Views) -> tuple[int, int]:
    """(width, height) px of a cell: the shape of the views, unless that is extreme."""
    return CELL_WIDTH, int(np.clip(round(CELL_WIDTH * views.height / views.width), *CELL_HEIGHTS))


def content_of(
    views: Views,
    view: int,
    residuals: np.ndarray | None,
    silhouette: np.ndarray | None,
    limit: float,
    cell: tuple[int, int],
    picture_reader: Callable[[str], np.ndarray | None],
) -> Content:
    """The Content of one row of the sheet. residuals, silhouette: (e,) of all edgels, None where unknown. limit: px."""
    assert views.edgels is not None
    part = slice(views.edgels.starts[view], views.edgels.starts[view + 1])
    points, normals, strengths = views.edgels.of_view(view)
    off, outer = (None if values is None else values[part] for values in (residuals, silhouette))
    window = busiest_window(points, off, outer, (views.width, views.height), cell)
    photo, edge_map = _photo(views, view, picture_reader), views.edge_maps[view]
    picture = cv2.cvtColor(255 - edge_map, cv2.COLOR_GRAY2RGB) if photo is None else photo
    return Content(picture, photo is not None, edge_map, points, normals, strengths, off, outer, window, limit)


def _photo(views: Views, view: int, picture_reader: Callable[[str], np.ndarray | None]) -> np.ndarray | None:
    """(H, W, 3) uint8 in the size of the view; None where there is no picture of it."""
    picture = picture_reader(views.image_paths[view]) if views.image_paths[view] else None
    if picture is None:
        return None
    height, width = picture.shape[:2]
    if abs(width * views.height / (height * views.width) - 1.0) >= SAME_SHAPE:
        return None
    return cv2.resize(picture, (views.width, views.height), interpolation=cv2.INTER_AREA)


def busiest_window(
    points: np.ndarray,
    residuals: np.ndarray | None,
    silhouette: np.ndarray | None,
    size: tuple[int, int],
    cell: tuple[int, int],
) -> tuple[int, int, int, int]:
    """Left, top, width, height, px, of the part to magnify: where most edgels are, of both kinds where they are known.

    Edgels without a residual do not count where others have one. Without any, the middle of the view.
    """
    width, height = (min(have, max(side // MAGNIFICATION, 1)) for have, side in zip(size, cell, strict=True))
    counted = np.ones(len(points), bool)
    if residuals is not None and np.isfinite(residuals).any():
        counted = np.isfinite(residuals)
    if not len(points):
        return (size[0] - width) // 2, (size[1] - height) // 2, width, height
    kinds = [counted] if silhouette is None else [counted & silhouette, counted & ~silhouette]
    sums = [window_sums(points[kind], size, (width, height)) for kind in kinds]
    score = sum(sums) + MIXED * np.minimum.reduce(sums)
    top, left = np.unravel_index(np.argmax(score), score.shape)
    return int(left), int(top), width, height


def window_sums(points: np.ndarray, size: tuple[int, int], window: tuple[int, int]) -> np.ndarray:
    """How many points lie in each place of a window in an image; both sizes are (width, height) px."""
    columns, rows = (
        np.clip(np.rint(values), 0, side - 1).astype(int) for values, side in zip(points.T, size, strict=True)
    )
    counts = np.bincount(rows * size[0] + columns, minlength=size[0] * size[1]).reshape(size[1], size[0])
    sums = np.pad(counts.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    wide, high = window
    return sums[high:, wide:] - sums[:-high, wide:] - sums[high:, :-wide] + sums[:-high, :-wide]


# --- The cells of a row ---


def _columns(residuals: np.ndarray | None) -> list[Column]:
    """The cells of a row, from left to right: functions (content, cell) -> (h, w, 3) uint8."""
    return [_whole_picture, _whole_map, _whole_edgels, _magnified_edgels] + (
        [magnified_residuals, _histograms] if residuals is not None else []
    )


def _whole_picture(content: Content, cell: tuple[int, int]) -> np.ndarray:
    return _centred(_fitted(content.picture, cell), cell)


def _whole_map(content: Content, cell: tuple[int, int]) -> np.ndarray:
    fitted = _fitted(content.edge_map, cell).astype(np.float32)
    gain = EDGE_GAIN if fitted.shape[0] < content.edge_map.shape[0] else 1.0
    drawn = (255 - np.clip(gain * fitted, 0, 255)).astype(np.uint8)
    return _centred(cv2.cvtColor(drawn, cv2.COLOR_GRAY2RGB), cell)


def _whole_edgels(content: Content, cell: tuple[int, int]) -> np.ndarray:
    picture = _dim(_fitted(content.picture, cell))
    scale = picture.shape[1] / content.picture.shape[1]
    order = np.argsort(content.strengths, kind="stable")  # the sure ones on top
    places = (content.points[order] + 0.5) * scale - 0.5
    _stamp(picture, places, strength_colours(content.strengths[order]), np.clip(0.4 * scale, SMALL_DOT, DOT))
    left, top, wide, high = (round(side * scale) for side in content.window)
    cv2.rectangle(picture, (left, top), (left + wide - 1, top + high - 1), FRAME, 2)
    return _centred(picture, cell)


def _magnified_edgels(content: Content, cell: tuple[int, int]) -> np.ndarray:
    return _magnified(content, cell, strength_colours(content.strengths))


def magnified_residuals(content: Content, cell: tuple[int, int]) -> np.ndarray:
    """The cell of the magnified edgels, coloured by their residuals, (height, width, 3) uint8."""
    assert content.residuals is not None  # else there is no such column
    return _magnified(content, cell, residual_colours(content.residuals, content.limit))


def _magnified(content: Content, cell: tuple[int, int], colours: np.ndarray) -> np.ndarray:
    """The window of the view, every pixel a square, with its edgels: a dot at its place, a dash along its edge."""
    left, top, wide, high = content.window
    part = _dim(_stretched(content.picture[top : top + high, left : left + wide]))
    scale = min(cell[0] / wide, cell[1] / high)
    size = (round(wide * scale), round(high * scale))
    picture = cv2.resize(part, size, interpolation=cv2.INTER_NEAREST)
    inside = ((content.points > (left - 1, top - 1)) & (content.points < (left + wide, top + high))).all(axis=1)
    points, colours = content.points[inside], colours[inside]
    along = content.normals[inside] @ np.array([[0.0, -1.0], [1.0, 0.0]])
    steps = np.linspace(-DASH, DASH, 2 * MAGNIFICATION)[:, None, None]
    dashes = (points + steps * along).reshape(-1, 2)
    for places, radius in ((dashes, THIN_DOT), (points, DOT)):
        _stamp(picture, (places - (left, top) + 0.5) * scale - 0.5, np.resize(colours, places.shape[:1] + (3,)), radius)
    _scale_bar(picture, scale)
    return _centred(picture, cell)


def _scale_bar(picture: np.ndarray, scale: float) -> None:
    """A white bar SCALE_BAR pixels of the view long, with its length, at the lower left."""
    length, bottom = round(SCALE_BAR * scale), picture.shape[0] - 10
    words = f"{SCALE_BAR} px"
    right = 10 + length + 7 + _text_width(words)
    if right + 5 > picture.shape[1]:
        return
    cv2.rectangle(picture, (4, bottom - 15), (right + 5, bottom + 6), (0, 0, 0), cv2.FILLED)
    cv2.rectangle(picture, (10, bottom - 4), (10 + length, bottom - 1), PAPER, cv2.FILLED)
    _write(picture, words, (length + 17, bottom), PAPER)


def _histograms(content: Content, cell: tuple[int, int]) -> np.ndarray:
    """The residuals of silhouettes and of creases, one above the other, on one axis."""
    assert content.residuals is not None  # else there is no such column
    picture = np.full((cell[1], cell[0], 3), 255, np.uint8)
    if content.silhouette is None:
        kinds = [("all edgels", np.ones(len(content.points), bool))]
    else:
        kinds = [("silhouettes", content.silhouette), ("creases", ~content.silhouette)]
    height = (cell[1] - LINE) // len(kinds)
    for place, (name, chosen) in enumerate(kinds):
        top = place * height
        _histogram(picture[top : top + height], name, content.residuals[chosen], content.limit)
    _axis(picture, content.limit)
    return picture


def _histogram(picture: np.ndarray, name: str, residuals: np.ndarray, limit: float) -> None:
    """Bars, the zero line, the median and its number, in place. What lies beyond the limit is in the last bars."""
    height, width = picture.shape[:2]
    median, mad, known = median_and_mad(residuals)
    _write(picture, f"{name}: {_described(median, mad, known)}", (2, LINE - 6), room=width - 4)
    base, tallest = height - 6, height - LINE - 16
    inside = np.clip(residuals[np.isfinite(residuals)], -limit, limit)
    counts, ends = np.histogram(inside, BINS, (-limit, limit))
    colours = residual_colours((ends[1:] + ends[:-1]) / 2, limit)
    for count, left, right, colour in zip(counts, ends[:-1], ends[1:], colours, strict=True):
        if count:
            up = max(round(tallest * count / counts.max()), 1)
            corners = (_across(left, limit, width), base - up), (_across(right, limit, width) - 1, base - 1)
            cv2.rectangle(picture, *corners, colour.tolist(), cv2.FILLED)
            cv2.rectangle(picture, *corners, UNKNOWN, 1)
    cv2.line(picture, (0, base), (width - 1, base), INK)
    cv2.line(picture, (_across(0.0, limit, width), base), (_across(0.0, limit, width), LINE + 6), INK)
    if known:
        place = _across(np.clip(median, -limit, limit), limit, width)
        cv2.line(picture, (place, base), (place, LINE + 6), FRAME, 2)


def _described(median: float, mad: float, known: int) -> str:
    return f"median {median:+.2f}, MAD {mad:.2f} px, n = {known}" if known else "none"


def _across(residual: float, limit: float, width: int) -> int:
    """Column of a residual in a histogram `width` px wide; half a bin is left free at each end."""
    return round(width * (0.5 + 0.48 * residual / limit))


def _axis(picture: np.ndarray, limit: float) -> None:
    """Numbers below the histograms, px."""
    height, width = picture.shape[:2]
    for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
        unit = " px" if share == 0 else ""
        words = f"{share * limit:+g}{unit}" if share else f"0{unit}"
        _write_centred(picture, words, _across(share * limit, limit, width), height - 6)


# --- The text around the cells ---

HEADINGS: dict[Column, tuple[str, str]] = {
    _whole_picture: ("view", ""),
    _whole_map: ("edge map", "what the splatting learns from"),
    _whole_edgels: ("edgels", "framed: the part that is magnified"),
    _magnified_edgels: ("edgels, magnified", ""),
    magnified_residuals: ("residuals, magnified", ""),
    _histograms: ("residuals", "outwards positive; red: median"),
}


def _header(
    views: Views,
    shown: int,
    residuals: np.ndarray | None,
    silhouette: np.ndarray | None,
    limit: float,
    cell: tuple[int, int],
) -> np.ndarray:
    """Title, the numbers over all views, and the headings and colour bars of the columns."""
    columns = _columns(residuals)
    width = GAP + len(columns) * (cell[0] + GAP)
    picture = np.full((5 * LINE + GAP, width, 3), 255, np.uint8)
    known = int(np.isfinite(residuals).sum()) if residuals is not None else 0
    assert views.edgels is not None
    title = f"{len(views)} views of {views.width} x {views.height} px ({shown} shown), {len(views.edgels)} edgels"
    _write(picture, f"{title}, {known} with a residual" if residuals is not None else title, (GAP, LINE), bold=True)
    if residuals is not None:
        _write(picture, f"all views, residuals: {_summary(residuals, silhouette)}", (GAP, 2 * LINE))
    for place, column in enumerate(columns):
        left, (heading, words) = GAP + place * (cell[0] + GAP), HEADINGS[column]
        _write(picture, heading, (left, 4 * LINE - 4), bold=True)
        if column is _magnified_edgels:
            _bar(picture, (left, 4 * LINE + 4), strength_colours, (0.0, 0.5, 1.0), "{:g}", "strength", cell)
        elif column is magnified_residuals:
            ticks = (-limit, 0.0, limit)
            _bar(picture, (left, 4 * LINE + 4), lambda r: residual_colours(r, limit), ticks, "{:+g}", "px", cell)
        else:
            _write(picture, words, (left, 5 * LINE - 2), room=cell[0])
    return picture


def _summary(residuals: np.ndarray, silhouette: np.ndarray | None) -> str:
    if silhouette is None:
        return _described(*median_and_mad(residuals))
    parts = (("silhouettes", silhouette), ("creases", ~silhouette))
    return "; ".join(f"{name} {_described(*median_and_mad(residuals[chosen]))}" for name, chosen in parts)


def _bar(
    picture: np.ndarray,
    corner: tuple[int, int],
    colours: Callable[[np.ndarray], np.ndarray],
    ticks: Sequence[float],
    form: str,
    unit: str,
    cell: tuple[int, int],
) -> None:
    """A colour bar from the first tick to the last with the numbers and the unit."""
    left, top = corner
    first, last = (form.format(tick) if tick else "0" for tick in (ticks[0], ticks[-1]))
    _write(picture, first, (left, top + LINE - 6))
    start, length = left + _text_width(first) + 6, cell[0] // 2
    values = colours(np.linspace(ticks[0], ticks[-1], length))
    picture[top + 4 : top + LINE - 4, start : start + length] = values
    cv2.rectangle(picture, (start - 1, top + 3), (start + length, top + LINE - 4), UNKNOWN)
    _write(picture, f"{last} {unit}", (start + length + 6, top + LINE - 6))


def _row_title(views: Views, view: int, content: Content, cell: tuple[int, int]) -> np.ndarray:
    """The strip above a row: which view it is, its numbers and how much is magnified."""
    columns = _columns(content.residuals)
    picture = np.full((LINE + 8, GAP + len(columns) * (cell[0] + GAP), 3), 255, np.uint8)
    cv2.line(picture, (GAP, 2), (picture.shape[1] - GAP, 2), FAINT)
    _, _, wide, high = content.window
    magnified = f"{min(cell[0] / wide, cell[1] / high):.3g}x: {wide} x {high} px"
    count = f"{len(content.points)} edgels"
    if len(content.points):
        count += f", median strength {np.median(content.strengths):.2f}"
    what = "" if content.is_photo else " (no picture: edge map)"
    name = _shortened(views.names[view], cell[0] - _text_width(what, bold=True)) + what
    words: dict[Column, str] = {_whole_picture: name, _whole_edgels: count, _magnified_edgels: magnified}
    if content.residuals is not None:
        words[magnified_residuals] = f"{np.isfinite(content.residuals).sum()} with a residual"
    for place, column in enumerate(columns):
        left, bold = GAP + place * (cell[0] + GAP), column is _whole_picture
        _write(picture, words.get(column, ""), (left, LINE), bold=bold, room=cell[0])
    return picture


def _shortened(words: str, width: int) -> str:
    """Words that fit `width` px."""
    for length in range(len(words), 0, -1):
        shorter = words if length == len(words) else words[:length] + "..."
        if _text_width(_ascii(shorter), bold=True) <= width:
            return shorter
    return ""


def _row(cells: Sequence[np.ndarray]) -> np.ndarray:
    """Cells side by side, with gaps."""
    height = cells[0].shape[0]
    gap = np.full((height, GAP, 3), 255, np.uint8)
    row = np.concatenate([gap, *(part for cell in cells for part in (cell, gap))], axis=1)
    return np.concatenate([row, np.full((GAP, row.shape[1], 3), 255, np.uint8)])


def _ascii(words: str) -> str:
    """OpenCV's letters are ASCII."""
    return words.encode("ascii", "replace").decode()


def _text_width(words: str, bold: bool = False) -> int:
    """px; OpenCV 5 writes narrower letters than OpenCV 4."""
    return cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, LETTERS, 2 if bold else 1)[0][0]


def _write(
    picture: np.ndarray,
    words: str,
    origin: tuple[float, float],
    colour: tuple[int, int, int] = INK,
    bold: bool = False,
    room: int | None = None,
) -> None:
    """Letters with their lower left corner at `origin`, (x, y) px; smaller ones where they need more than `room` px."""
    words, place = _ascii(words), tuple(round(value) for value in origin)
    scale = LETTERS * min(1.0, (room or np.inf) / max(_text_width(words, bold), 1))
    cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 2 if bold else 1, cv2.LINE_AA)


def _write_centred(picture: np.ndarray, words: str, column: int, baseline: int) -> None:
    """Letters around a column, pushed inside the picture."""
    wide = _text_width(words)
    _write(picture, words, (np.clip(column - wide / 2, 0, picture.shape[1] - wide - 1), baseline))


# --- Pixels ---


def _fitted(picture: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    """A picture as large as fits the cell; pixels stay squares where it grows."""
    height, width = picture.shape[:2]
    scale = min(cell[0] / width, cell[1] / height)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)


def _centred(picture: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    """The picture in the middle of a cell."""
    whole = np.full((cell[1], cell[0], 3), FAINT, np.uint8)
    top, left = (cell[1] - picture.shape[0]) // 2, (cell[0] - picture.shape[1]) // 2
    whole[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    cv2.rectangle(whole, (0, 0), (cell[0] - 1, cell[1] - 1), FAINT)  # or a white view has no border on white paper
    return whole


def _stretched(picture: np.ndarray) -> np.ndarray:
    """A picture with all its contrast, the same factor for the three channels: dark corners are looked into as well."""
    dark, bright = np.percentile(picture, (1, 99))
    return np.clip((picture - dark) * (255 / max(bright - dark, LEAST_CONTRAST)), 0, 255)


def _dim(picture: np.ndarray) -> np.ndarray:
    return np.rint(DIMMED * picture).astype(np.uint8)


def _stamp(picture: np.ndarray, places: np.ndarray, colours: np.ndarray, radius: float) -> None:
    """Put round dots on a picture, in place; later ones on top. places: (n, 2) px. colours: (n, 3). radius: px."""
    height, width = picture.shape[:2]
    fine = np.zeros((height * OVERSAMPLING, width * OVERSAMPLING, 4), np.uint8)  # RGB and whether there is a dot
    reach = int(np.ceil(radius * OVERSAMPLING))
    columns, rows = np.rint(OVERSAMPLING * (places + 0.5) - 0.5).astype(int).T
    for down, right in np.argwhere(np.ones((2 * reach + 1, 2 * reach + 1))) - reach:
        if down**2 + right**2 <= (radius * OVERSAMPLING) ** 2:
            inside = (rows + down >= 0) & (rows + down < len(fine))
            inside &= (columns + right >= 0) & (columns + right < fine.shape[1])
            fine[rows[inside] + down, columns[inside] + right, :3] = colours[inside]
            fine[rows[inside] + down, columns[inside] + right, 3] = 255
    cover = cv2.resize(fine.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    picture[:] = np.rint(picture * (1 - cover[:, :, 3:] / 255) + cover[:, :, :3]).clip(0, 255).astype(np.uint8)
