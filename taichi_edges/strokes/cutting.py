"""Strokes cut where one shape ends and another begins: straight and bent stretches, as few as pay.

Points along a stroke are in order, so dynamic programming over all ways to cut it finds the cheapest: squared distances
to the line or cubic of each stretch in units of the noise, and for every parameter the logarithm of the number of
observations (BIC, `fitting/model_selection.py`). A cubic is no arc of more than some 150 degrees: longer ones are cut,
and are one again where strokes that continue each other are cut anew.
"""

from itertools import pairwise

import numpy as np

from taichi_edges.fitting.model_selection import Track, Yardstick, best_shape
from taichi_edges.fitting.prices import PRICES, SHARED_PLACE
from taichi_edges.geometry.shapes import Shape
from taichi_edges.strokes.segmentation import stretch_costs

MOST_STATIONS = 48  # places along a stroke at which it may be cut
FEWEST = 3  # points between two of them
CLOSING_PX = 3.0  # between the ends of a stroke that comes back to its start
LEAST_LOOP = 20  # points of such a stroke
LEAST_LENGTH_PX = 1.5  # of a stretch
LONGEST = 2.0  # times the way along its points: a shape that is longer runs on beyond them


def cut_stroke(points: np.ndarray, yardstick: Yardstick) -> list[slice]:
    """The stretches of (n, 3) points in order along a stroke."""
    count = len(points)
    if count < 2 * FEWEST:
        return [slice(0, count)]
    stations = np.unique(np.linspace(0, count, min(MOST_STATIONS, count // FEWEST) + 1).round().astype(int))
    ends, starts = np.tril_indices(len(stations), -1)  # a stretch runs from any station to any later one
    share = step_length(points) / yardstick.stretch  # of an observation that a point is
    costs = share * np.stack(stretch_costs(points, stations[starts], stations[ends], yardstick.noise), axis=1)
    prices = np.array([PRICES["line"], PRICES["arc"]]) - SHARED_PLACE  # the first one's, too: it makes no difference
    costs += prices * np.log(max(share * count, np.e))
    best, came_from = np.zeros(len(stations)), np.zeros(len(stations), int)
    for end in range(1, len(stations)):
        totals = best[:end] + costs[ends == end].min(axis=1)
        came_from[end] = int(totals.argmin())
        best[end] = totals[came_from[end]]
    path = [len(stations) - 1]
    while path[-1]:
        path.append(int(came_from[path[-1]]))
    bounds = stations[path[::-1]]
    return [slice(int(first), int(last)) for first, last in pairwise(bounds.tolist())]


def step_length(points: np.ndarray) -> float:
    """Between neighbours of (n, 3) points in order: the median."""
    return float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))) if len(points) > 1 else 0.0


def track_through(points: np.ndarray, pixel: float) -> Track:
    """The Track of (n, 3) points in order. pixel: size of a pixel, unit-cube units."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    share = np.zeros(len(points))
    share[:-1] += 0.5 * steps
    share[1:] += 0.5 * steps
    gap = np.linalg.norm(points[-1] - points[0])
    closed = bool(len(points) >= LEAST_LOOP and gap <= CLOSING_PX * pixel)
    return Track(points, np.concatenate([[0.0], np.cumsum(steps)]), np.maximum(share, 1e-12), closed)


def shape_of_stretch(points: np.ndarray, yardstick: Yardstick) -> Shape | None:
    """The shape that describes (n, 3) points in order best; None where they are too short, or none does."""
    if len(points) < FEWEST:
        return None
    track = track_through(points, yardstick.pixel)
    length = track.arc[-1]
    if length < LEAST_LENGTH_PX * yardstick.pixel:
        return None
    shape, _ = best_shape(track, yardstick, max(length / yardstick.stretch, np.e))
    return shape if shape is not None and shape.length <= LONGEST * length else None
