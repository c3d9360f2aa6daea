"""Parametric 3D edges from photographs or edge maps, by splatting edge Gaussians with Taichi.

What is listed in `__all__` is the interface for other programs; it is imported when it is asked for, so that importing
the package itself takes no time.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from taichi_edges.corridor.loading import load_scene
    from taichi_edges.corridor.pipeline import Run, run_stages
    from taichi_edges.corridor.reconstruction import Reconstruction, reconstruct
    from taichi_edges.errors import UserError
    from taichi_edges.evaluation.scoring import evaluate
    from taichi_edges.geometry.edge_set import read_edges
    from taichi_edges.geometry.wireframe import read_wireframe

__all__ = [
    "Reconstruction",
    "Run",
    "UserError",
    "evaluate",
    "load_scene",
    "read_edges",
    "read_wireframe",
    "reconstruct",
    "run_stages",
]
__version__ = "0.1.0"

# Taichi reads these when it is imported: no version line on stdout, no question to a server on the net.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")

_HOMES = {
    "Reconstruction": "corridor.reconstruction",
    "Run": "corridor.pipeline",
    "UserError": "errors",
    "evaluate": "evaluation.scoring",
    "load_scene": "corridor.loading",
    "read_edges": "geometry.edge_set",
    "read_wireframe": "geometry.wireframe",
    "reconstruct": "corridor.reconstruction",
    "run_stages": "corridor.pipeline",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'taichi_edges' has no attribute '{name}'")
    return getattr(import_module(f"taichi_edges.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
