"""Clusters cut where a straight stretch meets a curved one.

Graph traversal follows an edge wherever it goes smoothly: round a fillet, from a rim into the line that touches it. One
line or one curve does not describe such a cluster. Dynamic programming over its order finds the cheapest sequence of
straight and curved stretches; the cluster is cut at both ends of every straight one.
"""

import numpy as np

from taichi_edges.arrays.ranges import ragged, starts_of
from taichi_edges.fitting.prices import OUTLIER, PRICES
from taichi_edges.strokes.neighbors import UNASSIGNED, members_of_clusters
from taichi_edges.strokes.ordering import order_points

STATIONS = 32  # places along a cluster at which it may be cut
MIN_STRETCH = 5  # points; a line through fewer says nothing
NOISE_WINDOW = 10  # points on which a quadratic measures the local scatter
MIN_NOISE = 7e-4  # unit-cube units; detectors' errors vary slowly along an edge, so the scatter alone is too small
BLOCK = 1 << 13  # points of overlapping stretches that are looked at in one go; the intermediate arrays stay in cache


def split_clusters(points: np.ndarray, labels: np.ndarray, min_points: int) -> np.ndarray:
    """Cut clusters into straight and curved stretches.

    points: (n, 3) unit cube. labels: (n,) ints, UNASSIGNED for none. min_points: smaller stretches stay with their
    neighbour. Returns (n,) labels 0.., in the order of the clusters and along them.
    """
    split = np.full(len(labels), UNASSIGNED)
    count = 0
    for members in members_of_clusters(labels):
        for stretch in stretches(points[members], min_points):
            split[members[stretch]] = count
            count += 1
    return split


def stretches(points: np.ndarray, min_points: int) -> list[np.ndarray]:
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


def _some_cut(chain: np.ndarray) -> int:
    """Position of a cut that an open chain gets at an end of a straight stretch; 0 where it gets none."""
    bounds, curved = cut_chain(chain)
    inner = [a for a, was, now in zip(bounds[1:-1], curved[:-1], curved[1:], strict=True) if was != now or not now]
    return inner[len(inner) // 2] if inner else 0


def cut_chain(chain: np.ndarray) -> tuple[list[int], list[bool]]:
    """Cheapest sequence of lines and cubics through (n, 3) ordered points.

    Cost of a stretch: squared distances to its line or cubic in units of the noise, each at most OUTLIER, plus the
    price of its parameters, ln n each (BIC). Returns the bounds (m + 1 positions) and (m,) bool: curved?
    """
    count = len(chain)
    noise = max(local_noise(chain), MIN_NOISE)
    stations = np.unique(np.linspace(0, count, min(STATIONS, count // MIN_STRETCH) + 1).round().astype(int))
    ends, starts = np.tril_indices(len(stations), -1)  # a stretch runs from any station to any later one
    costs = np.stack(stretch_costs(chain, stations[starts], stations[ends], noise), axis=1)
    costs += np.array([PRICES["line"], PRICES["arc"]]) * np.log(count)  # a cubic stands for an arc
    best = np.zeros(len(stations))
    came_from, was_curved = np.zeros(len(stations), int), np.zeros(len(stations), bool)
    for end in range(1, len(stations)):
        totals = best[:end, None] + costs[ends == end]
        cheapest = int(totals.argmin())
        best[end], came_from[end], was_curved[end] = totals.flat[cheapest], cheapest // 2, cheapest % 2
    path = [len(stations) - 1]
    while path[-1]:
        path.append(came_from[path[-1]])
    path.reverse()
    return [int(stations[i]) for i in path], [bool(was_curved[i]) for i in path[1:]]


def stretch_costs(
    chain: np.ndarray, starts: np.ndarray, ends: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances, capped and summed, of the points of many stretches to their lines and to their cubics.

    chain: (n, 3) ordered points. starts, ends: (p,) ints, the stretches are chain[start:end].
    Returns two (p,) arrays: for the lines, and for the cubics of the chord-length parameter; 0 for stretches below
    MIN_STRETCH. They overlap, so their points are laid out one stretch after the other, some BLOCK at a time.
    """
    costs = np.zeros((2, len(starts)))
    worth = np.flatnonzero(ends - starts >= MIN_STRETCH)
    block = np.cumsum((ends - starts)[worth]) // BLOCK
    centred = chain - chain.mean(axis=0)  # or the moments of a far point would swamp those of a short stretch
    for part in np.split(worth, np.flatnonzero(np.diff(block)) + 1):
        if len(part):
            costs[:, part] = _block_costs(centred, starts[part], ends[part], noise)
    return costs[0], costs[1]


def _block_costs(chain: np.ndarray, starts: np.ndarray, ends: np.ndarray, noise: float) -> np.ndarray:
    """(2, p) costs of the stretches of one block; see `stretch_costs`. t counts all their points, in order."""
    lengths = ends - starts
    of, place = ragged(lengths)  # (t,) the stretch, and 0, 1, .. within it
    first = starts_of(lengths)
    means = np.diff(_running_sums(chain)[np.stack([starts, ends])], axis=0)[0] / lengths[:, None]
    offsets = chain[starts[of] + place].T - np.repeat(means.T, lengths, axis=1)  # (3, t)

    # residuals, directions: (3, t) each; what lies along the direction is no distance
    def capped(residuals: np.ndarray, directions: np.ndarray) -> np.ndarray:
        along = (residuals * directions).sum(axis=0) ** 2 / np.maximum((directions**2).sum(axis=0), 1e-300)
        squared = (residuals**2).sum(axis=0) - along
        return np.add.reduceat(np.minimum(np.maximum(squared, 0.0) / noise**2, OUTLIER), first)

    lines = capped(offsets, np.repeat(_main_directions(chain, starts, ends, means).T, lengths, axis=1))
    # Gram's polynomials are orthogonal over evenly spaced places, so a cubic takes no equations to solve:
    # p_1 = x, p_(k+1) = x p_k - b_k p_(k-1), where b_k = |p_k|^2 / |p_(k-1)|^2; p_0 = 1 is spent on the mean.
    b = [k**2 * (lengths**2 - k**2) / ((4 * k**2 - 1) * (lengths - 1.0) ** 2) for k in (1, 2, 3)]
    b1, b2 = b[0][of], b[1][of]
    x = 2.0 * place / (lengths - 1)[of] - 1.0
    basis = [x, x**2 - b1, x * (x**2 - b1 - b2)]
    slopes = [np.ones_like(x), 2 * x, 3 * x**2 - b1 - b2]
    cubics, directions, norm = np.zeros_like(offsets), np.zeros_like(offsets), lengths.astype(float)
    for values, slope, ratio in zip(basis, slopes, b, strict=True):
        norm = norm * ratio
        coefficients = np.repeat(np.add.reduceat(offsets * values, first, axis=1) / norm, lengths, axis=1)
        cubics += coefficients * values
        directions += coefficients * slope
    return np.stack([lines, capped(offsets - cubics, directions)])


def _running_sums(values: np.ndarray) -> np.ndarray:
    """(n, ...) -> (n + 1, ...) sums of the first 0 .. n values."""
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])


def _main_directions(chain: np.ndarray, starts: np.ndarray, ends: np.ndarray, means: np.ndarray) -> np.ndarray:
    """(p, 3) unit vectors along which the stretches scatter most."""
    sums = _running_sums(chain[:, :, None] * chain[:, None, :])
    moments = sums[ends] - sums[starts]
    scatter = moments - (ends - starts)[:, None, None] * means[:, :, None] * means[:, None, :]
    return np.linalg.eigh(scatter)[1][:, :, -1]


def local_noise(chain: np.ndarray) -> float:
    """Scatter of ordered (n, 3) points per axis across their edge: median over windows of NOISE_WINDOW points."""
    window = min(NOISE_WINDOW, len(chain))
    design = np.polynomial.legendre.legvander(np.linspace(-1, 1, window), 2)
    onto = design @ np.linalg.pinv(design)
    starts = np.arange(0, len(chain) - window + 1, max(window // 2, 1))
    parts = chain[starts[:, None] + np.arange(window)]
    centred = parts - parts.mean(axis=1, keepdims=True)
    directions = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)[1][:, :, -1]
    residuals = parts - onto @ parts
    across = (residuals**2).sum(axis=(1, 2)) - (np.einsum("wnc,wc->wn", residuals, directions) ** 2).sum(axis=1)
    return float(np.sqrt(np.median(across / (2 * max(window - 3, 1)))))


def _joined(bounds: list[int], curved: list[bool], min_points: int, closed: bool) -> list[list[tuple[int, int]]]:
    """Stretches as lists of (start, end): neighbouring curved ones are one, tiny ones go to their neighbour."""
    groups: list[list[tuple[int, int]]] = []
    kinds: list[bool] = []
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
