"""Where edges meet: loose shapes become a Wireframe with shared vertices.

An end may move along its edge, outwards or inwards, by as much as detectors lose near a corner or trace beyond it. Two
ends meet where their edges come nearest within that reach; where they run into each other tangentially, the place is
where their tangents agree. Pairs are joined best first, as long as one point is near to all the edges that meet in it.
An end that meets no other may lie on another edge between that one's ends: a T-junction, a contact. All that is said
in pixels is in those of the place: of several ends in the mean of theirs.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from taichi_edges.fitting.arcs import through_three
from taichi_edges.fitting.cubic_chains import lsq_chain, nearest_on_chain
from taichi_edges.fitting.distances import distances_to, pairs_within
from taichi_edges.fitting.model_selection import PixelAt, track_of
from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline, bounds_of, middles_of, near_bounds
from taichi_edges.geometry.wireframe import Edge, Wireframe

REACH_PX = 8.0  # by which an end may move along its edge
STEP_PX = 0.5  # between the places looked at
MEETING_PX = 1.0  # edges that meet come as near as that
SHARE = 0.4  # of an edge's length: its ends do not move inwards by more
TANGENTIAL = np.cos(np.radians(18.0))  # edges that meet at a smaller angle run into each other
LEVER_PX = 4.0  # how far apart in space two tangents count that differ by a radian
CHAIN_ROUNDS = 3  # in which the places of points on a chain settle
END_WEIGHT = 1e3  # of the ends of a chain against the points between them
FAR_ASIDE_PX, FAR_ALONG_PX = 0.3, 3.0  # usual errors of an end, across and along; pairs that ask for less go first
FRUGAL = 0.05  # weight of the way of an end against the distance that it leaves

Group = dict[int, float]  # ends that meet, indices, and the way of each


@dataclass(frozen=True)
class Reach:
    """The places within reach of one end, side 0 or 1, of the edge of some number.

    pixel: size of one at the end. ways: (m,) outwards along the edge. points, tangents: (m, 3), outwards.
    """

    edge: int
    side: int
    pixel: float
    ways: np.ndarray
    points: np.ndarray
    tangents: np.ndarray


@dataclass(frozen=True)
class Meeting:
    """Two ends, by number. cost: how much it asks for, in usual errors. ways: of the ends. smooth: do they run on?"""

    cost: float
    first: int
    second: int
    ways: tuple[float, float]
    smooth: bool


def connected(shapes: Sequence[Shape], pixel_at: PixelAt) -> Wireframe:
    """The Wireframe of shapes, whose ends meet where they can."""
    ends = [(number, side) for number, shape in enumerate(shapes) if not shape.closed for side in (0, 1)]
    pixels = pixel_at(np.array([shapes[number].ends[side] for number, side in ends]).reshape(-1, 3)).tolist()
    reaches = [reach_of(number, shapes[number], side, own) for (number, side), own in zip(ends, pixels, strict=True)]
    groups = grouped(reaches, meetings(reaches))
    places = [meeting_point([(reaches[end], way) for end, way in group.items()]) for group in groups]
    at = {(reaches[end].edge, reaches[end].side): number for number, group in enumerate(groups) for end in group}
    vertices, contacts = with_contacts(shapes, reaches, groups, np.array(places).reshape(-1, 3))
    edges = []
    for number, (shape, pixel) in enumerate(zip(shapes, pixel_at(middles_of(shapes)).tolist(), strict=True)):
        own = () if shape.closed else (at[number, 0], at[number, 1])
        edges.append(Edge(between(shape, vertices[list(own)], pixel) if own else shape, own))
    return Wireframe(vertices, tuple(edges), contacts)


# ------------------------------------------------------------------------------------------------------------ ends


def reach_of(number: int, shape: Shape, side: int, pixel: float) -> Reach:
    """The Reach of one end of a shape of some number."""
    inwards = min(REACH_PX * pixel, SHARE * shape.length)
    count = round(inwards / (STEP_PX * pixel))
    ways = np.arange(-count, int(REACH_PX / STEP_PX) + 1) * STEP_PX * pixel
    points, tangents = along_end(shape, side, ways)
    return Reach(number, side, pixel, ways, points, tangents)


def pixel_of(reaches: Iterable[Reach]) -> float:
    """Size of a pixel where some ends meet."""
    return float(np.mean([reach.pixel for reach in reaches]))


def along_end(shape: Shape, side: int, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 3) and outward tangents (m, 3) at (m,) ways from an end, positive ones beyond it."""
    sign = 2 * side - 1
    if shape.kind in ("line", "arc"):
        parameters = side + sign * ways / shape.length
        return shape.at(parameters), sign * shape.tangents(parameters)
    grid = np.linspace(0, 1, 257)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(shape.at(grid), axis=0), axis=1))])
    inside = np.minimum(ways, 0.0)
    parameters = np.interp(travelled[-1] * side + sign * inside, travelled, grid)
    tangents = sign * shape.tangents(parameters)
    return shape.at(parameters) + np.maximum(ways, 0.0)[:, None] * tangents, tangents


def meetings(reaches: Sequence[Reach]) -> list[Meeting]:
    """The Meetings of pairs of ends, best first."""
    if len(reaches) < 2:
        return []
    places = np.array([reach.points[reach.ways == 0][0] for reach in reaches])
    found = []
    for i, j in pairs_within(places, np.array([2 * REACH_PX * reach.pixel for reach in reaches])).tolist():
        if reaches[i].edge != reaches[j].edge:
            meeting = meet(i, j, reaches[i], reaches[j])
            if meeting is not None:
                found.append(meeting)
    return sorted(found, key=lambda meeting: (meeting.cost, meeting.first, meeting.second))


def meet(i: int, j: int, first: Reach, second: Reach) -> Meeting | None:
    """The Meeting of two ends, or None where they come not near enough."""
    pixel = pixel_of((first, second))
    apart = np.linalg.norm(first.points[:, None] - second.points, axis=2)
    ways = FRUGAL * (np.abs(first.ways)[:, None] + np.abs(second.ways))
    a, b = np.unravel_index(np.argmin(apart + ways), apart.shape)
    smooth = bool(first.tangents[a] @ second.tangents[b] <= -TANGENTIAL)
    if smooth:
        turned = LEVER_PX * pixel * np.linalg.norm(first.tangents[:, None] + second.tangents, axis=2)
        a, b = np.unravel_index(np.argmin(np.hypot(apart, turned) + ways), apart.shape)
    elif abs(first.tangents[a] @ second.tangents[b]) >= TANGENTIAL:
        return None  # they lie side by side
    if apart[a, b] > MEETING_PX * pixel:
        return None
    cost = float(apart[a, b] / FAR_ASIDE_PX + (abs(first.ways[a]) + abs(second.ways[b])) / FAR_ALONG_PX) / pixel
    return Meeting(cost, i, j, (float(first.ways[a]), float(second.ways[b])), smooth)


def grouped(reaches: Sequence[Reach], found: Iterable[Meeting]) -> list[Group]:
    """The ends that meet, as dicts end -> way; every end is in one of them. found: their Meetings."""
    group_of = {end: {end: 0.0} for end in range(len(reaches))}
    for meeting in found:
        first, second = group_of[meeting.first], group_of[meeting.second]
        if first is second:
            continue
        both = first | second
        for end, way in zip((meeting.first, meeting.second), meeting.ways, strict=True):
            if len(group_of[end]) == 1:
                both[end] = way
        if len({reaches[end].edge for end in both}) < len(both) or not agree(reaches, both):
            continue
        for end in both:
            group_of[end] = both
    return list({id(group): group for group in group_of.values()}.values())


def agree(reaches: Sequence[Reach], group: Group) -> bool:
    """Is one point near enough to all the edges that are to meet in it?"""
    point = meeting_point([(reaches[end], way) for end, way in group.items()])
    near = MEETING_PX * pixel_of(reaches[end] for end in group)
    return all(np.linalg.norm(reaches[end].points - point, axis=1).min() <= near for end in group)


def meeting_point(members: Sequence[tuple[Reach, float]]) -> np.ndarray:
    """(3,) the point nearest to the tangents of some ends, each a Reach and a way."""
    nearest = [int(np.argmin(np.abs(reach.ways - way))) for reach, way in members]
    places = np.array([reach.points[at] for (reach, _), at in zip(members, nearest, strict=True)])
    tangents = np.array([reach.tangents[at] for (reach, _), at in zip(members, nearest, strict=True)])
    if len(places) == 1:
        return places[0]
    across = np.eye(3) - tangents[:, :, None] * tangents[:, None, :]
    middle = places.mean(axis=0)
    pull = (across @ (places - middle)[:, :, None]).sum(axis=0)[:, 0]
    return middle + np.linalg.solve(across.sum(axis=0) + 0.02 * len(places) * np.eye(3), pull)


# -------------------------------------------------------------------------------------------------------- contacts


def with_contacts(
    shapes: Sequence[Shape], reaches: Sequence[Reach], groups: Sequence[Group], vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The vertices, those of free ends moved onto an edge that they touch; and (k, 2) the contacts."""
    vertices, contacts, bounds = vertices.copy(), [], bounds_of(shapes)
    for number, group in enumerate(groups):
        own, pixel = {reaches[end].edge for end in group}, pixel_of(reaches[end] for end in group)
        options = []
        places = reaches[next(iter(group))].points if len(group) == 1 else vertices[number : number + 1]
        for other in near_bounds(bounds, places, MEETING_PX * pixel).tolist():
            if other in own:
                continue
            shape = shapes[other]
            if len(group) == 1:
                touch = touching(shape, reaches[next(iter(group))])
            else:
                distance = float(distances_to(shape, vertices[number : number + 1])[0])
                touch = (distance, vertices[number]) if distance <= MEETING_PX * pixel else None
            if touch is not None and between_ends(shape, touch[1], pixel):
                options.append((touch[0], other, touch[1]))
        if options:
            _, other, vertices[number] = min(options, key=lambda option: option[:2])
            contacts.append((number, other))
    return vertices, np.array(contacts, dtype=np.int64).reshape(-1, 2)


def touching(shape: Shape, reach: Reach) -> tuple[float, np.ndarray] | None:
    """(cost, point) where a free end touches a shape, or None."""
    apart = distances_to(shape, reach.points)
    at = int(np.argmin(apart + FRUGAL * np.abs(reach.ways)))
    if apart[at] > 0.5 * MEETING_PX * reach.pixel:
        return None
    return float(apart[at] + FRUGAL * abs(reach.ways[at])), reach.points[at]


def between_ends(shape: Shape, point: np.ndarray, pixel: float) -> bool:
    """Does a point on a shape lie clear of its ends? Nearer to them, ends meet, or do not."""
    return shape.closed or np.linalg.norm(shape.ends - point, axis=1).min() > 2 * MEETING_PX * pixel


# ------------------------------------------------------------------------------------------------------ new shapes


def between(shape: Shape, ends: np.ndarray, pixel: float) -> Shape:
    """A shape of the same kind from one point to another, near its own ends. ends: (2, 3)."""
    if isinstance(shape, Line):
        return Line(ends)
    if isinstance(shape, Spline):
        return spline_between(shape, ends, pixel)
    return arc_between(shape, ends) if shape.circular else ellipse_between(shape, ends)


def arc_between(shape: EllipticArc, ends: np.ndarray) -> Line | EllipticArc:
    """A circular arc from one point to another through the middle of where it was between them."""
    angles = angles_of(shape, ends)
    middle = shape.at((angles.mean() - shape.low) / (shape.high - shape.low))
    arc = through_three(ends[0], middle, ends[1])
    return Line(ends) if arc is None else arc.shape()


def angles_of(shape: EllipticArc, ends: np.ndarray) -> np.ndarray:
    """(2,) radians of the places of an EllipticArc nearest to two points by its ends."""
    offsets = ends - shape.centre
    angles = np.arctan2(offsets @ shape.axes[1] / shape.radii[1] ** 2, offsets @ shape.axes[0] / shape.radii[0] ** 2)
    near = np.array([shape.low, shape.high])
    return near + (angles - near + np.pi) % (2 * np.pi) - np.pi


def ellipse_between(shape: EllipticArc, ends: np.ndarray) -> EllipticArc:
    """An elliptic arc from one point to another: the ellipse between their angles, sheared to meet them exactly."""
    angles = angles_of(shape, ends)
    middle, half = angles.mean(), 0.5 * (angles[1] - angles[0])
    top = shape.at((middle - shape.low) / (shape.high - shape.low))
    chord = ends.mean(axis=0)
    first, second = (top - chord) / (1 - np.cos(half)), (ends[1] - ends[0]) / (2 * np.sin(half))
    return EllipticArc.conjugate(top - first, np.array([first, second]), -half, half)


def spline_between(shape: Spline, ends: np.ndarray, pixel: float) -> Spline:
    """An open chain of as many cubics from one point to another, along the chain."""
    track = track_of(shape, pixel)
    heading = np.array([shape.tangents(0.0), shape.tangents(1.0)])
    beyond = ((ends - shape.ends) * heading).sum(axis=1)  # by how much the chain grows at its end, shrinks at its start
    inside = (track.arc > beyond[0]) & (track.arc < shape.length + beyond[1])
    points = np.concatenate([ends[:1], track.points[inside], ends[1:]])
    count = len(shape.curves)
    parameters = nearest_on_chain(points, shape.curves)[1]
    speeds = 3.0 * np.linalg.norm(shape.curves[[0, -1], [1, 3]] - shape.curves[[0, -1], [0, 2]], axis=1)
    for at, end in ((0, 0.0), (-1, float(count))):
        if beyond[at] * (1 if at else -1) > 0:  # a parameter goes on beyond its end at the pace that it has there
            parameters[at] = end + beyond[at] / max(speeds[at], 1e-300)
    parameters = (parameters - parameters[0]) / (parameters[-1] - parameters[0]) * count
    return Spline(chain_between(points, parameters, count))


def chain_between(points: np.ndarray, parameters: np.ndarray, count: int) -> np.ndarray:
    """A chain of cubics that starts and ends in the first and the last of (n, 3) points and follows the others.

    parameters: (n,) where the points are on it, ascending, 0 to count. A heavy weight moves the ends, the rest of the
    way is nothing.
    """
    weights = np.ones(len(points))
    weights[[0, -1]] = END_WEIGHT
    for _ in range(CHAIN_ROUNDS):
        curves = lsq_chain(parameters, points, weights, count)
        parameters = nearest_on_chain(points, curves)[1]
        parameters[0], parameters[-1] = 0.0, count
    curves[0, 0], curves[-1, 3] = points[0], points[-1]
    return curves
