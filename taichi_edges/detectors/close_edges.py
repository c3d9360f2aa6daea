"""Edges so close to each other that their blurs overlap: where each of them is.

The gradient across a blurred step is a Gaussian. Of two steps beside each other the gradient is the sum of two, and its
maxima are not where the steps are: those of a thin line, darker or lighter than both sides, are farther apart than the
line is wide, never less than two blurs; those of two steps in the same direction are nearer to each other.
"""

import numpy as np
from scipy.spatial import cKDTree

REACH = 3.5  # blurs, between maxima; farther apart they leave each other where they are, within 1 % of the blur
LEAST_APART = 1.0  # blurs; nearer ones are the next maximum of the same edge
BESIDE_PX = 0.71  # along the edge from one to the other; maxima are about 1 px apart
ALIGNED = 0.8  # cosine of the angle between the normals of edges that run beside each other
ROUNDS, STEP = 12, 0.5  # of the solution; what has not converged then has gone as far as the noise allows
LEAST_OWN = 0.2  # of the gradient at a maximum: what the edge itself contributes at least
MOST_SHIFT = 0.9  # blurs: of the flanks of an infinitely thin line
LEAST_GAP_PX = 1.2  # that remains between two edges; nearer ones would pass for one in other views
SAMPLING_PX = 0.75  # maxima are found from the pixels before and behind: so far away, over all directions and places
ALONE = 0.01  # of an edge's height: what others beside it may add, for the width to be its own within 10 %


def beside_each_other(points: np.ndarray, normals: np.ndarray, blur: float) -> tuple[np.ndarray, ...]:
    """Pairs (i, j), (m,) each, of maxima beside each other, j the nearest one on its side of i; with the distance from
    i to j along the normal of i, px, and +1 where both have their light on the same side, else -1.
    """
    pairs = cKDTree(points).query_pairs(REACH * blur, output_type="ndarray")
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    step = points[second] - points[first]
    across = np.einsum("ij,ij->i", step, normals[first])
    along = normals[first, 0] * step[:, 1] - normals[first, 1] * step[:, 0]
    turn = np.einsum("ij,ij->i", normals[first], normals[second])
    fits = (np.abs(along) <= BESIDE_PX) & (np.abs(turn) >= ALIGNED) & (np.abs(across) >= LEAST_APART * blur)
    first, second, across, turn = first[fits], second[fits], across[fits], turn[fits]
    order = np.lexsort((second, np.abs(across), across > 0, first))
    first, second, across, turn = first[order], second[order], across[order], turn[order]
    sides = 2 * first + (across > 0)
    nearest = np.concatenate([[True], sides[1:] != sides[:-1]])[: len(first)]
    return first[nearest], second[nearest], across[nearest], np.sign(turn[nearest])


def disentangled(
    points: np.ndarray, normals: np.ndarray, steepness: np.ndarray, straight: np.ndarray, blur: float
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) px by which each edge is off its maximum, along its normal; and (n,) bool, whether nothing beside it has
    changed the width of the maximum.

    points, normals: (n, 2) of the maxima. steepness: (n,) gradients there. straight: (n,) bool; the others are on small
    circles and stay where they are. blur: px, of a sharp edge. Solved by iteration: from the places and heights of all
    the gradients at all maxima, and from these the places and heights.
    """
    count, variance = len(points), blur * blur
    shifts, heights = np.zeros(count), steepness.astype(np.float64)
    first, second, across, signs = beside_each_other(points, normals, blur)
    room = np.where(straight, np.inf, 0.0)
    np.minimum.at(room, first, np.maximum(np.abs(across) - LEAST_GAP_PX, 0.0) / 2)
    most = np.minimum(room, MOST_SHIFT * blur)

    def of_others(step: float) -> np.ndarray:
        """What the others add to the gradient so many pixels from each maximum."""
        distances = across + signs * shifts[second] - step
        return np.bincount(first, signs * heights[second] * np.exp(-0.5 * distances**2 / variance), count)

    for _ in range(ROUNDS):
        # A maximum was found where the gradients of the pixels before and behind it are the same.
        own = np.maximum(steepness - of_others(0.0), LEAST_OWN * steepness)
        uneven = of_others(-SAMPLING_PX) - of_others(SAMPLING_PX)
        slope = uneven / (2 * own * np.exp(-0.5 * SAMPLING_PX**2 / variance))
        wanted = np.clip(variance / SAMPLING_PX * np.arcsinh(slope), -most, most)
        shifts += STEP * (wanted - shifts)
        heights += STEP * (own * np.exp(0.5 * shifts**2 / variance) - heights)
    added = np.bincount(first, heights[second] * np.exp(-0.5 * across**2 / variance), count)
    return shifts, added < ALONE * heights
