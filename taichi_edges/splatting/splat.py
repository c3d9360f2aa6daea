"""The splat: order-independent blending at the selected pixels only, compared with the edge map, with its own adjoint.

Every edge Gaussian has colour 1 on black, so the image is C(p) = 1 - T(p) with the transmittance
T(p) = prod_i (1 - a_i(p)), whatever the order. The loss looks at few pixels (paper eq. 3), so only those are evaluated.

Forward: each Gaussian is projected and visits the selected pixels in its box. On a CPU every thread multiplies into a
plane of its own (`product`); on a GPU all add log(1 - a) into one with atomics (`log`). Then the planes are combined to
T and compared with the edge map. Backward: each Gaussian gathers dL/da_i = -T dL/dT / (1 - a_i) from the same pixels,
nothing is written twice, so there are no atomics; Taichi's own adjoint of the projection takes it to the parameters.

A launch that wakes a second thread costs as much as several hundred Gaussians, so what can be one kernel is one.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import taichi as ti

from taichi_edges.splatting.projection import (
    ALPHA_MAX,
    ALPHA_MIN,
    LOG2_E,
    CameraFields,
    SplatFields,
    box_of,
    exact_exp2,
    fast_exp2,
    make_project,
    make_splat_of,
)
from taichi_edges.splatting.selection import BLOCK, PixelSelection, slots_of

if TYPE_CHECKING:
    from taichi_edges.splatting.gaussians import GaussianFields


def make_compare(
    gaussians: "GaussianFields",
    cameras: CameraFields,
    target: SplatFields,
    selection: PixelSelection,
    loss: ti.Ndarray,
    threads: int,
    schedule: str,
) -> Callable[..., None]:
    """compare(count, page, view, level, edge_weight, background_weight): Gaussians -> loss, for the tape.

    L_proj (eq. 3) of the pixels selected in `page`, of which `view` says where they are seen from: the sum of
    weight * |C - target|, added to `loss` (0-D ndarray with gradient). The weight is that of the pixel's class times
    its own. level: target from which on a pixel has the class of an edge pixel. schedule: 'product' (a private plane
    for each of `threads` threads) or 'log' (atomic sums of logarithms). The adjoint adds to the gradients of
    `gaussians` and to its positional gradients.
    """
    draw = make_draw(gaussians, cameras, target, selection, threads, schedule)
    blend = make_blend(selection, schedule)
    gather = make_gather(gaussians, target, selection)
    project = make_project(gaussians, cameras, target)

    @ti.ad.grad_replaced
    def compare(count, page, view, level, edge_weight, background_weight):
        draw(count, page, view, selection.width, selection.height, selection.words)
        blend(int(selection.counts[page]), page, level, edge_weight, background_weight, loss)

    @ti.ad.grad_for(compare)
    def compare_adjoint(count, page, view, level, edge_weight, background_weight):
        gather(count, page, selection.words, loss.grad)
        project.grad(count, view)

    return compare


def make_draw(
    gaussians: "GaussianFields",
    cameras: CameraFields,
    target: SplatFields,
    selection: PixelSelection,
    threads: int,
    schedule: str,
) -> Callable[..., None]:
    """Kernel draw(count, page, view, width, height, words): Gaussians -> SplatFields and the selection's planes."""
    real = selection.real
    splats, boxes = target.splats, target.boxes
    columns, planes = selection.columns, selection.planes
    exp2 = fast_exp2 if real == ti.f32 else exact_exp2
    splat_of = make_splat_of(gaussians, cameras, exp2)

    @ti.func
    def draw_one(i, plane, page, view, width, height, words: ti.template()):
        g, variances, depth = splat_of(i, view)
        box = box_of(g, variances, depth, width, height)
        splats[i], boxes[i] = g, box
        a, b, c = -0.5 * LOG2_E * g[2], -LOG2_E * g[3], -0.5 * LOG2_E * g[4]
        for row in range(box[2], box[3]):
            dv = row - g[1]
            start, end = slots_of(words, page, row, box[0], box[1])
            for slot in range(start, end):
                du = columns[page, slot] - g[0]
                alpha = g[5] * exp2((a * du + b * dv) * du + c * dv * dv)
                if ti.static(schedule == "log"):
                    if alpha >= ALPHA_MIN:
                        ti.atomic_add(planes[plane, slot], ti.log(1.0 - ti.min(alpha, ALPHA_MAX)))
                else:  # without a branch, which the processor would guess wrong half of the time
                    drawn = ti.select(alpha >= ALPHA_MIN, ti.min(alpha, ALPHA_MAX), 0.0)
                    planes[plane, slot] = planes[plane, slot] * (1.0 - drawn)  # `*=` would be atomic

    @ti.kernel
    def draw_product(
        count: ti.i32,
        page: ti.i32,
        view: ti.i32,
        width: ti.i32,
        height: ti.i32,
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
    ):
        for item in range(threads * BLOCK):  # one block of items is one thread: plane `thread` is its own
            thread = item // BLOCK
            share = (count + threads - 1) // threads
            i = thread * share + item % BLOCK
            end = ti.min((thread + 1) * share, count)
            while i < end:
                draw_one(i, thread, page, view, width, height, words)
                i += BLOCK

    @ti.kernel
    def draw_log(
        count: ti.i32,
        page: ti.i32,
        view: ti.i32,
        width: ti.i32,
        height: ti.i32,
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
    ):
        for i in range(count):
            draw_one(i, 0, page, view, width, height, words)

    return draw_log if schedule == "log" else draw_product


def make_blend(selection: PixelSelection, schedule: str) -> Callable[..., None]:
    """Kernel blend(slots, page, level, edge_weight, background_weight, loss): planes -> T, adjoint and loss.

    Leaves the planes empty for the next view. Serial on a CPU: a few thousand slots do not pay for waking a thread, and
    the sum is the same in every run.
    """
    real = selection.real
    planes, transmittance, adjoint = selection.planes, selection.transmittance, selection.adjoint
    targets, weights, count = selection.targets, selection.weights, selection.planes.shape[0]
    empty = 0.0 if schedule == "log" else 1.0  # log T = 0 or T = 1

    @ti.kernel
    def clear():
        for plane, slot in planes:
            planes[plane, slot] = empty

    @ti.func
    def blend_one(slot, page, level, edge_weight, background_weight):
        """weight * |C - target| of one slot."""
        t = planes[0, slot]
        planes[0, slot] = empty
        for plane in ti.static(range(1, count)):
            t *= planes[plane, slot]
            planes[plane, slot] = empty
        if ti.static(schedule == "log"):
            t = ti.exp(t)
        wanted = targets[page, slot]
        weight = weights[page, slot] * (edge_weight if wanted >= level else background_weight)
        difference = 1.0 - t - wanted
        side = 1.0 if difference > 0 else -1.0
        if difference == 0:
            side = 0.0
        transmittance[slot] = t
        adjoint[slot] = weight * side * t
        return weight * ti.abs(difference)

    @ti.kernel
    def blend_serial(
        slots: ti.i32,
        page: ti.i32,
        level: real,
        edge_weight: real,
        background_weight: real,
        loss: ti.types.ndarray(dtype=real, ndim=0),
    ):
        ti.loop_config(serialize=True)
        for _ in range(1):
            total = ti.cast(0.0, real)
            for slot in range(slots):
                total += blend_one(slot, page, level, edge_weight, background_weight)
            loss[None] += total

    @ti.kernel
    def blend_parallel(
        slots: ti.i32,
        page: ti.i32,
        level: real,
        edge_weight: real,
        background_weight: real,
        loss: ti.types.ndarray(dtype=real, ndim=0),
    ):
        for slot in range(slots):
            loss[None] += blend_one(slot, page, level, edge_weight, background_weight)

    clear()
    return blend_parallel if schedule == "log" else blend_serial


def make_gather(gaussians: "GaussianFields", target: SplatFields, selection: PixelSelection) -> Callable[..., None]:
    """Kernel gather(count, page, words, loss_gradient): the slots' adjoints -> gradients of the splats (assigned)."""
    real = selection.real
    splats, boxes, positional = target.splats, target.boxes, gaussians.positional_gradients
    columns, adjoint = selection.columns, selection.adjoint
    exp2 = fast_exp2 if real == ti.f32 else exact_exp2

    @ti.kernel
    def gather(
        count: ti.i32,
        page: ti.i32,
        words: ti.types.ndarray(dtype=ti.u32, ndim=4),
        loss_gradient: ti.types.ndarray(dtype=real, ndim=0),
    ):
        for i in range(count):
            box, g = boxes[i], splats[i]
            a, b, c = -0.5 * LOG2_E * g[2], -LOG2_E * g[3], -0.5 * LOG2_E * g[4]
            # Sums over the pixels of dL / d(exponent) times 1, du, dv, du^2, du dv, dv^2.
            one, u, v, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            u_absolute, v_absolute = 0.0, 0.0
            for row in range(box[2], box[3]):
                dv = row - g[1]
                row_one, row_u, row_uu = 0.0, 0.0, 0.0  # what dv multiplies is summed up for the whole row
                start, end = slots_of(words, page, row, box[0], box[1])
                for slot in range(start, end):
                    du = columns[page, slot] - g[0]
                    alpha = g[5] * exp2((a * du + b * dv) * du + c * dv * dv)
                    drawn = ti.select(alpha >= ALPHA_MIN and alpha < ALPHA_MAX, alpha, 0.0)
                    d_exponent = adjoint[slot] * drawn / (1.0 - drawn)
                    along_u = d_exponent * du
                    row_one += d_exponent
                    row_u += along_u
                    row_uu += along_u * du
                    pull = ti.abs(d_exponent)
                    u_absolute += pull * ti.abs(g[2] * du + g[3] * dv)
                    v_absolute += pull * ti.abs(g[3] * du + g[4] * dv)
                one += row_one
                u += row_u
                v += row_one * dv
                uu += row_uu
                uv += row_u * dv
                vv += row_one * dv * dv
            scale = loss_gradient[None]
            slopes = ti.Vector(
                [g[2] * u + g[3] * v, g[3] * u + g[4] * v, -0.5 * uu, -uv, -0.5 * vv, one / ti.max(g[5], 1e-30)]
            )
            splats.grad[i] = scale * slopes
            # Absolute values, so that pulls to opposite sides add up instead of cancelling (AbsGS, 2024).
            positional[i] += scale * ti.sqrt(u_absolute * u_absolute + v_absolute * v_absolute)

    return gather
