"""The paper's regularisers, differentiated by Taichi: L_orient (eq. 4) and L_shape (eq. 5)."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from taichi_edges.splatting.projection import rotation

if TYPE_CHECKING:
    from taichi_edges.splatting.gaussians import GaussianFields


class NeighborFields:
    """The k nearest neighbours of every Gaussian, and who has whom for a neighbour.

    The neighbours' means are copied to a field of their own, so that their share of the gradient can be gathered in a
    fixed order: scattered with atomics, the last bits of a sum would depend on which thread came first.
    """

    def __init__(self, capacity: int, k: int, real: Any = ti.f32) -> None:
        self.capacity, self.k = capacity, k
        self.indices = ti.field(ti.i32, shape=(capacity, k))
        self.means = ti.Vector.field(3, real, shape=(capacity, k), needs_grad=True)
        # Who uses i: users[user_starts[i] : user_starts[i + 1]].
        self.user_starts = ti.field(ti.i32, shape=capacity + 1)
        self.users = ti.field(ti.i32, shape=capacity * k)  # flat positions into (capacity, k)

    def load(self, neighbors: np.ndarray) -> None:
        """neighbors: (n, k) int indices of the nearest other Gaussians."""
        count = len(neighbors)
        indices = np.zeros((self.capacity, self.k), np.int32)
        indices[:count] = neighbors
        users = np.zeros(self.capacity * self.k, np.int32)
        users[: count * self.k] = np.argsort(neighbors.ravel(), kind="stable")
        used = np.bincount(neighbors.ravel(), minlength=self.capacity)
        self.indices.from_numpy(indices)
        self.users.from_numpy(users)
        self.user_starts.from_numpy(np.concatenate([[0], np.cumsum(used)]).astype(np.int32))
        self.means.grad.fill(0)


def make_regularizers(
    gaussians: "GaussianFields", neighbors: NeighborFields, loss: ti.Ndarray
) -> Callable[[int, float, float], None]:
    """regularize(count, orient_weight, shape_weight): both regularisers, added to `loss` (0-D ndarray), for the tape.

    L_orient as the text of 3.2 defines it: the principal direction d_i points towards the k nearest neighbours,
    1 - mean |d_i . (mu_i - mu_j)| / |mu_i - mu_j|. L_shape: the mean ratio of the second largest to the largest scale.
    """
    means, log_scales, quaternions = gaussians.means, gaussians.log_scales, gaussians.quaternions
    indices, neighbor_means = neighbors.indices, neighbors.means
    users, user_starts, k = neighbors.users, neighbors.user_starts, neighbors.k
    real = gaussians.real
    # A field of its own: the adjoint that Taichi makes for an ndarray reads the wrong memory on Vulkan.
    total = ti.field(real, shape=(), needs_grad=True)

    @ti.kernel
    def copy(count: ti.i32):
        for i in range(count):
            for j in ti.static(range(k)):
                neighbor_means[i, j] = means[indices[i, j]]

    @ti.kernel
    def gather(count: ti.i32):
        for i in range(count):
            pulls = ti.Vector.zero(real, 3)
            for position in range(user_starts[i], user_starts[i + 1]):
                user = users[position]
                pulls += neighbor_means.grad[user // k, user % k]
                neighbor_means.grad[user // k, user % k] = ti.Vector.zero(real, 3)
            means.grad[i] += pulls

    @ti.ad.grad_replaced
    def copy_neighbors(count):
        copy(count)

    @ti.ad.grad_for(copy_neighbors)
    def copy_neighbors_adjoint(count):
        gather(count)

    @ti.kernel
    def sum_up(count: ti.i32, orient_weight: real, shape_weight: real):
        for i in range(count):
            axes = rotation(quaternions[i])
            s = ti.exp(log_scales[i])
            direction = ti.Vector([axes[0, 0], axes[1, 0], axes[2, 0]])
            largest, second = s[0], ti.max(s[1], s[2])
            if s[1] > s[0] and s[1] >= s[2]:
                direction = ti.Vector([axes[0, 1], axes[1, 1], axes[2, 1]])
                largest, second = s[1], ti.max(s[0], s[2])
            elif s[2] > s[0] and s[2] > s[1]:
                direction = ti.Vector([axes[0, 2], axes[1, 2], axes[2, 2]])
                largest, second = s[2], ti.max(s[0], s[1])
            alignment = 0.0
            for j in ti.static(range(k)):
                offset = means[i] - neighbor_means[i, j]
                alignment += ti.abs(direction.dot(offset)) / ti.sqrt(offset.dot(offset) + 1e-12)
            total[None] += (orient_weight * (1.0 - alignment / k) + shape_weight * second / largest) / count

    @ti.kernel
    def move_total(loss: ti.types.ndarray(dtype=real, ndim=0)):
        loss[None] += total[None]
        total[None] = 0.0

    @ti.kernel
    def take_gradient(loss_gradient: ti.types.ndarray(dtype=real, ndim=0)):
        total.grad[None] = loss_gradient[None]

    @ti.ad.grad_replaced
    def add_to_loss():
        move_total(loss)

    @ti.ad.grad_for(add_to_loss)
    def add_to_loss_adjoint():
        take_gradient(loss.grad)

    def regularize(count, orient_weight, shape_weight):
        copy_neighbors(count)
        sum_up(count, orient_weight, shape_weight)
        add_to_loss()

    return regularize
