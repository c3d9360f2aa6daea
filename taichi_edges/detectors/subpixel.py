"""Edgels straight from pictures, at sub-pixel accuracy."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from taichi_edges.detectors.pictures import Picture, as_picture, read_picture, srgb_slope
from taichi_edges.detectors.ridges import gaussian_derivatives
from taichi_edges.edgels import Edgels

SCALES = (0.7, 1.5)
REACH_SIGMAS = 3.5
MIN_COVERAGE = 0.5
BAND = 1.4
CLUTTER_SIGMA = 2.0
CLUTTER_WINDOW = 12.0
LOW = 1.0
NEEDED = 2.5
CAP = 2.0
TOTAL = 14.0
HALF_WINDOW = 5
WAVY = 5.0
SMOOTH = 0.9
MAX_TURN = np.cos(np.radians(50.0))
HALF_SURE = 12.0
NEIGHBOURS = [(r, c) for r in range(-2, 3) for c in range(-2, 3) if r or c]


@dataclass(frozen=True)
class Field:
    """gx, gy: (H, W) linear light per pixel; levels: (H, W) grey levels per linear unit."""

    gx: np.ndarray
    gy: np.ndarray
    levels: np.ndarray
    sigma: float


def _opponent(light):
    if light.shape[2] == 1:
        return light
    turn = np.array([[1 / 3, 1 / 3, 1 / 3], [-(6**-0.5), 0, 6**-0.5], [-(18**-0.5), 2 * 18**-0.5, -(18**-0.5)]])
    return cv2.transform(light, turn.astype(np.float32))


def _smooth(image, sigma):
    size = 2 * int(np.ceil(3 * sigma)) + 1
    return cv2.GaussianBlur(image, (size, size), sigma, borderType=cv2.BORDER_REPLICATE)


def _colour_field(planes, coverage, sigma):
    planes = planes if planes.shape[2] > 1 else planes[:, :, 0]
    if coverage is None:
        gx, gy = islice(gaussian_derivatives(planes, sigma), 2)
        mean = _smooth(planes, sigma)
    else:
        share = _smooth(coverage, sigma)
        inside = share > MIN_COVERAGE
        inverse = np.where(inside, 1 / np.maximum(share, MIN_COVERAGE), 0).astype(np.float32)
        inverse = inverse if planes.ndim == 2 else inverse[:, :, None]
        weighted = planes * (coverage if planes.ndim == 2 else coverage[:, :, None])
        mean = _smooth(weighted, sigma) * inverse
        gx, gy = (
            (whole - mean * (own if planes.ndim == 2 else own[:, :, None])) * inverse
            for whole, own in zip(islice(gaussian_derivatives(weighted, sigma), 2), islice(gaussian_derivatives(coverage, sigma), 2))
        )
    if planes.ndim == 2:
        return Field(gx, gy, 255 * srgb_slope(mean), sigma)
    x, y = gx[:, :, 0].copy(), gy[:, :, 0].copy()
    best = x * x + y * y
    for c in (1, 2):
        own = gx[:, :, c] ** 2 + gy[:, :, c] ** 2
        more = own > best
        np.copyto(x, gx[:, :, c], where=more)
        np.copyto(y, gy[:, :, c], where=more)
        np.copyto(best, own, where=more)
    return Field(x, y, 255 * srgb_slope(mean[:, :, 0]), sigma)


def _clutter(field):
    hx, hy = field.gx * field.levels, field.gy * field.levels
    small = ((field.gx.shape[1] + 1) // 2, (field.gx.shape[0] + 1) // 2)
    xx, yy, xy = (_smooth(cv2.resize(p, small, interpolation=cv2.INTER_AREA), max(CLUTTER_SIGMA, 1.5*field.sigma) / 2) for p in (hx * hx, hy * hy, hx * hy))
    across = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    floor = BAND / (np.sqrt(2 * np.pi) * np.hypot(field.sigma, 0.3) * NEEDED)
    logs = 0.5 * np.log(np.maximum(across, 0) + floor**2)
    smooth = _smooth(logs, CLUTTER_WINDOW / 2)
    return cv2.resize(np.exp(smooth), field.gx.shape[::-1], interpolation=cv2.INTER_LINEAR)


def _maxima(field, clutter):
    squares = field.gx**2 + field.gy**2
    strong = np.sqrt(squares) * field.levels > LOW * clutter
    strong[[0, 1, -2, -1]] = False
    strong[:, [0, 1, -2, -1]] = False
    rows, columns = np.nonzero(strong)
    gx, gy = field.gx[rows, columns], field.gy[rows, columns]
    here = squares[rows, columns]
    flat = squares.reshape(-1)
    width = squares.shape[1]
    centre = rows * width + columns
    steep = np.abs(gy) > np.abs(gx)
    dx, dy = np.where(gx < 0, -1, 1), np.where(gy < 0, -width, width)
    major = np.where(steep, dy, dx)
    slant = np.where(steep, np.abs(gx), np.abs(gy)) / np.maximum(np.maximum(np.abs(gx), np.abs(gy)), 1e-12)
    ahead = (1 - slant) * flat[centre + major] + slant * flat[centre + dx + dy]
    behind = (1 - slant) * flat[centre - major] + slant * flat[centre - dx - dy]
    top = (here > behind) & (here >= ahead)
    rows, columns, centre = rows[top], columns[top], centre[top]
    size = np.sqrt(here[top])
    nx, ny = gx[top] / size, gy[top] / size
    logs = {(r, c): np.log(flat[centre + r * width + c] + 1e-20) for r in (-1, 0, 1) for c in (-1, 0, 1)}
    lx, ly = (logs[0, 1] - logs[0, -1]) / 2, (logs[1, 0] - logs[-1, 0]) / 2
    lxx, lyy = logs[0, 1] - 2 * logs[0, 0] + logs[0, -1], logs[1, 0] - 2 * logs[0, 0] + logs[-1, 0]
    lxy = (logs[1, 1] - logs[1, -1] - logs[-1, 1] + logs[-1, -1]) / 4
    bend = lxx * nx * nx + 2 * lxy * nx * ny + lyy * ny * ny
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = -(lx * nx + ly * ny) / bend
    ok = (bend < 0) & (np.abs(offset) < 1)
    rows, columns, nx, ny, size, offset = (a[ok] for a in (rows, columns, nx, ny, size, offset))
    points = np.stack([columns + offset * nx, rows + offset * ny], axis=1)
    reach = REACH_SIGMAS * np.hypot(field.sigma, 0.3)
    aside = 0
    for side in (-reach, reach):
        r = np.rint(rows + side * ny).astype(int).clip(0, squares.shape[0] - 1)
        c = np.rint(columns + side * nx).astype(int).clip(0, width - 1)
        aside = aside + 0.5 * (field.gx[r, c] * nx + field.gy[r, c] * ny)
    ratio = (size - aside) * (field.levels / clutter)[rows, columns]
    return rows, columns, points, np.stack([nx, ny], axis=1), ratio


def _link(rows, columns, points, normals, shape):
    """succ (n,) int, -1 none; mutual"""
    count = len(rows)
    place = np.full(shape, -1, np.int32)
    place[rows, columns] = np.arange(count)
    flat = place.reshape(-1)
    centre = rows * shape[1] + columns
    best = np.full((2, count), np.inf)
    who = np.full((2, count), -1)
    for r, c in NEIGHBOURS:
        other = flat[centre + r * shape[1] + c]
        own = np.flatnonzero(other >= 0)
        other = other[own]
        n, m = normals[own], normals[other]
        d = points[other] - points[own]
        along = d[:, 1] * n[:, 0] - d[:, 0] * n[:, 1]
        aside = np.abs((d * n).sum(1)) + np.abs((d * m).sum(1))
        turn = (n * m).sum(1)
        cost = aside + np.abs(along) + (1 - turn)
        ok = (turn > MAX_TURN) & (aside < 2 * np.abs(along))
        for side in (0, 1):
            use = ok & ((along > 0) if side == 0 else (along < 0))
            i = own[use]
            better = cost[use] < best[side, i]
            best[side, i[better]] = cost[use][better]
            who[side, i[better]] = other[use][better]
    succ, pred = who
    mutual = (succ >= 0) & (pred[succ] == np.arange(count))
    succ = np.where(mutual, succ, -1)
    pred = np.full(count, -1)
    pred[succ[mutual]] = np.flatnonzero(mutual)
    return succ, pred


def _ordered(succ, pred):
    """order, chain starts along order"""
    count = len(succ)
    i = np.flatnonzero(succ >= 0)
    graph = coo_array((np.ones(len(i), bool), (i, succ[i])), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    has_head = np.zeros(labels.max(initial=-1) + 1, bool)
    has_head[labels[pred < 0]] = True
    first = np.full(len(has_head), count)
    np.minimum.at(first, labels, np.arange(count))
    pred = pred.copy()
    pred[first[~has_head]] = -1
    rank, jump = (pred >= 0).astype(np.int64), pred.copy()
    while (jump >= 0).any():
        rank = rank + np.where(jump >= 0, rank[jump], 0)
        jump = np.where(jump >= 0, jump[jump], -1)
    order = np.lexsort((rank, labels))
    return order, labels[order]


def _chain_means(values, labels):
    count = len(values)
    starts = np.searchsorted(labels, labels, "left")
    ends = np.searchsorted(labels, labels, "right")
    sums = np.concatenate([[0], np.cumsum(values)])
    i = np.arange(count)
    low, high = np.maximum(i - HALF_WINDOW, starts), np.minimum(i + HALF_WINDOW + 1, ends)
    return (sums[high] - sums[low]) / (high - low)


def _layer(field):
    clutter = _clutter(field)
    rows, columns, points, normals, ratio = _maxima(field, clutter)
    if len(rows) == 0:
        return points, normals, ratio, rows, columns
    succ, pred = _link(rows, columns, points, normals, field.gx.shape)
    order, labels = _ordered(succ, pred)
    score = np.clip(np.log(np.maximum(ratio[order], 0.1) / NEEDED), -CAP, CAP)
    straight = np.hypot(*(_chain_means(normals[order, k], labels) for k in (0, 1)))
    score = score - WAVY * np.maximum(SMOOTH - straight, 0)
    mean = _chain_means(score, labels)
    good = mean > 0
    breaks = np.concatenate([[True], (labels[1:] != labels[:-1]) | (good[1:] != good[:-1])])
    piece = np.cumsum(breaks) - 1
    total = np.bincount(piece, np.where(good, score, 0))
    keep = good & (total >= TOTAL)[piece]
    chosen = order[keep]
    ratios = _chain_means(ratio[order], labels)[keep]
    return points[chosen], normals[chosen], ratios, rows[chosen], columns[chosen]


def _covered(taken, points, normals, reach):
    covered = np.zeros(len(points), bool)
    for step in np.arange(-np.ceil(reach), np.ceil(reach) + 1):
        place = np.rint(points + step * normals).astype(np.int64)
        rows = place[:, 1].clip(0, taken.shape[0] - 1)
        covered |= taken[rows, place[:, 0].clip(0, taken.shape[1] - 1)] > 0
    return covered


def detect_edgels(image):
    picture = image if isinstance(image, Picture) else as_picture(image)
    planes = _opponent(picture.light)
    shape = planes.shape[:2]
    found = []
    taken = np.zeros(shape, np.uint8)
    if picture.coverage is not None:
        gx, gy = islice(gaussian_derivatives(picture.coverage, SCALES[0]), 2)
        found.append(_layer(Field(gx, gy, np.full(shape, 255, np.float32), SCALES[0])))
        taken[found[-1][3], found[-1][4]] = 1
    for sigma in SCALES:
        layer = _layer(_colour_field(planes, picture.coverage, sigma))
        free = ~_covered(taken, layer[0], layer[1], 2 * sigma)
        found.append([a[free] for a in layer])
        taken[found[-1][3], found[-1][4]] = 1
    points, normals, ratios = (np.concatenate([layer[k] for layer in found]) for k in range(3))
    return points, normals, (ratios / (ratios + HALF_SURE)).clip(0, 1)


def trace_pictures(paths, threads=None, report=None):
    def trace(path):
        if not path:
            return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
        return detect_edgels(read_picture(path))

    with ThreadPoolExecutor(threads) as pool:
        return Edgels.of_views(pool.map(trace, paths))
