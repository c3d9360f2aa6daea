"""The corridor: which stages there are, what each reads and writes, and when a stage may be skipped.

`run.json` records for every finished stage a fingerprint of all it depended on (settings, input files, seed, threads,
versions) and the digests of what it wrote. A stage whose fingerprint and outputs still match is skipped; a stage the
user wants to start after is refused when it is missing or stale.
"""

import contextlib
import os
import platform
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import yaml

import taichi_edges
from taichi_edges import stages
from taichi_edges.artefacts import digest, digest_file, write_json, write_text
from taichi_edges.errors import UserError
from taichi_edges.progress import Progress

PACKAGES = ("taichi", "numpy", "scipy", "opencv-python-headless", "open3d", "open3d-cpu", "pycolmap")


@dataclass(frozen=True)
class Stage:
    """One stage of the corridor.

    sections: the keys of the scene its result depends on ('a.b' reaches into a section). reads: artefacts of earlier
    stages. writes: its own. outside: function of the Run that lists the input files it reads beyond those.
    """

    function: Callable
    sections: tuple
    reads: tuple
    writes: tuple
    outside: Callable = lambda run: []
    on_device: bool = False


STAGES = {
    "prepare": Stage(stages.prepare, ("source", "box", "seed"), (), ("views.npz",), stages.source_files),
    "train": Stage(stages.train, ("train", "seed"), ("views.npz",), ("gaussians.ply", "train_log.csv"), on_device=True),
    "cluster": Stage(
        stages.cluster,
        ("filter", "cluster", "train.edge_threshold"),
        ("gaussians.ply", "views.npz"),
        ("points.ply", "clusters.npz"),
    ),
    "fit": Stage(stages.fit, ("fit", "name", "seed"), ("clusters.npz", "views.npz"), ("edges.json",)),
    "evaluate": Stage(
        stages.evaluate, ("evaluation",), ("edges.json", "views.npz"), ("metrics.json", "metrics.csv"), stages.truth_files
    ),
    "export": Stage(stages.export, (), ("edges.json", "views.npz"), ("overlays.png",)),
}


@dataclass(frozen=True)
class Run:
    """One scene on its way through the corridor.

    folder: where all artefacts go. data_root: where relative paths of the scene start, or None.
    """

    config: object
    folder: Path
    data_root: Path | None = None
    threads: int = 1
    arch: str = "cpu"
    progress: Progress = field(default_factory=Progress)

    def path(self, name):
        """An artefact's path."""
        return self.folder / name

    @property
    def kernel_cache(self):
        """Where compiled Taichi kernels are kept between runs."""
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        return home / "taichi_edges" / f"kernels-{taichi_edges.__version__}"

    def data_path(self, text, key):
        """A path of the scene: absolute, or relative to the data root. UserError where it does not exist."""
        path = Path(text).expanduser()
        if not path.is_absolute():
            if self.data_root is None:
                raise UserError(f"{key}: {text} is relative to the data root; give --data FOLDER or set TAICHI_EDGES_DATA")
            path = self.data_root / path
        if not path.exists():
            raise UserError(f"{key}: {path} does not exist; correct {key}, --data or TAICHI_EDGES_DATA")
        return path


def run_stages(run, start=None, until=None):
    """Run the corridor. start: this stage and those after it run anew; until: stop after this one.

    Without `start`, every stage that is up to date is skipped. Returns the record that `run.json` holds.
    """
    names = list(STAGES)
    first = names.index(start) if start else 0
    last = names.index(until) if until else len(names) - 1
    if first > last:
        raise UserError(f"--stage {start} comes after --until {until}; the order is {' '.join(names)}")
    record = _open_record(run)
    for name in names[:first]:
        _refuse_stale(run, record, name)
    redo = False
    for name in names[first : last + 1]:
        redo = redo or start is not None
        _run_stage(run, record, name, force=redo)
    return record


def _open_record(run):
    """The run's record, with what is known before any stage: the resolved scene, versions, machine."""
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{run.folder}: cannot be created ({error.strerror}); choose another folder with --out") from error
    old = stages.read_facts(run.path("run.json"))
    scene = run.config.model_dump()
    record = {
        "taichi_edges": taichi_edges.__version__,
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "scene": scene,
        "threads": run.threads,
        "arch": run.arch,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "versions": _versions(),
        "stages": old.get("stages", {}),
    }
    write_text(run.path("scene.yaml"), yaml.safe_dump(scene, sort_keys=False))
    return record


def _versions():
    found = {}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _settings(run, stage):
    """The values a stage depends on, by key."""
    values = {}
    for section in stage.sections:
        value = run.config
        for name in section.split("."):
            value = getattr(value, name)
        values[section] = value.model_dump() if hasattr(value, "model_dump") else value
    if stage.on_device:
        values["threads"], values["arch"] = run.threads, run.arch
    return values


def _fingerprint(run, stage):
    """What the stage depends on: settings, versions, and the digest of every file it reads."""
    files = {path.name: digest_file(run.path(path.name)) for path in map(run.path, stage.reads)}
    outside = {str(path): digest_file(path) for path in stage.outside(run) if path.exists()}
    return digest([_settings(run, stage), files, outside, taichi_edges.__version__, _versions()])


def _state(run, record, name):
    """'fresh', or why not: 'missing', 'changed' (settings or inputs) or 'touched' (an output is not what it wrote)."""
    stage, known = STAGES[name], record["stages"].get(name)
    missing = [artefact for artefact in (*stage.reads, *stage.writes) if not run.path(artefact).exists()]
    if known is None or missing:
        return "missing"
    if known["fingerprint"] != _fingerprint(run, stage):
        return "changed"
    same = all(digest_file(run.path(artefact)) == known["outputs"].get(artefact) for artefact in stage.writes)
    return "fresh" if same else "touched"


def _refuse_stale(run, record, name):
    """UserError unless the stage before the one asked for is up to date."""
    state = _state(run, record, name)
    if state == "fresh":
        return
    stage = STAGES[name]
    artefact = next((a for a in stage.writes if not run.path(a).exists()), stage.writes[0])
    cure = f"run again without --stage, or with --stage {name}"
    if state == "missing":
        raise UserError(f"{run.path(artefact)}: not there yet, the {name} stage has not finished; {cure}")
    if state == "touched":
        raise UserError(f"{run.path(artefact)}: is not the file that the {name} stage wrote; {cure}")
    changes = _changes(record["stages"][name].get("settings", {}), _settings(run, stage))
    why = "; ".join(changes[:3]) or "its input files or the installed versions have changed"
    raise UserError(f"{run.path(artefact)}: stale: {why}; {cure}")


def _changes(old, new, prefix=""):
    """'train.epochs was 500, is now 100' for every value that differs."""
    found = []
    for key in [*new, *(key for key in old if key not in new)]:
        before, now = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(now, dict):
            found += _changes(before, now, f"{prefix}{key}.")
        elif before != now:
            found.append(f"{prefix}{key} was {before}, is now {now}")
    return found


def _run_stage(run, record, name, force):
    """Run one stage, or skip it where it is up to date; keep the record on disk."""
    stage = STAGES[name]
    if not force and _state(run, record, name) == "fresh":
        run.progress.say(f"{name}: up to date ({record['stages'][name]['seconds']:.1f} s when it ran)")
        record["stages"][name]["skipped"] = True
        return
    run.progress.say(f"{name} ...")
    _reset_peak_memory()
    started = time.perf_counter()
    facts = stage.function(run)
    record["stages"][name] = {
        "seconds": round(time.perf_counter() - started, 3),
        "peak_memory_mib": round(_peak_memory_mib(), 1),
        "fingerprint": _fingerprint(run, stage),
        "settings": _settings(run, stage),
        "outputs": {artefact: digest_file(run.path(artefact)) for artefact in stage.writes},
        "facts": facts,
    }
    write_json(run.path("run.json"), record)
    run.progress.say(f"{name}: {describe_facts(facts)} ({record['stages'][name]['seconds']:.1f} s)")


def describe_facts(facts):
    """'50 views, 800 width px' : the counts of a stage in one line; nested values and texts are left to run.json."""
    units = (("_px", " px"), ("_mm", " mm"), ("_percent", " %"), ("_units", " units"))
    parts = []
    for key, value in facts.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            continue
        number = f"{value}" if isinstance(value, int) else f"{value:.4g}"
        suffix = next(((end, unit) for end, unit in units if key.endswith(end)), ("", ""))
        label = key.removesuffix(suffix[0]).replace("_", " ")
        parts.append(f"{number}{suffix[1]} {label}")
    return ", ".join(parts[:6]) or "done"


def _reset_peak_memory():
    """Start the peak anew (Linux; elsewhere the peak is that of the whole process so far)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_memory_mib():
    """Peak resident memory in MiB since the last reset."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if platform.system() == "Darwin" else 1024)
