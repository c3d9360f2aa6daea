"""From single edges to a wireframe: connected, minimal, in agreement with the images."""

from dataclasses import dataclass


@dataclass(frozen=True)
class RefineCounts:
    """What the refinement did."""

    unsupported: int = 0


def refine_wireframe(loose, views, config):
    """The Wireframe of `loose` edges, in the unit cube, and RefineCounts.

    views: Views. config: the scene's `refine` section. ti.init must have been called.
    """
    return loose, RefineCounts()
