"""Free curves that lines and arcs have cut to pieces, put together again.

Arcs claim points first, and a bit of any smooth curve is nearly an arc. Where graph traversal finds one chain whose
points a smooth chain of cubics describes better than the lines and arcs do, the curve it is. "Better" is BIC, as in
`merging`, over all points of the chain: one that no piece comes near counts as an outlier of theirs.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.fitting.cubic_chains import fewest_cubics, fit_chain, nearest_on_chain
from taichi_edges.fitting.prices import OUTLIER, price_of_arc, price_of_cubics
from taichi_edges.strokes.arc_growth import INLIER, Cloud
from taichi_edges.strokes.branches import separate_branches
from taichi_edges.strokes.cluster_fits import POINTS_PER_PIECE
from taichi_edges.strokes.clustering import grow_clusters
from taichi_edges.strokes.neighbors import members_of_clusters
from taichi_edges.strokes.ordering import order_points

if TYPE_CHECKING:
    from taichi_edges.scene.settings import ClusterConfig
    from taichi_edges.strokes.merging import Piece

WITHIN = 0.9  # of a piece's points, which must be the chain's for the piece to be one of its own


def free_curves(cloud: Cloud, pieces: "Sequence[Piece]", config: "ClusterConfig") -> tuple[list[np.ndarray], set[int]]:
    """The point indices of every free curve, and the set of the numbers of the pieces that these replace.

    cloud: Cloud. pieces: list of Pieces. config: the scene's `cluster` section. A chain that runs on into a piece it
    does not cover leaves that its points: it explains them already.
    """
    curves: list[np.ndarray] = []
    replaced: set[int] = set()
    piece_at = np.full(len(cloud.points), -1)
    for number, piece in enumerate(pieces):
        piece_at[piece.own] = number
    traversed = grow_clusters(cloud.points, cloud.directions, config)
    for members in members_of_clusters(separate_branches(cloud.points, traversed, config.min_points)):
        inside = zip(*np.unique(piece_at[members], return_counts=True), strict=True)
        own = [number for number, count in inside if number >= 0 and count >= WITHIN * len(pieces[number].own)]
        members = members[np.isin(piece_at[members], [-1, *own])]
        if len(own) >= 2 and not any(pieces[number].closed for number in own):  # a circle is no part of a chain
            cost = cost_of_pieces(cloud, [pieces[number] for number in own], members)
            if cost_of_chain(cloud, members, cost) < cost:
                curves.append(members)
                replaced.update(own)
    return curves, replaced


def cost_of_pieces(cloud: Cloud, pieces: "Sequence[Piece]", members: np.ndarray) -> float:
    """BIC of the pieces as a description of the points in `members`."""
    best = np.full(len(members), OUTLIER)
    for piece in pieces:
        if piece.arc is not None:
            distances = np.linalg.norm(piece.arc.coordinates(cloud.points[members])[1], axis=1)
        else:
            distances, _ = nearest_on_chain(cloud.points[members], piece.chain)
        mine = np.isin(members, piece.members)
        best[mine] = np.minimum(best[mine], (distances[mine] / cloud.scale.noise) ** 2)
    return best.sum() + sum(price_of_piece(piece) for piece in pieces) * np.log(len(members))


def price_of_piece(piece: "Piece") -> int:
    """Number of free parameters of a Piece."""
    if piece.arc is not None:
        return price_of_arc(piece.arc)
    return price_of_cubics(len(piece.chain))


def cost_of_chain(cloud: Cloud, members: np.ndarray, worth: float) -> float:
    """BIC of the best smooth chain of cubics through the points in `members`, if it can be below `worth`; else inf."""
    points, best = cloud.points[members], np.inf
    ordering = order_points(points)
    first = fewest_cubics(points, ordering)
    for cubics in sorted({first, first + 1, first + 2, 2 * first, 3 * first}):
        price_of_all = price_of_cubics(cubics) * np.log(len(members))
        if POINTS_PER_PIECE * cubics > len(points) or price_of_all >= min(worth, best):
            break
        curves, _ = fit_chain(points, ordering, INLIER * cloud.scale.noise, cubics)
        distances, _ = nearest_on_chain(points, curves)
        best = min(best, price_of_all + np.minimum((distances / cloud.scale.noise) ** 2, OUTLIER).sum())
    return best
