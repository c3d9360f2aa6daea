"""Edges and occluding contours told apart by where their edgels lie as the viewpoint moves.

The contour of a smooth surface is where viewing rays touch it. As the viewpoint turns by an angle t about a surface of
radius rho, the contour leaves any line in space by rho (1 - cos t), a parabola at first: it lies on the line in some
views and near it in the views before and after. An edge stays; where it is hidden or faint it has no edgels at all. So
of the edgels near a line that no better established edge explains, the share that lies on it counts. A parabola spends
at most sqrt(2 / (NEAR + 1)) = 0.53 of its way through a window within 1 / NEAR of that window's half width.

What is independent are the views, not the edgels beside each other in one view. The share is tested by a likelihood
ratio: a line that few views see must be the steadier, and one whose edgels others explain has no evidence at all.
From similar directions even a contour looks steady: a line must be seen from directions LEAST_ANGLE apart.
"""

from dataclasses import dataclass

import numpy as np

from taichi_edges.strokes.neighbors import members_of_clusters

NEAR = 6.0  # an edgel is near a line within so many times the distance at which it is on it
OWNED_PX = 1.0  # an edge explains the edgels so near to it
CONTOUR_SHARE = 0.45  # of a contour's edgels near a line that lie on it; those of pipes and blades: 0.3 .. 0.55
CHANCE_SHARE = 0.38  # the same where no single contour can be what is seen, only edgels that happen to be near
ROUNDS = 2  # what is no edge is looked at again when all edges have taken their edgels
# Over an angle to either side of their mean a contour moves by half the radius times its square: from directions within
# this, one of 15 pixels stays within the half pixel in which edgels are on a line.
LEAST_ANGLE = np.radians(15.0)
WIDE_ANGLE = np.radians(45.0)  # seen over so much to either side, only a contour of 5 pixels stays near
LEAST_DOUBT = 1e-6  # of a share, from 0 and 1


@dataclass(frozen=True)
class Sightings:
    """The edgels that points have near them in every view.

    edgels: (n, v) indices into Edgels, -1 where there is none. on, owned: (n, v) bool, those that lie on the point,
    and those near enough to be explained by it.
    """

    edgels: np.ndarray
    on: np.ndarray
    owned: np.ndarray

    @staticmethod
    def of(matching, points, directions, tight_px):
        """Sightings of oriented points. tight_px: residual up to which an edgel lies on a point."""
        views = slice(0, matching.edgels.view_count)
        edgels, residuals, _ = matching.matches(points, directions, views, max(NEAR * tight_px, OWNED_PX))
        there, offsets = edgels >= 0, np.abs(residuals)
        edgels = np.where(there & (offsets <= NEAR * tight_px), edgels, -1)
        return Sightings(edgels, there & (offsets <= tight_px), there & (offsets <= OWNED_PX))

    def views_of(self, members, free):
        """In how many views the edgels of an average member lie on it, and are near it; only those that are `free`.

        members: (k,) point indices. free: (e + 1,) bool, of every edgel; the last one stands for no edgel.
        """
        counted = free[self.edgels[members]]
        return (counted & self.on[members]).sum() / len(members), counted.sum() / len(members)


def without_contours(clusters, explained, views, config):
    """The Clusters without what are no edges but contours, and the number of these. Arguments as for `steady_edges`.

    explained: None where nothing is known of the points' edgels; then all stays. config: the scene's `filter` section.
    """
    from taichi_edges.evidence.edgel_matching import EdgelMatching

    if explained is None or not config.min_evidence:
        return clusters, 0
    tests = config.min_evidence, np.radians(config.min_angle)
    edges = steady_edges(EdgelMatching(views), clusters, explained, *tests)
    return clusters.keep(edges), int((~edges).sum())


def steady_edges(matching, clusters, explained, least, angle=LEAST_ANGLE):
    """(m,) bool: the clusters that are edges, and not where contours pass by.

    matching: EdgelMatching. clusters: Clusters. explained: Explained of their points. least: log likelihood ratio from
    which on a cluster is an edge. angle: radians, see the module's first lines.
    Those whose points own the largest share of their views come first, and explain their edgels.
    """
    members_of = members_of_clusters(clusters.labels)
    sightings = Sightings.of(matching, clusters.points, clusters.directions, explained.tight_px)
    order = np.argsort([-explained.support[members].mean() for members in members_of], kind="stable")
    spread = np.array([np.median(explained.spread[members]) for members in members_of])  # squared sines
    order = order[spread[order] >= np.sin(angle) ** 2]
    usual = np.where(spread >= np.sin(WIDE_ANGLE) ** 2, CHANCE_SHARE, CONTOUR_SHARE)
    free, edges = np.ones(len(matching.edgels) + 1, bool), np.zeros(len(members_of), bool)
    free[-1] = False
    for _ in range(ROUNDS):
        for number in order[~edges[order]]:
            members = members_of[number]
            if evidence(*sightings.views_of(members, free), usual[number]) > least:
                edges[number] = True
                explains = sightings.edgels[members][sightings.owned[members]]
                free[matching.neighbors[explains]] = False
    return edges


def evidence(on, near, usual):
    """Log likelihood ratio of an edge over what is none, which has no more than the `usual` share of its edgels on it.

    on, near: numbers of views. The share of an edge is not known, so it is what it is found to be.
    """
    share = np.clip(on / max(near, LEAST_DOUBT), LEAST_DOUBT, 1 - LEAST_DOUBT)
    if share <= usual:
        return 0.0
    return near * (share * np.log(share / usual) + (1 - share) * np.log((1 - share) / (1 - usual)))
