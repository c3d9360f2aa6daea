"""From a scene to its wireframe in one call: what the command does, and `reconstruct` for other programs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_edges.corridor.loading import is_source, load_scene
from taichi_edges.corridor.pipeline import Run, run_stages, with_reader
from taichi_edges.corridor.stages import STAGES
from taichi_edges.errors import UserError
from taichi_edges.files.artefacts import read_facts
from taichi_edges.geometry.wireframe import Wireframe, read_wireframe
from taichi_edges.progress import make_progress
from taichi_edges.scene.paths import data_folder, expand, scene_path


@dataclass(frozen=True)
class Reconstruction:
    """What `reconstruct` has come to.

    run: the Run, with the resolved scene (`run.config`). wireframe: Wireframe in the frame of the input. metrics: what
    docs/metrics.md lists. record: what `run.json` holds. Wireframe and metrics are None where their stage was not asked
    for.
    """

    run: Run
    wireframe: Wireframe | None
    metrics: dict[str, Any] | None
    record: dict[str, Any]

    @property
    def folder(self) -> Path:
        """Where all files of the run are."""
        return self.run.folder


def reconstruct(
    scene: Path | str,
    start: str | None = None,
    until: str | None = None,
    *,
    out: Path | str = "runs",
    data: Path | str | None = None,
    preset: str | None = None,
    scale: str | None = None,
    seed: int | None = None,
    threads: int | None = None,
    arch: str = "cpu",
    quiet: bool = False,
    **settings: Any,
) -> Reconstruction:
    """Recover the 3D edges of a scene; what is up to date in its folder, `out`/<name of the scene>, is kept.

    scene: a scene file, the name of one that comes along ("demo"), or a folder: COLMAP, nerfstudio, photographs, ...
    start, until: names of stages, see `run_stages`. data: the data root, None for that of TAICHI_EDGES_DATA. The other
    options are those of the command line, by the same names.
    settings: keys of the scene and its sections, as a scene file has them: `name="mine", train={"steps": 300}`.
    Returns a Reconstruction. UserError where the input has a mistake.
    """
    options: dict[str, Any] = {"out": out, "data": data, "preset": preset, "scale": scale, "seed": seed}
    run = open_run(scene, settings, **options, threads=threads, arch=arch, quiet=quiet)
    record = run_stages(run, start, until)
    done = stages_until(record, until)
    wireframe = read_wireframe(run.path("edges.json")) if "refine" in done else None
    metrics = read_facts(run.path("metrics.json")) if "evaluate" in done else None
    return Reconstruction(run, wireframe, metrics, record)


def open_run(
    scene: Path | str,
    settings: Iterable[str] | Mapping[str, Any],
    *,
    out: Path | str,
    data: Path | str | None,
    preset: str | None,
    scale: str | None,
    seed: int | None,
    threads: int | None,
    arch: str,
    quiet: bool,
) -> Run:
    """The Run of a scene, ready for `run_stages`. settings: as `load_scene` takes them, the rest as `reconstruct`."""
    data, out = data_folder(data, "data"), expand(out, "out")
    config = load_scene(scene, preset, settings, seed, scale, data)
    run = Run(config, out / config.name, data, threads, arch, make_progress(quiet))
    run = with_reader(run)
    if is_source(scene_path(scene)):
        _refuse_results_of_another(run)
    return run


def stages_until(record: Mapping[str, Any], until: str | None = None) -> list[str]:
    """The names of the stages that a run has behind it which was to end with `until`, None for the last."""
    names = list(STAGES)
    return [name for name in names[: names.index(until) + 1 if until else None] if name in record["stages"]]


def _refuse_results_of_another(run: Run) -> None:
    """UserError where the run's folder holds the results of another source: folders in two places may be called alike.

    Only where the name is the folder's; in a scene file the user has chosen it.
    """
    try:
        scene = read_facts(run.path("run.json"))["scene"]
        before, name = Path(scene["source"]["path"]), scene["name"]
    except (KeyError, TypeError):
        return
    before = before if before.is_absolute() else (run.data_root or Path()) / before
    if name == run.config.name and before.resolve() != Path(run.config.source.path).resolve():
        problem = f"holds the results of {before}"
        raise UserError(f"{run.folder}: {problem}; name others with --out FOLDER or --set name=NAME, or delete it")
