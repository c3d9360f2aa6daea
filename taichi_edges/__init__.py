"""Parametric 3D edges from posed images and 2D edge maps, by splatting edge Gaussians."""

import os

# Taichi reads these when it is imported: no version line on stdout, no question to a server on the net.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")

__version__ = "0.1.0"
