"""Statistics that outliers do not spoil.

The robust weight is that of Geman and McClure: the larger a residual, the less it counts, and outliers hardly at all.
"""

from typing import TypeVar

import numpy as np

NORMAL_MAD = 1.4826  # standard deviations for each median absolute deviation, of a normal distribution

Numbers = TypeVar("Numbers", float, np.ndarray)


def geman_mcclure(squared: Numbers, strength: Numbers | float = 1.0) -> Numbers:
    """strength / (1 + squared)^2. squared: residuals over the scale, squared; at the scale the weight is a quarter.

    Of numbers or arrays; Taichi compiles it as well.
    """
    return strength / (1.0 + squared) ** 2


def widening(squared: Numbers) -> Numbers:
    """By how much that weight widens the standard deviation of a residual: geman_mcclure^(-1/2)."""
    return 1.0 + squared
