"""The kernel cache survives killed processes, and arrays reach the kernels and come back."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from taichi_edges.kernels.device import STALE_LOCK, download, is_running, kernel_cache, release_cache, upload


@pytest.mark.parametrize("age, stays", [(0.5 * STALE_LOCK, True), (2 * STALE_LOCK, False)])
def test_only_a_lock_that_nobody_can_hold_any_more_is_removed(tmp_path, age, stays):
    lock, kernel = tmp_path / "ticache.lock", tmp_path / "T0.tic"
    for path in (lock, kernel):
        path.touch()
        os.utime(path, (time.time() - age,) * 2)
    release_cache(tmp_path)
    assert lock.exists() == stays and kernel.exists()


@pytest.mark.slow(reason="starts processes")
@pytest.mark.parametrize("folder", ["/proc/nowhere", "taken/kernels"])
def test_without_a_place_for_the_cache_the_kernels_run_all_the_same(tmp_path, folder):
    (tmp_path / "taken").write_text("a file where the folder should be")
    code = "from taichi_edges.kernels.device import start_taichi, upload; import sys, taichi as ti\n"
    code += "start_taichi('cpu', 1, 0, sys.argv[1]); x = ti.field(ti.f32, shape=3); x.fill(2.0); assert x[1] == 2.0"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / folder)], capture_output=True, check=False, text=True
    )
    assert done.returncode == 0, done.stderr


def test_a_cache_that_is_not_there_yet_needs_nothing(tmp_path):
    release_cache(tmp_path / "nowhere")
    assert list(tmp_path.iterdir()) == []


def test_each_pair_of_versions_has_a_cache_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = kernel_cache()
    monkeypatch.setattr("taichi_edges.kernels.device.version", lambda package: "9.9")
    other = kernel_cache()
    assert folder != other and folder.is_relative_to(tmp_path) and "9.9" in other.name


def test_arrays_stay_where_they_are_on_a_cpu(start_taichi, generator):
    start_taichi("f32", 2)
    assert is_running("cpu", 2) and not is_running("cpu", 1) and not is_running("vulkan", 2)
    array = generator.random((5, 3)).astype(np.float32)
    assert upload(array) is array and download(array) is array
