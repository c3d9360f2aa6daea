"""Where viewing rays pass through the scene box."""

import numpy as np


def through_box(origin: np.ndarray, rays: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where (n, 3) rays enter and leave the box (2, 3), (n,) in multiples of them; not in order where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):  # along a side: infinite; in a side: NaN, which is not inside
        sides = (box[:, None] - origin) / rays
    return np.minimum(*sides).max(axis=1), np.maximum(*sides).min(axis=1)
