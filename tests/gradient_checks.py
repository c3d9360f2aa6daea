"""Gradients read from the device and compared with those of a twin, and neighbours for the regularisers."""

import numpy as np
from reference_splatting import PARAMETERS

from taichi_edges.splatting.gaussians import Gaussians

NEIGHBORS = 4


def gradients(splatter):
    """The gradients on the device, as Gaussians."""
    fields = splatter.fields
    return Gaussians(*(getattr(fields, name).grad.to_numpy()[: fields.count] for name in PARAMETERS))


def assert_gradients(actual, expected, tolerance):
    for name in PARAMETERS:
        scale = np.abs(getattr(expected, name)).max(initial=0)
        np.testing.assert_allclose(
            getattr(actual, name), getattr(expected, name), rtol=0, atol=tolerance * scale, err_msg=name
        )


def random_neighbors(count, generator):
    """(n, NEIGHBORS) indices of others, some of them neighbours of many, some of none."""
    popular = generator.integers(0, max(count // 3, 1), (count, NEIGHBORS))
    return np.where(popular == np.arange(count)[:, None], (popular + 1) % count, popular)
