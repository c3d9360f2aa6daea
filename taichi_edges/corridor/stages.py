"""The table of the stages: their names in order, what each reads and writes, and what its result depends on.

Nothing here takes long to import, for the command line lists the names: the files of the stages are imported when they
are to run.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_edges.corridor import sources

if TYPE_CHECKING:
    from taichi_edges.corridor.pipeline import Run


@dataclass(frozen=True)
class Stage:
    """What a stage needs and makes. Its function has its name, and lies in a file of that name beside this one.

    sections: the keys of the scene its result depends on ('a.b' reaches into a section). reads: artefacts of earlier
    stages. writes: its own. outside: function of the Run that lists the input files it reads beyond those, and raises
    UserError where the scene names one that is not there. on_device: whether threads and arch matter to its result.
    packages: those beyond PACKAGES whose version matters to it.
    """

    sections: tuple[str, ...]
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    outside: Callable[["Run"], list[Path]] = lambda run: []
    on_device: bool = False
    packages: tuple[str, ...] = ()


STAGES = {
    "prepare": Stage(
        ("source", "calibration", "box", "seed", "train.edge_threshold", "evaluation.held_out"),
        (),
        ("views.npz", "held_out.npz"),
        sources.source_files,
        packages=("pycolmap",),
    ),
    "train": Stage(
        ("train", "seed"),
        ("views.npz",),
        ("gaussians.ply", "train_log.csv"),
        sources.seed_files,
        on_device=True,
    ),
    "cluster": Stage(
        ("filter", "cluster", "train.edge_threshold", "train.enabled", "seed"),
        ("gaussians.ply", "views.npz"),
        ("points.ply", "clusters.npz"),
        on_device=True,
    ),
    "fit": Stage(("fit", "name", "seed"), ("clusters.npz", "views.npz"), ("edges_fit.json",)),
    "refine": Stage(("refine", "seed"), ("edges_fit.json", "views.npz"), ("edges.json",), on_device=True),
    "evaluate": Stage(
        ("evaluation",),
        ("edges.json", "views.npz", "held_out.npz"),
        ("metrics.json", "metrics.csv"),
        sources.truth_files,
    ),
    "export": Stage(
        (),
        ("edges.json", "views.npz"),
        ("overlays.png",),
        sources.export_files,
        packages=("ezdxf",),
    ),
}


def function_of(name: str) -> Callable[["Run"], dict[str, Any]]:
    """The function of a stage."""
    return getattr(import_module(f"taichi_edges.corridor.{name}"), name)
