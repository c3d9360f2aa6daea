"""The corridor: stage after stage of the table `stages`, and when a stage may be skipped.

`run.json` records for every finished stage a fingerprint of all it depended on (settings, input files, seed, threads,
versions) and the digests of what it wrote. A stage whose fingerprint and outputs still match is skipped; a stage the
user wants to start after is refused when it is missing or stale.

A stage is a plain function of a Run, in a file of its name beside this one. It returns the facts it found (JSON-able),
which `run.json` keeps; the fact "files", where there is one, lists what it wrote beyond its artefacts. A stage reads
only what is on disk, so a resumed run cannot differ from an unbroken one. What takes long to import (SciPy, OpenCV,
Open3D, Taichi) is imported by the stage that needs it: a run that is up to date, and a mistake in the scene file, shall
not wait for it.
"""

import contextlib
import errno
import functools
import numbers
import os
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

import taichi_edges
from taichi_edges.corridor.findings import FINDINGS
from taichi_edges.corridor.machine import available_threads, peak_memory_mib, reset_peak_memory
from taichi_edges.corridor.stages import STAGES, Stage, function_of
from taichi_edges.errors import OptionError, UserError, refuse_unknown
from taichi_edges.files.artefacts import (
    digest,
    digest_file,
    locked,
    read_facts,
    remove_unfinished,
    write_json,
    write_text,
)
from taichi_edges.progress import Progress, make_progress
from taichi_edges.scene.paths import data_folder, expand
from taichi_edges.scene.settings import SceneConfig

ARCHS = ("cpu", "cuda", "vulkan")
MOST_THREADS = 256  # each has a plane of its own to draw into
STAGE_KEYS = {"seconds", "peak_memory_mib", "fingerprint", "inputs", "outputs", "facts"}
DISK_TROUBLE = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR)
# What the result of any stage may depend on; a stage that uses another package names it.
PACKAGES = ("taichi", "numpy", "scipy", "opencv-python-headless", "open3d", "open3d-cpu", "onnxruntime")


@dataclass(frozen=True)
class Run:
    """One scene on its way through the corridor.

    folder: where all artefacts go; made where it is not there. data_root: where relative paths of the scene start, or
    None. threads: of the CPU. arch: where the kernels run, one of ARCHS.
    """

    config: SceneConfig
    folder: Path
    data_root: Path | None
    threads: int
    arch: str
    progress: Progress

    def __init__(
        self,
        config: SceneConfig,
        folder: Path | str,
        data_root: Path | str | None = None,
        threads: int | None = None,
        arch: str = "cpu",
        progress: Progress | None = None,
    ) -> None:
        """Paths may be strings. data_root: None for that of TAICHI_EDGES_DATA, where it is set. threads: None for all
        that this process may use. progress: None for what the command shows; a plain Progress() is silent.
        """
        if not isinstance(config, SceneConfig):
            raise UserError(f"config: must be what load_scene returns, not {config!r}")
        threads = available_threads() if threads is None else threads
        if not isinstance(threads, numbers.Integral) or isinstance(threads, bool):
            raise OptionError(f"threads {threads!r}: must be a whole number")
        if not 1 <= threads <= MOST_THREADS:
            bound = "at least 1" if threads < 1 else f"at most {MOST_THREADS}"
            raise OptionError(f"threads {threads}: must be {bound}")
        refuse_unknown("arch", arch, "device", ARCHS)
        vars(self).update(
            config=config,
            folder=expand(folder, "folder"),
            data_root=data_folder(data_root),
            threads=int(threads),
            arch=arch,
            progress=progress or make_progress(),
        )

    def path(self, name: str) -> Path:
        """An artefact's path."""
        return self.folder / name

    def data_path(self, text: Path | str, key: str) -> Path:
        """A path of the scene: absolute, or relative to the data root. UserError where it does not exist."""
        path = expand(text, key)
        if not path.is_absolute():
            if self.data_root is None:
                problem = f"{text} is relative to the data root, and there is none"
                raise UserError(f"{key}: {problem}; give --data FOLDER or set TAICHI_EDGES_DATA")
            path = self.data_root / path
        if not path.exists():
            raise UserError(f"{key}: {path} does not exist; correct {key}, --data or TAICHI_EDGES_DATA")
        return path


def with_reader(run: Run) -> Run:
    """The run with the reader that fits what is at its source.path, where the scene names none; says which it is."""
    if run.config.source.reader != "auto":
        return run
    from taichi_edges.readers.recognition import recognised_source

    path = run.data_path(run.config.source.path, "source.path")
    source, found = recognised_source(path, run.config.source)
    run.progress.say(f"{path}: read as {found}")
    return replace(run, config=run.config.model_copy(update={"source": source}))


def run_stages(run: Run, start: str | None = None, until: str | None = None) -> dict[str, Any]:
    """Run the corridor. start: this stage and those after it run anew; until: stop after this one.

    Without `start`, every stage that is up to date is skipped. Returns the record that `run.json` holds; its key "ran"
    lists the stages that were not skipped.
    """
    names = list(STAGES)
    refuse_unknown("start", start, "stage", names)
    refuse_unknown("until", until, "stage", names)
    run = with_reader(run)
    first = names.index(start) if start else 0
    last = names.index(until) if until else len(names) - 1
    if first > last:
        raise UserError(f"{start} comes after {until}, so there is nothing to run; the order is {' '.join(names)}")
    for name in names[: last + 1]:
        STAGES[name].outside(run)  # a mistyped path must not come to light after the training
    with _own_folder(run):
        record = _open_record(run)
        for name in names[:first]:
            _refuse_stale(run, record, name)
        for name in names[first : last + 1]:
            _run_stage(run, record, name, force=start is not None)
    return record


@contextlib.contextmanager
def _own_folder(run: Run) -> Iterator[None]:
    """The run's folder, ours alone; UserError where it cannot be."""
    with contextlib.ExitStack() as stack:
        with _explained_to_be_unwritable(run):
            stack.enter_context(locked(run.folder))
        yield


@contextlib.contextmanager
def _explained_to_be_unwritable(run: Run) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        problem = f"cannot be written to ({error.strerror})"
        raise UserError(f"{run.folder}: {problem}; choose another folder with --out") from error


def _open_record(run: Run) -> dict[str, Any]:
    """The run's record, with what is known before any stage: the resolved scene, versions, machine."""
    scene = run.config.model_dump()
    with _explained_to_be_unwritable(run):
        remove_unfinished(run.folder)
        write_text(run.path("scene.yaml"), yaml.safe_dump(scene, sort_keys=False))
    old = read_facts(run.path("run.json")).get("stages")
    known = old.items() if isinstance(old, dict) else ()
    return {
        "taichi_edges": taichi_edges.__version__,
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "scene": scene,
        "threads": run.threads,
        "arch": run.arch,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "versions": package_versions(tuple(package for stage in STAGES.values() for package in stage.packages)),
        "ran": [],
        "stages": {name: stage for name, stage in known if isinstance(stage, dict) and set(stage) >= STAGE_KEYS},
    }


@functools.cache
def package_versions(more: tuple[str, ...] = ()) -> dict[str, str]:
    """The versions of ourselves, of PACKAGES and of more, by name; without those that are not installed."""
    found = {"taichi_edges": taichi_edges.__version__}
    for package in (*PACKAGES, *more):
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _settings(run: Run, stage: Stage) -> dict[str, Any]:
    """The values a stage depends on, by key."""
    values: dict[str, Any] = {}
    for section in stage.sections:
        value: Any = run.config
        for name in section.split("."):
            value = getattr(value, name)
        values[section] = value.model_dump() if hasattr(value, "model_dump") else value
    if stage.on_device:
        values["threads"], values["arch"] = run.threads, run.arch
    return values


def _inputs(run: Run, stage: Stage) -> dict[str, Any]:
    """What the stage depends on: its settings, the versions, and the digest of every file it reads."""
    files = {artefact: digest_file(run.path(artefact)) for artefact in stage.reads}
    files |= {file_label(run, path): digest_file(path) for path in stage.outside(run) if path.exists()}
    return {"settings": _settings(run, stage), "files": files, "versions": package_versions(stage.packages)}


def file_label(run: Run, path: Path) -> str:
    """A file's path, relative to the run's folder where it lies in it: a folder that was moved is not stale."""
    return (path.relative_to(run.folder) if path.is_relative_to(run.folder) else path).as_posix()


def _why_stale(run: Run, record: dict[str, Any], name: str) -> tuple[str, str] | None:
    """None where a stage is up to date, else (artefact, why it is not what the stage would write now)."""
    stage, known = STAGES[name], record["stages"].get(name)
    missing = [artefact for artefact in stage.writes if not run.path(artefact).exists()]
    if known is None or missing:
        return (*missing, *stage.writes)[0], f"not there yet, the {name} stage has not finished"
    unread = [artefact for artefact in stage.reads if not run.path(artefact).exists()]
    if unread:
        return stage.writes[0], f"stale: {unread[0]}, which the {name} stage reads, is gone"
    inputs = _inputs(run, stage)
    if known["fingerprint"] != digest(inputs):
        changes = _changes(known["inputs"], inputs)
        more = f" and {len(changes) - 3} more" if len(changes) > 3 else ""
        return stage.writes[0], f"stale: {'; '.join(changes[:3]) or 'its inputs have changed'}{more}"
    for artefact, digest_then in known["outputs"].items():
        if not run.path(artefact).exists():
            return artefact, f"is gone since the {name} stage wrote it"
        if digest_file(run.path(artefact)) != digest_then:
            return artefact, f"is not the file that the {name} stage wrote"
    return None


def _refuse_stale(run: Run, record: dict[str, Any], name: str) -> None:
    """UserError unless the stage, one before those asked for, is up to date."""
    stale = _why_stale(run, record, name)
    if stale:
        artefact, why = stale
        raise UserError(f"{run.path(artefact)}: {why}; run again without --stage, or with --stage {name}")


def _changes(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """What differs between two `_inputs`: 'train.epochs was 500, is now 100', 'views.npz has changed'."""
    changes = _changed_values(old.get("settings", {}), new["settings"])
    before, now = old.get("files", {}), new["files"]
    for path in [*now, *(path for path in before if path not in now)]:
        if before.get(path) != now.get(path):
            what = "has changed" if path in before and path in now else "is new" if path in now else "is gone"
            changes.append(f"{path} {what}")
    return changes + _changed_values(old.get("versions", {}), new["versions"], "the version of ")


def _changed_values(old: dict[str, Any], new: dict[str, Any], prefix: str = "") -> list[str]:
    """'train.epochs was 500, is now 100' for every value that differs between two nested dicts."""
    found = []
    for key in [*new, *(key for key in old if key not in new)]:
        before, now = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(now, dict):
            found += _changed_values(before, now, f"{prefix}{key}.")
        elif key not in old or key not in new:
            found.append(f"{prefix}{key} is {'new' if key in new else 'gone'}")
        elif before != now:
            found.append(f"{prefix}{key} was {before}, is now {now}")
    return found


def _run_stage(run: Run, record: dict[str, Any], name: str, force: bool) -> None:
    """Run one stage, or skip it where it is up to date; keep the record on disk."""
    stage, known = STAGES[name], record["stages"].get(name)
    stale = _why_stale(run, record, name)
    if not force and not stale:
        run.progress.say(f"{name}: up to date ({known['seconds']:.1f} s when it ran)")
        return
    run.progress.say(f"{name} again ({stale[0]}: {stale[1]})" if known and stale else f"{name} ...")
    reset_peak_memory()
    started = time.perf_counter()
    try:
        inputs = _inputs(run, stage)
        facts = function_of(name)(run)
        outputs = [*stage.writes, *facts.get("files", [])]
        record["stages"][name] = {
            "seconds": round(time.perf_counter() - started, 3),
            "peak_memory_mib": round(peak_memory_mib(), 1),
            "fingerprint": digest(inputs),
            "inputs": inputs,
            "outputs": {artefact: digest_file(run.path(artefact)) for artefact in outputs},
            "facts": facts,
        }
        record["ran"].append(name)
        write_json(run.path("run.json"), record)
    except OSError as error:
        if error.errno not in DISK_TROUBLE:
            raise
        problem = f"{error.strerror} in the {name} stage"
        raise UserError(f"{error.filename or run.folder}: {problem}; put that right and repeat the command") from error
    run.progress.say(f"{name}: {FINDINGS[name](facts)} ({record['stages'][name]['seconds']:.1f} s)")
