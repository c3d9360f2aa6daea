"""The splat: order-independent blending at chosen pixels only, with an adjoint of its own.

Every edge Gaussian has colour 1 on black, so the image is C(p) = 1 - T(p) with the transmittance
T(p) = prod_i (1 - a_i(p)), whatever the order. The loss looks at few pixels (paper eq. 3), so only those are evaluated:
the selected pixels stand in a list of slots and in a bit mask over the image, 32 pixels a word.

Forward: each Gaussian visits the set bits of its box. On a CPU every thread multiplies into an image of its own
(`product`); on a GPU all add log(1 - a) into one image with atomics (`log`). Backward: each Gaussian gathers
dL/da_i = -T(p) dL/dT(p) / (1 - a_i) from the same bits; nothing is written twice, so there are no atomics.
"""

import taichi as ti

from taichi_edges.splatting.projection import ALPHA_MAX, ALPHA_MIN
from taichi_edges.splatting.selection import WORD

BLOCK = 512  # Taichi's CPU backend gives a thread no fewer items of a range-for than this


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
    draw, combine = make_forward(target, selection, threads, schedule)
    spread_adjoint, gather_adjoint = make_adjoint(gaussians, target, selection)

    @ti.ad.grad_replaced
    def splat(count):
        draw(count, selection.mask, selection.planes)
        combine(selection.count, selection.planes)

    @ti.ad.grad_for(splat)
    def splat_adjoint(count):
        spread_adjoint(selection.count, selection.adjoint)
        gather_adjoint(count, selection.mask, selection.adjoint)

    return splat


def make_forward(target, selection, threads, schedule):
    """Kernels draw(count, mask, planes): splats into the planes, and combine(slots, planes): planes into slots."""
    real = selection.real
    splats, boxes = target.splats, target.boxes
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

    return draw_log if schedule == "log" else draw_product, combine


def make_adjoint(gaussians, target, selection):
    """Kernels spread_adjoint(slots, adjoint): T dL/dT from the slots to the image, and
    gather_adjoint(count, mask, adjoint): from the image to the splats.
    """
    real = selection.real
    splats, boxes, positional = target.splats, target.boxes, gaussians.positional_gradients
    pixels, transmittance = selection.pixels, selection.transmittance
    exp = fast_exp if real == ti.f32 else ti.exp

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

    return spread_adjoint, gather_adjoint
