"""Differentiable splatting of edge Gaussians with Taichi. Arrays in, arrays out: no files and no YAML in this room."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # read when Taichi is imported: no version line on stdout
