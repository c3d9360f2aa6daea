"""Strokes: the paths of edgels in the views, each edgel at one of its candidate depths, so that a path stays one line.

The candidates of single edgels err, most often where edges run beside each other or along the epipolar lines. But an
edge is connected: of an edgel's candidates the one counts that goes on where its neighbours on the path are. Dynamic
programming (Viterbi) finds the depths of a path that have the most evidence, less what their jumps cost; where nothing
has enough evidence the path is open.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taichi_edges.arrays.columns import Columns
from taichi_edges.seeding.lifting import CANDIDATES, Lifted, Rays
from taichi_edges.views.views import Views

LEAST_EVIDENCE = 5.0  # of a candidate, to be preferred to none: two views that look from elsewhere give 6
JUMP = 8.0  # cost of a jump in depth; half of that of leaving the path, or coming back to it
STEP_NOISES = 1.5  # tolerances by which neighbours on a path may disagree, for a cost of 1
SHORTEST = 3  # edgels of a stroke


@dataclass(frozen=True)
class Strokes(Columns):
    """Oriented points in order along strokes, each from an edgel.

    points, directions: (n, 3) unit cube, unit vectors. edgels: (n,) index into Edgels, -1 where a point is from a whole
    run of them. numbers: (n,) of the stroke, rising.
    """

    points: np.ndarray
    directions: np.ndarray
    edgels: np.ndarray
    numbers: np.ndarray

    @property
    def starts(self) -> np.ndarray:
        """(m + 1,) where each stroke begins."""
        firsts = np.flatnonzero(np.diff(self.numbers, prepend=-1))
        return np.append(firsts, len(self.numbers))


def traced(views: Views, lifted: Lifted, paths: Sequence[np.ndarray], tolerance: float) -> Strokes:
    """Strokes along paths of edgels. lifted: their candidates. paths: index arrays. tolerance: px, of the lifting."""
    states = best_states(views, lifted, paths, tolerance)
    edgels, chosen, numbers, count = [], [], [], 0
    for path, (state, goes_on) in zip(paths, states, strict=True):
        ends = np.flatnonzero(~goes_on) + 1
        for first, last in zip((0, *ends), (*ends, len(path)), strict=True):
            if state[first] < CANDIDATES and last - first >= SHORTEST:
                edgels.append(path[first:last])
                chosen.append(state[first:last])
                numbers.append(np.full(last - first, count))
                count += 1
    nothing = np.zeros(0, np.int64)
    edgel, which = np.concatenate([nothing, *edgels]), np.concatenate([nothing, *chosen])
    points, directions = lifted.points[edgel, which], lifted.directions[edgel, which]
    return Strokes(points, directions, edgel, np.concatenate([nothing, *numbers]))


def best_states(
    views: Views, lifted: Lifted, paths: Sequence[np.ndarray], tolerance: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each path the candidate of each edgel, CANDIDATES for none; and whether each goes on to the next, (n - 1,).

    All paths at a time: step by step along them, the longest first.
    """
    lengths = np.array([len(path) for path in paths], dtype=np.int64)
    order = np.argsort(-lengths, kind="stable")
    longest = int(lengths.max(initial=0))
    table = np.zeros((len(paths), longest), np.int64)
    for row, number in enumerate(order):
        table[row, : lengths[number]] = paths[number]
    worth = np.where(lifted.evidence > 0, lifted.evidence - LEAST_EVIDENCE, -np.inf)
    score = np.zeros((len(paths), CANDIDATES + 1))
    if longest:
        score[:, :CANDIDATES] = worth[table[:, 0]]
    before = np.zeros((longest, len(paths), CANDIDATES + 1), np.int8)
    smooth = np.zeros((longest, len(paths), CANDIDATES + 1), bool)
    steps = _Steps(views, lifted, STEP_NOISES * tolerance)
    for step in range(1, longest):
        active = int(np.count_nonzero(lengths > step))
        costs = steps.costs(table[:active, step - 1], table[:active, step])
        totals = score[:active, :, None] - costs
        best = totals.argmax(axis=1)
        before[step, :active] = best
        smooth[step, :active] = np.take_along_axis(costs, best[:, None], axis=1)[:, 0] < JUMP
        smooth[step, :active, :CANDIDATES] &= best[:, :CANDIDATES] < CANDIDATES
        smooth[step, :active, CANDIDATES] = best[:, CANDIDATES] == CANDIDATES
        score[:active] = np.take_along_axis(totals, best[:, None], axis=1)[:, 0]
        score[:active, :CANDIDATES] += worth[table[:active, step]]
    found: list = [None] * len(paths)
    for row, number in enumerate(order):
        count = int(lengths[number])
        state, goes_on = np.empty(count, np.int64), np.empty(count - 1, bool)
        state[-1] = int(score[row].argmax())
        for step in range(count - 1, 0, -1):
            goes_on[step - 1] = smooth[step, row, state[step]]
            state[step - 1] = before[step, row, state[step]]
        found[number] = state, goes_on
    return found


class _Steps:
    """What it costs to go from a candidate of one edgel to one of the next on its path."""

    def __init__(self, views: Views, lifted: Lifted, deviation: float) -> None:
        """deviation: px by which they may disagree for a cost of 1."""
        assert views.edgels is not None
        self.views, self.lifted, self.deviation = views.edgels.views, lifted, deviation
        self.points = views.edgels.points.astype(np.float64)
        self.projections = Rays.of(views).projections

    def costs(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """(n, CANDIDATES + 1, CANDIDATES + 1) for (n,) pairs of edgels of one view."""
        parallax = np.minimum(self.lifted.parallax[first][:, :, None], self.lifted.parallax[second][:, None, :])
        step = self.points[second] - self.points[first]
        here, ahead = self._inverse_depths(first, step)
        there, back = self._inverse_depths(second, -step)
        off = np.minimum(np.abs(ahead[:, :, None] - there[:, None]), np.abs(here[:, :, None] - back[:, None]))
        costs = np.full((len(first), CANDIDATES + 1, CANDIDATES + 1), 0.5 * JUMP)
        costs[:, CANDIDATES, CANDIDATES] = 0.0
        costs[:, :CANDIDATES, :CANDIDATES] = np.minimum((off * parallax / self.deviation) ** 2, JUMP)
        return costs

    def _inverse_depths(self, edgels: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, CANDIDATES) of the candidates, and where their lines are a `step`, (n, 2) px, on."""
        projections = self.projections[self.views[edgels]]
        points, ways = self.lifted.points[edgels], self.lifted.directions[edgels]
        h = np.einsum("nij,nkj->nki", projections[:, :, :3], points) + projections[:, None, :, 3]
        slope = np.einsum("nij,nkj->nki", projections[:, :, :3], ways)
        depth = np.maximum(h[:, :, 2], 1e-9)
        along = (slope[:, :, :2] - h[:, :, :2] / depth[:, :, None] * slope[:, :, 2:]) / depth[:, :, None]
        travelled = (along * step[:, None]).sum(axis=2) / np.maximum((along**2).sum(axis=2), 1e-12)
        return 1.0 / depth, 1.0 / np.maximum(depth + travelled * slope[:, :, 2], 1e-3)
