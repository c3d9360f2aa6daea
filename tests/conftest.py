"""What the tests share: random inputs that can be repeated, and one Splatter at a time."""

import gc
import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
import taichi as ti

from taichi_edges.splatting.splatter import Splatter

SEED = int(os.environ.get("TEST_SEED", np.random.SeedSequence().generate_state(1)[0]))
REALS = {"f32": ti.f32, "f64": ti.f64}
ARCHS = {"cpu": ti.cpu, "cuda": ti.cuda, "vulkan": ti.vulkan}
PROBE = """
import sys
import taichi as ti

ti.init(arch=getattr(ti, sys.argv[1]), offline_cache=False)
sys.exit(ti.lang.impl.current_cfg().arch != getattr(ti, sys.argv[1]))
"""


def pytest_report_header():
    """The seed of this run's random inputs."""
    return f"random inputs: repeat with TEST_SEED={SEED}"


@cache
def offers(arch):
    """Whether Taichi gets such a device here; asked of another process, which a broken driver may take with it."""
    command = [sys.executable, "-c", PROBE, arch]
    try:
        return subprocess.run(command, capture_output=True, timeout=60).returncode == 0
    except subprocess.TimeoutExpired:
        return False


@pytest.fixture(scope="session")
def seed():
    """Fresh in every run; TEST_SEED repeats one."""
    return SEED


@pytest.fixture
def generator(request):
    """Random numbers of a test, the same whichever other tests run."""
    return np.random.default_rng([SEED, *request.node.name.encode()])


@pytest.fixture(scope="session")
def start_taichi(pytestconfig):
    """start_taichi(real, threads, arch): ti.init. All fields and ndarrays of the last program become invalid.

    A test that wants a GPU is skipped where there is none: ti.init would fall back to the CPU. Kernels are cached in
    pytest's cache folder: a second run compiles nothing.
    """
    cache = pytestconfig.cache.mkdir("taichi")

    def start(real, threads, arch="cpu"):
        if arch != "cpu" and not offers(arch):
            hint = "; Mesa's mesa-vulkan-drivers and libvulkan1 bring a software one" if arch == "vulkan" else ""
            pytest.skip(f"this machine offers Taichi no {arch} device{hint}")
        gc.collect()  # an ndarray freed later deletes whatever the next program keeps at its address
        ti.init(
            arch=ARCHS[arch],
            default_fp=REALS[real],
            cpu_max_num_threads=threads,
            offline_cache=True,
            offline_cache_file_path=str(cache),
            log_level=ti.ERROR,
        )

    return start


@pytest.fixture(scope="session")
def open_splatter(start_taichi):
    """open_splatter(scene, real, threads, arch, **options of Splatter) -> Splatter.

    Nobody keeps a Splatter, because Taichi has one program at a time: every test opens the one it needs, and gets the
    one that is open already if it fits.
    """
    is_open = {"key": None}
    old = []  # never freed: see start_taichi

    def open_one(scene, real="f64", threads=2, arch="cpu", **options):
        key = (scene, real, threads, arch, tuple(sorted(options.items())))
        if is_open["key"] != key or is_open["runtime"] is not ti.lang.impl.get_runtime():
            start_taichi(real, threads, arch)
            arguments = (scene.edge_maps, scene.intrinsics, scene.world_to_camera, 1)
            edgels = getattr(scene, "edgels", None)
            splatter = Splatter(*arguments, threads=threads, real=REALS[real], edgels=edgels, **options)
            old.append(splatter)
            is_open.update(key=key, runtime=ti.lang.impl.get_runtime(), splatter=splatter)
        return is_open["splatter"]

    return open_one
