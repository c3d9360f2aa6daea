"""Gaussians as a PLY with the field names of 3D Gaussian Splatting: opens in any splat viewer."""

from pathlib import Path

import numpy as np

from taichi_edges.files.ply import read_vertices, stack_fields, write_float_vertices

MEAN_FIELDS = ("x", "y", "z")
NORMAL_FIELDS = ("nx", "ny", "nz")  # always zero in 3DGS, but viewers expect them
COLOUR_FIELDS = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY_FIELDS = ("opacity",)
SCALE_FIELDS = ("scale_0", "scale_1", "scale_2")
ROTATION_FIELDS = ("rot_0", "rot_1", "rot_2", "rot_3")
FIELDS = MEAN_FIELDS + NORMAL_FIELDS + COLOUR_FIELDS + OPACITY_FIELDS + SCALE_FIELDS + ROTATION_FIELDS

HARMONIC_0 = 0.28209479  # the constant spherical harmonic: rgb = 0.5 + HARMONIC_0 * f_dc
SPLAT_RGB = (1.0, 0.5, 0.1)  # our Gaussians have no colour of their own; orange shows on black and on white


def write_gaussians(
    path: Path | str, means: np.ndarray, log_scales: np.ndarray, quaternions: np.ndarray, opacity_logits: np.ndarray
) -> Path:
    """Write Gaussians as a binary little-endian PLY of float32 fields named as 3D Gaussian Splatting names them.

    means: (n, 3) world units. log_scales: (n, 3) natural logarithm of world units. quaternions: (n, 4) as
    (w, x, y, z), written as they are. opacity_logits: (n,) or (n, 1).
    """
    count = len(means)
    normals = np.zeros((count, 3), np.float32)
    colours = np.tile((np.array(SPLAT_RGB) - 0.5) / HARMONIC_0, (count, 1))
    opacity_column = np.reshape(opacity_logits, (count, 1))
    columns = [means, normals, colours, opacity_column, log_scales, quaternions]
    return write_float_vertices(path, FIELDS, np.concatenate([np.asarray(c, np.float32) for c in columns], axis=1))


def read_gaussians(path: Path | str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Read a Gaussian Splatting PLY, ours or another's (colours and further harmonics are left out).

    Returns means (n, 3), log_scales (n, 3), quaternions (n, 4) and opacity_logits (n,), all float32.
    """
    wanted = (MEAN_FIELDS, SCALE_FIELDS, ROTATION_FIELDS, OPACITY_FIELDS)
    vertices = read_vertices(path, [name for names in wanted for name in names])
    means, log_scales, quaternions, opacities = (
        stack_fields(vertices, names).astype(np.float32, copy=False) for names in wanted
    )
    return means, log_scales, quaternions, opacities[:, 0]
