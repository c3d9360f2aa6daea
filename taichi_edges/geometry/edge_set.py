"""EdgeSet: edges as EMAP has them, lines and cubics, with their samples; and EMAP's keys of the file `edges.json`."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import write_json
from taichi_edges.geometry.bezier import bezier_lengths, evaluate_bezier
from taichi_edges.scene.paths import expand


@dataclass(frozen=True)
class EdgeSet:
    """Line segments and cubic Bezier curves.

    lines:          (L, 2, 3) end points.
    curves:         (C, 4, 3) control points.
    line_sources:   (L,) int, the number of the edge that a line is, or -1 where it is unknown.
    curve_sources:  (C,) int, the same for curves. Pieces of one edge (a circle is several cubics) share the number, so
                    counting distinct sources counts edges.
    """

    lines: np.ndarray
    curves: np.ndarray
    line_sources: np.ndarray
    curve_sources: np.ndarray

    @staticmethod
    def of(lines: ArrayLike = (), curves: ArrayLike = ()) -> "EdgeSet":
        """An EdgeSet in which every line and every curve is an edge of its own."""
        lines = np.asarray(lines, dtype=np.float64).reshape(-1, 2, 3)
        curves = np.asarray(curves, dtype=np.float64).reshape(-1, 4, 3)
        return EdgeSet(lines, curves, np.arange(len(lines)), len(lines) + np.arange(len(curves)))

    def __len__(self) -> int:
        return len(self.lines) + len(self.curves)

    @property
    def lengths(self) -> np.ndarray:
        """(L + C,) arc lengths, lines first."""
        return np.concatenate(
            [np.linalg.norm(self.lines[:, 1] - self.lines[:, 0], axis=1), bezier_lengths(self.curves)]
        )

    def transformed(self, function: Callable[[np.ndarray], np.ndarray]) -> "EdgeSet":
        """The same edges with `function`, (n, 3) -> (n, 3), an affine map, applied to every point."""
        lines = function(self.lines.reshape(-1, 3)).reshape(-1, 2, 3)
        curves = function(self.curves.reshape(-1, 3)).reshape(-1, 4, 3)
        return EdgeSet(lines, curves, self.line_sources, self.curve_sources)

    def polylines(self, curve_segments: int = 32) -> list[np.ndarray]:
        """One (m, 3) polyline for each edge, lines first."""
        parameters = np.linspace(0.0, 1.0, curve_segments + 1)
        return list(self.lines) + [evaluate_bezier(control, parameters) for control in self.curves]

    def sample(self, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points at most `spacing` apart along every edge (both end points included), with unit tangents.

        Returns points (n, 3), tangents (n, 3) and (n,) the index of the edge, lines first.
        """
        points: list[np.ndarray] = []
        tangents: list[np.ndarray] = []
        owners: list[np.ndarray] = []
        for index, polyline in enumerate(self.polylines()):
            steps = np.linalg.norm(np.diff(polyline, axis=0), axis=1)
            arc = np.concatenate([[0.0], np.cumsum(steps)])
            count = max(int(np.ceil(arc[-1] / spacing)), 1) + 1
            at = np.linspace(0.0, arc[-1], count)
            segment = np.clip(np.searchsorted(arc, at, side="right") - 1, 0, len(steps) - 1)
            points.append(np.stack([np.interp(at, arc, polyline[:, axis]) for axis in range(3)], axis=1))
            tangents.append((np.diff(polyline, axis=0) / np.maximum(steps, 1e-300)[:, None])[segment])
            owners.append(np.full(count, index))
        if not points:
            return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64)
        return np.concatenate(points), np.concatenate(tangents), np.concatenate(owners)


def write_edges(path: Path | str, edges: EdgeSet, about: dict[str, Any]) -> Path:
    """Write `edges.json`: EMAP's keys `curves_ctl_pts` (n, 4, 3) and `lines_end_pts` (n, 2, 3), and keys of our own.

    edges: EdgeSet in the frame of the input. about: dict of further top-level keys (counts, units), JSON values only.
    """
    content = {
        "curves_ctl_pts": edges.curves.tolist(),
        "lines_end_pts": edges.lines.tolist(),
        "curve_sources": edges.curve_sources.tolist(),
        "line_sources": edges.line_sources.tolist(),
        **about,
    }
    return write_json(path, content)


def read_edges(path: Path | str) -> EdgeSet:
    """The EdgeSet of an `edges.json`, of ours or of EMAP's (where every piece is an edge of its own)."""
    return edges_and_about(path)[0]


def edges_and_about(path: Path | str) -> tuple[EdgeSet, dict[str, Any]]:
    """The EdgeSet of an `edges.json`, and the dict of its other keys."""
    path = expand(path, "edges")
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; an edge file is what the refine stage writes") from error
    except ValueError as error:
        raise UserError(f"{path}: not an edge file, it cannot be read as JSON ({error})") from error
    if not isinstance(content, dict) or not {"lines_end_pts", "curves_ctl_pts"} <= set(content):
        raise UserError(f"{path}: not an edge file; it needs the keys curves_ctl_pts and lines_end_pts")
    lines, curves = _points(path, content, "lines_end_pts", 2), _points(path, content, "curves_ctl_pts", 4)
    edges = EdgeSet.of(lines, curves)
    found = [key for key in ("line_sources", "curve_sources") if key in content]
    if len(found) == 1:
        raise UserError(f"{path}: it has {found[0]} alone; give both line_sources and curve_sources, or neither")
    if found:
        line_sources = _sources(path, content, "line_sources", len(lines))
        edges = EdgeSet(edges.lines, edges.curves, line_sources, _sources(path, content, "curve_sources", len(curves)))
    return edges, content


def _points(path: Path | str, content: dict[str, Any], key: str, count: int) -> np.ndarray:
    """Takes the (n, count, 3) points of every edge out of an edge file's content."""
    values = content.pop(key)
    try:
        points = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: {key} must hold {count} points (x, y, z) for every edge") from error
    if points.size and points.shape[1:] != (count, 3):
        shape = " x ".join(map(str, points.shape))
        raise UserError(f"{path}: {key} must hold {count} points (x, y, z) for every edge, but it is {shape}")
    return points.reshape(-1, count, 3)


def _sources(path: Path | str, content: dict[str, Any], key: str, count: int) -> np.ndarray:
    """Takes the edge numbers of `count` lines or curves out of an edge file's content."""
    values = content.pop(key)
    if not isinstance(values, list) or not all(type(value) is int for value in values):
        raise UserError(f"{path}: {key} must be a list of whole numbers, one for every edge")
    if len(values) != count:
        problem = f"{key} and the edges do not match: {len(values)} and {count}"
        raise UserError(f"{path}: {problem}; give one for every edge, or remove line_sources and curve_sources")
    return np.array(values, dtype=np.int64)
