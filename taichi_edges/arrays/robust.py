"""The robust weight of Geman and McClure: the larger a residual, the less it counts, and outliers hardly at all."""


def geman_mcclure(squared, strength=1.0):
    """strength / (1 + squared)^2. squared: residuals over the scale, squared; at the scale the weight is a quarter.

    Of numbers or arrays; a Taichi function as it stands.
    """
    return strength / (1.0 + squared) ** 2


def widening(squared):
    """By how much that weight widens the standard deviation of a residual: geman_mcclure^(-1/2)."""
    return 1.0 + squared
