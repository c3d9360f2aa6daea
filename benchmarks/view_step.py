"""One view step of a Splatter, timed whole and in parts, and its state as arrays.

Only what the Splatter offers to everybody is called; the parts come from Taichi's own profiler, by the names of the
kernels. A renamed kernel shows up as itself, outside the parts: then `PARTS` wants changing, and nothing else.
"""

import contextlib
import io
import os
import re
import time
from dataclasses import dataclass

import numpy as np
import taichi as ti

from benchmarks.machine import benchmark_cache
from taichi_edges.kernels.device import start_taichi
from taichi_edges.splatting.gaussians import Gaussians
from taichi_edges.splatting.splatter import GPU_ARCHS, Splatter

PROFILED = ("cpu", "cuda")  # the devices whose kernels Taichi's profiler measures
RATES = (1e-12, 1e-12, 1e-12, 1e-12)  # Adam does all its work, and the Gaussians stay where they are

# part: (kernel names as a regular expression, whether it is their derivative made by Taichi)
PARTS = {
    "select": (r"select_.*", False),
    "project": (r"project.*", False),
    "forward": (r"draw.*|combine.*", False),
    "loss": (r"image_loss.*", False),
    "loss'": (r"image_loss.*", True),
    "backward": (r"spread_adjoint.*|gather_adjoint.*", False),
    "project'": (r"project.*", True),
    "Adam": (r"adam.*", False),
}
KERNEL = re.compile(r"(?P<name>.+?)_c\d+_\d+(?P<reverse>_reverse_grad)?_kernel_\d+")


def start(arch, threads, profile=True):
    """Start Taichi as training does; with its profiler if it is wanted and there is one."""
    os.environ["TI_KERNEL_PROFILER"] = str(
        int(profile and arch in PROFILED)
    )  # ti.init takes what the call does not name from here
    with contextlib.redirect_stdout(io.StringIO()):  # it announces itself with a bare print
        start_taichi(arch, threads, 0, benchmark_cache() / "kernels")


def make_splatter(scene, count, arch, threads):
    """A Splatter of an EdgeScene, for `count` Gaussians."""
    cameras = (scene.intrinsics, scene.world_to_camera)
    schedule = "log" if arch in GPU_ARCHS else "product"
    return Splatter(scene.edge_maps, *cameras, capacity=count, threads=threads, schedule=schedule)


def view_step(splatter, view, number):
    """One step of training on one view, as `Training` does it. number: counts from 1, and is the seed."""
    splatter.select_pixels(view, number)
    splatter.record(view)
    splatter.update(number, *RATES)
    ti.sync()


def time_step(splatter, view, number):
    """{part: milliseconds} of one view step: 'step' is the whole, 'launches' what no kernel accounts for."""
    profiler = ti.lang.impl.current_cfg().kernel_profiler
    if profiler:
        ti.profiler.clear_kernel_profiler_info()
    started = time.perf_counter()
    view_step(splatter, view, number)
    times = {"step": (time.perf_counter() - started) * 1e3}
    if profiler:
        kernels = kernel_times()
        times |= kernels | {"launches": times["step"] - sum(kernels.values())}
    return times


def kernel_times():
    """{part or name of a kernel that is in none: milliseconds} since the profiler was cleared."""
    times = dict.fromkeys(PARTS, 0.0)
    ti.profiler.get_kernel_profiler_total_time()  # fetches the records
    for record in ti.lang.impl.get_runtime().prog.get_kernel_profiler_records():
        part = part_of(record.name)
        times[part] = times.get(part, 0.0) + record.kernel_time
    return times


def part_of(task):
    """The part that a task of the profiler belongs to, or the name of its kernel."""
    found = KERNEL.match(task)
    name, reverse = (found["name"], bool(found["reverse"])) if found else (task, False)
    for part, (pattern, derivative) in PARTS.items():
        if reverse == derivative and re.fullmatch(pattern, name):
            return part
    return name + ("'" if reverse else "")


def medians(steps):
    """{part: median milliseconds} of several `time_step`s."""
    parts = dict.fromkeys(part for step in steps for part in step)
    return {part: float(np.median([step.get(part, 0.0) for step in steps])) for part in parts}


@dataclass(frozen=True, eq=False)
class DumpedStep:
    """What the splat of one view step was given and what it made of it, as arrays.

    shape: (height, width). splats: (n, 6) u, v, conic a, b, c, opacity. boxes: (n, 4) u0, u1, v0, v1, ends exclusive.
    pixels: (p,) row * width + column. transmittance, d_transmittance: (p,) T and dL/dT. gradients: Gaussians,
    dL/d(parameters). pull: (n,) the absolute positional gradients.
    """

    shape: tuple
    splats: np.ndarray
    boxes: np.ndarray
    pixels: np.ndarray
    transmittance: np.ndarray
    d_transmittance: np.ndarray
    gradients: Gaussians
    pull: np.ndarray


def dump_step(splatter, view, number):
    """Do one more view step and read everything the C floor needs."""
    fields, selection, target = splatter.fields, splatter.selection, splatter.splats
    fields.positional_gradients.fill(0)
    splatter.select_pixels(view, number)
    splatter.record(view)
    count, slots = fields.count, selection.count
    transmittance, weights, image = (
        field.to_numpy()[:slots] for field in (selection.transmittance, selection.weights, selection.targets)
    )
    dumped = DumpedStep(
        shape=(selection.height, selection.width),
        splats=target.splats.to_numpy()[:count],
        boxes=target.boxes.to_numpy()[:count],
        pixels=selection.pixels.to_numpy()[:slots],
        transmittance=transmittance,
        d_transmittance=-weights * np.sign(1.0 - transmittance - image),  # of eq. 3
        gradients=Gaussians(*(getattr(fields, name).grad.to_numpy()[:count] for name in fields.ARRAYS)),
        pull=fields.positional_gradients.to_numpy()[:count],
    )
    splatter.update(number, *RATES)  # zeroes the gradients
    return dumped
