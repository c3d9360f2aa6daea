"""Straight edges whose depth the views cannot tell, anchored to known edges that they meet.

For cameras in a row along a façade the viewing planes of a window sill nearly coincide: the images show where the sill
is, but not how far away. But it touches or crosses other edges, whose depth is known: each straight run of edgels in a
view that no known edge explains is given the depths of the known edges that it meets, the anchors. Two anchors make a
line in space, further ones confirm it. A pipe in front of a cornice meets it in the image alone, and is outvoted. Then
the other views have to show the line as well, and of the lines that would explain the same edgels the one with most
anchors and views stays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.ranges import ragged, starts_of
from taichi_edges.detectors.straight_runs import LEAST_LENGTH_PX, StraightRuns, runs_of
from taichi_edges.evidence.edge_support import Support, support_of
from taichi_edges.evidence.lying import EdgelsAbout
from taichi_edges.geometry.shapes import Line, Shape, middles_of
from taichi_edges.refinement.anchors import BEYOND_PX, Anchors, anchors_of

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching

AGREEING_PX = 2.0  # from a line in space, an anchor on it
APART_SHARE = 0.5  # of a run's length: anchors nearer to each other do not tell its slope in depth
MOST_ANCHORS = 12  # of a run, evenly chosen
TRIED = 3  # hypotheses of each run that are shown to the other views
SPACING_PX = 2.0  # of the places where the views are asked
SHOWN_PX = 1.2  # an edgel so near to the projection shows the line
LEAST_VIEWS = 3  # that show it
SHOWN = 0.6  # of its length in each of them
EXPECTED = 0.5  # share of the views that show its anchors' shapes which show the line, too
CLAIMED = 0.5  # share of its edgels that better lines explain already: it repeats them
LEAST_VOTES, LEAST_WORTH = 2, 3.0  # views that propose a line; with how many of its ends are anchors
OVERLAP, SAME_PX = 0.4, 3.0  # share of common edgels of two lines for one edge; px in space, up to which they agree
ROUNDS = 3  # in which lines carry further ones
REPEAT_PX = 1.5  # in space, between lines that are parts of one


def anchored_lines(matching: "EdgelMatching", shapes: Sequence[Shape]) -> list[Line]:
    """Lines that meet known shapes and that the views show where these say. matching: EdgelMatching.

    What is found in one round is an anchor in the next: the wall for the window's frame, the frame for its pane.
    """
    if not shapes:
        return []
    cameras, support = matching.every_camera, support_of(matching, shapes)
    runs = runs_of(matching.edgels, support.claims.owners < 0)
    anchors = anchors_of(runs, shapes, cameras, matching.pixel_at(middles_of(shapes)))
    lines: list[Line] = []
    for number in range(ROUNDS):
        support = support_of(matching, [*shapes, *lines]) if number else support
        free = support.claims.owners < 0
        found = distinct(shown(matching, hypotheses(runs, anchors), free, seen_in(support)), matching, free)
        if not found:
            break
        further = anchors_of(runs, found, cameras, matching.pixel_at(middles_of(found)))
        anchors = anchors.with_further(further, len(shapes) + len(lines))
        lines += found
    return lines


# ------------------------------------------------------------------------------------------------- lines in space


@dataclass(frozen=True)
class Lines(Columns):
    """Lines in space that are proposed for runs.

    points: (n, 2, 3) two anchors that they pass through. extents: (n, 2) parameters of their ends, 0 and 1 at these.
    shapes: (n, 2) those that these are on. views: (n,) of the runs. closed: (n,) how many ends of the run are anchors,
    0 to 2, each the less the farther it is. pixels: (n,) size of one there, in
    these views, unit-cube units.
    """

    points: np.ndarray
    extents: np.ndarray
    shapes: np.ndarray
    views: np.ndarray
    closed: np.ndarray
    pixels: np.ndarray

    @property
    def ways(self) -> np.ndarray:
        """(n, 3) from the first anchor to the second."""
        return self.points[:, 1] - self.points[:, 0]

    @property
    def ends(self) -> np.ndarray:
        """(n, 2, 3)."""
        return self.points[:, :1] + self.extents[:, :, None] * self.ways[:, None]

    @property
    def at_anchors(self) -> np.ndarray:
        """(n, 2) bool: is an end as near to its anchor as edges are that meet?"""
        off = np.abs(self.extents - [0.0, 1.0]) * np.linalg.norm(self.ways, axis=1)[:, None]
        return off <= BEYOND_PX * self.pixels[:, None]

    @property
    def lengths(self) -> np.ndarray:
        """(n,) unit-cube units."""
        return (self.extents[:, 1] - self.extents[:, 0]) * np.linalg.norm(self.ways, axis=1)


def hypotheses(runs: StraightRuns, anchors: Anchors) -> Lines:
    """The Lines through pairs of anchors of StraightRuns with which most others agree, at most TRIED for each run."""
    counts = np.bincount(anchors.runs, minlength=len(runs))
    starts = starts_of(counts)
    several: list[Lines] = []
    for count in range(2, MOST_ANCHORS + 1):
        chosen = np.flatnonzero(counts == count if count < MOST_ANCHORS else counts >= count)
        share = np.arange(count) / (count - 1)
        rows = starts[chosen, None] + np.round(share * (counts[chosen, None] - 1)).astype(np.int64)
        several += proposed(runs.keep(chosen), anchors.keep(rows))
    return Lines.joined(several)


def proposed(runs: StraightRuns, anchors: Anchors) -> list[Lines]:
    """Lists of Lines for r StraightRuns with c anchors each. anchors: Anchors with arrays (r, c, ..)."""
    lengths, points, ways, pixels = runs.lengths, anchors.points, anchors.ways, anchors.pixels
    first, second = np.triu_indices(points.shape[1], 1)
    agree = on_lines(points, first, second, pixels)  # (r, p, c)
    far = ways[:, second] - ways[:, first]
    enough = far >= APART_SHARE * lengths[:, None]
    worth = np.where(enough, agree.sum(axis=2) + 0.25 * np.minimum(far / lengths[:, None], 2.0), 0.0)
    found, rows = [], np.arange(len(lengths))
    for _ in range(TRIED):
        best = worth.argmax(axis=1) if len(rows) else np.zeros(0, np.int64)
        mine, pair = rows[worth[rows, best] > 0], best[worth[rows, best] > 0]
        ends = np.column_stack([first[pair], second[pair]])
        chosen = (mine[:, None], ends)
        extents, usable = extents_of(lengths[mine], ways[chosen], pixels[chosen])
        gaps = np.abs(ways[chosen] - np.stack([np.zeros(len(mine)), lengths[mine]], axis=1))
        closed = np.maximum(1.0 - gaps / BEYOND_PX, 0.0).sum(axis=1)
        of = anchors.shapes[chosen], runs.views[mine], closed, pixels[chosen].mean(axis=1)
        found.append(Lines(points[chosen], extents, *of).keep(usable))
        implied = ~(agree & ~agree[rows, best][:, None]).any(axis=2)  # nothing agrees that does not with the best
        worth = np.where(implied, 0.0, worth)
    return found


def on_lines(points: np.ndarray, first: np.ndarray, second: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(r, p, c) bool: do anchors, (r, c, 3), lie on the lines through pairs of them? pixels: (r, c) size of one."""
    start, way = points[:, first], points[:, second] - points[:, first]
    way = way / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-300)
    offsets = points[:, None] - start[:, :, None]
    offsets = offsets - np.einsum("rpck,rpk->rpc", offsets, way)[..., None] * way[:, :, None]
    return np.linalg.norm(offsets, axis=3) <= AGREEING_PX * pixels[:, None]


def extents_of(lengths: np.ndarray, ways: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(r, 2) parameters of the ends of runs on lines in space, and (r,) bool, whether they are in front of the camera.

    lengths: (r,) px. ways: (r, 2) px along the run of the places with parameter 0 and 1. pixels: (r, 2) size of one
    there, which are as their depths. A line's places in the image are a projective function of those in space.
    """
    ends = np.stack([np.zeros(len(lengths)), lengths], axis=1)
    near = (ends - ways[:, :1]) * pixels[:, :1]
    below = near + (ways[:, 1:] - ends) * pixels[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        extents = near / below
    return extents, (below > 0).all(axis=1) & (extents[:, 1] > extents[:, 0])


# -------------------------------------------------------------------------------------------- what the views show


@dataclass(frozen=True)
class Sightings:
    """What the views show at places along some Lines.

    lines: (m,) index of the line. parameters: (m,). edgels: (m, V) index, -1 none that is free. seen: (m, V) bool,
    whether the place is in the image.
    """

    lines: np.ndarray
    parameters: np.ndarray
    edgels: np.ndarray
    seen: np.ndarray

    @staticmethod
    def of(matching: "EdgelMatching", lines: Lines, free: np.ndarray, spacing: float) -> "Sightings":
        """spacing: px. free: (e,) bool, the edgels that count."""
        counts = np.maximum(np.round(lines.lengths / (spacing * lines.pixels)), 4).astype(np.int64)
        owners, number = ragged(counts)
        share = (number + 0.5) / counts[owners]
        parameters = lines.extents[owners, 0] + share * np.diff(lines.extents, axis=1)[owners, 0]
        way = lines.ways[owners]
        points = lines.points[owners, 0] + parameters[:, None] * way
        way = way / np.linalg.norm(way, axis=1, keepdims=True)
        about = EdgelsAbout.of(matching, points, way, SHOWN_PX)
        edgels = np.where(np.append(free, False)[about.edgels], about.edgels, -1)
        return Sightings(owners, parameters, edgels, about.inside)

    def shares(self, count: int) -> np.ndarray:
        """(L, V) share of the places of each of the lines that a view has and shows; of them all."""
        total = np.bincount(self.lines, minlength=count)[:, None]
        shown = [np.bincount(self.lines, column, count) for column in (self.edgels >= 0).T]
        return np.stack(shown, axis=1) / np.maximum(total, 1)


def seen_in(support: Support) -> np.ndarray:
    """(S, V) bool: does a view show a shape, on half of its length? support: Support of the shapes."""
    lengths = support.samples.lengths[:, None]
    return support.samples.sums(lengths * (support.edgels >= 0)) >= 0.5 * support.samples.sums(lengths)


def shown(matching: "EdgelMatching", lines: Lines, free: np.ndarray, seen: np.ndarray) -> Lines:
    """The Lines that enough views show, cut to where they do. free: (e,) bool, the edgels that no known shape has.

    seen: (S, V) bool, which views show which shapes. A view that shows both shapes on which a line is anchored should
    show it, too; where it has the depth of something in front of it, neighbouring views do and others do not.
    """
    sightings = Sightings.of(matching, lines, free, SPACING_PX)
    enough = (sightings.edgels >= 0).sum(axis=1) >= LEAST_VIEWS
    lines, kept = clipped(lines, sightings, enough)
    lines = lines.keep(kept)
    sightings = Sightings.of(matching, lines, free, SPACING_PX)
    views = sightings.shares(len(lines)) >= SHOWN
    expected = seen[lines.shapes].all(axis=1)
    agreed = (views & expected).sum(axis=1) >= EXPECTED * expected.sum(axis=1)
    return lines.keep(agreed & (views.sum(axis=1) >= LEAST_VIEWS))


def clipped(lines: Lines, sightings: Sightings, enough: np.ndarray) -> tuple[Lines, np.ndarray]:
    """The Lines cut to where most places are shown by enough views, (m,) bool, and (n,) bool, whether that is a line.

    Of all stretches the one with the greatest surplus of places that are shown over SHOWN of them.
    """
    gain, extents = np.where(enough, 1.0 - SHOWN, -SHOWN), lines.extents.copy()
    starts = np.searchsorted(sightings.lines, np.arange(len(lines) + 1))
    for line in np.unique(sightings.lines[enough]):
        part = slice(starts[line], starts[line + 1])
        total = np.concatenate([[0.0], np.cumsum(gain[part])])
        lowest = np.minimum.accumulate(total)
        last = int(np.argmax(total - lowest))
        first = int(np.argmin(total[: last + 1]))
        step = (lines.extents[line, 1] - lines.extents[line, 0]) / (part.stop - part.start)
        extents[line] = lines.extents[line, 0] + step * np.array([first, last])
    shown = np.bincount(sightings.lines, enough, len(lines)) > 0
    lines = replace(lines, extents=extents)
    lines = replace(lines, extents=np.where(lines.at_anchors, [0.0, 1.0], extents))
    return lines, shown & (lines.lengths >= LEAST_LENGTH_PX * lines.pixels)


# ------------------------------------------------------------------------------------------------- each edge once


def distinct(lines: Lines, matching: "EdgelMatching", free: np.ndarray) -> list[Line]:
    """A list of Line that several views propose. Each edgel is on one, the best founded one, which its repeats extend.

    free: (e,) bool, the edgels that no known shape has.
    """
    sightings = Sightings.of(matching, lines, free, 0.5 * SPACING_PX)
    line_votes = LineVotes.of(lines, sightings, len(free))
    support = np.bincount(sightings.lines, (sightings.edgels >= 0).sum(axis=1), len(lines))
    starts = np.searchsorted(sightings.lines, np.arange(len(lines) + 1))
    owners, extents, kept, accepted = np.full(len(free), -1), lines.extents.copy(), [], line_votes.accepted
    for line in np.lexsort((-support, -line_votes.worth)).tolist():
        found = np.unique(sightings.edgels[starts[line] : starts[line + 1]])
        found = found[found >= 0]
        others = owners[found]
        if (others >= 0).mean() < CLAIMED:
            if accepted[line]:
                kept.append(line)
                owners[found[others < 0]] = line
            continue
        best = int(np.bincount(others[others >= 0]).argmax())
        along, apart = beside(lines, np.array([best]), lines.ends[line][None])
        if apart[0] <= REPEAT_PX * lines.pixels[best]:
            extents[best] = min(extents[best, 0], along.min()), max(extents[best, 1], along.max())
            owners[found[others < 0]] = best
    ends = replace(lines, extents=extents).ends
    return [Line(ends[line]) for line in sorted(kept)]


@dataclass(frozen=True)
class LineVotes:
    """How well some Lines are founded.

    Which known edges a run happens to cross in the image changes with the viewpoint, and so does where a line through
    these would be; what it really touches does not. And edges end where they meet others, in every view.
    votes: (n,) number of views whose runs propose a line. worth: (n,) that and how many of their ends are anchors, on
    average. rivals: (n,) the greatest worth of the other lines for the same edgels.
    """

    votes: np.ndarray
    worth: np.ndarray
    rivals: np.ndarray

    @staticmethod
    def of(lines: Lines, sightings: Sightings, count: int) -> "LineVotes":
        """sightings: of the Lines. count: of edgels."""
        place, view = np.nonzero(sightings.edgels >= 0)
        shape, entries = (len(lines), count), np.ones(len(place), np.int32)
        owned = csr_matrix((entries, (sightings.lines[place], sightings.edgels[place, view])), shape=shape)
        owned.data[:] = 1
        total, common = np.asarray(owned.sum(axis=1))[:, 0], (owned @ owned.T).tocoo()
        alike = common.data >= OVERLAP * np.minimum(total[common.row], total[common.col])
        one, other = common.row[alike], common.col[alike]
        same = beside(lines, one, lines.ends[other])[1] <= SAME_PX * lines.pixels[one]
        votes = votes_of(one[same], lines.views[other[same]], len(lines))
        closed = np.bincount(one[same], lines.closed[other[same]], len(lines))
        worth = votes + closed / np.maximum(np.bincount(one[same], minlength=len(lines)), 1)
        rivals = np.zeros(len(lines))
        np.maximum.at(rivals, one[~same], worth[other[~same]])
        return LineVotes(votes, worth, rivals)

    @property
    def accepted(self) -> np.ndarray:
        """(n,) bool: the lines that enough views propose, and that no other one for their edgels beats."""
        return (self.votes >= LEAST_VOTES) & (self.worth >= LEAST_WORTH) & (self.worth >= self.rivals)


def votes_of(lines: np.ndarray, views: np.ndarray, count: int) -> np.ndarray:
    """(count,) number of different views that are paired with each of the lines."""
    pairs = np.unique(np.column_stack([lines, views]), axis=0)
    return np.bincount(pairs[:, 0], minlength=count)


def beside(lines: Lines, chosen: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k, m) parameters on chosen Lines, (k,), of points (k, m, 3), and (k,) how far these are from them at most."""
    way, offsets = lines.ways[chosen][:, None], points - lines.points[chosen, :1]
    along = (offsets * way).sum(axis=2) / (way**2).sum(axis=2)
    return along, np.linalg.norm(offsets - along[:, :, None] * way, axis=2).max(axis=1)
