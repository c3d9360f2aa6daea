"""Lines that the points have missed: the images show an edge from one vertex to another.

Points are thinned out and clustered, and an edge of a few pixels has hardly any. But when its two ends are known, from
the other edges that meet there, nothing is left to guess: the edgels between them, which no other edge owns, decide.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.evidence.edge_support import Claims, claims_of, support_along
from taichi_edges.evidence.lying import EdgelsAbout, steadiness
from taichi_edges.fitting.distances import distances_to, pairs_within
from taichi_edges.geometry.shapes import Line, Shape, bounds_of, near_bounds
from taichi_edges.geometry.wireframe import Edge, Wireframe

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching

LONGEST_PX = 60.0  # a longer edge has points of its own
SHORTEST_PX = 4.0
CLEAR_PX = 2.0  # next to a vertex the edgels are those of the others
SHOWN = 0.9  # of the places between, in enough views
ON_PX, ABOUT_PX = 0.5, 3.0  # from a line: on it, about it
STEADY = 0.6  # a contour that passes by at random lies on the line a sixth of the time
MOST_PAIRS = 20_000  # the nearest ones, so that a large scene does not take long


def completed(wireframe: Wireframe, matching: "EdgelMatching") -> tuple[Wireframe, int]:
    """The Wireframe with the missing lines, and how many there were. matching: EdgelMatching."""
    pixels = matching.pixel_at(wireframe.vertices)
    pairs = open_pairs(wireframe, pixels)
    if not len(pairs):
        return wireframe, 0
    claims, found = claims_of(matching, wireframe.shapes), []
    for first, second in pairs.tolist():
        line = Line(wireframe.vertices[[first, second]])
        places = clear_places(line, pixels[[first, second]].mean())
        views = support_along(matching, line, places, claims)
        if (views >= matching.least_views).mean() >= SHOWN and steadiness_of_line(
            matching, line, places, claims
        ) >= STEADY:
            found.append((float(views.mean()), first, second))
    edges = list(wireframe.edges)
    for _, first, second in sorted(found, reverse=True):
        line, pixel = Line(wireframe.vertices[[first, second]]), pixels[[first, second]].mean()
        others = np.delete(wireframe.vertices, [first, second], axis=0)
        passes = len(others) and distances_to(line, others).min() <= pixel  # two lines meet there, if any
        if not passes and not repeats(line, [edge.shape for edge in edges], pixel):
            edges.append(Edge(line, (first, second)))
    return Wireframe(wireframe.vertices, tuple(edges), wireframe.contacts), len(edges) - len(wireframe)


def repeats(line: Line, shapes: Sequence[Shape], pixel: float) -> bool:
    """Does a line lie within a pixel of some edge on its whole length? An edge that is not adjusted yet may be off."""
    places = line.at(np.linspace(0.0, 1.0, 5))
    near = near_bounds(bounds_of(shapes), places, pixel)
    return any((distances_to(shapes[number], places) <= pixel).all() for number in near)


def steadiness_of_line(matching: "EdgelMatching", line: Line, places: np.ndarray, claims: Claims) -> float:
    """Share of the edgels about a line, of those that nothing else explains, that lie on it.

    A chord across a rounded corner is followed by the occluding contour in some views, and missed by it in others.
    """
    found = EdgelsAbout.of(matching, line.at(places), line.tangents(places), ABOUT_PX)
    free = np.append(claims.owners < 0, False)[found.edgels]
    return steadiness((free & found.within(ON_PX)).sum(), free.sum())


def open_pairs(wireframe: Wireframe, pixels: np.ndarray) -> np.ndarray:
    """(k, 2) pairs of vertices that are near each other, in which edges meet, and that no edge joins.

    pixels: (V,) size of one at each vertex.
    """
    pairs = pairs_within(wireframe.vertices, LONGEST_PX * pixels)
    lengths = np.linalg.norm(wireframe.vertices[pairs[:, 0]] - wireframe.vertices[pairs[:, 1]], axis=1)
    joined = {tuple(sorted(edge.vertices)) for edge in wireframe.edges if edge.vertices}
    new = np.array([tuple(sorted(pair)) not in joined for pair in pairs.tolist()], dtype=bool)
    good = new & (lengths >= SHORTEST_PX * pixels[pairs].mean(axis=1)) & (wireframe.degrees[pairs] >= 2).all(axis=1)
    order = np.lexsort((pairs[good, 1], pairs[good, 0], lengths[good]))
    return pairs[good][order][:MOST_PAIRS]


def clear_places(line: Line, pixel: float) -> np.ndarray:
    """(n,) parameters a pixel apart, clear of the ends of a line."""
    margin = min(CLEAR_PX * pixel / line.length, 0.3)
    return np.linspace(margin, 1 - margin, max(int(line.length / pixel * (1 - 2 * margin)), 2) + 1)
