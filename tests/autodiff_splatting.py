"""The splat written plainly and differentiated by Taichi: the oracle of the hand-written adjoint."""

import taichi as ti

from taichi_edges.splatting.projection import ALPHA_MAX, ALPHA_MIN


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
