"""What shapes cost in BIC: free parameters of each kind, and what one observation can cost at most."""

from typing import TYPE_CHECKING

from taichi_edges.geometry.shapes import Shape, Spline

if TYPE_CHECKING:
    from taichi_edges.fitting.arcs import Arc

OUTLIER = 9.0  # squared noises that one observation can cost: three standard deviations
# Free parameters, as `refinement/charts.py` has them: a line has its two ends, an arc its middle across the chord too.
PRICES = {"line": 6, "arc": 8, "circle": 6, "elliptic_arc": 10, "ellipse": 8, "spline": 12}
SHARED_PLACE = 3  # of these, of each shape that begins where another ends
NEXT_CUBIC_PRICE = 6  # of one more cubic in a spline, which is smooth
MOST_CUBICS = 4  # of an open chain


def price_of_arc(arc: "Arc") -> int:
    """Free parameters of a line, an arc or a circle."""
    return PRICES["line" if arc.curvature == 0 else "circle" if arc.closed else "arc"]


def price_of_cubics(count: int) -> int:
    """Free parameters of a smooth chain of cubics."""
    return PRICES["spline"] + NEXT_CUBIC_PRICE * (count - 1)


def price_of(shape: Shape) -> int:
    """Free parameters of a shape."""
    return price_of_cubics(len(shape.curves)) if isinstance(shape, Spline) else PRICES[shape.kind]
