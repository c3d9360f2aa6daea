"""The pixels of a view at which the splat is evaluated: those of the loss (paper eq. 3), and how a splat finds them.

The selected pixels of a view stand in a list of slots, row by row. For every word of 32 pixels of a row there is a bit
mask of the selected ones and the number of those before it, so that the slots of any stretch of a row are a range that
two look-ups give. Whatever the splat reads and writes at a pixel is kept by slot: a few thousand numbers, not an image.
"""

import numpy as np
import taichi as ti

WORD = 32  # pixels in a word of the mask
BLOCK = 512  # Taichi's CPU backend gives a thread no fewer items of a range-for than this


def pack_mask(edges):
    """(H, W) bool -> (H, ceil(W / 32)) uint32, bit b of word w is column 32 w + b."""
    height, width = edges.shape
    packed = np.packbits(edges, axis=1, bitorder="little")
    padded = np.zeros((height, -(-width // WORD) * 4), np.uint8)
    padded[:, : packed.shape[1]] = packed
    return padded.view("<u4")


class PixelSelection:
    """The selected pixels of up to `pages` views, and what the splat computes at those of the current one.

    Per page: words (pages, H, W / 32, 2) mask and number of selected pixels before; columns and targets (0..1) of the
    slots, (pages, capacity); on the host views and counts of selected pixels, (pages,). Of the current page: planes
    (threads or 1, capacity), from which the transmittance (capacity,) is combined, and adjoint (capacity,) = -T dL/dT.
    """

    def __init__(self, height, width, capacity, pages, planes, real=ti.f32):
        self.height, self.width, self.capacity, self.real = height, width, capacity, real
        self.words = ti.ndarray(ti.u32, shape=(pages, height, -(-width // WORD), 2))
        self.columns = ti.field(real, shape=(pages, capacity))
        self.targets = ti.field(real, shape=(pages, capacity))
        self.planes = ti.field(real, shape=(planes, capacity))
        self.transmittance = ti.field(real, shape=capacity)
        self.adjoint = ti.field(real, shape=capacity)
        self.views, self.counts = np.zeros(pages, np.int64), np.zeros(pages, np.int64)

    @property
    def pages(self):
        """Views that can be selected at once."""
        return len(self.counts)


@ti.func
def lowest_bit(bits):
    """Index of the lowest set bit of a non-zero u32."""
    return ti.cast(ti.math.popcnt((bits & (~bits + ti.u32(1))) - ti.u32(1)), ti.i32)


@ti.func
def slots_of(words: ti.template(), page, row, u0, u1):
    """First and last (exclusive) slot of the selected pixels in columns u0..u1-1 of a row; u0 < u1."""
    word, last = u0 >> 5, (u1 - 1) >> 5
    from_u0 = ti.u32(0xFFFFFFFF) << ti.cast(u0 & 31, ti.u32)
    up_to_u1 = ti.u32(0xFFFFFFFF) >> ti.cast(31 - ((u1 - 1) & 31), ti.u32)
    mask, before = words[page, row, word, 0], ti.cast(words[page, row, word, 1], ti.i32)
    start = before + ti.cast(ti.math.popcnt(mask & ~from_u0), ti.i32)
    if last > word:
        mask, before = words[page, row, last, 0], ti.cast(words[page, row, last, 1], ti.i32)
    return start, before + ti.cast(ti.math.popcnt(mask & up_to_u1), ti.i32)


def make_select(selection, threads, schedule):
    """Kernel select(count, views, seeds, backgrounds, edge_maps, edge_words, words): one view per page, in parallel.

    views, seeds, backgrounds: (count,). All edge pixels of a view and `background` others, drawn without repetition
    (paper eq. 3); every pixel where `background` is negative. One page is one thread's, so that one seed gives one
    selection.
    """
    columns, targets, real = selection.columns, selection.targets, selection.real
    # Items of the loop that share a thread, and the pages worked on at once.
    block, lanes = (1, selection.pages) if schedule == "log" else (BLOCK, min(threads, selection.pages))

    @ti.func
    def draw_background(page, seed, background, width, height, words: ti.template()):
        """Set the bits of `background` pixels that are not set yet."""
        state = seed
        pixels = ti.cast(width * height, ti.u64)
        found = 0
        while found < background:
            state = state * ti.u32(747796405) + ti.u32(2891336453)  # PCG-RXS-M-XS, O'Neill 2014
            hashed = ((state >> ((state >> 28) + ti.u32(4))) ^ state) * ti.u32(277803737)
            hashed = (hashed >> 22) ^ hashed
            pixel = ti.cast((ti.cast(hashed, ti.u64) * pixels) >> 32, ti.i32)
            row = pixel // width
            column = pixel - row * width
            bit = ti.u32(1) << ti.cast(column & 31, ti.u32)
            if (words[page, row, column >> 5, 0] & bit) == 0:
                words[page, row, column >> 5, 0] = words[page, row, column >> 5, 0] | bit  # `|=` would be atomic
                found += 1

    @ti.func
    def list_pixels(page, view, height, row_words, edge_maps: ti.template(), words: ti.template()):
        """Fill the slots and the counts from the mask."""
        slot = 0
        for row in range(height):
            for word in range(row_words):
                words[page, row, word, 1] = ti.cast(slot, ti.u32)
                bits = words[page, row, word, 0]
                while bits != 0:
                    column = word * WORD + lowest_bit(bits)
                    bits &= bits - ti.u32(1)
                    columns[page, slot] = ti.cast(column, real)
                    targets[page, slot] = ti.cast(edge_maps[view, row, column], real) * (1.0 / 255.0)
                    slot += 1

    @ti.func
    def fill_page(
        page, view, seed, background, edge_maps: ti.template(), edge_words: ti.template(), words: ti.template()
    ):
        height, width, row_words = edge_maps.shape[1], edge_maps.shape[2], edge_words.shape[2]
        for row in range(height):
            for word in range(row_words):
                bits = edge_words[view, row, word]
                if background < 0:
                    spare = ti.max((word + 1) * WORD - width, 0)  # bits beyond the end of the row
                    bits = ti.u32(0xFFFFFFFF) >> ti.cast(spare, ti.u32)
                words[page, row, word, 0] = bits
        draw_background(page, seed, background, width, height, words)
        list_pixels(page, view, height, row_words, edge_maps, words)

    @ti.kernel
    def select(
        count: ti.i32,
        views: ti.types.ndarray(dtype=ti.i32, ndim=1),
        seeds: ti.types.ndarray(dtype=ti.u32, ndim=1),
        backgrounds: ti.types.ndarray(dtype=ti.i32, ndim=1),
        edge_maps: ti.types.ndarray(dtype=ti.u8, ndim=3),
        edge_words: ti.types.ndarray(dtype=ti.u32, ndim=3),
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
    ):
        for item in range(lanes * block):
            turns = (count + lanes - 1) // lanes if item % block == 0 else 0
            for turn in range(turns):
                page = item // block + turn * lanes
                if page < count:
                    fill_page(page, views[page], seeds[page], backgrounds[page], edge_maps, edge_words, words)

    return select
