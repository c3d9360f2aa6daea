"""The device that Taichi runs on, and arrays on their way there: a CPU works on NumPy's own memory, a GPU on copies."""

import contextlib
import gc
import io
import os
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import taichi as ti

import taichi_edges
from taichi_edges.errors import OptionError

DEVICES = {"cpu": ti.cpu, "cuda": ti.cuda, "vulkan": ti.vulkan}
STALE_LOCK = 60.0  # seconds; Taichi holds the lock of its kernel cache for some milliseconds


def kernel_cache() -> Path:
    """Where compiled kernels are kept between runs: a folder of our own for each pair of versions."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "taichi_edges" / f"kernels-{taichi_edges.__version__}-taichi-{version('taichi')}"


def start_taichi(arch: str, threads: int, seed: int, cache: Path | str) -> None:
    """ti.init for this project: f32, quiet, kernels cached in the folder `cache` (not at all where it is read-only).

    What an earlier program held on the device is freed. arch: 'cpu', 'cuda' or 'vulkan'. UserError where the machine
    does not have it.
    """
    gc.collect()  # an ndarray of an earlier program that is freed later would take memory of the new one with it
    release_cache(Path(cache))
    cached = _is_writable(Path(cache))  # else Taichi would crash
    with contextlib.redirect_stdout(io.StringIO()):  # ti.init announces itself with a bare print
        ti.init(
            arch=DEVICES[arch],
            default_fp=ti.f32,
            cpu_max_num_threads=threads,
            random_seed=seed,
            offline_cache=cached,
            **({"offline_cache_file_path": str(cache)} if cached else {}),
            log_level=ti.ERROR,
        )
    in_use = ti.lang.impl.current_cfg().arch
    if arch != "cpu" and in_use != DEVICES[arch]:
        raise OptionError(f"arch {arch}: this machine offers Taichi no {arch} device; use cpu")


def _is_writable(folder: Path) -> bool:
    """Whether files can be written to a folder, which is made where it is not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def release_cache(cache: Path) -> None:
    """Remove the lock that a killed process has left in the kernel cache: with it nothing is read from there again.

    Processes that run at the same time take turns by that lock; one held for STALE_LOCK is nobody's.
    """
    lock = cache / "ticache.lock"
    with contextlib.suppress(OSError):
        if time.time() - lock.stat().st_mtime > STALE_LOCK:
            lock.unlink()


def is_running(arch: str, threads: int) -> bool:
    """Whether Taichi runs on this arch ('cpu', 'cuda' or 'vulkan') with this number of CPU threads, and in f32."""
    if ti.lang.impl.get_runtime().prog is None:
        return False
    running = ti.lang.impl.current_cfg()
    wanted = (getattr(ti, arch), threads, ti.f32)
    return (running.arch, running.cpu_max_num_threads, running.default_fp) == wanted


def threads() -> int:
    """The number of CPU threads Taichi was started with."""
    return ti.lang.impl.current_cfg().cpu_max_num_threads


def upload(array: np.ndarray) -> np.ndarray | ti.Ndarray:
    """What kernels take for a NumPy array: on a CPU the array itself, on a GPU a copy in its memory."""
    array = np.ascontiguousarray(array)
    if ti.lang.impl.current_cfg().arch == ti.cpu:
        return array
    copy = ti.ndarray(ti.lang.util.to_taichi_type(array.dtype), shape=array.shape)
    copy.from_numpy(array)
    return copy


def download(array: np.ndarray | ti.Ndarray) -> np.ndarray:
    """What kernels have written to the `upload` of an array, as a NumPy array."""
    return array if isinstance(array, np.ndarray) else array.to_numpy()
