"""A chain of cubic Beziers as one cubic B-spline: the same points, in the form that CAD files hold."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

DEGREE = 3
SMOOTH = 1e-7  # of the two handles at a joint: how far it may lie beside the straight line between their ends


@dataclass(frozen=True)
class BSpline:
    """A clamped, non-rational cubic B-spline.

    control_points: (m, 3). knots: (k,) distinct, from 0 to 1. multiplicities: (k,) 4 at the ends.
    """

    control_points: np.ndarray
    knots: np.ndarray
    multiplicities: np.ndarray

    @property
    def all_knots(self) -> np.ndarray:
        """(m + 4,) every knot as often as it counts."""
        return np.repeat(self.knots, self.multiplicities)


def joined(curves: np.ndarray) -> BSpline:
    """The BSpline of a chain of cubics, (c, 4, 3).

    With a triple knot at a joint any two cubics are one spline, but many kernels cut a curve there, or refuse it, since
    it might have a corner. Where the tangents agree, spans as long as the handles beside the joint make the derivative
    continuous: the joint follows from its two neighbours, and a double knot does. The points stay the same.
    """
    spans, multiplicities, control = [1.0], [DEGREE + 1], [curves[0, 0], curves[0, 1]]
    for before, after in pairwise(curves):
        into, out = (float(np.linalg.norm(handle)) for handle in (before[3] - before[2], after[1] - after[0]))
        smooth = _is_smooth(before[2], before[3], after[1], into, out)
        spans.append(spans[-1] * (out / into if smooth else 1.0))
        multiplicities.append(DEGREE - smooth)
        control += [before[2], after[1]] if smooth else [before[2], before[3], after[1]]
    control += [curves[-1, 2], curves[-1, 3]]
    knots = np.concatenate([[0.0], np.cumsum(spans)])
    return BSpline(np.array(control), knots / knots[-1], np.array([*multiplicities, DEGREE + 1]))


def _is_smooth(before: np.ndarray, joint: np.ndarray, after: np.ndarray, into: float, out: float) -> bool:
    """Does the joint lie between its neighbours, (3,) each, `into` and `out` away from it, as a smooth curve's does?"""
    if min(into, out) <= SMOOTH * max(into, out):
        return False
    between = (out * before + into * after) / (into + out)
    return bool(np.linalg.norm(joint - between) <= SMOOTH * (into + out))
