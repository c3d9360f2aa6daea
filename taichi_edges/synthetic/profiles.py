"""Planar outlines made of exact lines, circular arcs and cubic Bezier segments.

Points are (2,) in the plane of the outline, in the units of the part before it is scaled into the unit cube (parts are
drawn about one unit long). Angles are degrees, counter-clockwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from taichi_edges.geometry.bezier import evaluate_bezier

ARC_PIECE = 45.0  # degrees: a cubic of 45 degrees leaves the true circle by 4.2e-6 of the radius
PIECE_FACETS = 24  # mesh facets across an arc piece; equal for all radii, so that faces about one axis can meet
CHORD_ERROR = 5e-5  # world units: the mesh stays this near to a free-form curve
SHARP_ANGLE = 8.0  # degrees: a smaller break of the tangent counts as smooth; facets of one curve turn by less

Point = np.ndarray | tuple[float, float]  # (2,)
Points = np.ndarray | Sequence[Point]  # (n, 2)


@dataclass(frozen=True)
class Segment:
    """One exact piece of an outline.

    points: (2, 2) end points of a line, or (k, 4, 2) control points of the k cubics of one smooth curve.
    facets: mesh facets for each cubic (1 for a line).
    """

    points: np.ndarray
    facets: int = 1

    @property
    def straight(self) -> bool:
        """Is it a line?"""
        return self.points.ndim == 2

    @property
    def flat(self) -> np.ndarray:
        """(n, 2) end points or control points in order."""
        return self.points.reshape(-1, 2)

    def reversed(self) -> "Segment":
        """The same segment run through backwards."""
        return Segment(self.flat[::-1].reshape(self.points.shape), self.facets)

    def polyline(self) -> np.ndarray:
        """(n, 2) points on the segment, both end points included: the vertices of the mesh."""
        if self.straight:
            return self.points
        pieces = evaluate_bezier(self.points, np.linspace(0.0, 1.0, self.facets + 1))
        return np.concatenate([pieces[0, :1], *pieces[:, 1:]])


@dataclass(frozen=True)
class Path:
    """A chain of segments, each starting where the one before it ends. The solid lies to its LEFT."""

    segments: tuple[Segment, ...]

    def __post_init__(self) -> None:
        for one, other in pairwise(self.segments):
            assert np.allclose(one.flat[-1], other.flat[0], atol=1e-9), (one.flat[-1], other.flat[0])

    @property
    def closed(self) -> bool:
        """Does it end where it starts?"""
        return np.allclose(self.segments[0].flat[0], self.segments[-1].flat[-1], atol=1e-9)

    @property
    def sharp(self) -> np.ndarray:
        """(s,) bool: does the direction break at the START of each segment? The ends of an open path are sharp."""
        into = np.array([s.flat[-1] - s.flat[-2] for s in self.segments])
        onward = np.array([s.flat[1] - s.flat[0] for s in self.segments])
        into = np.roll(into, 1, axis=0)
        cross = into[:, 0] * onward[:, 1] - into[:, 1] * onward[:, 0]
        sharp = np.abs(np.arctan2(cross, (into * onward).sum(axis=1))) > np.radians(SHARP_ANGLE)
        if not self.closed:
            sharp[0] = True
        return sharp

    @property
    def polygon(self) -> np.ndarray:
        """(n, 2) vertices, the first one not repeated at the end when the path is closed."""
        vertices = np.concatenate([s.polyline()[:-1] for s in self.segments])
        return vertices if self.closed else np.vstack([vertices, self.segments[-1].flat[-1]])

    @property
    def area(self) -> float:
        """Signed area of the polygon, positive when it runs counter-clockwise."""
        x, y = self.polygon.T
        return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))

    def reversed(self) -> "Path":
        """The same path run through backwards: what was solid is hollow."""
        return Path(tuple(s.reversed() for s in self.segments[::-1]))


@dataclass(frozen=True)
class Profile:
    """A face of the plane: an outer outline and the holes in it, brought to 'solid on the left' whatever was given."""

    outer: Path
    holes: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "outer", self.outer if self.outer.area > 0 else self.outer.reversed())
        object.__setattr__(self, "holes", tuple(h if h.area < 0 else h.reversed() for h in self.holes))

    @property
    def paths(self) -> tuple[Path, ...]:
        """The outer outline and the holes."""
        return (self.outer, *self.holes)


def line(start: Point, end: Point) -> Segment:
    """A straight segment."""
    return Segment(np.array([start, end], dtype=np.float64))


def curve(control_points: Points) -> Segment:
    """One free-form cubic, (4, 2) control points."""
    control_points = np.asarray(control_points, dtype=np.float64)
    # A chord over a step h of t misses the curve by at most h^2 / 8 max|B''|, and |B''| <= 6 max|second difference|.
    bend = 6.0 * np.linalg.norm(np.diff(control_points, n=2, axis=0), axis=1).max()
    facets = max(PIECE_FACETS, int(np.ceil(np.sqrt(bend / (8.0 * CHORD_ERROR)))))
    return Segment(control_points[None], facets)


def arc(centre: Point, radius: float, start: float, sweep: float) -> Segment:
    """A circular arc from the angle `start` over `sweep` degrees (negative: clockwise)."""
    count = max(int(np.ceil(abs(sweep) / ARC_PIECE - 1e-9)), 1)
    angles = np.radians(start + np.linspace(0.0, sweep, count + 1))
    on_circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tangents = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    handle = 4.0 / 3.0 * np.tan(np.radians(sweep) / count / 4.0)  # the cubic touches the circle at its middle too
    ahead, back = on_circle + handle * tangents, on_circle - handle * tangents
    pieces = np.stack([on_circle[:-1], ahead[:-1], back[1:], on_circle[1:]], axis=1)
    return Segment(np.asarray(centre, dtype=np.float64) + radius * pieces, PIECE_FACETS)


def corner_arc(before: Point, corner: Point, after: Point, radius: float) -> Segment:
    """The fillet that rounds the corner of the polyline before-corner-after."""
    before, corner, after = (np.asarray(point, dtype=np.float64) for point in (before, corner, after))
    into, onward = corner - before, after - corner
    into, onward = into / np.linalg.norm(into), onward / np.linalg.norm(onward)
    turn = np.arctan2(into[0] * onward[1] - into[1] * onward[0], into @ onward)
    start = corner - radius * np.tan(abs(turn) / 2.0) * into
    to_centre = np.sign(turn) * np.array([-into[1], into[0]])
    angle = np.degrees(np.arctan2(-to_centre[1], -to_centre[0]))
    return arc(start + radius * to_centre, radius, angle, np.degrees(turn))


def join(segments: Sequence[Segment]) -> Path:
    """A closed path through `segments`, with the straight lines between them that are missing."""
    chain = []
    for index, segment in enumerate(segments):
        end = segments[index - 1].flat[-1]
        if not np.allclose(end, segment.flat[0], atol=1e-9):
            chain.append(line(end, segment.flat[0]))
        chain.append(segment)
    return Path(tuple(chain))


def polygon(corners: Points, radii: np.ndarray | Sequence[float] | None = None) -> Path:
    """A closed polygon. radii: the fillet of each corner, 0 where it stays sharp."""
    corners = np.asarray(corners, dtype=np.float64)
    radii = np.zeros(len(corners)) if radii is None else radii
    segments = []
    for index, (corner, radius) in enumerate(zip(corners, radii, strict=True)):
        before, after = corners[index - 1], corners[(index + 1) % len(corners)]
        # A sharp corner is a segment of no length: `join` draws the lines from one to the next.
        segments.append(corner_arc(before, corner, after, radius) if radius else line(corner, corner))
    chain = join(segments).segments
    return Path(tuple(s for s in chain if not np.array_equal(s.flat[0], s.flat[-1])))


def rectangle(low: Point, high: Point, radius: float = 0.0) -> Path:
    """A rectangle between two corners, all its corners rounded by `radius`."""
    return polygon([low, (high[0], low[1]), high, (low[0], high[1])], [radius] * 4)


def circle(centre: Point, radius: float) -> Path:
    """A full circle: one smooth segment that meets itself."""
    return Path((arc(centre, radius, 0.0, 360.0),))


def slot(start: Point, end: Point, radius: float) -> Path:
    """A long hole: half circles about `start` and `end`, joined by their tangents."""
    across = np.asarray(end, dtype=np.float64) - start
    angle = np.degrees(np.arctan2(across[1], across[0]))
    return join([arc(end, radius, angle - 90.0, 180.0), arc(start, radius, angle + 90.0, 180.0)])
