"""Clusters: oriented points, each with the edge that it lies on. Written by the cluster stage as `clusters.npz`."""

import zipfile
import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import replacing
from taichi_edges.fitting.arc_batch import ArcBatch
from taichi_edges.fitting.arcs import Arc
from taichi_edges.strokes.neighbors import UNASSIGNED


@dataclass(frozen=True)
class Clusters:
    """n oriented points of m edges.

    points, directions: (n, 3) unit cube, and unit vectors, sign arbitrary. labels: (n,) int, the edge that each point
    belongs to, UNASSIGNED for none. shared: (k, 2) int, a point, and an edge it lies on as well. arcs: (m,) of each
    edge the Arc, a line or an arc of a circle, that it is known to be; None for a free curve. noise_px: standard
    deviation of the points across their edge, px, where those of each edge are in order along it; 0 where not.
    """

    points: np.ndarray
    directions: np.ndarray
    labels: np.ndarray
    shared: np.ndarray
    arcs: tuple[Arc | None, ...]
    noise_px: float = 0.0

    @staticmethod
    def of(points: np.ndarray, directions: np.ndarray, labels: np.ndarray) -> "Clusters":
        """Points of free curves only, each on one of them. labels: 0 .. m - 1, or UNASSIGNED."""
        curves = (None,) * int(labels.max(initial=UNASSIGNED) + 1)
        return Clusters(points, directions, labels, np.zeros((0, 2), np.int64), curves)

    def keep(self, chosen: np.ndarray) -> "Clusters":
        """Only the chosen edges, renumbered, and all points. chosen: (m,) bool."""
        numbers = np.append(np.where(chosen, np.cumsum(chosen) - 1, UNASSIGNED), UNASSIGNED)
        shared = self.shared[chosen[self.shared[:, 1]]]
        shared = np.stack([shared[:, 0], numbers[shared[:, 1]]], axis=1)
        arcs = tuple(arc for arc, kept in zip(self.arcs, chosen, strict=True) if kept)
        return replace(self, labels=numbers[self.labels], shared=shared, arcs=arcs)


def write_clusters(path: Path, clusters: Clusters) -> Path:
    """Write `clusters.npz`, a compressed NumPy archive: the fields of Clusters; of the arcs `has_arc` and columns."""
    with replacing(path) as unfinished, open(unfinished, "wb") as file:
        np.savez_compressed(file, **_arrays(clusters))
    return path


def read_clusters(path: Path) -> Clusters:
    """Read `clusters.npz`; UserError where it is not what `write_clusters` writes."""
    try:
        with open(path, "rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError("it is no archive")
        with np.load(path) as archive:
            return _checked({name: archive[name] for name in _arrays(NO_POINTS)})
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); run again with --stage cluster") from error
    except (ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        problem = f"damaged, or of another version ({error})"
        raise UserError(f"{path}: {problem}; run again with --stage cluster") from error


# Its arrays tell the kind, and the shape of a row, of each array in a file.
NO_POINTS = Clusters.of(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64))


def _arrays(clusters: Clusters) -> dict[str, Any]:
    """{name: array} of the file. Columns `arc_..` have a row for each edge that has an Arc."""
    arcs = ArcBatch.of([arc for arc in clusters.arcs if arc is not None])
    return {
        "points": clusters.points,
        "directions": clusters.directions,
        "labels": clusters.labels.astype(np.int64),
        "shared": clusters.shared.astype(np.int64),
        "has_arc": np.array([arc is not None for arc in clusters.arcs], bool),
        "noise_px": np.array([clusters.noise_px], np.float64),
        **{f"arc_{field.name}": getattr(arcs, field.name) for field in fields(arcs)},
    }


def _checked(arrays: dict[str, np.ndarray]) -> Clusters:
    """The Clusters of what the file holds; ValueError where that does not fit together."""
    for name, like in _arrays(NO_POINTS).items():
        array = arrays[name]
        if (array.dtype, array.ndim, array.shape[1:]) != (like.dtype, like.ndim, like.shape[1:]):
            raise ValueError(f"{name} is {array.dtype} {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    arcs = ArcBatch(*(arrays[f"arc_{field.name}"] for field in fields(ArcBatch)))
    points, directions, labels, shared = (arrays[name] for name in ("points", "directions", "labels", "shared"))
    has_arc, lengths = arrays["has_arc"], {len(getattr(arcs, field.name)) for field in fields(arcs)}
    if not len(points) == len(directions) == len(labels) or lengths != {np.count_nonzero(has_arc)}:
        raise ValueError("its arrays are of different lengths")
    if not np.array_equal(np.unique(labels[labels != UNASSIGNED]), np.arange(len(has_arc))):
        raise ValueError("its labels are not those of its edges")
    if ((shared < 0) | (shared >= [len(points), len(has_arc)])).any():
        raise ValueError("it shares points or edges that it has not")
    if len(arrays["noise_px"]) != 1 or arrays["noise_px"][0] < 0:
        raise ValueError("its noise is no standard deviation")
    found = iter(arcs)
    known = tuple(next(found) if has else None for has in has_arc)
    return Clusters(points, directions, labels, shared, known, float(arrays["noise_px"][0]))
