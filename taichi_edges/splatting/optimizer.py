"""Adam over the 11 parameters of every Gaussian, one kernel, which also zeroes the gradients it has used."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import taichi as ti

if TYPE_CHECKING:
    from taichi_edges.splatting.gaussians import GaussianFields

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-15  # as in 3D Gaussian Splatting: the loss is a mean, so its gradients are small


def make_adam(gaussians: "GaussianFields") -> Callable[..., None]:
    """Kernel adam(count, correction1, correction2, means_rate, scales_rate, quaternions_rate, opacities_rate).

    correction = 1 / (1 - beta^step). A rate of 0 leaves its parameters alone; their moments go on.
    """
    means, log_scales = gaussians.means, gaussians.log_scales
    quaternions, opacity_logits = gaussians.quaternions, gaussians.opacity_logits
    first, second = gaussians.first_moments, gaussians.second_moments
    real = gaussians.real

    @ti.kernel
    def adam(
        count: ti.i32,
        correction1: real,
        correction2: real,
        means_rate: real,
        scales_rate: real,
        quaternions_rate: real,
        opacities_rate: real,
    ):
        for i in range(count):
            g0, g1, g2, g3 = means.grad[i], log_scales.grad[i], quaternions.grad[i], opacity_logits.grad[i]
            gradient = ti.Vector([g0[0], g0[1], g0[2], g1[0], g1[1], g1[2], g2[0], g2[1], g2[2], g2[3], g3])
            m = BETA1 * first[i] + (1 - BETA1) * gradient
            v = BETA2 * second[i] + (1 - BETA2) * gradient * gradient
            first[i], second[i] = m, v
            step = (m * correction1) / (ti.sqrt(v * correction2) + EPSILON)
            means[i] -= means_rate * ti.Vector([step[0], step[1], step[2]])
            log_scales[i] -= scales_rate * ti.Vector([step[3], step[4], step[5]])
            quaternions[i] -= quaternions_rate * ti.Vector([step[6], step[7], step[8], step[9]])
            opacity_logits[i] -= opacities_rate * step[10]
            means.grad[i] = ti.Vector.zero(real, 3)
            log_scales.grad[i] = ti.Vector.zero(real, 3)
            quaternions.grad[i] = ti.Vector.zero(real, 4)
            opacity_logits.grad[i] = 0.0

    return adam
