"""The splat and the image loss written plainly and differentiated by Taichi: the oracle of the hand-written adjoint."""

from functools import cache

import taichi as ti
from reference_splatting import selected

from taichi_edges.splatting.projection import ALPHA_MAX, ALPHA_MIN, make_project


class AutodiffSplat:
    """record() does for one Splatter what Splatter.record does, with kernels that Taichi differentiates itself.

    Every differentiable load stands in the innermost loop, or Taichi's reverse mode would lose iterations.
    """

    def __init__(self, splatter):
        self.splatter = splatter
        height, width, real = splatter.images.height, splatter.images.width, splatter.real
        fields, target, loss = splatter.fields, splatter.splats, splatter.loss
        splats, boxes = target.splats, target.boxes
        self.log_transmittance = log_transmittance = ti.field(real, shape=(height, width), needs_grad=True)
        self.transmittance = transmittance = ti.field(real, shape=height * width, needs_grad=True)
        self.project = make_project(fields, splatter.cameras, target)

        @ti.kernel
        def draw(count: ti.i32):
            for i in range(count):
                u0, v0 = boxes[i][0], boxes[i][2]
                columns = boxes[i][1] - u0
                visits = columns * (boxes[i][3] - v0)
                for visit in range(visits):
                    row = v0 + visit // columns
                    column = u0 + visit - visit // columns * columns
                    g = splats[i]
                    du, dv = column - g[0], row - g[1]
                    alpha = g[5] * ti.exp(-0.5 * (g[2] * du * du + g[4] * dv * dv) - g[3] * du * dv)
                    if alpha >= ALPHA_MIN:
                        log_transmittance[row, column] += ti.log(1.0 - ti.min(alpha, ALPHA_MAX))

        @ti.kernel
        def gather(slots: ti.i32, pixels: ti.types.ndarray(dtype=ti.i32, ndim=2)):
            for slot in range(slots):
                transmittance[slot] = ti.exp(log_transmittance[pixels[slot, 1], pixels[slot, 0]])

        @ti.kernel
        def image_loss(
            slots: ti.i32,
            weights: ti.types.ndarray(dtype=real, ndim=1),
            targets: ti.types.ndarray(dtype=real, ndim=1),
            loss: ti.types.ndarray(dtype=real, ndim=0, needs_grad=True),
        ):
            for slot in range(slots):
                loss[None] += weights[slot] * ti.abs(1.0 - transmittance[slot] - targets[slot])

        self.draw, self.gather, self.image_loss, self.loss = draw, gather, image_loss, loss

    def record(self):
        """Loss and gradients of the pixels selected in page 0. Returns their transmittances."""
        splatter = self.splatter
        splatter.draw()  # for the boxes
        for field in (self.log_transmittance, self.log_transmittance.grad, self.transmittance.grad):
            field.fill(0)
        splatter.splats.splats.grad.fill(0)
        pixels, weights, targets = selected(splatter)
        arrays = []
        for values, dtype in ((pixels, ti.i32), (weights, splatter.real), (targets, splatter.real)):
            arrays.append(ti.ndarray(dtype, shape=values.shape))
            arrays[-1].from_numpy(values.astype("i4" if dtype == ti.i32 else "f8" if dtype == ti.f64 else "f4"))
        count, slots = splatter.fields.count, len(pixels)
        with ti.ad.Tape(loss=self.loss, clear_gradients=False):
            self.project(count, int(splatter.selection.views[0]))
            self.draw(count)
            self.gather(slots, arrays[0])
            self.image_loss(slots, arrays[1], arrays[2], self.loss)
        kept.extend(arrays)
        return self.transmittance.to_numpy()[:slots]


@cache
def autodiff_of(splatter):
    """The AutodiffSplat of a Splatter; its kernels are built once."""
    return AutodiffSplat(splatter)


kept = []  # ndarrays that are freed after a second ti.init damage the new program: these are freed at the end
