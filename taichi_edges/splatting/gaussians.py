"""Edge Gaussians: NumPy arrays between the stages, Taichi fields with gradients and Adam moments while training."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taichi_edges.arrays.columns import Columns

MIN_CAPACITY = 4096  # a changed capacity recompiles every kernel, so capacities are powers of two from here up


@dataclass(frozen=True)
class Gaussians(Columns):
    """n edge Gaussians.

    means: (n, 3) unit-cube units. log_scales: (n, 3) natural logarithm of the standard deviations along the three axes.
    quaternions: (n, 4) w, x, y, z, not necessarily of unit length. opacity_logits: (n,). All float32.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray

    @property
    def opacities(self) -> np.ndarray:
        """(n,) in 0..1."""
        return 1.0 / (1.0 + np.exp(-self.opacity_logits))

    @property
    def scales(self) -> np.ndarray:
        """(n, 3) standard deviations along the axes, unit-cube units."""
        return np.exp(self.log_scales)

    def directions(self) -> np.ndarray:
        """(n, 3) unit vectors along the axis of the largest scale (paper 3.2: principal direction), sign arbitrary."""
        axes = rotation_matrices(self.quaternions)
        return np.take_along_axis(axes, self.log_scales.argmax(axis=1)[:, None, None], axis=2)[:, :, 0]


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """(n, 4) w, x, y, z of any length -> (n, 3, 3); column j is the j-th axis of the Gaussian in the world."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def logit(opacity: float) -> float:
    """Inverse of the logistic function."""
    return np.log(opacity / (1.0 - opacity))


def start_gaussians(points: np.ndarray, generator: np.random.Generator, scale: float, opacity: float) -> Gaussians:
    """Gaussians at given points, as the supplement starts them: constant scale and opacity, random unit quaternions.

    points: (n, 3) unit-cube units. generator: numpy.random.Generator. scale: unit-cube units. opacity: 0..1.
    """
    count = len(points)
    quaternions = generator.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Gaussians(
        means=np.asarray(points, dtype=np.float32),
        log_scales=np.full((count, 3), np.log(scale), dtype=np.float32),
        quaternions=quaternions.astype(np.float32),
        opacity_logits=np.full(count, logit(opacity), dtype=np.float32),
    )


def orient_gaussians(
    points: np.ndarray, directions: np.ndarray, along: float | np.ndarray, across: float | np.ndarray, opacity: float
) -> Gaussians:
    """Gaussians at (n, 3) points with their first axis along (n, 3) unit `directions`.

    along, across: standard deviations along that axis and across it, (n,) or of all, unit-cube units. opacity: 0..1.
    """
    count = len(points)
    scales = np.stack([np.broadcast_to(scale, count) for scale in (along, across, across)], axis=1)
    # The shortest rotation from the x axis to the direction; for the opposite direction, half a turn about z.
    x_axis = np.array([1.0, 0.0, 0.0])
    quaternions = np.concatenate([1 + directions @ x_axis[:, None], np.cross(x_axis, directions)], axis=1)
    quaternions[quaternions[:, 0] < 1e-6] = [0.0, 0.0, 0.0, 1.0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Gaussians(
        means=np.asarray(points, dtype=np.float32),
        log_scales=np.log(scales).astype(np.float32),
        quaternions=quaternions.astype(np.float32),
        opacity_logits=np.full(count, logit(opacity), dtype=np.float32),
    )


def round_capacity(count: int) -> int:
    """The smallest power of two that holds `count`, and at least MIN_CAPACITY."""
    return max(MIN_CAPACITY, 1 << int(np.ceil(np.log2(max(count, 1)))))


class GaussianFields:
    """Taichi fields of the parameters, their gradients, Adam's moments and the accumulated positional gradient.

    Only the first `count` of `capacity` entries are in use. `real` is ti.f32, or ti.f64 for proofs.
    """

    ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits")

    def __init__(self, capacity: int, real: Any = ti.f32) -> None:
        self.capacity, self.real, self.count = capacity, real, 0
        self.means = ti.Vector.field(3, real, shape=capacity, needs_grad=True)
        self.log_scales = ti.Vector.field(3, real, shape=capacity, needs_grad=True)
        self.quaternions = ti.Vector.field(4, real, shape=capacity, needs_grad=True)
        self.opacity_logits = ti.field(real, shape=capacity, needs_grad=True)
        self.first_moments = ti.Vector.field(11, real, shape=capacity)
        self.second_moments = ti.Vector.field(11, real, shape=capacity)
        self.positional_gradients = ti.field(real, shape=capacity)  # sum of |d loss / d pixel| since the last reset

    def _put(self, field: ti.Field, values: np.ndarray) -> None:
        dtype = np.float64 if self.real == ti.f64 else np.float32
        whole = np.zeros((self.capacity, *values.shape[1:]), dtype)
        whole[: len(values)] = values
        field.from_numpy(whole)

    def load(
        self, gaussians: Gaussians, first_moments: np.ndarray | None = None, second_moments: np.ndarray | None = None
    ) -> None:
        """Fill from NumPy; moments (n, 11) continue an optimisation, without them Adam starts anew."""
        assert len(gaussians) <= self.capacity, (len(gaussians), self.capacity)
        self.count = len(gaussians)
        fresh = np.zeros((self.count, 11))
        for name in self.ARRAYS:
            self._put(getattr(self, name), getattr(gaussians, name))
        self._put(self.first_moments, fresh if first_moments is None else first_moments)
        self._put(self.second_moments, fresh if second_moments is None else second_moments)
        self.positional_gradients.fill(0)
        for name in self.ARRAYS:
            getattr(self, name).grad.fill(0)

    def gaussians(self) -> Gaussians:
        """The parameters in use, as NumPy."""
        return Gaussians(*(getattr(self, name).to_numpy()[: self.count] for name in self.ARRAYS))

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Adam's two moments in use, (n, 11) each."""
        return self.first_moments.to_numpy()[: self.count], self.second_moments.to_numpy()[: self.count]
