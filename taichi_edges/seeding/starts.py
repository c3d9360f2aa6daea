"""Where the Gaussians start."""

from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.splatting.gaussians import Gaussians, orient_gaussians

if TYPE_CHECKING:
    from taichi_edges.seeding.tracing import Strokes

ALONG_PX, ACROSS_PX = 2.0, 0.7  # standard deviations of a Gaussian laid along an edge
LEAST_SEEDS = 50  # fewer are no start


def random_points(count: int, box: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """(count, 3) points uniform in the box (2, 3): the supplement's start for textureless objects."""
    box = np.asarray(box, dtype=np.float64)
    return box[0] + generator.random((count, 3)) * (box[1] - box[0])


def given_points(points: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """At most `count` of the (n, 3) given points, drawn without repetition where there are more."""
    if len(points) <= count:
        return points
    return points[np.sort(generator.choice(len(points), count, replace=False))]


def stroke_gaussians(
    strokes: "Strokes", pixels: np.ndarray, count: int, opacity: float
) -> tuple[Gaussians, np.ndarray]:
    """Gaussians laid along Strokes, at most `count`, evenly; and (n,) the stroke of each.

    pixels: size of a pixel at each point of the strokes, unit-cube units. opacity: 0..1.
    """
    chosen = slice(None, None, max(-(-len(strokes) // count), 1))
    some, pixels = strokes.keep(chosen), pixels[chosen]
    laid = orient_gaussians(some.points, some.directions, ALONG_PX * pixels, ACROSS_PX * pixels, opacity)
    return laid, some.numbers
