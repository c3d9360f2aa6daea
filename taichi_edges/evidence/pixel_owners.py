"""What the edge maps show at the projections of points, and which point owns a pixel.

Sums run over the views in order, the owner of a pixel is the highest of distinct ranks, and counts are integers: no
result depends on the number of threads.
"""

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.points import (
    F32_1D,
    F32_2D,
    F32_3D,
    I32_1D,
    I32_2D,
    I32_3D,
    U8_3D,
    U32_2D,
    WORD,
    blocks_of,
    load_camera,
    load_point,
    nearest_pixel,
)
from taichi_edges.views.cameras import NEAR

if TYPE_CHECKING:
    from taichi_edges.views.views import Views

BATCH_BYTES = 16 << 20  # images and pixel lists of the views that are worked on together
LARGEST_I32 = 2**31 - 1


class PixelOwners:
    """What the edge maps show at the projections of some points, and the memory to find out which point owns what.

    The views are worked on in batches, so that the memory stays bounded: n / 8 bytes a view beyond BATCH_BYTES.
    strength: (n,) mean map value 0..1. seen: (n,) number of views that have the point in the image, at least 1.
    """

    def __init__(self, views: "Views", points: np.ndarray, threshold: float) -> None:
        count = len(points)
        per_view = 4 * (views.height * views.width + count)
        size = min(max(BATCH_BYTES // per_view, 1), len(views))
        self.points, words = upload(points), -(-count // WORD)
        self.claims = upload(np.zeros((size, views.height, views.width), np.int32))
        self.pixels = upload(np.zeros((size, count), np.int32))
        self.claimed = 0  # how often the points have claimed their pixels in `claims`
        # (projections, edge bits) of the views of each batch
        self.batches: list[tuple[np.ndarray | ti.Ndarray, np.ndarray | ti.Ndarray]] = []
        projections = (views.intrinsics @ views.world_to_camera).astype(np.float32)
        total, seen = upload(np.zeros(count, np.float32)), upload(np.zeros(count, np.int32))
        level = int(np.ceil(threshold * 255))
        for first in range(0, len(views), size):
            batch = slice(first, first + size)
            cameras, edge_maps = upload(projections[batch]), upload(views.edge_maps[batch])
            on_edge = upload(np.zeros((len(projections[batch]), words), np.uint32))
            look_up(words, self.points, cameras, edge_maps, level, total, seen, on_edge)
            self.batches.append((cameras, on_edge))
        self.seen = np.maximum(download(seen), 1)
        self.strength = download(total).astype(np.float64) / self.seen / 255.0

    def owned_share(self, strength: np.ndarray, claim_px: float, reach: float) -> np.ndarray:
        """(n,) share of the views that see a point in which its pixel is an edge pixel and owned by a point beside it.

        strength: (n,), the stronger one owns a pixel. claim_px: pixels. reach: unit-cube units.
        """
        count = len(strength)
        weakest_first = np.argsort(strength, kind="stable").astype(np.int32)
        ranks = np.empty_like(weakest_first)
        ranks[weakest_first] = np.arange(count, dtype=np.int32)
        weakest_first, ranks, supported = upload(weakest_first), upload(ranks), upload(np.zeros(count, np.int32))
        blocks = blocks_of(self.points)
        for cameras, on_edge in self.batches:
            offset = self._next_offset(count)
            claim_pixels(*blocks, self.points, cameras, on_edge, ranks, offset, self.claims, self.pixels)
            claimed = (weakest_first, offset, self.claims, self.pixels)
            count_support(*blocks, cameras.shape[0], self.points, *claimed, claim_px, reach, supported)
        return download(supported) / self.seen

    def _next_offset(self, count: int) -> int:
        """What to add to ranks below `count` so that claims outbid all those made before."""
        self.claimed += 1
        if (self.claimed + 1) * count > LARGEST_I32:
            self.claims.fill(0)
            self.claimed = 1
        return self.claimed * count


@ti.kernel
def look_up(
    words: ti.i32,
    points: F32_2D,
    projections: F32_3D,
    maps: U8_3D,
    level: ti.i32,
    total: F32_1D,
    seen: I32_1D,
    on_edge: U32_2D,
):
    """What the (b, H, W) maps show where the points project to.

    Adds the bilinear map values (0..255) to `total` (n,), and the views that have a point in the image to `seen` (n,).
    on_edge (b, words): bit k of word w says whether the pixel of point WORD w + k is at least `level`.
    """
    last_row, last_column = maps.shape[1] - 1, maps.shape[2] - 1
    for word in range(words):
        for view in range(projections.shape[0]):
            camera = load_camera(projections, view)
            bits = ti.u32(0)
            for i in range(word * WORD, ti.min((word + 1) * WORD, points.shape[0])):
                h = camera @ load_point(points, i)
                if h[2] > NEAR:
                    row, column = nearest_pixel(h)
                    if row >= 0 and row <= last_row and column >= 0 and column <= last_column:
                        if maps[view, row, column] >= level:
                            bits |= ti.u32(1) << ti.cast(i - word * WORD, ti.u32)
                        u, v = ti.math.clamp(h[0] / h[2], 0, last_column), ti.math.clamp(h[1] / h[2], 0, last_row)
                        left, above = ti.cast(u, ti.i32), ti.cast(v, ti.i32)
                        right, below = ti.min(left + 1, last_column), ti.min(above + 1, last_row)
                        upper = ti.math.mix(maps[view, above, left], maps[view, above, right], u - left)
                        lower = ti.math.mix(maps[view, below, left], maps[view, below, right], u - left)
                        total[i] = total[i] + ti.math.mix(upper, lower, v - above)  # += would be atomic
                        seen[i] = seen[i] + 1
            on_edge[view, word] = bits


@ti.kernel
def claim_pixels(
    size: ti.i32,
    blocks: ti.i32,
    points: F32_2D,
    projections: F32_3D,
    on_edge: U32_2D,
    ranks: I32_1D,
    offset: ti.i32,
    claims: I32_3D,
    pixels: I32_2D,
):
    """In `claims` (at least b, H, W) the highest rank + offset of the points that project to a pixel stays.

    pixels (at least b, n): row * W + column of the points on edge pixels (see `look_up`), -1 of the others.
    """
    height, width = claims.shape[1], claims.shape[2]
    for item in range(projections.shape[0] * blocks):
        view = item // blocks
        block = item - view * blocks
        camera = load_camera(projections, view)
        for i in range(block * size, ti.min((block + 1) * size, points.shape[0])):
            pixel = -1
            h = camera @ load_point(points, i)
            if h[2] > NEAR:
                row, column = nearest_pixel(h)
                if row >= 0 and row < height and column >= 0 and column < width:
                    ti.atomic_max(claims[view, row, column], offset + ranks[i])
                    if on_edge[view, i // WORD] >> ti.cast(i % WORD, ti.u32) & ti.u32(1):
                        pixel = row * width + column
            pixels[view, i] = pixel


@ti.kernel
def count_support(
    size: ti.i32,
    blocks: ti.i32,
    views: ti.i32,
    points: F32_2D,
    weakest_first: I32_1D,
    offset: ti.i32,
    claims: I32_3D,
    pixels: I32_2D,
    radius: ti.f32,
    reach: ti.f32,
    supported: I32_1D,
):
    """Adds to `supported` (n,) in how many of the first `views` images a point's pixel is owned by a point beside it.

    The owner is the highest claim within `radius` pixels; beside is within `reach` in 3D. Only `pixels` >= 0 count.
    """
    height, width = claims.shape[1], claims.shape[2]
    margin = ti.cast(radius, ti.i32)
    for item in range(views * blocks):
        view = item // blocks
        block = item - view * blocks
        for i in range(block * size, ti.min((block + 1) * size, points.shape[0])):
            pixel = pixels[view, i]
            if pixel >= 0:
                row = pixel // width
                column = pixel - row * width
                owner = offset
                for near_row in range(ti.max(row - margin, 0), ti.min(row + margin + 1, height)):
                    down = near_row - row
                    half = ti.cast(ti.sqrt(radius * radius - down * down), ti.i32)
                    for near_column in range(ti.max(column - half, 0), ti.min(column + half + 1, width)):
                        owner = ti.max(owner, claims[view, near_row, near_column])
                apart = load_point(points, weakest_first[owner - offset]) - load_point(points, i)
                if apart.dot(apart) <= reach * reach:
                    supported[i] += 1
