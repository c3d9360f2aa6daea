"""The box of a scene from the points and cameras of structure from motion.

Points are what the box must hold, but some are wrong by any distance, and a scene has surroundings that nobody means.
Where the cameras stand around something and look at it, the surroundings are what is farther from it than they are.
"""

from collections.abc import Sequence

import numpy as np

FEWEST = 10  # points; fewer say nothing about the scene's extent
CORE = 0.05  # of the points beyond each side of the core
REACH = 0.5  # of the core's size, by which points may lie outside it and still belong to the scene
STRAY = 0.005  # of the points within reach, beyond each side
MARGIN = 0.05  # of the box's size on each side: edges end beyond the last point
THINNEST = 0.05  # of the longest side: a facade has some depth
IN_FRONT = 0.9  # share of the cameras that must have the focus in front of them
STEADY = 0.5  # spread of the cameras' distances to the focus, of their median
AROUND = (
    0.2  # share of the points that must lie about the focus, nearer than half way to the cameras: else it is a room
)
SURROUNDINGS = 0.75  # of the cameras' distance to the focus: what is farther from it is not meant
NARROWEST = 25.0  # degrees between the cameras' directions from the focus, else it is nowhere sure


def scene_box(points: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray | None:
    """(2, 3) corners of the box that holds the scene; None where there are too few points to tell.

    points: (n, 3), without the worst. camera_to_world: (V, 4, 4), OpenCV axes.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < FEWEST:
        return None
    chosen = points[_about_the_focus(points, camera_to_world)]
    low, high = np.quantile(chosen, [CORE, 1 - CORE], axis=0)
    reach = REACH * max((high - low).max(), np.finfo(float).tiny)
    inside = chosen[((chosen >= low - reach) & (chosen <= high + reach)).all(axis=1)]
    return _widened(*np.quantile(inside, [STRAY, 1 - STRAY], axis=0))


def box_of_cameras(camera_to_world: np.ndarray, fields: Sequence[float]) -> np.ndarray | None:
    """(2, 3) corners of a cube that every camera sees about whole, where all look at one place; None where they do not.

    A guess, for want of points. camera_to_world: (V, 4, 4), OpenCV axes. fields: (V,) width of the narrower field of
    view at distance 1.
    """
    found = _focus(camera_to_world)
    if found is None:
        return None
    focus, distance = found
    half = 0.5 * distance * float(np.median(fields))
    return np.array([focus - half, focus + half])


def _about_the_focus(points: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray:
    """(n,) bool: the points that the cameras stand around; all of them where they stand in a room or along a street."""
    found = _focus(camera_to_world)
    if found is None:
        return np.ones(len(points), bool)
    focus, distance = found
    away = np.linalg.norm(points - focus, axis=1)
    if (away < 0.5 * distance).mean() < AROUND:
        return np.ones(len(points), bool)
    return away < SURROUNDINGS * distance


def _widened(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The (2, 3) box with its margin, and some depth where it is flat."""
    longest = max((high - low).max(), np.finfo(float).tiny)
    lack = np.maximum(THINNEST * longest - (high - low), 0) / 2
    margin = MARGIN * longest + lack
    return np.array([low - margin, high + margin])


def _focus(camera_to_world: np.ndarray) -> tuple[np.ndarray, float] | None:
    """The point around which the cameras stand and at which they look, and their median distance to it; None.

    The point nearest to all viewing axes, in the sense of least squares.
    """
    centres, axes = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if len(centres) < 3 or np.linalg.cond(across.sum(axis=0)) > 1 / np.sin(np.radians(NARROWEST / 2)) ** 2:
        return None
    focus = np.linalg.solve(across.sum(axis=0), (across @ centres[:, :, None]).sum(axis=0)[:, 0])
    depths = ((focus - centres) * axes).sum(axis=1)
    distances = np.linalg.norm(focus - centres, axis=1)
    low, middle, high = np.quantile(distances, [0.1, 0.5, 0.9])
    if (depths > 0.5 * distances).mean() < IN_FRONT or high - low > 2 * STEADY * middle:
        return None
    return focus, middle
