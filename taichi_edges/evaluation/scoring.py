"""Edges scored against a ground truth, both from files: for edges that come from elsewhere, too."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from taichi_edges.errors import UserError
from taichi_edges.evaluation.ground_truth import as_it_is, read_ground_truth
from taichi_edges.evaluation.metrics import evaluate as measure
from taichi_edges.geometry.edge_set import EdgeSet, read_edges
from taichi_edges.geometry.wireframe import Wireframe
from taichi_edges.views.cameras import Similarity


def evaluate(
    edges: Path | str | EdgeSet | Wireframe, truth: Path | str, box: ArrayLike | None = None
) -> dict[str, Any]:
    """EMAP's metrics of edges against a ground truth, and those of the wireframe: the dict of docs/metrics.md.

    edges: path of an edge file (`edges.json`, EMAP's), EdgeSet or Wireframe. truth: path of an ABC folder, a sampled
    `.ply` or an edge `.json`. Both must be in one frame; the edges of a run are in that of its cameras, whose `box` is
    in `run.json`.
    box: (2, 3) opposite corners of the scene in that frame. The protocol measures in a unit cube, of which 0.001 is a
    "mm"; the box, its longest side, becomes it. None: the frame is that of the unit cube already, as in the ABC scenes.
    An ABC folder has a frame of its own and takes no box.
    UserError where a file cannot be read or the box has no size.
    """
    if isinstance(edges, Wireframe):
        edges = edges.edge_set()
    elif not isinstance(edges, EdgeSet):
        edges, _ = read_edges(edges)
    to_unit = as_it_is if box is None else _similarity(box).to_unit
    known = read_ground_truth(truth, to_unit)
    if known.own_frame and box is not None:
        raise UserError(f"box: {truth} is an ABC folder, whose frame is normalised; leave box out")
    return {**measure(edges.transformed(to_unit), known), "ground_truth": known.source}


def _similarity(box: ArrayLike) -> Similarity:
    """The Similarity that brings a box as the user gives it into the unit cube."""
    corners = np.asarray(box, dtype=np.float64)
    if corners.shape != (2, 3) or not (corners[1] > corners[0]).all():
        raise UserError("box: must be two corners (x, y, z), the second greater in x, y and z")
    return Similarity.of_box(corners)
