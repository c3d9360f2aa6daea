"""How noisy oriented points are, from the points themselves.

Neighbours scatter ten times less about their common edge than they are off it: the errors of a detector vary slowly
along an edge. What counts is how far the points of a whole line or arc are off that, so lines and arcs are grown with a
tolerance that is raised until it no longer cuts off what it measures.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from taichi_edges.fitting.arcs import Arc
from taichi_edges.strokes.arc_growth import Cloud, Scale, grown_from_seeds

PROBES = 20  # seeds from which lines and arcs are grown
LONGEST = 0.5  # share of these that tell the noise; the others may be bits of freer curves, which are off by more
LEAST_NOISE = 2e-4  # unit-cube units, about a tenth of a pixel: near corners the best detector is off by as much
MOST_NOISE = 1e-2  # unit-cube units; what is off by more is no edge
STEP = np.sqrt(2.0)  # from one tolerance to the next
CUT_OFF = 0.33  # measured noise over the one assumed; nearer to 1 the tolerance may be what is measured
RAYLEIGH = 1.1774  # median distance over the standard deviation on each axis, of a normal distribution in the plane
LEAST_TURN, FIRST_TURN = np.radians([0.5, 5.0])  # of directions: at least, and until they have been measured


def measured_scale(
    points: np.ndarray,
    directions: np.ndarray,
    neighbors: Sequence[np.ndarray],
    seeds: np.ndarray,
    gap: float,
    most: float = MOST_NOISE,
) -> Scale:
    """The Scale of oriented points.

    points, directions: (n, 3). neighbors: for every point its aligned neighbours. seeds: (n,) indices, best first.
    gap: points of an edge are no farther apart, unit-cube units. most: noise, unit-cube units: among curved edges close
    to each other, tolerances that are raised take in ever more of the neighbours.
    """
    better = np.asarray(seeds)[: max(len(seeds) // 2, 1)]  # stray points and the midst of junctions come last
    probes = better[np.linspace(0, len(better) - 1, min(PROBES, len(better))).astype(int)]
    noise, turn = LEAST_NOISE, FIRST_TURN
    cloud = Cloud(points, directions, Scale(noise, turn, gap))
    while noise < most:
        cloud = cloud.at_scale(Scale(noise, turn, gap))
        grown = grown_from_seeds(cloud, neighbors, probes)
        found = [residual for pair in grown for residual in _residuals(cloud, pair)]
        if found:
            lengths, noises, turns = np.array(found).T
            longest = np.argsort(-lengths, kind="stable")[: max(int(LONGEST * len(lengths)), 1)]
            measured, turn = float(np.median(noises[longest])), max(float(np.median(turns[longest])), LEAST_TURN)
            if measured <= CUT_OFF * noise:
                break
        noise *= STEP
    return Scale(min(noise, most), turn, gap)


def _residuals(cloud: Cloud, pair: tuple[Arc | None, Arc | None]) -> Iterator[tuple[float, float, float]]:
    """(length, noise of the places, noise of the directions) of the line and the arc grown from one seed."""
    for grown in pair if pair[0] is not None else ():
        if grown is not None:
            on = cloud.inliers(grown, grown.low, grown.high)
            if not len(on):
                continue
            cosines = np.abs((cloud.directions[on.members] * grown.tangents(on.along)).sum(axis=1))
            noise = np.sqrt(np.median(on.squared)) * cloud.scale.noise / RAYLEIGH
            yield grown.length, noise, np.median(np.arccos(np.minimum(cosines, 1.0))) / RAYLEIGH
