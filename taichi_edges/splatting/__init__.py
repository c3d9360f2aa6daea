"""Differentiable splatting of edge Gaussians with Taichi. Arrays in, arrays out: no files and no YAML in this room."""
