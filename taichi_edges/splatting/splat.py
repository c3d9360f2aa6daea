"""The splat: order-independent blending at chosen pixels only, with an adjoint of its own.

Every edge Gaussian has colour 1 on black, so the image is C(p) = 1 - T(p) with the transmittance
T(p) = prod_i (1 - a_i(p)), whatever the order. The loss looks at few pixels (paper eq. 3), so only those are evaluated:
the selected pixels stand in a list of slots and in a bit mask over the image, 32 pixels a word.

Forward: each Gaussian visits the set bits of its box. On a CPU every thread multiplies into an image of its own
(`product`); on a GPU all add log(1 - a) into one image with atomics (`log`). Backward: each Gaussian gathers
dL/da_i = -T(p) dL/dT(p) / (1 - a_i) from the same bits; nothing is written twice, so there are no atomics.
"""

import numpy as np
import taichi as ti

from taichi_edges.splatting.projection import ALPHA_MAX, ALPHA_MIN

BLOCK = 512  # Taichi's CPU backend gives a thread no fewer items of a range-for than this
WORD = 32


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


@ti.func
def lowest_bit(bits):
    """Index of the lowest set bit of a non-zero u32."""
    return ti.cast(ti.math.popcnt((bits & (~bits + ti.u32(1))) - ti.u32(1)), ti.i32)


@ti.func
def word_in_box(mask: ti.template(), row, word, u0, u1):
    """The mask's word with the bits outside columns u0..u1-1 cleared."""
    bits = mask[row, word]
    first = word * WORD
    if first < u0:
        bits &= ti.u32(0xFFFFFFFF) << ti.cast(u0 - first, ti.u32)
    if first + WORD > u1:
        bits &= ti.u32(0xFFFFFFFF) >> ti.cast(first + WORD - u1, ti.u32)
    return bits


@ti.func
def fast_exp(x):
    """exp of x <= 0 in f32: fifth-order minimax polynomial, off by 1e-7; libm's costs twice the splat."""
    scaled = ti.max(x, -80.0) * 1.44269504
    whole = ti.floor(scaled + 0.5)
    f = scaled - whole
    p = 1.32647271e-3 * f + 9.67151264e-3
    p = p * f + 5.55073374e-2
    p = p * f + 2.40222421e-1
    p = p * f + 6.93146978e-1
    p = p * f + 1.0
    return p * ti.bit_cast((ti.cast(whole, ti.i32) + 127) << 23, ti.f32)


def make_splat(gaussians, target, selection, threads, schedule):
    """splat(count): SplatFields -> transmittance of the selected slots, with its own adjoint registered for the tape.

    schedule: 'product' (a private image for each of `threads` threads) or 'log' (atomic sums of logarithms).
    The adjoint writes `splats.grad` (assigned, not added) and adds to `positional_gradients`.
    """
    real = gaussians.real
    splats, boxes, positional = target.splats, target.boxes, gaussians.positional_gradients
    pixels, transmittance = selection.pixels, selection.transmittance
    exp = fast_exp if real == ti.f32 else ti.exp

    @ti.func
    def draw(i, plane, mask: ti.template(), planes: ti.template()):
        box, g = boxes[i], splats[i]
        for row in range(box[2], box[3]):
            dv = row - g[1]
            for word in range(box[0] >> 5, ((box[1] - 1) >> 5) + 1):
                bits = word_in_box(mask, row, word, box[0], box[1])
                while bits != 0:
                    column = word * WORD + lowest_bit(bits)
                    bits &= bits - ti.u32(1)
                    du = column - g[0]
                    alpha = g[5] * exp(-0.5 * (g[2] * du * du + g[4] * dv * dv) - g[3] * du * dv)
                    if alpha >= ALPHA_MIN:
                        if ti.static(schedule == "log"):
                            ti.atomic_add(planes[plane, row, column], ti.log(1.0 - ti.min(alpha, ALPHA_MAX)))
                        else:
                            planes[plane, row, column] *= 1.0 - ti.min(alpha, ALPHA_MAX)

    @ti.kernel
    def draw_product(
        count: ti.i32, mask: ti.types.ndarray(dtype=ti.u32, ndim=2), planes: ti.types.ndarray(dtype=real, ndim=3)
    ):
        for item in range(threads * BLOCK):  # one block of items is one thread: plane `thread` is its own
            thread = item // BLOCK
            share = (count + threads - 1) // threads
            i = thread * share + item % BLOCK
            end = ti.min((thread + 1) * share, count)
            while i < end:
                draw(i, thread, mask, planes)
                i += BLOCK

    @ti.kernel
    def draw_log(
        count: ti.i32, mask: ti.types.ndarray(dtype=ti.u32, ndim=2), planes: ti.types.ndarray(dtype=real, ndim=3)
    ):
        for i in range(count):
            draw(i, 0, mask, planes)

    @ti.kernel
    def combine(slots: ti.i32, planes: ti.types.ndarray(dtype=real, ndim=3)):
        for slot in range(slots):
            row = pixels[slot] // planes.shape[2]
            column = pixels[slot] - row * planes.shape[2]
            value = planes[0, row, column]
            for plane in range(1, planes.shape[0]):
                value *= planes[plane, row, column]
            if ti.static(schedule == "log"):
                value = ti.exp(value)
            transmittance[slot] = value

    @ti.kernel
    def spread_adjoint(slots: ti.i32, adjoint: ti.types.ndarray(dtype=real, ndim=2)):
        for slot in range(slots):
            row = pixels[slot] // adjoint.shape[1]
            adjoint[row, pixels[slot] - row * adjoint.shape[1]] = transmittance.grad[slot] * transmittance[slot]
            transmittance.grad[slot] = 0.0

    @ti.kernel
    def gather_adjoint(
        count: ti.i32, mask: ti.types.ndarray(dtype=ti.u32, ndim=2), adjoint: ti.types.ndarray(dtype=real, ndim=2)
    ):
        for i in range(count):
            box, g = boxes[i], splats[i]
            du_sum, dv_sum, a_sum, b_sum, c_sum, opacity_sum = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            du_absolute, dv_absolute = 0.0, 0.0
            for row in range(box[2], box[3]):
                dv = row - g[1]
                for word in range(box[0] >> 5, ((box[1] - 1) >> 5) + 1):
                    bits = word_in_box(mask, row, word, box[0], box[1])
                    while bits != 0:
                        column = word * WORD + lowest_bit(bits)
                        bits &= bits - ti.u32(1)
                        du = column - g[0]
                        falloff = exp(-0.5 * (g[2] * du * du + g[4] * dv * dv) - g[3] * du * dv)
                        alpha = g[5] * falloff
                        if alpha >= ALPHA_MIN and alpha < ALPHA_MAX:
                            d_alpha = -adjoint[row, column] / (1.0 - alpha)
                            d_exponent = d_alpha * alpha
                            opacity_sum += d_alpha * falloff
                            a_sum -= 0.5 * d_exponent * du * du
                            b_sum -= d_exponent * du * dv
                            c_sum -= 0.5 * d_exponent * dv * dv
                            towards_u = d_exponent * (g[2] * du + g[3] * dv)
                            towards_v = d_exponent * (g[3] * du + g[4] * dv)
                            du_sum += towards_u
                            dv_sum += towards_v
                            du_absolute += ti.abs(towards_u)
                            dv_absolute += ti.abs(towards_v)
            splats.grad[i] = ti.Vector([du_sum, dv_sum, a_sum, b_sum, c_sum, opacity_sum])
            # Absolute values, so that pulls to opposite sides add up instead of cancelling (AbsGS, 2024).
            positional[i] += ti.sqrt(du_absolute * du_absolute + dv_absolute * dv_absolute)

    draw_all = draw_log if schedule == "log" else draw_product

    @ti.ad.grad_replaced
    def splat(count):
        draw_all(count, selection.mask, selection.planes)
        combine(selection.count, selection.planes)

    @ti.ad.grad_for(splat)
    def splat_adjoint(count):
        spread_adjoint(selection.count, selection.adjoint)
        gather_adjoint(count, selection.mask, selection.adjoint)

    return splat


def make_splat_autodiff(target, selection):
    """splat(count, slots): the same splat, written plainly and differentiated by Taichi: the oracle of the tests.

    Every differentiable load stands in the innermost loop, or Taichi's reverse mode would lose iterations.
    """
    splats, boxes = target.splats, target.boxes
    pixels, transmittance = selection.pixels, selection.transmittance
    log_transmittance = ti.field(transmittance.dtype, shape=(selection.height, selection.width), needs_grad=True)

    @ti.kernel
    def clear():
        for pixel in ti.grouped(log_transmittance):
            log_transmittance[pixel] = 0.0
            log_transmittance.grad[pixel] = 0.0

    @ti.kernel
    def draw(count: ti.i32):
        for i in range(count):
            u0, v0 = boxes[i][0], boxes[i][2]
            width = boxes[i][1] - u0
            visits = width * (boxes[i][3] - v0)
            for visit in range(visits):
                row = v0 + visit // width
                column = u0 + visit - visit // width * width
                g = splats[i]
                du, dv = column - g[0], row - g[1]
                alpha = g[5] * ti.exp(-0.5 * (g[2] * du * du + g[4] * dv * dv) - g[3] * du * dv)
                if alpha >= ALPHA_MIN:
                    log_transmittance[row, column] += ti.log(1.0 - ti.min(alpha, ALPHA_MAX))

    @ti.kernel
    def gather(slots: ti.i32):
        for slot in range(slots):
            row = pixels[slot] // log_transmittance.shape[1]
            column = pixels[slot] - row * log_transmittance.shape[1]
            transmittance[slot] = ti.exp(log_transmittance[row, column])

    return clear, draw, gather
