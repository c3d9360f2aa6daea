"""What shapes cost in BIC: free parameters of each kind, and what one observation can cost at most."""

from typing import TYPE_CHECKING

from taichi_edges.geometry.shapes import Shape, Spline

if TYPE_CHECKING:
    from taichi_edges.fitting.arcs import Arc

OUTLIER = 9.0  # squared noises that one observation can cost: three standard deviations
# Free parameters of whole edges: a line has its two ends, an arc is counted as three points.
PRICES = {"line": 6, "arc": 9, "circle": 6, "elliptic_arc": 10, "ellipse": 8}
# Among points, stretches follow each other: where one ends the next begins, so of the two ends one costs. Both tables
# charge three for a bend, and so choose alike between a line and an arc.
LINE_PRICE, ARC_PRICE = PRICES["line"] - 1, PRICES["arc"] - 1
CUBIC_PRICE, NEXT_CUBIC_PRICE = 12, 6  # of a cubic, and of one more in a smooth chain; as a whole edge and among points
MOST_CUBICS = 4  # of an open chain


def price_of_arc(arc: "Arc") -> int:
    """Free parameters of a line or an arc among points."""
    return LINE_PRICE if arc.curvature == 0 else ARC_PRICE


def price_of_cubics(count: int) -> int:
    """Free parameters of a smooth chain of cubics."""
    return CUBIC_PRICE + NEXT_CUBIC_PRICE * (count - 1)


def price_of(shape: Shape) -> int:
    """Free parameters of a shape that is a whole edge."""
    if isinstance(shape, Spline):
        return price_of_cubics(len(shape.curves))
    return PRICES[shape.kind]
