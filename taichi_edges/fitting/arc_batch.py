"""Many lines and arcs at once, each with points of its own: what `arcs` does for one, without a Python loop.

Points and the arc each is compared with come as two arrays: points (t, 3) and `of` (t,), the number of the arc.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.robust import geman_mcclure
from taichi_edges.fitting.arcs import FLAT, GAUSS_NEWTON, RIDGE, Arc


@dataclass(frozen=True)
class ArcBatch(Columns):
    """m stretches of lines or circles, see `arcs.Arc`.

    origin, tangent, bend: (m, 3). low, high: (m,). closed: (m,) bool.
    """

    origin: np.ndarray
    tangent: np.ndarray
    bend: np.ndarray
    low: np.ndarray
    high: np.ndarray
    closed: np.ndarray

    @staticmethod
    def of(arcs: Sequence[Arc]) -> "ArcBatch":
        """From a list of Arcs."""
        origin, tangent, bend = (np.array([getattr(arc, name) for arc in arcs]).reshape(-1, 3) for name in VECTORS)
        low, high = (np.array([getattr(arc, name) for arc in arcs], np.float64) for name in ("low", "high"))
        return ArcBatch(origin, tangent, bend, low, high, np.array([arc.closed for arc in arcs], bool))

    def __iter__(self) -> Iterator[Arc]:
        """One Arc after the other."""
        rows = zip(
            *(getattr(self, name) for name in VECTORS), *(getattr(self, name).tolist() for name in ENDS), strict=True
        )
        return (Arc(*row) for row in rows)

    def put(self, numbers: np.ndarray, others: "ArcBatch") -> "ArcBatch":
        """The same, those of the given numbers replaced by the ArcBatch `others`."""
        arrays = [getattr(self, name).copy() for name in VECTORS + ENDS]
        for array, name in zip(arrays, VECTORS + ENDS, strict=True):
            array[numbers] = getattr(others, name)
        return ArcBatch(*arrays)

    @cached_property
    def curvature(self) -> np.ndarray:
        """(m,) 1 / radius; 0 for a line."""
        return np.sqrt((self.bend**2).sum(axis=1))

    @property
    def round(self) -> np.ndarray:
        """(m,) lengths of the whole circles; infinite for a line."""
        return np.where(self.curvature > FLAT, 2 * np.pi / np.maximum(self.curvature, FLAT), np.inf)

    @property
    def length(self) -> np.ndarray:
        """(m,) from `low` to `high`."""
        return self.high - self.low

    @cached_property
    def frame(self) -> np.ndarray:
        """(m, 3, 3) rows: tangent, inward normal (any, of a line) and the normal of the plane, at the origin."""
        aside = crosses(self.tangent, np.eye(3)[np.argmin(np.abs(self.tangent), axis=1)])
        aside /= np.sqrt((aside**2).sum(axis=1, keepdims=True))
        bent = self.curvature[:, None]
        inward = np.where(bent > FLAT, self.bend / np.maximum(bent, FLAT), aside)
        return np.stack([self.tangent, inward, crosses(self.tangent, inward)], axis=1)

    def coordinates(self, points: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(t,) arc lengths of the nearest places, and (t, 2) offsets from these, see `Arc.coordinates`."""
        x, u, w = np.einsum("tij,tj->it", self.frame[of], points - self.origin[of])
        bent = self.curvature[of]
        curved = bent > FLAT
        if not curved.any():
            return x, np.stack([u, w], axis=1)
        inward = (2 * u - bent * (x**2 + u**2)) / (1 + np.sqrt((bent * x) ** 2 + (1 - bent * u) ** 2))
        along = np.arctan2(bent * x, 1 - bent * u) / np.where(curved, bent, 1.0)
        turns = (along - 0.5 * (self.low + self.high)[of]) * bent / (2 * np.pi)
        along -= np.round(turns) * np.where(curved, self.round[of], 0.0)
        return np.where(curved, along, x), np.stack([np.where(curved, inward, u), w], axis=1)

    def at(self, along: np.ndarray, of: np.ndarray) -> np.ndarray:
        """(t,) arc lengths -> (t, 3) points."""
        bent, frame = self.curvature[of], self.frame[of]
        x, y = sine(along, bent), bent * versine(along, bent)
        return self.origin[of] + x[:, None] * frame[:, 0] + y[:, None] * frame[:, 1]

    def tangents(self, along: np.ndarray, of: np.ndarray) -> np.ndarray:
        """(t,) arc lengths -> (t, 3) unit tangents."""
        angle, frame = (along * self.curvature[of])[:, None], self.frame[of]
        return np.cos(angle) * frame[:, 0] + np.sin(angle) * frame[:, 1]

    def recentred(self) -> "ArcBatch":
        """The same with their origins in their middles."""
        each, middle, half = np.arange(len(self)), 0.5 * (self.low + self.high), 0.5 * self.length
        tangent = self.tangents(middle, each)
        bend = self.curvature[:, None] * crosses(self.frame[:, 2], tangent)
        return ArcBatch(self.at(middle, each), tangent, bend, -half, half, self.closed)

    def over(self, low: np.ndarray, high: np.ndarray) -> "ArcBatch":
        """The same with other ends, (m,) each; closed where these are a round apart."""
        whole = high - low >= self.round * (1 - 1e-9)
        return ArcBatch(self.origin, self.tangent, self.bend, low, np.where(whole, low + self.round, high), whole)

    @property
    def sagitta(self) -> np.ndarray:
        """(m,) how far the middles are off the chords; of more than half a circle, the radius at least."""
        bent = self.curvature
        return (1 - np.cos(np.minimum(0.5 * bent * self.length, np.pi))) / np.maximum(bent, 1e-9)


VECTORS, ENDS = ("origin", "tangent", "bend"), ("low", "high", "closed")


def crosses(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of (m, 3) vectors; np.cross takes several times as long for a few hundred."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return a[:, ahead] * b[:, behind] - a[:, behind] * b[:, ahead]


def sine(along: np.ndarray, bent: np.ndarray) -> np.ndarray:
    """sin(bent s) / bent, which tends to s."""
    curved = bent > FLAT
    return np.where(curved, np.sin(bent * along) / np.where(curved, bent, 1.0), along)


def versine(along: np.ndarray, bent: np.ndarray) -> np.ndarray:
    """(1 - cos(bent s)) / bent^2, which tends to s^2 / 2."""
    curved = bent > FLAT
    return np.where(curved, 2 * (np.sin(0.5 * bent * along) / np.where(curved, bent, 1.0)) ** 2, 0.5 * along**2)


def fit_batch(
    arcs: ArcBatch,
    points: np.ndarray,
    directions: np.ndarray,
    of: np.ndarray,
    lever: np.ndarray,
    tolerance: float,
    straight: bool,
    rounds: int = GAUSS_NEWTON,
) -> ArcBatch:
    """`arcs.fit_arc` for an ArcBatch; lever: (m,), one for each."""
    if straight:
        arcs = ArcBatch(arcs.origin, arcs.tangent, np.zeros_like(arcs.bend), arcs.low, arcs.high, arcs.closed)
    for _ in range(rounds):
        along, offsets = arcs.coordinates(points, of)
        weights = geman_mcclure((offsets**2).sum(axis=1) / tolerance**2)
        bent, terms = arcs.curvature[of], 2 if straight else 3
        values = np.stack([np.ones_like(along), sine(along, bent), versine(along, bent)][:terms])
        matrix, targets = _moments(values, offsets, weights, of, len(arcs))
        if lever.any():
            cosines, sines = np.cos(bent * along), bent * values[1]
            slopes = np.stack([np.zeros_like(along), cosines, values[1]][:terms]) * lever[of]
            turns = _turns(arcs.frame[of], cosines, sines, directions) * lever[of, None]
            told = _moments(slopes, turns, weights, of, len(arcs))
            matrix, targets = matrix + told[0], targets + told[1]
        scale = np.sqrt(np.maximum(np.einsum("mkk->mk", matrix), 1e-300))  # columns of the same size: no unit matters
        matrix = matrix / scale[:, :, None] / scale[:, None, :] + RIDGE * np.eye(terms)
        steps = np.linalg.solve(matrix, targets / scale[:, :, None]) / scale[:, :, None]
        if not straight:  # moving the origin inwards moves the far side of the circle outwards
            steps[:, 2, 0] += arcs.curvature**2 * steps[:, 0, 0]
        arcs = _stepped(arcs, steps)
    return arcs


def _moments(
    values: np.ndarray, targets: np.ndarray, weights: np.ndarray, of: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """(m, k, k) and (m, k, 2) weighted sums of products of values (k, t), with each other and with targets (t, 2)."""
    matrix, right = np.empty((count, len(values), len(values))), np.empty((count, len(values), 2))
    for i, row in enumerate(values * weights):
        for j, other in enumerate(values[: i + 1]):
            matrix[:, i, j] = matrix[:, j, i] = np.bincount(of, row * other, count)
        for j in range(2):
            right[:, i, j] = np.bincount(of, row * targets[:, j], count)
    return matrix, right


def _turns(frame: np.ndarray, cosines: np.ndarray, sines: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(t, 2) slopes of the points' directions against their arcs, see `arcs`; frame: (t, 3, 3)."""
    x, u, w = np.einsum("tij,tj->it", frame, directions)
    forward = x * cosines + u * sines
    forward = np.where(np.abs(forward) < 0.5, np.copysign(0.5, forward), forward)  # at 60 degrees a slope says nothing
    return np.stack([(u * cosines - x * sines) / forward, w / forward], axis=1)


def _stepped(arcs: ArcBatch, steps: np.ndarray) -> ArcBatch:
    """The arcs after a Gauss-Newton step: rows of steps (m, k, 2) move origins, turn tangents and change bends."""
    moves = steps @ arcs.frame[:, 1:]
    turned = arcs.tangent + moves[:, 1]
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    bend = arcs.bend + (moves[:, 2] if moves.shape[1] > 2 else 0.0)
    bend = bend - (bend * turned).sum(axis=1, keepdims=True) * turned
    return ArcBatch(arcs.origin + moves[:, 0], turned, bend, arcs.low, arcs.high, arcs.closed)
