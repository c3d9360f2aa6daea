"""What this process may use of the machine, and has used: threads and memory."""

import contextlib
import os
from pathlib import Path

import psutil

MIB = 1024.0 * 1024.0
PROCESS = Path("/proc/self")  # of Linux


def available_threads() -> int:
    """Threads that this process may use, where the system tells; else all there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def reset_peak_memory() -> None:
    """Start the peak anew, on Linux."""
    with contextlib.suppress(OSError):
        (PROCESS / "clear_refs").write_text("5", encoding="ascii")


def peak_memory_mib() -> float:
    """Peak resident memory of this process, MiB.

    On Linux since its start or the last `reset_peak_memory`, on Windows since its start. macOS does not tell: there it
    is what the process holds now.
    """
    with contextlib.suppress(OSError):
        for line in (PROCESS / "status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    memory = psutil.Process().memory_info()
    return getattr(memory, "peak_wset", memory.rss) / MIB
