"""What shapes cost in BIC: free parameters of each kind, and what one observation can cost at most."""

from typing import TYPE_CHECKING

from taichi_edges.geometry.shapes import Shape, Spline

if TYPE_CHECKING:
    from taichi_edges.fitting.arcs import Arc

LINE_PRICE, ARC_PRICE = 5, 8  # free parameters: a line and where it ends; an arc, which has a plane and a bend as well
OUTLIER = 9.0  # squared noises that one observation can cost: three standard deviations
PRICES = {"line": 6, "arc": 9, "circle": 6, "elliptic_arc": 10, "ellipse": 8}  # free parameters, with those of the ends
CUBIC_PRICE, NEXT_CUBIC_PRICE = 12, 6  # of a cubic, and of one more in a smooth chain
MOST_CUBICS = 4  # of an open chain


def price_of_arc(arc: "Arc") -> int:
    """Free parameters of a line or an arc with its ends."""
    return LINE_PRICE if arc.curvature == 0 else ARC_PRICE


def price_of(shape: Shape) -> int:
    """Number of free parameters of a shape, with its ends."""
    if isinstance(shape, Spline):
        return CUBIC_PRICE + NEXT_CUBIC_PRICE * (len(shape.curves) - 1)
    return PRICES[shape.kind]
