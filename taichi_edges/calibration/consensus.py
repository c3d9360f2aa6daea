"""What edgels of many views say together: 3D points on edges, each displaced a little so that all views agree."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from taichi_edges.arrays.robust import NORMAL_MAD
from taichi_edges.calibration.backgrounds import CLEAR, Sides
from taichi_edges.calibration.offsets import (
    LEAST_OBSERVATIONS,
    MOST_RESIDUAL,
    Estimate,
    Observations,
    OffsetFit,
    camera_leverage,
    fit_offsets,
    standard_errors,
)
from taichi_edges.views.cameras import NEAR, inside_image
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import Views, pixel_size

Found = TypeVar("Found")

LEAST_POINTS, MOST_POINTS = 50, 3000  # fewer are no use; more only cost time: each is seen by most of the views
REACHES = (5.0, 3.0)  # px around a 3D point within which an edgel may be its, round by round
FARTHEST_PX = 3.0  # that a point is moved in one round
# Two edgels place a point whatever they are, and it would agree with them to nothing: what few views see, as between
# bars whose lines blend in most views, is chance, and makes the rest look better than it is.
LEAST_REDUNDANT = 3  # edgels of a point
LEAST_SEEN, LEAST_SEEN_SHARE = 5, 0.2  # and views, and share of all of them, that see a point which measures biases
# Silhouettes are held against points that so many edgels inside place. A point on the occluding contour of a slim shaft
# is on silhouettes in all views; its displacement and their offset cannot be told apart.
LEAST_INSIDE = LEAST_REDUNDANT
MOST_SILHOUETTE = 0.85  # of a point's observations; a few chance edgels inside do not place what is a contour
# A flood that leaks through a gap of an outline makes silhouettes of edges that are none, many of them in one view.
ODD_PX = 0.5  # px by which the silhouettes of a view lie, in the median, farther out or in than those of the others
LEAST_IN_VIEW = 10  # silhouettes of which a median is taken
# Contours move over the surface with the viewpoint.
STEADY_SHARE = 2 / 3  # of a point's silhouettes, and of its edgels inside, that agree with it
AGREEING_PX, AGREEING_SCALES = 0.5, 3.0  # px, and standard deviations of the residuals, to which edgels agree
# Standard errors through 3D points, of the outward offset and the shift's coordinates, for each px of median residual,
# that no leaving out of observations shows: interior edges have small biases of their own, which points on them take
# over. On exact CAD models, with residuals of 0.17 px, the offset came out wrong by 0.17 px and the shift by 0.08.
OWN_ERRORS = np.array([0.6, 0.4, 0.4])
CAMERA_ERROR = 0.1  # px; cameras are not known better, whatever the residuals say
WALK, STEP = 8.0, 1.0  # px to each side of a projection that are looked at; lines in an edgel table are two px or more
SAME_LINE = 2.5  # px; edgels farther apart across the edge are of two lines
ALIGNED = np.cos(np.radians(20.0))  # an edgel runs along the projection of its point's line, to that angle
LEAST_LENGTH = 0.2  # of a line's true length: seen more end-on, its direction says nothing
BESIDE = (-2, -1, 0, 1, 2)  # px along an edge, to which an edgel's point explains others too


class Consensus:
    """3D points on edges, moved step by step to where the edgels of all views see them.

    points, directions: (p, 3) unit cube, and unit vectors along the edges.
    """

    def __init__(
        self,
        views: Views,
        edgels: Edgels,
        sides: Sides,
        points: np.ndarray,
        directions: np.ndarray,
        threads: int | None = None,
    ) -> None:
        count = len(points)
        chosen = np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int64)
        self.points, self.directions = (np.asarray(array, np.float64)[chosen] for array in (points, directions))
        self.views, self.edgels, self.sides, self.threads = views, edgels, sides, threads
        self.pixel, self.across = pixel_size(views), across(self.directions)

    def estimate(self, known: np.ndarray, start: np.ndarray) -> tuple[Estimate | None, str]:
        """Estimate of the biases, or None, and then why, or ''. known: (3,) px, NaN where unknown. start: a guess."""
        if len(self.points) < LEAST_POINTS:
            return None, f"{len(self.points)} 3D points are too few to calibrate with; {LEAST_POINTS} are needed"
        values = np.where(np.isnan(known), start, known)
        for reach in REACHES:
            observations = self._well_seen(self.observe(values, reach))
            if len(observations) < LEAST_OBSERVATIONS:
                return None, f"3D points explain only {len(observations)} edgels; {LEAST_OBSERVATIONS} are needed"
            fit = fit_offsets(observations, known, len(self.points))
            self._move(fit)
            values = fit.values
        observations = self._balanced(self._well_seen(self.observe(values, REACHES[-1])))
        if len(observations) >= LEAST_OBSERVATIONS:
            observations = self.without_odd_views(observations, known)
            observations = self._steady(observations, fit_offsets(observations, known, len(self.points)))
        if len(observations) < LEAST_OBSERVATIONS or np.count_nonzero(self._counts(observations)) < LEAST_POINTS:
            return None, "nearly all 3D points are on silhouettes only, or not steady"
        return self._weighed(observations, known)

    def _weighed(self, observations: Observations, known: np.ndarray) -> tuple[Estimate | None, str]:
        """Estimate from the observations, or None, and then why, or ''."""
        fit = fit_offsets(observations, known, len(self.points))
        residual = np.median(np.abs(fit.residuals))
        if residual > MOST_RESIDUAL:
            return None, f"the views agree on 3D points to {residual:.2f} px only; {MOST_RESIDUAL} px are needed"
        errors = standard_errors(observations, fit, known, self.points)
        cameras = max(residual, CAMERA_ERROR) * camera_leverage(observations, fit, known, len(self.points))
        own = OWN_ERRORS * residual * np.isnan(known)
        return Estimate(fit.values, np.sqrt(errors**2 + cameras**2 + own**2), "points"), ""

    def observe(self, values: np.ndarray, reach: float) -> Observations:
        """Observations of the points by edgels, sought without the biases `values`, (3,) px, at most `reach` px away.

        Edgels that are neither surely on silhouettes nor surely inside are left out.
        """
        corrected, weights = self.sides.correct(self.edgels, values)
        flags = np.where(weights >= CLEAR, 1.0, np.where(self.sides.interior, 0.0, np.nan))

        def look(view: int) -> Observations:
            owners, found = self._edgels_beside(view, corrected, reach)
            found += self.edgels.starts[view]
            owners, found = (array[np.isfinite(flags[found])] for array in (owners, found))
            points, normals = self.points[owners], self.sides.outward[found]
            offsets = ((self.edgels.points[found] - self.views.project(points, view)[0]) * normals).sum(axis=1)
            across_edge = np.einsum("ni,nij->nj", normals, self.views.camera(view).slopes(points))
            slopes = self.pixel * np.einsum("nj,nkj->nk", across_edge, self.across[owners])
            return Observations(offsets, normals, flags[found], found, np.full(len(found), view), owners, slopes)

        return Observations.joined(self._for_each_view(look))

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """(n,) px from the 3D point that explains an edgel to it, without the biases, outward; NaN where none does.

        The points are moved to fit those biases first. A point with edgels to spare explains those that are its own,
        and those next to them along the line.
        """
        observations = self._redundant(self.observe(values, REACHES[-1]))
        if len(observations) < LEAST_OBSERVATIONS:
            return np.full(len(self.edgels), np.nan)
        self._move(fit_offsets(observations, values, len(self.points)))
        corrected, _ = self.sides.correct(self.edgels, values)
        placed = self._counts(observations) > 0
        return np.concatenate(self._for_each_view(lambda view: self._residuals_in(view, corrected, placed)))

    def _for_each_view(self, look: Callable[[int], Found]) -> list[Found]:
        with ThreadPoolExecutor(self.threads) as pool:  # NumPy releases the lock in the long loops
            return list(pool.map(look, range(len(self.views))))

    def _move(self, fit: OffsetFit) -> None:
        moves = np.clip(fit.displacements, -FARTHEST_PX, FARTHEST_PX)
        self.points = self.points + self.pixel * np.einsum("nk,nkj->nj", moves, self.across)

    def _redundant(self, observations: Observations, least: float = LEAST_REDUNDANT) -> Observations:
        """The observations of points that have at least so many."""
        return observations.keep((self._counts(observations) >= least)[observations.owners])

    def _well_seen(self, observations: Observations) -> Observations:
        """The observations of points that enough views see to tell biases."""
        return self._redundant(observations, max(LEAST_SEEN, LEAST_SEEN_SHARE * len(self.views)))

    def _balanced(self, observations: Observations) -> Observations:
        """The observations of points that are seen inside often enough."""
        counts = self._counts(observations)
        silhouettes = self._counts(observations, observations.silhouette)
        enough = (counts - silhouettes >= LEAST_INSIDE) & (silhouettes <= MOST_SILHOUETTE * counts)
        return observations.keep(enough[observations.owners])

    def without_odd_views(self, observations: Observations, known: np.ndarray) -> Observations:
        """The observations without silhouettes of views that disagree with the others on how far outside they lie.

        That is told from points placed by edgels inside alone.
        """
        outside = observations.silhouette > 0
        placed = fit_offsets(observations.keep(~outside), np.append(0.0, known[1:]), len(self.points))
        moved = observations.moved_by(placed.displacements)
        offsets = observations.offsets - observations.normals @ placed.values[1:] - moved
        middles = np.full(len(self.views), np.nan)
        for view in np.flatnonzero(np.bincount(observations.views[outside]) >= LEAST_IN_VIEW):
            middles[view] = np.median(offsets[outside & (observations.views == view)])
        if np.isnan(middles).all():
            return observations
        odd = np.abs(middles - np.nanmedian(middles)) > ODD_PX
        return observations.keep(~(outside & odd[observations.views]))

    def _steady(self, observations: Observations, fit: OffsetFit) -> Observations:
        """The observations of points that most of their edgels agree with, on silhouettes as well as inside."""
        sizes = np.abs(fit.residuals)
        agree = sizes <= max(AGREEING_PX, AGREEING_SCALES * NORMAL_MAD * np.median(sizes))
        steady = np.ones(len(self.points), bool)
        for kind in (observations.silhouette > 0, observations.silhouette == 0):
            steady &= self._counts(observations, kind & agree) >= STEADY_SHARE * self._counts(observations, kind)
        return observations.keep(steady[observations.owners])

    def _counts(self, observations: Observations, weights: np.ndarray | None = None) -> np.ndarray:
        """(p,) of each point the number of its observations, or the sum of their weights."""
        assert observations.owners is not None
        return np.bincount(observations.owners, weights, len(self.points))

    def _residuals_in(self, view: int, edgels: Edgels, placed: np.ndarray) -> np.ndarray:
        """`residuals` of one view's edgels. placed: (p,) bool, the points that may explain any."""
        places, normals, _ = edgels.of_view(view)
        residuals = np.full(len(places), np.nan)
        owners, found = self._edgels_beside(view, edgels, REACHES[-1])
        owners, found = (array[placed[owners]] for array in (owners, found))
        pixels, _ = self.views.project(self.points[owners], view)
        others, rows = _neighbours(edgel_table(places, (self.views.height, self.views.width)), places, normals, found)
        across_edge = normals[found[rows]]
        offsets = ((places[others] - pixels[rows]) * across_edge).sum(axis=1)
        offsets *= np.sign((across_edge * self.sides.outward[edgels.starts[view] + others]).sum(axis=1))
        explained = np.flatnonzero(np.abs(offsets) <= REACHES[-1])
        explained = explained[np.argsort(-np.abs(offsets[explained]), kind="stable")]  # the smallest is written last
        residuals[others[explained]] = offsets[explained]
        return residuals

    def _edgels_beside(self, view: int, edgels: Edgels, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Points (m,) and, for each, the edgel (m,) of the view nearest to its projection across the edge, at most
        `reach` px away; only where no other edge is near.
        """
        places, normals, _ = edgels.of_view(view)
        pixels, across_edge = projected_normals(self.views, view, self.points, self.directions)
        inside = inside_image(pixels, self.views.width, self.views.height)
        seen = np.flatnonzero(inside & np.isfinite(across_edge[:, 0]))
        pixels, across_edge = pixels[seen], across_edge[seen]
        rows, found = _walk(edgel_table(places, (self.views.height, self.views.width)), pixels, across_edge)
        offsets = ((places[found] - pixels[rows]) * across_edge[rows]).sum(axis=1)
        aligned = np.abs((normals[found] * across_edge[rows]).sum(axis=1)) >= ALIGNED
        order = np.lexsort((np.where(aligned, np.abs(offsets), np.inf), rows))
        nearest = order[np.unique(rows[order], return_index=True)[1]]  # of each row that has any
        best = np.zeros(len(seen))
        best[rows[nearest]] = offsets[nearest]
        others = np.bincount(rows, np.abs(offsets - best[rows]) > SAME_LINE, len(seen))
        nearest = nearest[aligned[nearest] & (np.abs(offsets[nearest]) <= reach) & (others[rows[nearest]] == 0)]
        return seen[rows[nearest]], found[nearest].astype(np.int64)


def across(directions: np.ndarray) -> np.ndarray:
    """(n, 2, 3): two unit vectors at right angles to each of the (n, 3) unit vectors, and to each other."""
    least = np.eye(3)[np.abs(directions).argmin(axis=1)]
    first = np.cross(directions, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


def projected_normals(
    views: Views, view: int, points: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Projections (n, 2) and unit normals (n, 2) of the lines there, px; NaN where a line is seen end-on."""
    pixels, depths = views.project(points, view)
    safe = np.where((depths > NEAR)[:, None], points, np.nan)
    along = np.einsum("nij,nj->ni", views.camera(view).slopes(safe), directions)
    lengths = np.linalg.norm(along, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        long = lengths > LEAST_LENGTH * views.intrinsics[view, 0, 0] / depths
        along = np.where(long[:, None], along / lengths[:, None], np.nan)
    return pixels, np.stack([-along[:, 1], along[:, 0]], axis=1)


def edgel_table(places: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(H + 2, W + 2) int32: the edgel at each pixel, or beside it where it has none of its own; -1 where there is none.

    The table has a border of one pixel. A walk across a line cannot slip between its diagonal neighbours.
    """
    table = np.full((shape[0] + 2, shape[1] + 2), -1, np.int32)
    columns, rows = np.clip(np.rint(places).astype(np.int64), 0, [shape[1] - 1, shape[0] - 1]).T + 1
    indices = np.arange(len(places), dtype=np.int32)
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)):
        table[rows + down, columns + right] = indices
    return table


def _walk(table: np.ndarray, pixels: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edgels met on walks through pixels (n, 2) along directions (n, 2): which walk (k,), and which edgel (k,)."""
    along = np.arange(-WALK, WALK + STEP / 2, STEP, dtype=np.float32)
    columns, rows = (
        np.rint(pixels[:, axis, None] + 1 + directions[:, axis, None].astype(np.float32) * along).astype(np.int32)
        for axis in (0, 1)
    )
    found = _at(table, rows, columns)
    walks, steps = np.nonzero(found >= 0)
    return walks, found[walks, steps]


def _neighbours(
    table: np.ndarray, places: np.ndarray, normals: np.ndarray, found: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Edgels (k,) next to those in `found` (m,) along the line, themselves included, and to which of those, (k,)."""
    tangents = np.stack([-normals[found, 1], normals[found, 0]], axis=1)
    spots = np.rint(places[found] + np.asarray(BESIDE)[:, None, None] * tangents).astype(np.int64) + 1  # (5, m, 2)
    others = _at(table, spots[..., 1], spots[..., 0])
    aligned = np.abs((normals[others] * normals[found]).sum(axis=2)) >= ALIGNED if len(found) else others >= 0
    steps, rows = np.nonzero((others >= 0) & aligned)
    return others[steps, rows], rows


def _at(table: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The table's values at rows and columns, which may lie beyond it."""
    rows, columns = np.clip(rows, 0, table.shape[0] - 1), np.clip(columns, 0, table.shape[1] - 1)
    return table.reshape(-1)[rows * table.shape[1] + columns]
