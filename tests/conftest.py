"""What the tests share: random inputs that can be repeated, and one Splatter at a time."""

import gc
import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
import taichi as ti

from taichi_edges.kernels.device import is_running, kernel_cache
from taichi_edges.splatting.splatter import Splatter
from taichi_edges.synthetic.drawing import Imperfections
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.rendering import render_views

# In the environment, so that pytest-xdist's workers have the same.
SEED = int(os.environ.setdefault("TEST_SEED", str(np.random.SeedSequence().generate_state(1)[0])))
REALS = {"f32": ti.f32, "f64": ti.f64}
ARCHS = {"cpu": ti.cpu, "cuda": ti.cuda, "vulkan": ti.vulkan}
# What uses one of these fixtures is slow, as if it were marked so.
SLOW_FIXTURES = {"finished": "starts from a run of the whole corridor", "solved": "starts from solved photographs"}
PROBE = """
import sys
import taichi as ti

ti.init(arch=getattr(ti, sys.argv[1]), offline_cache=False)
sys.exit(ti.lang.impl.current_cfg().arch != getattr(ti, sys.argv[1]))
"""


def pytest_configure(config):
    """Kernels of all tests, and of the runs that they start, are kept in pytest's cache: a second run compiles none."""
    os.environ["XDG_CACHE_HOME"] = str(config.cache.mkdir("kernels"))


def pytest_terminal_summary(terminalreporter):
    """The seed of this run's random inputs; a header would be missing with -q."""
    terminalreporter.write_line(f"random inputs: repeat with TEST_SEED={SEED}")


def pytest_itemcollected(item):
    """A test is slow for a reason."""
    for name in SLOW_FIXTURES.keys() & set(item.fixturenames):
        item.add_marker(pytest.mark.slow(reason=SLOW_FIXTURES[name]))
    for marker in item.iter_markers("slow"):
        if marker.args or not marker.kwargs.get("reason"):
            raise pytest.UsageError(f"{item.nodeid}: say why: @pytest.mark.slow(reason='...')")


@cache
def offers(arch):
    """Whether Taichi gets such a device here; asked of another process, which a broken driver may take with it."""
    command = [sys.executable, "-c", PROBE, arch]
    try:
        return subprocess.run(command, capture_output=True, timeout=60, check=False).returncode == 0
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
def clean_block():
    """clean_block(count, size) -> (Views, pictures) of the block with clean maps, not to be changed; drawn once."""

    @cache
    def rendered(count, size):
        views, pictures = render_views(PARTS["block"](), count, size, Imperfections.none(), np.random.default_rng(0))
        for array in (views.edge_maps, pictures):
            array.flags.writeable = False
        return views, pictures

    return rendered


@pytest.fixture(scope="session")
def start_taichi():
    """start_taichi(real, threads, arch): ti.init. All fields and ndarrays of the last program become invalid.

    A test that wants a GPU is skipped where there is none: ti.init would fall back to the CPU.
    """
    kernels = kernel_cache()

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
            offline_cache_file_path=str(kernels),
            log_level=ti.ERROR,
        )

    return start


@pytest.fixture
def taichi(start_taichi):
    """Taichi in f32 with 2 threads: the program that runs already, if it is one, as its kernels have been built."""
    if not is_running("cpu", 2):
        start_taichi("f32", 2)


@pytest.fixture(scope="session")
def open_splatter(start_taichi):
    """open_splatter(scene, real, threads, arch, **options of Splatter) -> Splatter.

    Nobody keeps a Splatter, because Taichi has one program at a time: every test opens the one it needs, and gets the
    one that is open already if it fits. Each has a program of its own: kernels that found other fields before theirs
    would not be those in the cache.
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
