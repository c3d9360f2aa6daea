"""From single edges to a wireframe: connected, minimal, in agreement with the images."""

from dataclasses import dataclass
from functools import partial

from taichi_edges.edges.continuation import continued
from taichi_edges.edges.evidence import support_along
from taichi_edges.edges.junctions import connected
from taichi_edges.edges.model_selection import Yardstick
from taichi_edges.kernels.edgel_matching import EdgelMatching

NOISE_PX = 0.2  # by which a place on an edge may be off its shape, at least: next to other edges every detector is
STRETCH_PX = 4.0  # length of an edge on which the errors go together


@dataclass(frozen=True)
class RefineCounts:
    """What the refinement did."""

    circles: int = 0
    joined: int = 0
    duplicates: int = 0
    unsupported: int = 0


def refine_wireframe(loose, views, config):
    """The Wireframe of `loose` edges, in the unit cube, and RefineCounts.

    views: Views. config: the scene's `refine` section. ti.init must have been called.
    """
    if not config.enabled or not len(loose):
        return loose, RefineCounts()
    matching = EdgelMatching(views)
    yardstick = Yardstick(NOISE_PX * matching.pixel, STRETCH_PX * matching.pixel)
    shapes, merging = continued(loose.shapes, yardstick, matching.pixel, partial(support_along, matching))
    wireframe = connected(shapes, matching.pixel)
    return wireframe, RefineCounts(merging.circles, merging.joined, merging.duplicates)
