"""The pixels of a view at which the splat is evaluated: those of the loss (paper eq. 3), as slots and as a bit mask."""

import numpy as np
import taichi as ti

WORD = 32  # pixels in a word of the mask


def pack_mask(edges):
    """(V, H, W) bool -> (V, H, ceil(W / 32)) uint32, bit b of word w is column 32 w + b."""
    count, height, width = edges.shape
    words = -(-width // WORD)
    padded = np.zeros((count, height, words * WORD), bool)
    padded[:, :, :width] = edges
    return np.packbits(padded, axis=2, bitorder="little").view("<u4")


class PixelSelection:
    """The pixels of the current view at which the splat is evaluated.

    Slots (fields, `capacity`): pixel (row * width + column), weight in the loss, target in 0..1, transmittance with
    its gradient. Images (ndarrays): planes (threads or 1, H, W), mask (H, words), adjoint (H, W) = T dL/dT.
    """

    def __init__(self, height, width, capacity, planes, real=ti.f32):
        self.height, self.width, self.capacity, self.real = height, width, capacity, real
        self.pixels = ti.field(ti.i32, shape=capacity)
        self.weights = ti.field(real, shape=capacity)
        self.targets = ti.field(real, shape=capacity)
        self.transmittance = ti.field(real, shape=capacity, needs_grad=True)
        self.planes = ti.ndarray(real, shape=(planes, height, width))
        self.mask = ti.ndarray(ti.u32, shape=(height, -(-width // WORD)))
        self.adjoint = ti.ndarray(real, shape=(height, width))
        self.count = 0


def make_select(selection, schedule):
    """Kernels that choose the pixels of a view and reset the images there.

    select_balanced(view, edge_maps, edge_words, edge_pixels, first, edges, background, seed, weight): all edge pixels
    and `background` others drawn without repetition (paper eq. 3). Serial, so one seed gives one selection.
    select_all(view, edge_maps, threshold, edge_weight, background_weight): every pixel.
    """
    pixels, weights, targets = selection.pixels, selection.weights, selection.targets
    empty = 0.0 if schedule == "log" else 1.0  # log T = 0 or T = 1
    real = selection.real

    @ti.func
    def occupy(slot, view, row, column, weight, edge_maps: ti.template(), planes: ti.template()):
        pixels[slot] = row * edge_maps.shape[2] + column
        weights[slot] = weight
        targets[slot] = ti.cast(edge_maps[view, row, column], real) * (1.0 / 255.0)
        for plane in range(planes.shape[0]):
            planes[plane, row, column] = empty

    @ti.kernel
    def select_balanced(
        view: ti.i32,
        edge_maps: ti.types.ndarray(dtype=ti.u8, ndim=3),
        edge_words: ti.types.ndarray(dtype=ti.u32, ndim=3),
        edge_pixels: ti.types.ndarray(dtype=ti.i32, ndim=1),
        mask: ti.types.ndarray(dtype=ti.u32, ndim=2),
        planes: ti.types.ndarray(dtype=real, ndim=3),
        first: ti.i32,
        edges: ti.i32,
        background: ti.i32,
        seed: ti.u32,
        weight: real,
    ):
        for row, word in ti.ndrange(mask.shape[0], mask.shape[1]):
            mask[row, word] = edge_words[view, row, word]
        for slot in range(edges):
            pixel = edge_pixels[first + slot]
            row = pixel // edge_maps.shape[2]
            occupy(slot, view, row, pixel - row * edge_maps.shape[2], weight, edge_maps, planes)
        ti.loop_config(serialize=True)
        for lane in range(1):
            state = seed
            total = ti.cast(edge_maps.shape[1] * edge_maps.shape[2], ti.u64)
            slot = edges
            while slot < edges + background:
                state = state * ti.u32(747796405) + ti.u32(2891336453)  # PCG-RXS-M-XS, O'Neill 2014
                hashed = ((state >> ((state >> 28) + ti.u32(4))) ^ state) * ti.u32(277803737)
                hashed = (hashed >> 22) ^ hashed
                pixel = ti.cast((ti.cast(hashed, ti.u64) * total) >> 32, ti.i32)
                row = pixel // edge_maps.shape[2]
                column = pixel - row * edge_maps.shape[2]
                bit = ti.u32(1) << ti.cast(column & 31, ti.u32)
                if (mask[row, column >> 5] & bit) == 0:
                    mask[row, column >> 5] |= bit
                    occupy(slot, view, row, column, weight, edge_maps, planes)
                    slot += 1

    @ti.kernel
    def select_all(
        view: ti.i32,
        edge_maps: ti.types.ndarray(dtype=ti.u8, ndim=3),
        mask: ti.types.ndarray(dtype=ti.u32, ndim=2),
        planes: ti.types.ndarray(dtype=real, ndim=3),
        threshold: ti.i32,
        edge_weight: real,
        background_weight: real,
    ):
        for row, word in ti.ndrange(mask.shape[0], mask.shape[1]):
            mask[row, word] = ti.u32(0xFFFFFFFF)  # boxes end at the image, so the bits beyond it are never visited
        for row, column in ti.ndrange(edge_maps.shape[1], edge_maps.shape[2]):
            is_edge = ti.cast(edge_maps[view, row, column], ti.i32) >= threshold
            weight = edge_weight if is_edge else background_weight
            occupy(row * edge_maps.shape[2] + column, view, row, column, weight, edge_maps, planes)

    return select_balanced, select_all
