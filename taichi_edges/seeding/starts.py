"""Where the Gaussians start."""

from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.seeding.voting import vote_seeds
from taichi_edges.splatting.gaussians import Gaussians, orient_gaussians

if TYPE_CHECKING:
    from taichi_edges.views.views import Views

ALONG_PX, ACROSS_PX = 2.0, 0.7  # standard deviations of a voted Gaussian, in pixels at the scene
LEAST_VOTED = 50  # fewer seeds than this are no start


def random_points(count: int, box: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """(count, 3) points uniform in the box (2, 3): the supplement's start for textureless objects."""
    box = np.asarray(box, dtype=np.float64)
    return box[0] + generator.random((count, 3)) * (box[1] - box[0])


def given_points(points: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """At most `count` of the (n, 3) given points, drawn without repetition where there are more."""
    if len(points) <= count:
        return points
    return points[np.sort(generator.choice(len(points), count, replace=False))]


def voted_gaussians(
    views: "Views", edge_threshold: float, count: int, opacity: float, generator: np.random.Generator
) -> Gaussians | None:
    """At most `count` Gaussians where many views agree that an edge passes, laid along it; None if too few.

    ti.init must have been called. edge_threshold: of full scale. opacity: 0..1.
    """
    seeds = vote_seeds(views, edge_threshold, generator, count)
    if len(seeds.points) < min(LEAST_VOTED, count):
        return None
    along, across = ALONG_PX * seeds.pixel, ACROSS_PX * seeds.pixel
    return orient_gaussians(seeds.points, seeds.directions, along, across, opacity)
