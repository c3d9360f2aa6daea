"""Which shape describes a stretch of edge best: a line, an arc of a circle or an ellipse, a chain of cubics.

The criterion is BIC: squared distances in units of the noise, and for every free parameter the logarithm of the number
of observations. Errors of neighbouring places on an edge go together (a detector is drawn to one side by whatever is
next to the edge), so an observation is a stretch of some pixels, however many points it was sampled with.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from taichi_edges.fitting.arcs import Arc, fit_arc, through_three
from taichi_edges.fitting.cubic_chains import Ordering, fit_chain
from taichi_edges.fitting.distances import distances_to, unit
from taichi_edges.fitting.prices import MOST_CUBICS, OUTLIER, PRICES, price_of, price_of_cubics
from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline

LEAST_BEND = 1.0  # noises that the middle of an arc is off its chord, at least
LEAST_FLATNESS = 0.05  # of an ellipse: the shorter axis over the longer one
LEAST_ROUND = np.radians(45.0)  # of an ellipse, to be told from other curves
FIT_ROUNDS = 4
STRETCH_PX = 4.0  # length of an edge on which the errors go together
FEWEST_PLACES = 8  # on a shape, however short it is

Fit = Callable[[], Shape | None]
PixelAt = Callable[[np.ndarray], np.ndarray]  # (n,) size of a pixel at (n, 3) places, unit-cube units


@dataclass(frozen=True)
class Yardstick:
    """What counts as a difference. noise: of a place on an edge, across it. pixel: size of a pixel there.

    Both in units of the unit cube.
    """

    noise: float
    pixel: float

    @property
    def stretch(self) -> float:
        """Length of one observation."""
        return STRETCH_PX * self.pixel

    def at(self, pixel: float) -> "Yardstick":
        """The same where a pixel is so large."""
        return Yardstick(self.noise * (pixel / self.pixel), pixel)


@dataclass(frozen=True)
class Track:
    """Places along a stretch of edge, in order.

    points: (n, 3). arc: (n,) arc length of each. share: (n,) length that each stands for. closed: back to the start?
    """

    points: np.ndarray
    arc: np.ndarray
    share: np.ndarray
    closed: bool = False

    @property
    def ordering(self) -> Ordering:
        """The same as an Ordering."""
        closing = float(np.linalg.norm(self.points[0] - self.points[-1])) if self.closed else 0.0
        return Ordering(self.arc - self.arc[0], float(self.arc[-1] - self.arc[0]) + closing, self.closed)


def misfit(distances: np.ndarray, share: np.ndarray, yardstick: Yardstick) -> float:
    """Sum over the observations of squared distances in units of the noise, each at most OUTLIER.

    distances: (n,) of places. share: (n,) length that each stands for.
    """
    return float((share / yardstick.stretch) @ np.minimum((distances / yardstick.noise) ** 2, OUTLIER))


def observations(share: np.ndarray, yardstick: Yardstick) -> float:
    """How many observations some places are, at least e (whose logarithm is 1)."""
    return max(float(share.sum()) / yardstick.stretch, np.e)


def best_shape(track: Track, yardstick: Yardstick, count: float, worth: float = np.inf) -> tuple[Shape | None, float]:
    """The shape that describes a Track best, and its cost; None and infinity where none is cheaper than `worth`.

    count: number of observations of all that is compared.
    """
    best, least = None, worth
    for price, fit in shape_candidates(track, yardstick):
        if price * np.log(count) >= least:
            continue
        shape = fit()
        if shape is not None:
            cost = price_of(shape) * np.log(count) + misfit(distances_to(shape, track.points), track.share, yardstick)
            if cost < least:
                best, least = shape, cost
    return best, least if best is not None else np.inf


def shape_candidates(track: Track, yardstick: Yardstick) -> list[tuple[int, Fit]]:
    """Pairs of a price, and a function that fits a shape of at least that price, or None where there is none."""
    tolerance = 3.0 * yardstick.noise
    found: list[tuple[int, Fit]] = []
    if not track.closed:
        found.append((PRICES["line"], lambda: fitted_line(track, tolerance).shape()))
    found.append((PRICES["circle" if track.closed else "arc"], partial(bent_shape, track, tolerance)))
    found.append((PRICES["ellipse" if track.closed else "elliptic_arc"], partial(fitted_ellipse, track)))
    counts = [n for n in range(4 if track.closed else 1, MOST_CUBICS + 1) if len(track.points) >= 6 * n]
    found += [(price_of_cubics(cubics), partial(fitted_spline, track, tolerance, cubics)) for cubics in counts]
    return sorted(found, key=lambda pair: pair[0])


def bent_shape(track: Track, tolerance: float) -> Line | EllipticArc | None:
    """The circular arc through a Track, or None where it is as good as straight, or the fit runs away."""
    arc = fitted_arc(track, tolerance, fitted_line(track, tolerance))
    return arc.shape() if arc is not None and np.isfinite([arc.low, arc.high, *arc.origin, *arc.bend]).all() else None


def fitted_spline(track: Track, tolerance: float, cubics: int) -> Spline:
    """The chain of some cubics through a Track."""
    whole = track if track.closed else _with_ends(track)
    return Spline(fit_chain(whole.points, whole.ordering, tolerance, cubics)[0], track.closed)


def fitted_line(track: Track, tolerance: float) -> Arc:
    """The Arc of no bend through a Track."""
    start = Arc(track.points.mean(axis=0), unit(track.points[-1] - track.points[0]), np.zeros(3))
    line = _settled(start, track, tolerance, straight=True)
    return _spanning(line, track)


def fitted_arc(track: Track, tolerance: float, line: Arc) -> Arc | None:
    """The Arc through a Track, or None where it is as good as straight."""
    count = len(track.points)
    start = through_three(*track.points[[0, count // 3, 2 * count // 3] if track.closed else [0, count // 2, -1]])
    if start is None:
        return None
    arc = _settled(start, track, tolerance, straight=False)
    if arc.curvature * line.length**2 / 8 < LEAST_BEND * tolerance / 3.0:
        return None
    return _spanning(arc, track)


def fitted_ellipse(track: Track) -> EllipticArc | None:
    """The EllipticArc through a Track, or None where there is no ellipse, or hardly any of it.

    Least squares of the conic in the plane of the track (Fitzgibbon, Pilu, Fisher 1999, in OpenCV).
    """
    import cv2

    centre = track.points.mean(axis=0)
    _, spread, axes = np.linalg.svd(track.points - centre, full_matrices=False)
    if len(track.points) < 6 or spread[1] <= 0:
        return None
    flat = (track.points - centre) @ axes[:2].T / spread[0]
    (x, y), (width, height), turn = cv2.fitEllipseDirect(flat.astype(np.float32))
    if not np.isfinite([x, y, width, height]).all() or min(width, height) < LEAST_FLATNESS * max(width, height):
        return None
    cosine, sine = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    halves = 0.5 * spread[0] * np.array([[width * cosine, width * sine], [-height * sine, height * cosine]]) @ axes[:2]
    ellipse = EllipticArc.conjugate(centre + spread[0] * np.array([x, y]) @ axes[:2], halves, 0.0, 2 * np.pi)
    return None if ellipse.circular else _round_ellipse(ellipse, track)


def _round_ellipse(ellipse: EllipticArc, track: Track) -> EllipticArc | None:
    """A whole ellipse, cut to the Track along it, in whose direction it goes; None where that is less than a part."""
    offsets = track.points - ellipse.centre
    t = np.unwrap(np.arctan2(*(offsets @ ellipse.axes[k] / ellipse.radii[k] ** 2 for k in (1, 0))))
    if t[-1] < t[0]:
        ellipse = EllipticArc(ellipse.centre, ellipse.axes * np.array([[1.0], [-1.0]]), 0.0, 2 * np.pi)
        t = -t
    if track.closed:
        return ellipse.over(t[0], t[0] + 2 * np.pi)
    before, after = 0.5 * (t[1] - t[0]), 0.5 * (t[-1] - t[-2])  # the places are the middles of what they stand for
    return (
        ellipse.over(t[0] - before, t[-1] + after) if LEAST_ROUND < t[-1] - t[0] + before + after < 2 * np.pi else None
    )


def _with_ends(track: Track) -> Track:
    """The Track with one more place at each end, where the stretch that the outermost place stands for ends."""
    (first, second), (before, last) = track.points[:2], track.points[-2:]
    steps = 0.5 * track.share[[0, -1]]
    ends = first - steps[0] * unit(second - first), last + steps[1] * unit(last - before)
    return Track(
        np.concatenate([ends[:1], track.points, ends[1:]]),
        np.concatenate([[track.arc[0] - steps[0]], track.arc, [track.arc[-1] + steps[1]]]),
        np.concatenate([[0.0], track.share, [0.0]]),
    )


def _settled(arc: Arc, track: Track, tolerance: float, straight: bool) -> Arc:
    """The Arc fitted to a Track, first with a wide tolerance."""
    unused = np.broadcast_to(arc.tangent, track.points.shape)
    for width in (4.0 * tolerance, tolerance):
        arc = fit_arc(arc, track.points, unused, 0.0, width, straight, FIT_ROUNDS, track.share / track.share.max())
    return arc


def _spanning(arc: Arc, track: Track) -> Arc:
    """The Arc over the whole Track, whose places are the middles of what they stand for."""
    along = arc.coordinates(track.points)[0]
    if arc.curvature > 0:
        along = np.unwrap(along * arc.curvature) / arc.curvature
    if along[-1] < along[0]:
        arc, along = Arc(arc.origin, -arc.tangent, arc.bend), -along
    if arc.curvature == 0:
        along = np.array([along.min(), along.max()])
    low, high = along[0] - 0.5 * track.share[0], along[-1] + 0.5 * track.share[-1]
    return arc.over(low, low + arc.round if track.closed else min(high, low + arc.round))


def track_of(shape: Shape, spacing: float) -> Track:
    """The Track of a shape, places at most `spacing` apart, at the middles of equal steps."""
    count = max(int(np.ceil(shape.length / spacing)), FEWEST_PLACES)
    fine = np.linspace(0, 1, 4 * count + 1)
    points = shape.at(fine)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = (np.arange(count) + 0.5) * arc[-1] / count
    places = shape.at(np.interp(at, arc, fine))
    return Track(places, at, np.full(count, arc[-1] / count), shape.closed)
