"""Linear light and the sRGB values that encode it."""

import numpy as np
from numpy.typing import ArrayLike

# sRGB (IEC 61966-2-1): values up to SRGB_LINEAR are SRGB_SLOPE times the light, those above a power of it.
SRGB_LINEAR, SRGB_SLOPE, SRGB_OFFSET, SRGB_POWER = 0.04045, 12.92, 0.055, 2.4


def light_of_srgb(values: ArrayLike) -> np.ndarray:
    """Linear light, float32, of sRGB-encoded values in 0..1."""
    values = np.asarray(values, np.float32)
    power = ((values + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** SRGB_POWER
    return np.where(values <= SRGB_LINEAR, values / SRGB_SLOPE, power).astype(np.float32)


def srgb_of_light(light: ArrayLike) -> np.ndarray:
    """sRGB-encoded values, float32 0..1, of linear light."""
    light = np.clip(np.asarray(light, np.float32), 0.0, 1.0)
    power = (1 + SRGB_OFFSET) * light ** (1 / SRGB_POWER) - SRGB_OFFSET
    return np.where(light <= SRGB_LINEAR / SRGB_SLOPE, light * SRGB_SLOPE, power).astype(np.float32)
