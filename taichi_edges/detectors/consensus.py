"""What edgels of many views say together: 3D points on edges, each displaced a little so that all views agree."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from taichi_edges.cameras import NEAR, inside_image
from taichi_edges.detectors.offsets import Observations
from taichi_edges.support import pixel_size

MOST_POINTS = 3000  # more would only cost time: each is seen by most of the views
REACH = 8.0  # px to each side of a point's projection that are searched
STEP = 1.0  # px between the pixels looked at; a line in the table is two wide or more
SAME_LINE = 2.5  # px; edgels farther apart across the edge are of two lines
ALIGNED = np.cos(np.radians(20.0))  # an edgel runs along the projection of its point's line, to that angle
BESIDE = (-2, -1, 0, 1, 2)  # px along an edge, to which an edgel's point explains others too
LEAST_LENGTH = 0.2  # of a line's true length: seen more end-on, its direction says nothing


def chosen_points(points):
    """Indices of at most MOST_POINTS of n points, evenly spread over their order."""
    count = len(points)
    return np.arange(count) if count <= MOST_POINTS else np.linspace(0, count - 1, MOST_POINTS).astype(np.int64)


def across(directions):
    """(n, 2, 3): two unit vectors at right angles to each of the (n, 3) unit vectors."""
    least = np.eye(3)[np.abs(directions).argmin(axis=1)]
    first = np.cross(directions, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


def observe(views, edgels, corrected, outward, silhouette, points, directions, reach, threads=None):
    """Observations of 3D points by the edgels nearest to them across the edge, those that stand alone.

    corrected: Edgels, where they are looked for; the offsets are those of `edgels`. outward: (n, 2) their normals,
    of silhouettes outward. silhouette: (n,) 1 or 0; NaN where neither, and then nothing is observed.
    points, directions: (p, 3) unit cube. reach: px from a projection within which an edgel may be its.
    """
    pixel, basis = pixel_size(views), across(directions)

    def look(view):
        owners, found = _edgels_beside(views, view, corrected, points, directions, reach)
        found += edgels.starts[view]
        kept = np.isfinite(silhouette[found])
        owners, found = owners[kept], found[kept]
        pixels, _ = views.project(points[owners], view)
        normals = outward[found]
        offsets = ((edgels.points[found] - pixels) * normals).sum(axis=1)
        moves = np.einsum("nij,nkj->nki", pixel * _derivatives(views, view, points[owners]), basis[owners])
        slopes = np.einsum("nki,ni->nk", moves, normals)
        return offsets, normals, silhouette[found], found, np.full(len(found), view), owners, slopes

    with ThreadPoolExecutor(threads) as pool:  # NumPy releases the lock in the long loops
        columns = zip(*pool.map(look, range(len(views))), strict=True)
        return Observations(*(np.concatenate(column) for column in columns))


def residuals_beside(views, edgels, outward, points, directions, reach, threads=None):
    """(n,) px from the nearest 3D point's line to each edgel along `outward`; NaN for edgels that no point explains.

    A point explains the edgel that is its own and those next to it along the line.
    """

    def look(view):
        places, normals, _ = edgels.of_view(view)
        residuals = np.full(len(places), np.nan)
        owners, found = _edgels_beside(views, view, edgels, points, directions, reach)
        if len(found) == 0:
            return residuals
        pixels, _ = views.project(points[owners], view)
        table = edgel_table(places, (views.height, views.width))
        tangents = np.stack([-normals[found, 1], normals[found, 0]], axis=1)
        pairs = []
        for along in BESIDE:
            columns, rows = np.rint(places[found] + along * tangents).astype(np.int64).T + 1
            columns, rows = np.clip(columns, 0, views.width + 1), np.clip(rows, 0, views.height + 1)
            others = table[rows, columns]
            same = np.abs((normals[others] * normals[found]).sum(axis=1)) >= ALIGNED
            offsets = ((places[others] - pixels) * normals[found]).sum(axis=1)
            good = (others >= 0) & same & (np.abs(offsets) <= reach)
            pairs.append((others[good], offsets[good], normals[found][good]))
        others, offsets, across_ = (np.concatenate(column) for column in zip(*pairs))
        order = np.argsort(-np.abs(offsets), kind="stable")  # the smallest comes last, and stays
        others, offsets, across_ = others[order], offsets[order], across_[order]
        own = outward[edgels.starts[view] : edgels.starts[view + 1]][others]
        residuals[others] = offsets * np.sign((across_ * own).sum(axis=1))
        return residuals

    with ThreadPoolExecutor(threads) as pool:
        return np.concatenate(list(pool.map(look, range(len(views)))))


def displaced(views, points, directions, displacements):
    """The (n, 3) points, moved across their directions by (n, 2) px at the middle of the scene box."""
    return points + pixel_size(views) * np.einsum("nk,nkj->nj", displacements, across(directions))


def _derivatives(views, view, points):
    """(n, 2, 3): px that the projection of each point moves for a unit step along each axis of the world."""
    lens, pose = views.intrinsics[view], views.world_to_camera[view]
    camera = points @ pose[:, :3].T + pose[:, 3]
    homogeneous = camera @ lens.T
    rows = lens @ pose[:, :3]
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    return (rows[None, :2] - pixels[:, :, None] * rows[2]) / homogeneous[:, 2, None, None]


def _edgels_beside(views, view, edgels, points, directions, reach):
    """Points (m,) and, for each, the edgel (m,) of the view nearest to its projection across the edge, at most `reach`
    px away; only where no other edge is near.
    """
    places, normals, _ = edgels.of_view(view)
    pixels, across_ = _projected_normals(views, view, points, directions)
    seen = np.flatnonzero(inside_image(pixels, views.width, views.height) & np.isfinite(across_[:, 0]))
    pixels, across_ = pixels[seen], across_[seen]
    rows, found = _walk(edgel_table(places, (views.height, views.width)), pixels, across_)
    offsets = ((places[found] - pixels[rows]) * across_[rows]).sum(axis=1)
    aligned = np.abs((normals[found] * across_[rows]).sum(axis=1)) >= ALIGNED
    order = np.lexsort((np.where(aligned, np.abs(offsets), np.inf), rows))
    nearest = order[np.unique(rows[order], return_index=True)[1]]  # of each row that has any
    best = np.zeros(len(seen))
    best[rows[nearest]] = offsets[nearest]
    others = np.bincount(rows, np.abs(offsets - best[rows]) > SAME_LINE, len(seen))
    nearest = nearest[aligned[nearest] & (np.abs(offsets[nearest]) <= reach) & (others[rows[nearest]] == 0)]
    return seen[rows[nearest]], found[nearest].astype(np.int64)


def _walk(table, pixels, directions):
    """The edgels met on walks through pixels (n, 2) along directions (n, 2): which walk (k,), and which edgel (k,)."""
    along = np.arange(-REACH, REACH + STEP / 2, STEP, dtype=np.float32)
    columns, rows = (
        np.rint(pixels[:, axis, None] + 1 + directions[:, axis, None].astype(np.float32) * along).astype(np.int32)
        for axis in (0, 1)
    )
    np.clip(columns, 0, table.shape[1] - 1, out=columns)
    np.clip(rows, 0, table.shape[0] - 1, out=rows)
    found = table.reshape(-1)[rows * table.shape[1] + columns]
    walks, steps = np.nonzero(found >= 0)
    return walks, found[walks, steps]


def _projected_normals(views, view, points, directions):
    """Projections (n, 2) and unit normals (n, 2) of the lines there, px; NaN where a line is seen end-on."""
    pixels, depths = views.project(points, view)
    safe = np.where((depths > NEAR)[:, None], points, np.nan)
    along = np.einsum("nij,nj->ni", _derivatives(views, view, safe), directions)
    lengths = np.linalg.norm(along, axis=1)
    full = views.intrinsics[view, 0, 0] / depths
    with np.errstate(invalid="ignore", divide="ignore"):
        along = np.where((lengths > LEAST_LENGTH * full)[:, None], along / lengths[:, None], np.nan)
    return pixels, np.stack([-along[:, 1], along[:, 0]], axis=1)


def edgel_table(places, shape):
    """(H + 2, W + 2) int32: the edgel at each pixel, or beside it where it has none of its own; -1 where there is none.

    The table has a border of one pixel. A walk across a line cannot slip between its diagonal neighbours.
    """
    table = np.full((shape[0] + 2, shape[1] + 2), -1, np.int32)
    columns, rows = np.clip(np.rint(places).astype(np.int64), 0, [shape[1] - 1, shape[0] - 1]).T + 1
    indices = np.arange(len(places), dtype=np.int32)
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)):
        table[rows + down, columns + right] = indices
    return table
