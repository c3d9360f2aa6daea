"""Edges and occluding contours told apart by where their edgels lie as the viewpoint moves.

The contour of a smooth surface is where viewing rays touch it. As the viewpoint turns by an angle t about a surface of
radius rho, the contour leaves any line in space by rho (1 - cos t), a parabola at first: it lies on the line in some
views and near it in the views before and after. An edge stays; where it is hidden or faint it has no edgels at all. So
of the edgels near a line that no better established edge explains, the share that lies on it counts. A parabola spends
at most sqrt(2 / (ABOUT + 1)) = 0.53 of its way through a window within 1 / ABOUT of that window's half width.

What is independent are the views, not the edgels beside each other in one view. The share is tested by a likelihood
ratio: a line that few views see must be the steadier, and one whose edgels others explain has no evidence at all.
From similar directions even a contour looks steady: a line must be seen from directions LEAST_ANGLE apart.
"""

from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.evidence.lying import EdgelsAbout
from taichi_edges.strokes.neighbors import members_of_clusters

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching
    from taichi_edges.evidence.explaining import Explained
    from taichi_edges.scene.settings import FilterConfig
    from taichi_edges.strokes.clusters import Clusters
    from taichi_edges.views.views import Views

ABOUT = 6.0  # an edgel is near a line within so many times the distance at which it is on it
OWNED_PX = 1.0  # an edge explains the edgels so near to it
CONTOUR_SHARE = 0.45  # of a contour's edgels near a line that lie on it; those of pipes and blades: 0.3 .. 0.55
CHANCE_SHARE = 0.38  # the same where no single contour can be what is seen, only edgels that happen to be near
ROUNDS = 2  # what is no edge is looked at again when all edges have taken their edgels
# Over an angle to either side of their mean a contour moves by half the radius times its square: from directions within
# this, one of 15 pixels stays within the half pixel in which edgels are on a line.
LEAST_ANGLE = np.radians(15.0)
WIDE_ANGLE = np.radians(45.0)  # seen over so much to either side, only a contour of 5 pixels stays near
LEAST_DOUBT = 1e-6  # of a share, from 0 and 1


def without_contours(
    clusters: "Clusters", explained: "Explained | None", views: "Views", config: "FilterConfig"
) -> "tuple[Clusters, int]":
    """The Clusters without what are no edges but contours, and the number of these. Arguments as for `steady_edges`.

    explained: None where nothing is known of the points' edgels; then all stays. config: the scene's `filter` section.
    """
    from taichi_edges.evidence.edgel_matching import EdgelMatching

    if explained is None or not config.min_evidence:
        return clusters, 0
    tests = config.min_evidence, np.radians(config.min_angle)
    edges = steady_edges(EdgelMatching(views), clusters, explained, *tests)
    return clusters.keep(edges), int((~edges).sum())


def steady_edges(
    matching: "EdgelMatching", clusters: "Clusters", explained: "Explained", least: float, angle: float = LEAST_ANGLE
) -> np.ndarray:
    """(m,) bool: the clusters that are edges, and not where contours pass by.

    matching: EdgelMatching. clusters: Clusters. explained: Explained of their points. least: log likelihood ratio from
    which on a cluster is an edge. angle: radians, see the module's first lines.
    Those whose points own the largest share of their views come first, and explain their edgels.
    """
    members_of, tight = members_of_clusters(clusters.labels), explained.tight_px
    about = EdgelsAbout.of(matching, clusters.points, clusters.directions, max(ABOUT * tight, OWNED_PX))
    edgels = np.where(about.within(ABOUT * tight), about.edgels, -1)
    on, owned = about.within(tight), about.within(OWNED_PX)
    order = np.argsort([-explained.support[members].mean() for members in members_of], kind="stable")
    spread = np.array([np.median(explained.spread[members]) for members in members_of])  # squared sines
    order = order[spread[order] >= np.sin(angle) ** 2]
    usual = np.where(spread >= np.sin(WIDE_ANGLE) ** 2, CHANCE_SHARE, CONTOUR_SHARE)
    free, edges = np.ones(len(matching.edgels) + 1, bool), np.zeros(len(members_of), bool)
    free[-1] = False
    for _ in range(ROUNDS):
        for number in order[~edges[order]]:
            members = members_of[number]
            counted = free[edgels[members]]
            views_on, views_about = (some.sum() / len(members) for some in (counted & on[members], counted))
            if likelihood_ratio(views_on, views_about, usual[number]) > least:
                edges[number] = True
                free[matching.neighbors[edgels[members][owned[members]]]] = False
    return edges


def likelihood_ratio(on: float, about: float, usual: float) -> float:
    """Log likelihood ratio of an edge over what is none, which has no more than the `usual` share of its edgels on it.

    on, about: numbers of views. The share of an edge is not known, so it is what it is found to be.
    """
    share = np.clip(on / max(about, LEAST_DOUBT), LEAST_DOUBT, 1 - LEAST_DOUBT)
    if share <= usual:
        return 0.0
    return about * (share * np.log(share / usual) + (1 - share) * np.log((1 - share) / (1 - usual)))
