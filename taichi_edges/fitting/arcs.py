"""Lines and circular arcs in space as one family, so that a line is no special case of a fit, only an arc of no bend.

An arc starts from a point on it (`origin`), the tangent there and the curvature vector there (`bend`, 1 / length units,
towards the centre). Unlike centre, normal and radius this stays well-conditioned as an arc becomes straight.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from taichi_edges.arrays.robust import geman_mcclure
from taichi_edges.geometry.shapes import EllipticArc, Line

FLAT = 1e-9  # bend, 1 / unit-cube units, below which an arc is computed as a line
QUARTER = 0.5 * np.pi
GAUSS_NEWTON = 3  # rounds; they converge quadratically
RIDGE = 1e-9  # relative; keeps a fit through points in one place from being singular


@dataclass(frozen=True)
class Arc:
    """A stretch of a line or circle, from arc length `low` to `high`, both counted from the origin.

    origin, tangent, bend: (3,); the bend is orthogonal to the tangent, 0 for a line. closed: a whole circle.
    """

    origin: np.ndarray
    tangent: np.ndarray
    bend: np.ndarray
    low: float = 0.0
    high: float = 0.0
    closed: bool = False

    @cached_property
    def curvature(self) -> float:
        """1 / radius; 0 for a line."""
        return float(np.sqrt(self.bend @ self.bend))

    @property
    def round(self) -> float:
        """Length of the whole circle; infinite for a line."""
        return 2 * np.pi / self.curvature if self.curvature > FLAT else np.inf

    @property
    def length(self) -> float:
        """From `low` to `high`."""
        return self.high - self.low

    @cached_property
    def frame(self) -> np.ndarray:
        """(3, 3) rows: tangent, inward normal (any, of a line) and the normal of the plane, at the origin."""
        if self.curvature > FLAT:
            inward = self.bend / self.curvature
        else:
            inward = cross(self.tangent, np.eye(3)[np.argmin(np.abs(self.tangent))])
            inward /= np.sqrt(inward @ inward)
        return np.array([self.tangent, inward, cross(self.tangent, inward)])

    def coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) arc lengths of the nearest places, and (n, 2) offsets from these: inward, and along the plane's normal.

        Arc lengths on a circle lie within half a round of the middle of the arc.
        """
        x, u, w = self.frame @ (points - self.origin).T
        bent = self.curvature
        if bent <= FLAT:
            return x, np.stack([u, w], axis=1)
        inward = (2 * u - bent * (x**2 + u**2)) / (1 + np.sqrt((bent * x) ** 2 + (1 - bent * u) ** 2))
        along, middle = np.arctan2(bent * x, 1 - bent * u) / bent, 0.5 * (self.low + self.high)
        along -= np.round((along - middle) / self.round) * self.round
        return along, np.stack([inward, w], axis=1)

    def at(self, along: np.ndarray | float) -> np.ndarray:
        """(n,) arc lengths -> (n, 3) points."""
        along = np.asarray(along, dtype=np.float64)
        x, y = _sine(along, self.curvature), _versine(along, self.curvature)
        tangent, inward, _ = self.frame
        return self.origin + x[..., None] * tangent + self.curvature * y[..., None] * inward

    def tangents(self, along: np.ndarray | float) -> np.ndarray:
        """(n,) arc lengths -> (n, 3) unit tangents."""
        angle = np.asarray(along)[..., None] * self.curvature
        tangent, inward, _ = self.frame
        return np.cos(angle) * tangent + np.sin(angle) * inward

    def recentred(self) -> "Arc":
        """The same arc with its origin in its middle."""
        middle = 0.5 * (self.low + self.high)
        tangent = self.tangents(middle)
        inward = cross(self.frame[2], tangent)
        origin, half = self.at(middle), 0.5 * self.length
        return Arc(origin, tangent, self.curvature * inward, -half, half, self.closed)

    def cubics(self) -> np.ndarray:
        """(c, 4, 3) cubic Beziers along the arc, each over a quarter round at most: 3e-4 of the radius off."""
        angle = self.length * self.curvature
        joints = np.linspace(self.low, self.high, max(int(np.ceil(angle / QUARTER - 1e-9)), 1) + 1)
        places, tangents = self.at(joints), self.tangents(joints)
        step = (joints[1] - joints[0]) * self.curvature
        handle = 4 / 3 * np.tan(step / 4) / self.curvature if step > 0 else (joints[1] - joints[0]) / 3
        if self.closed:
            places[-1], tangents[-1] = places[0], tangents[0]
        starts, ends = places[:-1], places[1:]
        return np.stack([starts, starts + handle * tangents[:-1], ends - handle * tangents[1:], ends], axis=1)

    def shape(self) -> Line | EllipticArc:
        """The Line or EllipticArc it is."""
        if self.curvature <= FLAT:
            return Line(self.at(np.array([self.low, self.high])))
        tangent, inward, _ = self.frame
        axes = np.array([-inward, tangent]) / self.curvature
        low = self.low * self.curvature
        high = low + 2 * np.pi if self.closed else min(self.high * self.curvature, low + 2 * np.pi)
        return EllipticArc(self.origin + inward / self.curvature, axes, low, high)

    def over(self, low: float, high: float) -> "Arc":
        """The same arc with other ends; closed if these are a round apart."""
        whole = high - low >= self.round * (1 - 1e-9)
        return replace(self, low=low, high=low + self.round if whole else high, closed=bool(whole))


def through_three(start: np.ndarray, middle: np.ndarray, end: np.ndarray) -> Arc | None:
    """The Arc from one point through another to a third, origin at the middle one; None where they are on a line."""
    first, second = start - middle, end - middle
    normal = cross(first, second)
    double = normal @ normal
    if double <= 1e-12 * (first @ first) * (second @ second):
        return None
    to_centre = cross((first @ first) * second - (second @ second) * first, normal) / (2 * double)
    squared = to_centre @ to_centre
    tangent = cross(normal, to_centre)
    tangent /= np.sqrt(tangent @ tangent)
    angles = [np.arctan2(way @ tangent * np.sqrt(squared), squared - way @ to_centre) for way in (first, second)]
    low, high = (np.array([angles[0] % (2 * np.pi) - 2 * np.pi, angles[1] % (2 * np.pi)]) * np.sqrt(squared)).tolist()
    return Arc(middle, tangent, to_centre / squared, low, high)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of two (3,) vectors; np.cross takes ten times as long for a single one."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _sine(along: np.ndarray, bent: float) -> np.ndarray:
    """sin(bent s) / bent, which tends to s."""
    return np.sin(bent * along) / bent if bent > FLAT else along


def _versine(along: np.ndarray, bent: float) -> np.ndarray:
    """(1 - cos(bent s)) / bent^2, which tends to s^2 / 2."""
    return 2 * (np.sin(0.5 * bent * along) / bent) ** 2 if bent > FLAT else 0.5 * along**2


def fit_arc(
    arc: Arc,
    points: np.ndarray,
    directions: np.ndarray,
    lever: float,
    tolerance: float,
    straight: bool,
    rounds: int = GAUSS_NEWTON,
    shares: np.ndarray | float = 1.0,
) -> Arc:
    """The arc moved, turned and bent to the points: robust Gauss-Newton; its ends are kept.

    arc: a start that is near. points, directions: (n, 3). lever: noise of the points over that of the directions,
    unit-cube units: how much a direction tells, compared with a place. tolerance: distance at which a point's weight
    has fallen to a quarter. straight: fit a line; the bend is dropped. shares: (n,) weights of the points, or 1.
    """
    if straight:
        arc = replace(arc, bend=np.zeros(3))
    for _ in range(rounds):
        along, offsets = arc.coordinates(points)
        _, inward, normal = arc.frame
        weights = geman_mcclure((offsets**2).sum(axis=1) / tolerance**2, shares)
        bent, terms = arc.curvature, 2 if straight else 3
        cosine, sine = np.cos(bent * along), _sine(along, bent)
        values = np.array([np.ones_like(along), sine, _versine(along, bent)][:terms])
        weighted = values * weights
        matrix, targets = weighted @ values.T, weighted @ offsets
        if lever:
            slopes = np.array([np.zeros_like(along), cosine, sine][:terms]) * lever
            turns = _turns(arc.frame, cosine, bent * sine, directions) * lever
            matrix, targets = matrix + (slopes * weights) @ slopes.T, targets + (slopes * weights) @ turns
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))  # columns of the same size: no unit matters
        matrix = matrix / scale[:, None] / scale + RIDGE * np.eye(terms)
        steps = np.linalg.solve(matrix, targets / scale[:, None]) / scale[:, None]
        if not straight:  # moving the origin inwards moves the far side of the circle outwards
            steps[2, 0] += bent**2 * steps[0, 0]
        arc = _stepped(arc, steps, np.stack([inward, normal]))
    return arc


def _turns(frame: np.ndarray, cosine: np.ndarray, sine: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(n, 2) slopes of the points' directions against the arc: towards the centre, and along the plane's normal.

    frame: of the arc. cosine, sine: (n,) of the angles from its origin to the points.
    """
    x, u, w = frame @ directions.T
    forward = x * cosine + u * sine
    forward = np.where(np.abs(forward) < 0.5, np.copysign(0.5, forward), forward)  # at 60 degrees a slope says nothing
    return np.stack([(u * cosine - x * sine) / forward, w / forward], axis=1)


def _stepped(arc: Arc, steps: np.ndarray, sides: np.ndarray) -> Arc:
    """The arc after one Gauss-Newton step: rows of `steps` move its origin, turn its tangent and change its bend."""
    turned = arc.tangent + steps[1] @ sides
    turned /= np.sqrt(turned @ turned)
    bend = arc.bend + (steps[2] @ sides if len(steps) > 2 else 0.0)
    bend = bend - (bend @ turned) * turned
    return replace(arc, origin=arc.origin + steps[0] @ sides, tangent=turned, bend=bend)
