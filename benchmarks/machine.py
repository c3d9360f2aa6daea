"""The machine a benchmark runs on: one line about it, its threads, the memory of this process."""

import contextlib
import os
import platform
import resource
import sys
from importlib.metadata import version
from pathlib import Path

MIB = 1024.0 * 1024.0


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


def available_threads():
    """Threads that this process may use: what run.py takes when nobody says otherwise."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_memory_mib():
    """Peak resident memory of this process in MiB, since its start or the last `reset_peak_memory`."""
    with contextlib.suppress(OSError):
        return _status_mib("VmHWM")  # of this program alone; ru_maxrss takes over the peak of whoever started it
    return maxrss_mib(resource.getrusage(resource.RUSAGE_SELF))


def memory_mib():
    """Resident memory of this process now, in MiB; NaN where the system does not say."""
    with contextlib.suppress(OSError):
        return _status_mib("VmRSS")
    return float("nan")


def reset_peak_memory():
    """Start the peak anew (Linux; elsewhere it stays that of the whole process)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _status_mib(key):
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) / 1024.0
    raise OSError(f"/proc/self/status has no {key}")


def maxrss_mib(usage):
    """Peak memory in MiB of a `resource` usage record; macOS counts it in bytes, Linux in KiB."""
    return usage.ru_maxrss / (MIB if sys.platform == "darwin" else 1024.0)


def benchmark_cache():
    """The folder where benchmarks keep compiled Taichi kernels; nobody else compiles there."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taichi_edges" / "benchmarks"


def compiled_kernels(folder):
    """Names of the compiled kernels below a folder: those that appear during a run had to be compiled in it."""
    return {path.name for path in Path(folder).rglob("*.tic")}
