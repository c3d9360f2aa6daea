"""Clusters cut where a straight stretch meets a curved one.

Graph traversal follows an edge wherever it goes smoothly: round a fillet, from a rim into the line that touches it. One
line or one curve does not describe such a cluster. Dynamic programming over its order finds the cheapest sequence of
straight and curved stretches; the cluster is cut at both ends of every straight one.
"""

import numpy as np

from taichi_edges.edges.clustering import UNASSIGNED
from taichi_edges.edges.ordering import order_points

STATIONS = 32  # places along a cluster at which it may be cut
MIN_STRETCH = 5  # points; a line through fewer says nothing
LINE_PRICE, CURVE_PRICE = 5, 8  # free parameters: a line and where it ends; a circular arc and where it starts and ends
OUTLIER = 9.0  # squared residuals in units of the noise count up to here
NOISE_WINDOW = 10  # points on which a quadratic measures the local scatter
MIN_NOISE = 1e-3  # unit-cube units; detectors' errors vary slowly along an edge, so the scatter alone is too small


def split_clusters(points, labels, min_points):
    """Cut clusters into straight and curved stretches.

    points: (n, 3) unit cube. labels: (n,) ints, UNASSIGNED for none. min_points: smaller stretches stay with their
    neighbour. Returns (n,) labels 0.., in the order of the clusters and along them.
    """
    split = np.full(len(labels), UNASSIGNED)
    count = 0
    for label in range(labels.max(initial=UNASSIGNED) + 1):
        members = np.flatnonzero(labels == label)
        for stretch in stretches(points[members], min_points):
            split[members[stretch]] = count
            count += 1
    return split


def stretches(points, min_points):
    """Index arrays of the straight and curved stretches of one cluster, in order along it."""
    if len(points) < 2 * min_points:
        return [np.arange(len(points))]
    ordering = order_points(points)
    order = np.argsort(ordering.arc, kind="stable")
    if ordering.closed:
        # A loop has no natural start: cut it once from anywhere, then start again at one of the cuts that were found.
        order = np.roll(order, -_some_cut(points[order]))
    bounds, curved = cut_chain(points[order])
    groups = _joined(bounds, curved, min_points, ordering.closed)
    return [np.concatenate([order[a:b] for a, b in group]) for group in groups]


def _some_cut(chain):
    """Position of a cut that an open chain gets at an end of a straight stretch; 0 where it gets none."""
    bounds, curved = cut_chain(chain)
    inner = [a for a, was, now in zip(bounds[1:-1], curved[:-1], curved[1:], strict=True) if was != now or not now]
    return inner[len(inner) // 2] if inner else 0


def cut_chain(chain):
    """Cheapest sequence of lines and cubics through (n, 3) ordered points.

    Cost of a stretch: squared distances to its line or cubic in units of the noise, each at most OUTLIER, plus the
    price of its parameters, ln n each (BIC). Returns the bounds (m + 1 positions) and (m,) bool: curved?
    """
    count = len(chain)
    noise = max(local_noise(chain), MIN_NOISE)
    stations = np.unique(np.linspace(0, count, min(STATIONS, count // MIN_STRETCH) + 1).round().astype(int))
    price = np.log(count)
    best = np.full(len(stations), np.inf)
    best[0] = 0.0
    came_from, was_curved = np.zeros(len(stations), int), np.zeros(len(stations), bool)
    for end in range(1, len(stations)):
        for start in range(end):
            stretch = chain[stations[start] : stations[end]]
            for curved, parameters in ((False, LINE_PRICE), (True, CURVE_PRICE)):
                cost = best[start] + stretch_cost(stretch, curved, noise) + parameters * price
                if cost < best[end]:
                    best[end], came_from[end], was_curved[end] = cost, start, curved
    path = [len(stations) - 1]
    while path[-1]:
        path.append(came_from[path[-1]])
    path = path[::-1]
    return [int(stations[i]) for i in path], [bool(was_curved[i]) for i in path[1:]]


def stretch_cost(stretch, curved, noise):
    """Sum of squared distances of (n, 3) ordered points to a line or a cubic of the chord-length parameter."""
    if len(stretch) < MIN_STRETCH:
        return 0.0
    centre = stretch.mean(axis=0)
    direction = np.linalg.svd(stretch - centre, full_matrices=False)[2][0]
    if not curved:
        offsets = stretch - centre
        squared = (offsets**2).sum(axis=1) - (offsets @ direction) ** 2
    else:
        parameter = np.linspace(-1.0, 1.0, len(stretch))
        design = np.polynomial.legendre.legvander(parameter, 3)
        coefficients, *_ = np.linalg.lstsq(design, stretch, rcond=None)
        slope = np.polynomial.legendre.legval(parameter, np.polynomial.legendre.legder(coefficients)).T
        slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
        residuals = stretch - design @ coefficients
        squared = (residuals**2).sum(axis=1) - (residuals * slope).sum(axis=1) ** 2
    return float(np.minimum(np.maximum(squared, 0.0) / noise**2, OUTLIER).sum())


def local_noise(chain):
    """Scatter of ordered (n, 3) points per axis across their edge: median over windows of NOISE_WINDOW points."""
    window = min(NOISE_WINDOW, len(chain))
    design = np.polynomial.legendre.legvander(np.linspace(-1, 1, window), 2)
    onto = design @ np.linalg.pinv(design)
    scatter = []
    for start in range(0, len(chain) - window + 1, max(window // 2, 1)):
        part = chain[start : start + window]
        direction = np.linalg.svd(part - part.mean(axis=0), full_matrices=False)[2][0]
        residuals = part - onto @ part
        across = (residuals**2).sum(axis=1) - (residuals @ direction) ** 2
        scatter.append(across.sum() / (2 * max(window - 3, 1)))
    return float(np.sqrt(np.median(scatter)))


def _joined(bounds, curved, min_points, closed):
    """Stretches as lists of (start, end): neighbouring curved ones are one, tiny ones go to their neighbour."""
    groups, kinds = [], []
    for start, end, is_curved in zip(bounds[:-1], bounds[1:], curved, strict=True):
        tiny = end - start < min_points
        if groups and (tiny or (is_curved and kinds[-1]) or sum(b - a for a, b in groups[-1]) < min_points):
            groups[-1].append((start, end))
            kinds[-1] = kinds[-1] or is_curved
        else:
            groups.append([(start, end)])
            kinds.append(is_curved)
    if closed and len(groups) > 1 and kinds[0] and kinds[-1]:  # a loop's last curve runs on into its first
        groups[0] = groups.pop() + groups[0]
    return groups
