"""The machine a benchmark runs on: one line about it, its threads, the memory of this process."""

import contextlib
import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

import psutil

from taichi_edges.corridor.machine import MIB, available_threads


def machine_line():
    """CPU, cores, system, Python and Taichi, for the head of every result."""
    python, taichi = platform.python_version(), version("taichi")
    cores = f"{available_threads()} of {os.cpu_count()} cores"
    return f"{_cpu_model()}, {cores}, {platform.system()} {platform.machine()}, Python {python}, Taichi {taichi}"


def _cpu_model():
    """The model's name where the system says it, else the architecture."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def memory_mib():
    """Resident memory of this process now, in MiB."""
    return psutil.Process().memory_info().rss / MIB


def maxrss_mib(usage):
    """Peak memory in MiB of a `resource` usage record; macOS counts it in bytes, Linux in KiB."""
    return usage.ru_maxrss / (MIB if sys.platform == "darwin" else 1024.0)


def benchmark_cache():
    """The folder where benchmarks keep compiled Taichi kernels; nobody else compiles there."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taichi_edges" / "benchmarks"


def compiled_kernels(folder):
    """Names of the compiled kernels below a folder: those that appear during a run had to be compiled in it."""
    return {path.name for path in Path(folder).rglob("*.tic")}
