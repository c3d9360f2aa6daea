"""Edges as line sets: PLY (Open3D, CloudCompare, MeshLab) and OBJ (Blender and most CAD programs)."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.exporters.naming import confidence_of, edge_name, evidence_words, refuse_empty
from taichi_edges.files.artefacts import write_text
from taichi_edges.files.palette import label_colours
from taichi_edges.files.ply import write_elements
from taichi_edges.geometry.shapes import polyline

if TYPE_CHECKING:
    import open3d as o3d

    from taichi_edges.geometry.wireframe import Wireframe

CURVE_SEGMENTS = 32  # for each cubic: a quarter circle in so many chords is off by 0.03 % of its radius


def edge_paths(wireframe: "Wireframe") -> tuple[np.ndarray, list[np.ndarray]]:
    """The edges of a Wireframe as paths over one list of points.

    Returns points (n, 3) float64, the wireframe's vertices first, and for each edge the (k,) int64 indices of the
    points along it: edges that meet share the index of their vertex, a closed edge ends with the index it starts with.
    """
    points, paths, count = [wireframe.vertices], [], len(wireframe.vertices)
    for edge in wireframe.edges:
        along = polyline(edge.shape, CURVE_SEGMENTS)
        own = along[:-1] if edge.shape.closed else along[1:-1]
        between = count + np.arange(len(own))
        first, last = (between[:0], between[:1]) if edge.shape.closed else np.reshape(edge.vertices, (2, 1))
        paths.append(np.concatenate([first, between, last]))
        points.append(own)
        count += len(own)
    return np.concatenate(points), paths


def line_set_arrays(wireframe: "Wireframe") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The edges of a Wireframe as one indexed line set.

    Returns points (n, 3) float64, segments (m, 2) int32 into them, and (m,) the edge of each segment.
    """
    points, paths = edge_paths(wireframe)
    segments = [np.stack([path[:-1], path[1:]], axis=1) for path in paths]
    owners = np.repeat(np.arange(len(paths)), [len(pairs) for pairs in segments])
    return points, np.concatenate([np.zeros((0, 2)), *segments]).astype(np.int32), owners


def build_line_set(wireframe: "Wireframe") -> "o3d.geometry.LineSet":
    """A Wireframe as an open3d.geometry.LineSet, one colour per edge."""
    import open3d as o3d

    points, segments, owners = line_set_arrays(wireframe)
    line_set = o3d.geometry.LineSet(o3d.utility.Vector3dVector(points), o3d.utility.Vector2iVector(segments))
    line_set.colors = o3d.utility.Vector3dVector(label_colours(owners) / 255.0)
    return line_set


def write_line_set_ply(path: Path | str, wireframe: "Wireframe") -> Path:
    """Write a binary PLY: points as doubles, segments as vertex1, vertex2, red, green, blue and two of our own.

    These are `edge`, the index in `edges.json`, and `confidence`, NaN where it is unknown; readers skip properties
    that they do not know. wireframe: in the frame the file shall have.
    """
    refuse_empty(path, wireframe)
    points, pairs, owners = line_set_arrays(wireframe)
    vertices = np.zeros(len(points), [(axis, "<f8") for axis in "xyz"])
    vertices["x"], vertices["y"], vertices["z"] = points.T
    fields = [("vertex1", "<i4"), ("vertex2", "<i4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    segments = np.zeros(len(pairs), [*fields, ("confidence", "<f4"), ("edge", "<i4")])
    segments["vertex1"], segments["vertex2"] = pairs.T
    segments["red"], segments["green"], segments["blue"] = label_colours(owners).T
    segments["confidence"] = np.array([confidence_of(edge) for edge in wireframe.edges])[owners]
    segments["edge"] = owners
    return write_elements(path, {"vertex": vertices, "edge": segments})


def write_line_set_obj(path: Path | str, wireframe: "Wireframe") -> Path:
    """Write a Wavefront OBJ: one object `line_3` or `arc_0` with one `l` polyline per edge, numbers in full.

    wireframe: in the frame the file shall have.
    """
    refuse_empty(path, wireframe)
    points, paths = edge_paths(wireframe)
    text = ["# taichi_edges: edges as polylines; those that meet share vertices"]
    text += _vertex_lines(wireframe.vertices)
    written = len(wireframe.vertices)
    for number, (edge, along) in enumerate(zip(wireframe.edges, paths, strict=True)):
        text.append(f"o {edge_name(number, edge)}")
        text += [f"# {evidence_words(edge)}"] if edge.evidence else []
        upto = max(written, along.max() + 1)
        text += _vertex_lines(points[written:upto])
        text.append("l " + " ".join(map(str, along + 1)))  # OBJ counts vertices from 1
        written = upto
    return write_text(path, "\n".join(text) + "\n")


def _vertex_lines(points: np.ndarray) -> list[str]:
    """'v 0.1 0.2 0.3' of each of the (n, 3) points."""
    return ["v " + " ".join(map(repr, point)) for point in points.tolist()]
