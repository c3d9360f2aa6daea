"""Parametric 3D edges (line segments and cubic Bezier curves) from posed images and 2D edge maps."""

__version__ = "0.1.0"
