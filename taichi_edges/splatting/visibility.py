"""The mask of the loss with the flanks of the lines in it, but not where a hidden edge passes through them.

Between the edge pixels and the background lie the flanks, from half of a line's height down to its foot. The paper's
mask meets them as seldom as any background, so a Gaussian may stand there, beside its line, and pay nothing. With all
of them in the mask it must share the line's profile; but an edge that is hidden in a view and passes through the
lines of others there is pushed away by their flanks. So flanks are left out where an edge that other views have
established projects to a place without an edge pixel (paper Fig. 2).
"""

from typing import Any

import numpy as np
import taichi as ti

from taichi_edges.kernels.device import download, upload
from taichi_edges.kernels.points import F32_2D, F32_3D, I32_1D, load_camera, load_point, nearest_pixel
from taichi_edges.splatting.selection import WORD

CLEAR_PX = 2  # an edge pixel so near, in columns and in rows, and the view shows the edge
REACH_PX = 5  # around the centre of a Gaussian that is hidden: 3 standard deviations of a px, and the way to the next
U32_3D: Any = ti.types.ndarray(dtype=ti.u32, ndim=3)


def mask_with_flanks(
    edge_words: np.ndarray | ti.Ndarray,
    line_words: np.ndarray | ti.Ndarray,
    width: int,
    projections: np.ndarray,
    points: np.ndarray,
) -> tuple[np.ndarray | ti.Ndarray, np.ndarray]:
    """The pixels that are in the loss of each view for sure: those of lines, but no flanks where `points` are hidden.

    edge_words, line_words: (V, H, W / 32) bit masks of the edge pixels and of all pixels of the lines, where the
    kernels have them. width: of the images, pixels. projections: (V, 3, 4) world to pixels. points: (n, 3) on edges
    that are known to be there. Returns the masks, where the others are, and how many pixels each has, (V,) int64.
    """
    mask = upload(np.zeros(edge_words.shape, np.uint32))
    counts = upload(np.zeros(len(projections), np.int32))
    if len(points):
        points, projections = upload(points.astype(np.float32)), upload(projections.astype(np.float32))
        mark_hidden(width, points, projections, edge_words, mask)
    take_in_flanks(edge_words, line_words, mask, counts)
    return mask, download(counts).astype(np.int64)


@ti.func
def bits_between(word, first, last):
    """Mask of the columns first..last that lie in a word of a row, which has at least one of them."""
    low, high = ti.max(first - word * WORD, 0), ti.min(last - word * WORD, WORD - 1)
    return (ti.u32(0xFFFFFFFF) << ti.cast(low, ti.u32)) & (ti.u32(0xFFFFFFFF) >> ti.cast(WORD - 1 - high, ti.u32))


@ti.func
def is_clear(view, row, column, edge_words: ti.template()):
    """Whether there is no edge pixel within CLEAR_PX of a pixel."""
    found = ti.u32(0)
    first, last = ti.max(column - CLEAR_PX, 0), ti.min(column + CLEAR_PX, WORD * edge_words.shape[2] - 1)
    for near in range(ti.max(row - CLEAR_PX, 0), ti.min(row + CLEAR_PX + 1, edge_words.shape[1])):
        for word in range(first >> 5, (last >> 5) + 1):
            found |= edge_words[view, near, word] & bits_between(word, first, last)
    return found == 0


@ti.func
def mark_disc(view, row, column, hidden: ti.template()):
    """Set the bits of the pixels within REACH_PX of a pixel."""
    for near in range(ti.max(row - REACH_PX, 0), ti.min(row + REACH_PX + 1, hidden.shape[1])):
        rest = REACH_PX * REACH_PX - (near - row) * (near - row)
        half = ti.cast(ti.sqrt(rest + 0.5), ti.i32)  # 0.5: a GPU may take the root of 16 to be less than 4
        first, last = ti.max(column - half, 0), ti.min(column + half, WORD * hidden.shape[2] - 1)
        for word in range(first >> 5, (last >> 5) + 1):
            ti.atomic_or(hidden[view, near, word], bits_between(word, first, last))


@ti.kernel
def mark_hidden(width: ti.i32, points: F32_2D, projections: F32_3D, edge_words: U32_3D, hidden: U32_3D):
    """Set the bits around the projections of points with no edge pixel near, in all views."""
    for view, i in ti.ndrange(projections.shape[0], points.shape[0]):
        h = load_camera(projections, view) @ load_point(points, i)
        if h[2] > 0:
            row, column = nearest_pixel(h)
            if 0 <= row and row < hidden.shape[1] and 0 <= column and column < width:  # noqa: SIM102, SIM300
                if is_clear(view, row, column, edge_words):  # apart: Taichi's `and` evaluates both sides
                    mark_disc(view, row, column, hidden)


@ti.kernel
def take_in_flanks(edge_words: U32_3D, line_words: U32_3D, mask: U32_3D, counts: I32_1D):
    """`mask`, in which the hidden pixels are set, becomes the mask; its pixels are added to `counts` (V,)."""
    for view, row in ti.ndrange(mask.shape[0], mask.shape[1]):
        count = 0
        for word in range(mask.shape[2]):
            bits = edge_words[view, row, word] | (line_words[view, row, word] & ~mask[view, row, word])
            mask[view, row, word] = bits
            count += ti.cast(ti.math.popcnt(bits), ti.i32)
        ti.atomic_add(counts[view], count)
