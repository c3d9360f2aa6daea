"""Edgels straight from pictures: where the light changes fastest, at sub-pixel accuracy (after Canny, PAMI 1986).

For each scale, the fine ones first:

1. The gradient of the light, in that of three opponent colours in which it is steepest: an edge between equally bright
   colours counts like any other. The outline of a picture with transparency is a layer of its own.
2. The clutter around each pixel: how much the gradient varies in the direction along an edge. A straight edge, or a
   grid of them, has none; noise and texture vary in all directions alike.
3. Maxima of the gradient across the edge, at sub-pixel positions. Their ratio says how far they stand out: of what
   is beside them (a smooth shading, however steep, does not) in units of the clutter.
4. Maxima are linked into chains, and every maximum of a chain is a vote for or against an edge here: the logarithm of
   its ratio, less what the chain winds. Votes add up along a chain, clear ones by their squares, so that a long smooth
   chain may be faint, a clear one may be short, and noise, whose votes are negative, never gathers enough.

A coarse scale adds what the finer ones did not find: edges that drown in noise, and blurred ones.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.components import components
from taichi_edges.detectors.close_edges import disentangled
from taichi_edges.detectors.ridges import gaussian_derivatives
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.pictures import Picture, as_picture, levels_per_light, read_picture

# px, smoothing. The first is about the smallest whose derivative is sampled well; it keeps edges 2 px apart separate.
# The noise of the gradient falls with the square of the scale.
SCALES = (0.8, 1.5)
PIXEL_SIGMA = 0.3  # px; a pixel sees the mean over its area, which blurs like a Gaussian of sqrt(1 / 12)
MIN_COVERAGE = 0.5  # of a smoothed pixel by the object; the object's colour is not looked at farther out
MARGIN = 2  # px at the image's border where no edgel is looked for: as far as a link reaches

# Grey levels of 255: a lower step does not count. Steps of one level are what rounding makes of smooth shading.
MIN_STEP = 1.4
CLUTTER_SIGMA = 2.0  # px; directions are compared over so much, which is short against the curves of most edges
CLUTTER_WINDOW = 40.0  # px; the clutter's mean is taken over so much, wide against a group of slots or letters
# px, of what the rounding of smooth shading varies, which a flat background beside it shall not hide; and how much that
# is at most, in units of the least clutter.
ROUNDING_WINDOW, MOST_ROUNDING = 12.0, 2.0
BESIDE = 3.0  # blurs of the edge; there its own gradient is nearly gone (1 %)

LOW = 1.6  # times the clutter; less is no candidate
NEEDED = 2.5  # ratio of a maximum that speaks neither for nor against an edge; noise has maxima of 1.5 to 2.5
MOST = 3.0  # votes of one maximum at most, for or against: reached at 20 times the ratio needed
ENOUGH = 15.0  # votes for an edge: 5 maxima of 8 times the ratio needed, or 37 of 1.5 times that
CLEAR = 1.5  # votes of a maximum that counts by its square; steps of rounding in smooth shading hardly reach it
WINDOW = 5  # maxima to each side that are asked whether the edge goes on here
STRAIGHT = 0.9  # mean of the unit normals over the window; a circle with a radius of 7 px has it
WINDING = 5.0  # votes lost when the mean of the normals falls by 1
MOST_LOST = 1.5  # votes that winding costs at most: a contour three pixels wide winds, and stands out as no noise does
MAX_TURN = np.cos(np.radians(50.0))  # from one maximum to the next of a chain
MIN_CHORD = 3.0  # px; of nearer ends the directions say little about the curvature
NARROW = 2  # maxima to each side that tell it then: a window that goes all the way round a small hole tells nothing
SMALLEST, MOST_BENT = 0.81, 0.9  # curvatures times the blur: of a disc whose rim stays where it is; of any blurred rim
TOO_BENT = 0.5  # the same: of a disc whose rim is not blurred in a way of its own any more
ROUND = 0.3  # 1 / px; what is opposite on so small a circle is no line beside it
WIDEST = 4.0  # px; what is blurred by more has no width that neighbouring pixels could tell
MIN_RUN = 5  # maxima; what remains of a coarse chain beside finer ones must be longer
HALF_SURE = 12.0  # ratio of an edge that gets the strength 0.5

# BGR to opponent colours of equal noise: brightness, red against blue, green against both.
OPPONENT = np.array([[1, 1, 1], [-(1.5**0.5), 0, 1.5**0.5], [-(0.5**0.5), 2**0.5, -(0.5**0.5)]], np.float32) / 3
RING = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]
GAPS = [(down, right) for down in range(-2, 3) for right in range(-2, 3) if max(abs(down), abs(right)) == 2]


@dataclass(frozen=True)
class Field:
    """The gradient of one layer at one scale.

    gx, gy: (H, W) float32, light per pixel. levels: (H, W) float32, grey levels per unit of light. sigma: pixels.
    """

    gx: np.ndarray
    gy: np.ndarray
    levels: np.ndarray
    sigma: float

    @property
    def blur(self) -> float:
        """Pixels: the Gaussian that a sharp edge has become."""
        return float(np.hypot(self.sigma, PIXEL_SIGMA))


@dataclass(frozen=True)
class Maxima(Columns):
    """Maxima of the gradient across the edge.

    rows, columns: (n,) their pixels. points: (n, 2) pixels (u, v). normals: (n, 2) unit, towards more light.
    ratios: (n,) how far they stand out of what is beside them, in units of the clutter. widths: (n,) px^2, variance of
    the gradient's profile across the edge, a Gaussian where the edge is a blurred step. steepness: (n,) the gradient.
    curvatures: (n,) of the chain, 1 / px, see `_curvatures`.
    """

    rows: np.ndarray
    columns: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    ratios: np.ndarray
    widths: np.ndarray
    steepness: np.ndarray
    curvatures: np.ndarray


def trace_pictures(
    paths: Iterable[Path | str],
    threads: int | None = None,
    report: Callable[[int], None] | None = None,
    exponent: float | None = None,
) -> tuple[Edgels, list[tuple[int, int] | None]]:
    """Edgels of images, a few of which are held at a time, and the (width, height) of each, px, None without one.

    paths: (V,) image files, '' for a view without one, which has no edgels. threads: None for one per core; the
    result does not depend on it. report: called with the number of views that are done. exponent: see `as_picture`.
    UserError where an image cannot be read.
    """

    def trace(path: Path | str) -> tuple[tuple[np.ndarray, ...], tuple[int, int] | None]:
        if not path:
            return _arrays([], False), None
        picture = read_picture(path, exponent)
        height, width = picture.light.shape[:2]
        return detect_edgels(picture), (width, height)

    views, sizes = [], []
    pool = ThreadPoolExecutor(threads or os.cpu_count())  # OpenCV and NumPy release the lock in the long loops
    try:
        for view, size in pool.map(trace, paths):
            views.append(view)
            sizes.append(size)
            if report:
                report(len(views))
    finally:
        pool.shutdown(cancel_futures=True)  # of no use any more when one image cannot be read
    return Edgels.of_views(views), sizes


def detect_edgels(image: Picture | np.ndarray) -> tuple[np.ndarray, ...]:
    """Edgels of one image: a Picture, or an array that `as_picture` accepts.

    Returns points (n, 2) as (u, v), pixel centres at integers, 0.7 to 1.4 for each pixel of an edge's length; unit
    normals (n, 2) across the edge, towards more light; strengths (n,) in 0..1: r / (r + HALF_SURE) for an edge that
    stands out r times from the clutter around it. The faintest have about 0.2, and clear ones more than 0.5. And blurs
    (n,) and outlines (n,), see `Edgels`.
    """
    picture = image if isinstance(image, Picture) else as_picture(image)
    shape = picture.light.shape[:2]
    if min(shape) <= 2 * MARGIN:
        return _arrays([], False)
    taken = np.zeros(shape, bool)  # pixels with an edgel
    layers: list[Maxima] = []
    for field in _fields(picture):
        edges, runs = _chained(_maxima(field, _clutter(field)), shape, field.blur)
        straight = np.abs(edges.curvatures) < ROUND
        shifts, alone = disentangled(edges.points, edges.normals, edges.steepness, straight, field.blur)
        widths = np.where(alone, edges.widths - field.blur**2, np.nan)
        edges = replace(edges, points=edges.points + shifts[:, None] * edges.normals, widths=widths)
        free = ~_beside_taken(taken, edges, 1.5 * field.sigma)
        layers.append(edges.keep(_long_runs(free, runs)))
        taken[layers[-1].rows, layers[-1].columns] = True
    return _arrays(layers, picture.coverage is not None)


def _arrays(layers: list[Maxima], outlined: bool) -> tuple[np.ndarray, ...]:
    """The columns of `detect_edgels`. outlined: the first of the layers is that of the outline."""
    points, normals = (
        np.concatenate([np.zeros((0, 2)), *(getattr(layer, name) for layer in layers)])
        for name in ("points", "normals")
    )
    ratios = np.concatenate([np.zeros(0), *(layer.ratios for layer in layers)]).clip(min=0.0)
    own = [np.sqrt(np.maximum(layer.widths, 0.0)) for layer in layers]
    on_outline = [np.full(len(layer), outlined and layer is layers[0]) for layer in layers]
    blurs, outlines = np.concatenate([np.zeros(0), *own]), np.concatenate([np.zeros(0, bool), *on_outline])
    return points, normals, ratios / (ratios + HALF_SURE), blurs, outlines


def _fields(picture: Picture) -> Iterator[Field]:
    """The Fields of a picture, one after the other: the outline, then the colours from fine to coarse."""
    coverage, light = picture.coverage, picture.light
    if coverage is not None:
        gx, gy = islice(gaussian_derivatives(coverage, SCALES[0]), 2)
        yield Field(gx, gy, np.full(coverage.shape, 255, np.float32), SCALES[0])
    light = cv2.transform(light, OPPONENT) if light.shape[2] == 3 else light[:, :, 0]
    for sigma in SCALES:
        gradients, mean = _steepest(*_derivatives(light, coverage, sigma))
        yield Field(*gradients, levels_per_light(mean, picture.exponent), sigma)


def _smooth(image: np.ndarray, sigma: float) -> np.ndarray:
    size = 2 * int(np.ceil(3 * sigma)) + 1
    return cv2.GaussianBlur(image, (size, size), sigma, borderType=cv2.BORDER_REPLICATE)


def _derivatives(
    light: np.ndarray, coverage: np.ndarray | None, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of the light along x and y, and its mean, each (H, W) or (H, W, 3), smoothed by `sigma` pixels.

    Where the object covers a part of the pixels, only that part counts (normalised convolution: Knutsson and Westin,
    CVPR 1993): the outline leaves no trace in the colours beside it.
    """
    if coverage is None:
        gx, gy = islice(gaussian_derivatives(light, sigma), 2)
        return gx, gy, _smooth(light, sigma)
    share = _smooth(coverage, sigma)
    inverse = np.where(share > MIN_COVERAGE, 1 / np.maximum(share, MIN_COVERAGE), 0).astype(np.float32)
    of_coverage: Iterator[np.ndarray] = islice(gaussian_derivatives(coverage, sigma), 2)
    if light.ndim == 3:
        coverage, inverse = coverage[:, :, None], inverse[:, :, None]
        of_coverage = (own[:, :, None] for own in of_coverage)
    covered = light * coverage
    mean = _smooth(covered, sigma) * inverse
    both = zip(gaussian_derivatives(covered, sigma), of_coverage, strict=False)  # the first two of five
    gx, gy = ((whole - mean * own) * inverse for whole, own in islice(both, 2))
    return gx, gy, mean


def _steepest(gx: np.ndarray, gy: np.ndarray, mean: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Gradient (gx, gy), (H, W) each, of the colour in which it is steepest, and the mean brightness (H, W)."""
    if gx.ndim == 2:
        return (gx, gy), mean
    x, y = gx[:, :, 0].copy(), gy[:, :, 0].copy()
    steepest = x * x + y * y
    for colour in range(1, gx.shape[2]):
        square = gx[:, :, colour] ** 2 + gy[:, :, colour] ** 2
        steeper = square > steepest
        for best, own in ((x, gx[:, :, colour]), (y, gy[:, :, colour]), (steepest, square)):
            np.copyto(best, own, where=steeper)
    return (x, y), np.ascontiguousarray(mean[:, :, 0])


def _clutter(field: Field) -> np.ndarray:
    """(H, W) float32: grey levels per pixel by which the gradient varies along the edges, or rounding varies it.

    That is the root of the smaller eigenvalue of the structure tensor. The mean is geometric: corners count little.
    """
    height, width = field.gx.shape
    half = ((width + 1) // 2, (height + 1) // 2)  # half the resolution is plenty and takes a quarter of the time
    gx, gy = field.gx * field.levels, field.gy * field.levels
    sigma = max(CLUTTER_SIGMA, 1.5 * field.sigma) / 2
    xx, yy, xy = (_smooth(cv2.resize(a, half, interpolation=cv2.INTER_AREA), sigma) for a in (gx**2, gy**2, gx * gy))
    smaller = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    floor = MIN_STEP / (np.sqrt(2 * np.pi) * field.blur * NEEDED)  # the steepest gradient of a step of MIN_STEP
    logs = 0.5 * np.log(np.maximum(smaller, 0) + floor**2)
    near, wide = (np.exp(_smooth(logs, window / 2)) for window in (ROUNDING_WINDOW, CLUTTER_WINDOW))
    clutter = np.maximum(wide, np.minimum(near, MOST_ROUNDING * floor))
    return cv2.resize(clutter, (width, height), interpolation=cv2.INTER_LINEAR)


def _maxima(field: Field, clutter: np.ndarray) -> Maxima:
    """Maxima of the gradient along its own direction that stand out of the clutter, (H, W), at least LOW times."""
    squares = field.gx**2 + field.gy**2
    rows, columns = _candidates(field, squares, clutter)
    gx, gy = field.gx[rows, columns], field.gy[rows, columns]
    size = np.sqrt(squares[rows, columns])
    normals = np.stack([gx, gy], axis=1) / size[:, None]
    offsets, widths = _offsets(squares, rows, columns, normals)
    near = np.abs(offsets) < 1
    found = (rows, columns, size, normals, offsets, widths)
    rows, columns, size, normals, offsets, widths = (array[near] for array in found)
    points = np.stack([columns, rows], axis=1).astype(np.float32) + offsets[:, None] * normals
    standing_out = size - _beside(field, rows, columns, normals)
    ratios = standing_out * (field.levels / clutter)[rows, columns]
    return Maxima(rows, columns, points, normals, ratios, widths, size, np.zeros(len(rows))).keep(ratios > LOW)


def _candidates(field: Field, squares: np.ndarray, clutter: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (n,) of the pixels whose gradient is larger than those before and behind it.

    The two are interpolated between the pixels where the gradient's direction meets the ring of eight around it.
    """
    strong = squares * field.levels**2 > (LOW * clutter) ** 2
    strong[:MARGIN] = strong[-MARGIN:] = strong[:, :MARGIN] = strong[:, -MARGIN:] = False
    rows, columns = np.nonzero(strong)
    gx, gy = field.gx[rows, columns], field.gy[rows, columns]
    width, flat = squares.shape[1], squares.reshape(-1)
    right, down = np.where(gx < 0, -1, 1), np.where(gy < 0, -width, width)
    steep = np.abs(gy) > np.abs(gx)
    major, minor = np.where(steep, down, right), np.where(steep, right, down)
    slant = np.minimum(np.abs(gx), np.abs(gy)) / np.maximum(np.abs(gx), np.abs(gy))
    centre = rows * width + columns
    before = (1 - slant) * flat[centre - major] + slant * flat[centre - major - minor]
    behind = (1 - slant) * flat[centre + major] + slant * flat[centre + major + minor]
    top = (flat[centre] > before) & (flat[centre] >= behind)
    return rows[top], columns[top]


def _offsets(
    squares: np.ndarray, rows: np.ndarray, columns: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) pixels from the pixel's centre to the maximum along the normal; infinite where there is none. And (n,) px^2,
    the variance of the gradient along it, at most WIDEST^2.

    The gradient across a blurred step is a Gaussian, the logarithm of which is a parabola: differences over the eight
    neighbours give its top without error.
    """
    width, flat = squares.shape[1], squares.reshape(-1)
    centre = rows * width + columns
    tiny = np.finfo(np.float32).tiny
    log = {
        (down, right): np.log(flat[centre + down * width + right] + tiny) for down, right in [(0, 0), *RING]
    }  # of the squares
    x, y = (log[0, 1] - log[0, -1]) / 2, (log[1, 0] - log[-1, 0]) / 2
    xx, yy = log[0, 1] - 2 * log[0, 0] + log[0, -1], log[1, 0] - 2 * log[0, 0] + log[-1, 0]
    xy = (log[1, 1] - log[1, -1] - log[-1, 1] + log[-1, -1]) / 4
    nx, ny = normals.T
    curvature = xx * nx * nx + 2 * xy * nx * ny + yy * ny * ny
    slope = x * nx + y * ny
    offsets = np.divide(-slope, curvature, out=np.full(len(rows), np.inf, np.float32), where=curvature < 0)
    widths = np.divide(-2.0, curvature, out=np.full(len(rows), WIDEST**2, np.float32), where=curvature < 0)
    return offsets, np.minimum(widths, WIDEST**2)


def _beside(field: Field, rows: np.ndarray, columns: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) mean of the gradients on both sides of the edges, along their normals."""
    height, width = field.gx.shape
    total = np.zeros(len(rows))
    for step in (-BESIDE * field.blur, BESIDE * field.blur):
        right = np.rint(columns + step * normals[:, 0]).astype(np.int64).clip(0, width - 1)
        down = np.rint(rows + step * normals[:, 1]).astype(np.int64).clip(0, height - 1)
        total += field.gx[down, right] * normals[:, 0] + field.gy[down, right] * normals[:, 1]
    return total / 2


def _chained(maxima: Maxima, shape: tuple[int, ...], blur: float) -> tuple[Maxima, np.ndarray]:
    """The Maxima that are edges, along their chains, ratios averaged there; and (n,) int, the run each belongs to.

    Where the edge is curved, blurring by `blur` pixels moved it inwards by half of blur^2 / radius; it is moved back.
    On discs of less than two blurs it moved less: no maximum is nearer to a centre than the blur. And the gradient's
    profile became wider, by blur^4 / radius^2 (measured on discs with radii of 2 px and more).
    """
    if len(maxima) == 0:
        return maxima, np.zeros(0, np.int64)
    order, low, high = _ordered(*_links(maxima, shape))
    maxima = maxima.keep(order)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
        return (sums[high] - sums[low]) / (high - low)

    straight = np.hypot(mean(maxima.normals[:, 0]), mean(maxima.normals[:, 1]))
    votes = np.log(np.maximum(maxima.ratios / NEEDED, np.exp(-MOST))).clip(max=MOST)
    votes -= np.minimum(WINDING * np.maximum(STRAIGHT - straight, 0.0), MOST_LOST)
    goes_on = mean(votes) > 0
    chain_starts = np.concatenate([[False], low[1:] > high[:-1] - 1])
    runs = np.cumsum(chain_starts | np.concatenate([[False], goes_on[1:] != goes_on[:-1]]))
    sums = np.bincount(
        runs, votes * np.maximum(votes / CLEAR, 1.0)
    )  # few clear ones say more than many that noise may be
    kept = goes_on & (sums[runs] >= ENOUGH)
    curvatures = _curvatures(maxima, low, high - 1)
    bent = (blur * curvatures).clip(-MOST_BENT, MOST_BENT)
    shifts = 0.5 * blur * bent * (1 - np.abs(bent / SMALLEST) ** 3)  # of a disc, within 0.01 of the blur
    points = maxima.points + shifts[:, None] * maxima.normals
    widths = np.where(np.abs(bent) < TOO_BENT, mean(maxima.widths) - (blur**2 * curvatures) ** 2, np.nan)
    means = mean(maxima.ratios), widths, mean(maxima.steepness), curvatures
    smoothed = Maxima(maxima.rows, maxima.columns, points, maxima.normals, *means)
    return smoothed.keep(kept), runs[kept]


def _curvatures(maxima: Maxima, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """(n,) 1 / pixels, positive where the normals point away from the centre: from the two ends of each window, or of
    a narrower one where these are too near to each other.

    On a circle the normals differ by the chord over the radius, however long it is.
    """
    here = np.arange(len(maxima))
    near = ((maxima.points[last] - maxima.points[first]) ** 2).sum(axis=1) <= MIN_CHORD**2
    first, last = (
        np.where(near, np.maximum(first, here - NARROW), first),
        np.where(near, np.minimum(last, here + NARROW), last),
    )
    chords = maxima.points[last] - maxima.points[first]
    turns = maxima.normals[last] - maxima.normals[first]
    return (chords * turns).sum(axis=1) / np.maximum((chords**2).sum(axis=1), 1.0)


def _links(maxima: Maxima, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(n,) index of the next maximum of the chain, light on one side throughout, -1 at its end; the same backwards.

    Two are linked when each is the best of the other's neighbours; over a gap of one pixel where there is no nearer.
    """
    count = len(maxima)
    place = np.full(shape, -1, np.int32)
    place[maxima.rows, maxima.columns] = np.arange(count)
    costs, partners = np.full((2, count), np.inf, np.float32), np.full((2, count), -1)
    columns = [np.ascontiguousarray(column) for column in (*maxima.points.T, *maxima.normals.T)]
    for ring in (RING, GAPS):
        lonely = np.flatnonzero((partners < 0).any(axis=0))
        centre = maxima.rows[lonely] * shape[1] + maxima.columns[lonely]
        for down, right in ring:
            others = place.reshape(-1)[centre + down * shape[1] + right]
            _offer(columns, lonely[others >= 0], others[others >= 0], costs, partners)
    ahead, behind = partners
    mutual = (ahead >= 0) & (behind[ahead] == np.arange(count))
    ahead = np.where(mutual, ahead, -1)
    behind = np.full(count, -1)
    behind[ahead[mutual]] = np.flatnonzero(mutual)
    return ahead, behind


def _offer(
    columns: list[np.ndarray], ours: np.ndarray, others: np.ndarray, costs: np.ndarray, partners: np.ndarray
) -> None:
    """Take each of the others for the neighbour of ours where it is better than the one so far; changes both arrays.

    columns: u, v of the points and of the normals, (n,) each. ours, others: (m,) indices. costs, partners: (2, n), of
    the best neighbour so far on either side.
    """
    (pu, pv, pnu, pnv), (qu, qv, qnu, qnv) = ([column[of] for column in columns] for of in (ours, others))
    u, v = qu - pu, qv - pv
    along = pnu * v - pnv * u
    aside = np.abs(u * pnu + v * pnv) + np.abs(u * qnu + v * qnv)
    turn = pnu * qnu + pnv * qnv
    cost = aside + np.abs(along) + 1 - turn
    fits = (turn > MAX_TURN) & (aside < 2 * np.abs(along))
    for side, mine in enumerate((along > 0, along < 0)):
        better = fits & mine & (cost < costs[side, ours])
        costs[side, ours[better]] = cost[better]
        partners[side, ours[better]] = others[better]


def _ordered(ahead: np.ndarray, behind: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) the maxima chain by chain, in order; and, in that order, (n,) the window of each, low .. high - 1."""
    count = len(ahead)
    linked = np.flatnonzero(ahead >= 0)
    labels = components(count, linked, ahead[linked])
    first = np.unique(labels, return_index=True)[1]
    open_chain = np.zeros(len(first), bool)
    open_chain[labels[behind < 0]] = True
    behind = behind.copy()
    behind[first[~open_chain]] = -1  # a closed chain is cut at its first pixel
    ranks = (behind >= 0).astype(np.int64)
    while (behind >= 0).any():  # each looks twice as far back as before
        ranks += np.where(behind >= 0, ranks[behind], 0)
        behind = np.where(behind >= 0, behind[behind], -1)
    order = np.lexsort((ranks, labels))
    ends = np.cumsum(np.bincount(labels))
    starts = np.concatenate([[0], ends])[:-1]
    here, label = np.arange(count), labels[order]
    return order, np.maximum(here - WINDOW, starts[label]), np.minimum(here + WINDOW + 1, ends[label])


def _beside_taken(taken: np.ndarray, maxima: Maxima, reach: float) -> np.ndarray:
    """(n,) bool: is one of the pixels across each edge, up to `reach` away, taken? taken: (H, W) bool."""
    height, width = taken.shape
    result = np.zeros(len(maxima), bool)
    for step in np.arange(-np.rint(reach), np.rint(reach) + 1):
        columns, rows = np.rint(maxima.points + step * maxima.normals).astype(np.int64).T
        result |= taken[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    return result


def _long_runs(free: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """(n,) bool: which of the free edgels (n,) have MIN_RUN free ones in a row. runs: (n,) int, ascending."""
    breaks = np.concatenate([[False], (free[1:] != free[:-1]) | (runs[1:] != runs[:-1])])[: len(free)]
    parts = np.cumsum(breaks)
    return free & (np.bincount(parts)[parts] >= MIN_RUN) if len(parts) else free
