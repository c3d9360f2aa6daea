"""The pixels of a view at which the splat is evaluated: those of the loss (paper eq. 3), and how a splat finds them.

The selected pixels of a view stand in a list of slots, row by row. For every word of 32 pixels of a row there is a bit
mask of the selected ones and the number of those before it, so that the slots of any stretch of a row are a range that
two look-ups give. Whatever the splat reads and writes at a pixel is kept by slot: a few thousand numbers, not an image.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import taichi as ti

WORD = 32  # pixels in a word of the mask
MULTIPLIER, INCREMENT = 747796405, 2891336453  # of the generator's linear congruence
BLOCK = 512  # Taichi's CPU backend gives a thread no fewer items of a range-for than this


def pack_mask(edges: np.ndarray) -> np.ndarray:
    """(H, W) bool -> (H, ceil(W / 32)) uint32, bit b of word w is column 32 w + b."""
    height, width = edges.shape
    packed = np.packbits(edges, axis=1, bitorder="little")
    padded = np.zeros((height, -(-width // WORD) * 4), np.uint8)
    padded[:, : packed.shape[1]] = packed
    return padded.view("<u4")


class PixelSelection:
    """The selected pixels of up to `pages` views, and what the splat computes at those of the current one.

    Per page: words (pages, H, W / 32, 2) mask and number of selected pixels before; columns, targets (0..1) and weights
    (0..1, among the pixels of their class) of the slots, (pages, capacity); on the host views and counts of selected
    pixels, (pages,). Of the current page: planes (threads or 1, capacity), from which the transmittance (capacity,) is
    combined, and adjoint (capacity,) = -T dL/dT.
    """

    def __init__(self, height: int, width: int, capacity: int, pages: int, planes: int, real: Any = ti.f32) -> None:
        self.height, self.width, self.capacity, self.real = height, width, capacity, real
        self.words = ti.ndarray(ti.u32, shape=(pages, height, -(-width // WORD), 2))
        self.columns = ti.field(real, shape=(pages, capacity))
        self.targets = ti.field(real, shape=(pages, capacity))
        self.weights = ti.field(real, shape=(pages, capacity))
        self.weights.fill(1.0)  # and that they stay, unless edge pixels have weights of their own
        self.planes = ti.field(real, shape=(planes, capacity))
        self.transmittance = ti.field(real, shape=capacity)
        self.adjoint = ti.field(real, shape=capacity)
        self.views, self.counts = np.zeros(pages, np.int64), np.zeros(pages, np.int64)

    @property
    def pages(self) -> int:
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


@ti.func
def next_state(state):
    """One step of the random generator, PCG-RXS-M-XS (O'Neill 2014)."""
    return state * ti.u32(MULTIPLIER) + ti.u32(INCREMENT)


@ti.func
def state_after(seed, steps):
    """The generator's state after `steps` steps, found by squaring: 17 rounds for 100 000 (Brown 1994)."""
    state, multiplier, increment = seed, ti.u32(MULTIPLIER), ti.u32(INCREMENT)
    rest = steps
    while rest > 0:
        if rest & 1:
            state = state * multiplier + increment
        increment *= multiplier + ti.u32(1)
        multiplier *= multiplier
        rest >>= 1
    return state


@ti.func
def pixel_of(state, pixels):
    """The pixel, one of `pixels`, that a state of the generator draws."""
    hashed = ((state >> ((state >> 28) + ti.u32(4))) ^ state) * ti.u32(277803737)
    hashed = (hashed >> 22) ^ hashed
    return ti.cast((ti.cast(hashed, ti.u64) * ti.cast(pixels, ti.u64)) >> 32, ti.i32)


@ti.func
def whole_word(word, width):
    """Mask of the columns that a word of a row has; fewer than 32 at the end of the row."""
    return ti.u32(0xFFFFFFFF) >> ti.cast(ti.max((word + 1) * WORD - width, 0), ti.u32)


def make_list_row(selection: PixelSelection, packed: bool, level: int | None) -> Callable:
    """ti.func list_row(page, view, row, width, first, edge_maps, starts, weights, words): fill the slots of a row.

    They are filled from `first` on. Returns the first slot of the next row. packed: whether edge maps and weights are
    four in a u32, (V, H W / 4) and (n / 4,), or u8, (V, H, W) and (n,). level: 0..255, from which on a pixel takes the
    next of the weights, from that at starts (V, H) on; None: all weigh alike.
    """
    columns, targets, slot_weights, real = selection.columns, selection.targets, selection.weights, selection.real
    weighted, level = level is not None, level or 0

    @ti.func
    def grey_level(view, row, column, width, edge_maps: ti.template()):
        level = ti.u32(0)
        if ti.static(packed):
            pixel = row * width + column
            level = (edge_maps[view, pixel >> 2] >> ti.cast((pixel & 3) << 3, ti.u32)) & ti.u32(255)
        else:
            level = ti.cast(edge_maps[view, row, column], ti.u32)
        return level

    @ti.func
    def weight_of(edge, weights: ti.template()):
        weight = ti.u32(0)
        if ti.static(packed):
            weight = (weights[edge >> 2] >> ti.cast((edge & 3) << 3, ti.u32)) & ti.u32(255)
        else:
            weight = ti.cast(weights[edge], ti.u32)
        return ti.cast(weight, real) * (1.0 / 255.0)

    @ti.func
    def list_row(
        page,
        view,
        row,
        width,
        first,
        edge_maps: ti.template(),
        starts: ti.template(),
        weights: ti.template(),
        words: ti.template(),
    ):
        slot, edge = first, 0
        if ti.static(weighted):
            edge = starts[view, row]
        for word in range(words.shape[2]):
            words[page, row, word, 1] = ti.cast(slot, ti.u32)
            bits = words[page, row, word, 0]
            while bits != 0:
                column = word * WORD + lowest_bit(bits)
                bits &= bits - ti.u32(1)
                columns[page, slot] = ti.cast(column, real)
                grey = grey_level(view, row, column, width, edge_maps)
                targets[page, slot] = ti.cast(grey, real) * (1.0 / 255.0)
                if ti.static(weighted):
                    weight = ti.cast(1.0, real)
                    if grey >= ti.u32(level):
                        weight = weight_of(edge, weights)
                        edge += 1
                    slot_weights[page, slot] = weight
                slot += 1
        return slot

    return list_row


def make_select(
    selection: PixelSelection, threads: int, schedule: str, level: int | None = None
) -> Callable[..., None]:
    """select(count, views, seeds, backgrounds, edge_maps, mask_words, starts, weights, words): one view per page.

    views, seeds, backgrounds: (count,). All pixels of a view's mask, which has at least its edge pixels, and
    `background` others, drawn without repetition (paper eq. 3); every pixel where `background` is negative. One seed
    gives one selection, whatever the schedule. level, starts, weights: see `make_list_row`.
    """
    return make_select_parallel(selection, level) if schedule == "log" else make_select_pages(selection, threads, level)


def make_select_pages(selection: PixelSelection, threads: int, level: int | None) -> Callable[..., None]:
    """Kernel select for a CPU: one page is one thread's."""
    lanes = min(threads, selection.pages)  # pages worked on at once
    list_row = make_list_row(selection, False, level)

    @ti.func
    def draw_background(page, seed, background, width, height, words: ti.template()):
        """Set the bits of `background` pixels that are not set yet."""
        state = seed
        found = 0
        while found < background:
            state = next_state(state)
            pixel = pixel_of(state, width * height)
            row = pixel // width
            column = pixel - row * width
            bit = ti.u32(1) << ti.cast(column & 31, ti.u32)
            if (words[page, row, column >> 5, 0] & bit) == 0:
                words[page, row, column >> 5, 0] = words[page, row, column >> 5, 0] | bit  # `|=` would be atomic
                found += 1

    @ti.func
    def fill_page(
        page,
        view,
        seed,
        background,
        edge_maps: ti.template(),
        mask_words: ti.template(),
        starts: ti.template(),
        weights: ti.template(),
        words: ti.template(),
    ):
        height, width = edge_maps.shape[1], edge_maps.shape[2]
        for row in range(height):
            for word in range(mask_words.shape[2]):
                bits = mask_words[view, row, word]
                words[page, row, word, 0] = bits if background >= 0 else whole_word(word, width)
        draw_background(page, seed, background, width, height, words)
        slot = 0
        for row in range(height):
            slot = list_row(page, view, row, width, slot, edge_maps, starts, weights, words)

    @ti.kernel
    def select(
        count: ti.i32,
        views: ti.types.ndarray(dtype=ti.i32, ndim=1),
        seeds: ti.types.ndarray(dtype=ti.u32, ndim=1),
        backgrounds: ti.types.ndarray(dtype=ti.i32, ndim=1),
        edge_maps: ti.types.ndarray(dtype=ti.u8, ndim=3),
        mask_words: ti.types.ndarray(dtype=ti.u32, ndim=3),
        starts: ti.types.ndarray(dtype=ti.i32, ndim=2),
        weights: ti.types.ndarray(dtype=ti.u8, ndim=1),
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
    ):
        for item in range(lanes * BLOCK):  # one block of items is one thread
            turns = (count + lanes - 1) // lanes if item % BLOCK == 0 else 0
            for turn in range(turns):
                page = item // BLOCK + turn * lanes
                if page < count:
                    view, seed, background = views[page], seeds[page], backgrounds[page]
                    fill_page(page, view, seed, background, edge_maps, mask_words, starts, weights, words)

    return select


def make_select_parallel(selection: PixelSelection, level: int | None) -> Callable[..., None]:
    """select for a GPU: as many threads as there are words, draws and rows, and no long loop in any of them.

    One thread for a page would go some 60 000 rounds one after the other; Mesa's software driver silently ends the
    loops of a thread after 65 535. The drawn pixels are the first so many different ones of a random sequence. While n
    are missing, the next n draws cannot find too many, so they are made at once, in any order, and the selection is
    that of one draw after the other. A round leaves the share that is set already: of lines, five rounds leave nothing.
    """
    pages, height, width = selection.pages, selection.height, selection.width
    list_row = make_list_row(selection, True, level)
    row_counts = ti.field(ti.i32, shape=(pages, height))
    drawn, missing, found = (ti.field(ti.i32, shape=pages) for _ in range(3))  # draws made; pixels to find; those found

    @ti.kernel
    def set_mask(
        count: ti.i32,
        width: ti.i32,
        views: ti.types.ndarray(dtype=ti.i32, ndim=1),
        backgrounds: ti.types.ndarray(dtype=ti.i32, ndim=1),
        mask_words: ti.types.ndarray(dtype=ti.u32, ndim=3),
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
    ):
        for page, row, word in ti.ndrange(count, mask_words.shape[1], mask_words.shape[2]):
            bits = mask_words[views[page], row, word]
            words[page, row, word, 0] = bits if backgrounds[page] >= 0 else whole_word(word, width)
        for page in range(pages):
            drawn[page], found[page] = 0, 0
            missing[page] = ti.max(backgrounds[page], 0) if page < count else 0

    @ti.func
    def draw(page, width, state, words: ti.template()):
        """Set the bit of one pixel. Returns 1 where it was not set yet, else 0."""
        pixel = pixel_of(state, width * words.shape[1])
        row = pixel // width
        column = pixel - row * width
        bit = ti.u32(1) << ti.cast(column & 31, ti.u32)
        before = ti.atomic_or(words[page, row, column >> 5, 0], bit)
        return 1 if (before & bit) == 0 else 0

    @ti.kernel
    def draw_missing(
        count: ti.i32,
        longest: ti.i32,
        width: ti.i32,
        seeds: ti.types.ndarray(dtype=ti.u32, ndim=1),
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
    ) -> ti.i32:
        for page, turn in ti.ndrange(count, longest):
            if turn < missing[page]:
                found[page] += draw(page, width, state_after(seeds[page], drawn[page] + turn + 1), words)
        most = 0
        for page in range(pages):
            drawn[page] += missing[page]
            missing[page], found[page] = missing[page] - found[page], 0
            ti.atomic_max(most, missing[page])
        return most

    @ti.kernel
    def list_pixels(
        count: ti.i32,
        width: ti.i32,
        views: ti.types.ndarray(dtype=ti.i32, ndim=1),
        edge_maps: ti.types.ndarray(dtype=ti.u32, ndim=2),
        starts: ti.types.ndarray(dtype=ti.i32, ndim=2),
        weights: ti.types.ndarray(dtype=ti.u32, ndim=1),
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
    ):
        for page, row in ti.ndrange(count, words.shape[1]):
            total = 0
            for word in range(words.shape[2]):
                total += ti.cast(ti.math.popcnt(words[page, row, word, 0]), ti.i32)
            row_counts[page, row] = total
        for page, row in ti.ndrange(count, words.shape[1]):
            slot = 0
            for above in range(row):
                slot += row_counts[page, above]
            list_row(page, views[page], row, width, slot, edge_maps, starts, weights, words)

    def select(count, views, seeds, backgrounds, edge_maps, mask_words, starts, weights, words):
        set_mask(count, width, views, backgrounds, mask_words, words)
        longest = int(backgrounds.max())
        while longest > 0:
            longest = draw_missing(count, longest, width, seeds, words)
        list_pixels(count, width, views, edge_maps, starts, weights, words)

    return select
