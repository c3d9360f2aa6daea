"""Gaussians as a PLY with the field names of 3D Gaussian Splatting: opens in any splat viewer."""

from pathlib import Path

import numpy as np

from taichi_edges.files.ply import read_vertices, stack_fields, write_elements

MEAN_FIELDS = ("x", "y", "z")
NORMAL_FIELDS = ("nx", "ny", "nz")  # always zero in 3DGS, but viewers expect them
COLOUR_FIELDS = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY_FIELDS = ("opacity",)
SCALE_FIELDS = ("scale_0", "scale_1", "scale_2")
ROTATION_FIELDS = ("rot_0", "rot_1", "rot_2", "rot_3")
STROKE_FIELDS = ("stroke",)  # our own: viewers pass over it
FIELDS = MEAN_FIELDS + NORMAL_FIELDS + COLOUR_FIELDS + OPACITY_FIELDS + SCALE_FIELDS + ROTATION_FIELDS

HARMONIC_0 = 0.28209479  # the constant spherical harmonic: rgb = 0.5 + HARMONIC_0 * f_dc
ROUNDED = 0.05  # of the standard deviation of a Gaussian: so much no rounding may move it
SPLAT_RGB = (1.0, 0.5, 0.1)  # our Gaussians have no colour of their own; orange shows on black and on white


def write_gaussians(
    path: Path | str,
    means: np.ndarray,
    log_scales: np.ndarray,
    quaternions: np.ndarray,
    opacity_logits: np.ndarray,
    strokes: np.ndarray | None = None,
) -> Path:
    """Write Gaussians as a binary little-endian PLY of float32 fields named as 3D Gaussian Splatting names them.

    Means far from the origin, which float32 would move by more than ROUNDED of the smallest Gaussian, are float64.
    means: (n, 3) world units. log_scales: (n, 3) natural logarithm of world units. quaternions: (n, 4) as
    (w, x, y, z), written as they are. opacity_logits: (n,) or (n, 1). strokes: (n,) int below 2^24, the stroke along
    which each was laid, in order; None where they were not.
    """
    count = len(means)
    normals = np.zeros((count, 3), np.float32)
    colours = np.tile((np.array(SPLAT_RGB) - 0.5) / HARMONIC_0, (count, 1))
    opacity_column = np.reshape(opacity_logits, (count, 1))
    columns, fields = [means, normals, colours, opacity_column, log_scales, quaternions], list(FIELDS)
    if strokes is not None:
        columns, fields = [*columns, np.reshape(strokes, (count, 1))], [*FIELDS, *STROKE_FIELDS]
    values = np.concatenate(columns, axis=1)
    rounding = np.abs(np.asarray(means, np.float64) - np.asarray(means, np.float32)).max(initial=0.0)
    wide = rounding > ROUNDED * np.exp(np.min(log_scales, initial=np.inf))
    kinds = [(name, "<f8" if wide and name in MEAN_FIELDS else "<f4") for name in fields]
    vertices = np.empty(count, kinds)
    for column, name in zip(values.T, fields, strict=True):
        vertices[name] = column
    return write_elements(path, {"vertex": vertices})


def read_gaussians(path: Path | str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Read a Gaussian Splatting PLY, ours or another's (colours and further harmonics are left out).

    Returns means (n, 3), log_scales (n, 3), quaternions (n, 4) and opacity_logits (n,), float32; the means as they are.
    """
    wanted = (MEAN_FIELDS, SCALE_FIELDS, ROTATION_FIELDS, OPACITY_FIELDS)
    vertices = read_vertices(path, [name for names in wanted for name in names])
    means, log_scales, quaternions, opacities = (stack_fields(vertices, names) for names in wanted)
    scales, turns, logits = (array.astype(np.float32, copy=False) for array in (log_scales, quaternions, opacities))
    return means, scales, turns, logits[:, 0]


def read_strokes(path: Path | str) -> np.ndarray | None:
    """(n,) int of a Gaussian Splatting PLY: the stroke along which each was laid; None where they were not."""
    vertices = read_vertices(path, MEAN_FIELDS)
    (name,) = STROKE_FIELDS
    return vertices[name].astype(np.int64) if name in (vertices.dtype.names or ()) else None
