"""Edges as line sets: PLY (Open3D, CloudCompare, MeshLab) and OBJ (Blender and most CAD programs)."""

import numpy as np

from taichi_edges.artefacts import replacing, write_text
from taichi_edges.errors import UserError
from taichi_edges.exporters.palette import label_colours

CURVE_SEGMENTS = 32  # a quarter circle in so many chords is off by 0.03 % of its radius


def line_set_arrays(edges):
    """The polylines of an EdgeSet as one indexed line set.

    Returns vertices (n, 3) float64, segments (m, 2) int32 into the vertices, and (m,) the edge of each segment,
    lines first. Edges share no vertices: two edges that meet have one each.
    """
    polylines = edges.polylines(CURVE_SEGMENTS)
    vertices = np.concatenate([np.zeros((0, 3)), *polylines])
    sizes = np.array([len(polyline) for polyline in polylines], dtype=np.int64)
    owners = np.repeat(np.arange(len(polylines)), sizes)
    starts = np.flatnonzero(owners[:-1] == owners[1:])  # a vertex whose successor is of the same edge
    segments = np.stack([starts, starts + 1], axis=1).astype(np.int32)
    return vertices, segments, owners[starts]


def edge_colours(edges):
    """(L + C, 3) uint8 RGB, lines first: the colour of the cluster each edge came from, grey where it is unknown."""
    return label_colours(np.concatenate([edges.line_sources, edges.curve_sources]))


def build_line_set(edges):
    """An EdgeSet as an open3d.geometry.LineSet, one colour per edge."""
    import open3d as o3d

    vertices, segments, owners = line_set_arrays(edges)
    line_set = o3d.geometry.LineSet(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector2iVector(segments))
    line_set.colors = o3d.utility.Vector3dVector(edge_colours(edges)[owners] / 255.0)
    return line_set


def write_line_set_ply(path, edges):
    """Write a binary PLY: vertices as doubles, edges as vertex1, vertex2, red, green, blue; curves as polylines.

    edges: EdgeSet in the frame the file shall have.
    """
    import open3d as o3d

    _refuse_empty(path, edges)
    with replacing(path) as unfinished:
        if not o3d.io.write_line_set(str(unfinished), build_line_set(edges)):
            raise UserError(f"{path}: Open3D could not write it; is the disk full?")
    return path


def write_line_set_obj(path, edges):
    """Write a Wavefront OBJ: one object `line_3` or `curve_0` with one `l` polyline per edge, numbers in full.

    edges: EdgeSet in the frame the file shall have.
    """
    _refuse_empty(path, edges)
    names = [f"line_{index}" for index in range(len(edges.lines))]
    names += [f"curve_{index}" for index in range(len(edges.curves))]
    text, first = ["# taichi_edges: parametric edges as polylines"], 1  # OBJ counts vertices from 1
    for name, polyline in zip(names, edges.polylines(CURVE_SEGMENTS), strict=True):
        text.append(f"o {name}")
        text += ["v " + " ".join(repr(x) for x in vertex) for vertex in polyline.tolist()]
        text.append("l " + " ".join(str(first + offset) for offset in range(len(polyline))))
        first += len(polyline)
    write_text(path, "\n".join(text) + "\n")
    return path


def _refuse_empty(path, edges):
    """Neither Open3D nor the programs that open these files take one without a single edge."""
    if len(edges) == 0:
        raise UserError(f"{path}: there are no edges to write; look at the clusters and loosen the fit's thresholds")
