"""Edges scored against a ground truth, both from files: for edges that come from elsewhere, too."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.errors import UserError
from taichi_edges.evaluation.ground_truth import as_it_is, read_ground_truth
from taichi_edges.evaluation.metrics import evaluate as measure
from taichi_edges.evaluation.metrics import refuse_unbounded
from taichi_edges.geometry.edge_set import EdgeSet, read_edges
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.views.cameras import Similarity


def evaluate(
    edges: Path | str | EdgeSet | Wireframe, truth: Path | str, box: ArrayLike | None = None
) -> dict[str, Any]:
    """EMAP's metrics of edges against a ground truth, and those of the wireframe: the dict of docs/metrics.md.

    edges: path of an edge file (`edges.json`, EMAP's), EdgeSet or Wireframe. truth: path of an ABC folder, a sampled
    `.ply` or an edge `.json`. Both must be in one frame; the edges of a run are in that of its cameras.
    box: (2, 3) opposite corners of the scene in that frame. The protocol measures in a unit cube, of which 0.001 is a
    "mm"; the box, its longest side, becomes it. That of a run is what its stage prepare has found, in `run.json` at
    stages.prepare.facts.box. None: the frame is that of the unit cube already, as in the ABC and the synthetic scenes.
    An ABC folder has a frame of its own and takes no box.
    UserError where a file cannot be read, or the box is none.
    """
    found = _edges(edges)
    to_unit = as_it_is if box is None else _similarity(box).to_unit
    known = read_ground_truth(truth, to_unit)
    if known.own_frame and box is not None:
        raise UserError(f"box: {truth} is an ABC folder, whose frame is normalised; leave box out")
    return {**measure(found.transformed(to_unit), known), "ground_truth": known.source}


def _edges(given: Path | str | EdgeSet | Wireframe) -> EdgeSet:
    """The edges as `evaluate` takes them, as an EdgeSet; those of a file finite."""
    if isinstance(given, Wireframe):
        return given.edge_set()
    if isinstance(given, EdgeSet):
        return given
    if not isinstance(given, (str, os.PathLike)):
        raise UserError(
            f"edges: must be the path of an edge file, an EdgeSet or a Wireframe, not {type(given).__name__}"
        )
    edges = read_edges(given)
    refuse_unbounded(edges, f"{given}: ")
    return edges


def _similarity(box: ArrayLike) -> Similarity:
    """The Similarity that brings a box as the user gives it into the unit cube."""
    try:
        corners = np.asarray(box, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.zeros(0)
    if corners.shape != (2, 3) or not (np.isfinite(corners).all() and (corners[1] > corners[0]).all()):
        raise UserError("box: must be two finite corners (x, y, z), the second greater in x, y and z")
    return Similarity.of_box(corners)
