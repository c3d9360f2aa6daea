"""View steps of a Splatter, timed whole and in parts, and their state as arrays.

Only what the Splatter offers to everybody is called; the parts come from Taichi's own profiler, by the names of the
kernels. A renamed kernel shows up as itself, outside the parts: then `PARTS` wants changing, and nothing else.
"""

import os
import re
import time
from dataclasses import dataclass

import numpy as np
import taichi as ti

from benchmarks.machine import benchmark_cache
from taichi_edges.kernels.device import start_taichi
from taichi_edges.splatting.gaussians import Gaussians
from taichi_edges.splatting.splatter import GPU_ARCHS, PAGES, Splatter

PROFILED = ("cpu", "cuda")  # the devices whose kernels Taichi's profiler measures
RATES = (1e-12, 1e-12, 1e-12, 1e-12)  # Adam does all its work, and the Gaussians stay where they are
ROUND = PAGES  # view steps whose pixels are selected at once

# part: (kernel names as a regular expression, whether it is their derivative made by Taichi)
PARTS = {
    "select": (r"select", False),
    "forward": (r"draw_.*|blend_.*", False),
    "backward": (r"gather", False),
    "project'": (r"project", True),
    "Adam": (r"adam", False),
}
KERNEL = re.compile(r"(?P<name>.+?)_c\d+_\d+(?P<reverse>_reverse_grad)?_kernel_\d+")


def start(arch, threads, profile=True):
    """Start Taichi as training does; with its profiler if it is wanted and there is one."""
    # ti.init takes what the call does not name from the environment.
    os.environ["TI_KERNEL_PROFILER"] = str(int(profile and arch in PROFILED))
    start_taichi(arch, threads, 0, benchmark_cache() / "kernels")


def make_splatter(scene, count, arch, threads):
    """A Splatter of an EdgeScene, for `count` Gaussians."""
    cameras = (scene.intrinsics, scene.world_to_camera)
    schedule = "log" if arch in GPU_ARCHS else "product"
    return Splatter(scene.edge_maps, *cameras, capacity=count, threads=threads, schedule=schedule)


def views_of_round(number, view_count):
    """(ROUND,) the views of a round, in turn. number: counts from 0."""
    return (number * ROUND + np.arange(ROUND)) % view_count


def do_round(splatter, number):
    """A round of view steps, as `Training` does them. Returns their losses, (ROUND,). number: counts from 0."""
    first = number * ROUND + 1  # of the steps, and of the seeds
    splatter.select_pixels(views_of_round(number, len(splatter.images.edge_counts)), first + np.arange(ROUND))
    losses = np.zeros(ROUND)
    for page in range(ROUND):
        splatter.record(page)
        losses[page] = splatter.loss[None]
        splatter.update(first + page, *RATES)
    ti.sync()
    return losses


def time_round(splatter, number):
    """{part: milliseconds per view step} of one round: 'step' is the whole, 'launches' what no kernel accounts for."""
    profiler = ti.lang.impl.current_cfg().kernel_profiler
    if profiler:
        ti.profiler.clear_kernel_profiler_info()
    started = time.perf_counter()
    do_round(splatter, number)
    times = {"step": (time.perf_counter() - started) * 1e3}
    if profiler:
        kernels = kernel_times()
        times |= kernels | {"launches": times["step"] - sum(kernels.values())}
    return {part: milliseconds / ROUND for part, milliseconds in times.items()}


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


def medians(rounds):
    """{part: median milliseconds} of several `time_round`s."""
    parts = dict.fromkeys(part for times in rounds for part in times)
    return {part: float(np.median([times.get(part, 0.0) for times in rounds])) for part in parts}


@dataclass(frozen=True, eq=False)
class DumpedRound:
    """What the splats of a round are given, as arrays.

    shape: (height, width). poses: (ROUND, 3, 4) world to camera. pinholes: (ROUND, 4) fx, fy, cx, cy. words: (ROUND,
    height, w, 2), columns, targets: (ROUND, capacity), counts: (ROUND,) as in PixelSelection. level: target from which
    on a pixel counts as an edge pixel. weights: (ROUND, 2) in the loss, of an edge pixel and of a background pixel.
    """

    shape: tuple
    gaussians: Gaussians
    poses: np.ndarray
    pinholes: np.ndarray
    words: np.ndarray
    columns: np.ndarray
    targets: np.ndarray
    counts: np.ndarray
    level: float
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class DumpedStep:
    """What the splat of one step made of it: slots p, Gaussians n.

    transmittance: (p,). gradients: Gaussians, dL/d(parameters). pull: (n,) the absolute positional gradients.
    """

    transmittance: np.ndarray
    loss: float
    gradients: Gaussians
    pull: np.ndarray


def dump_round(splatter):
    """The state of the round that was done last."""
    selection, cameras = splatter.selection, splatter.cameras
    return DumpedRound(
        shape=(selection.height, selection.width),
        gaussians=splatter.fields.gaussians(),
        poses=cameras.world_to_camera.to_numpy()[selection.views],
        pinholes=cameras.pinhole.to_numpy()[selection.views],
        words=selection.words.to_numpy(),
        columns=selection.columns.to_numpy(),
        targets=selection.targets.to_numpy(),
        counts=selection.counts.copy(),
        level=(splatter.images.level - 0.5) / 255,
        weights=np.array([splatter.weights(page) for page in range(selection.pages)]),
    )


def dump_step(splatter, page):
    """Record one page of the last round again and read what came out."""
    fields = splatter.fields
    fields.positional_gradients.fill(0)
    splatter.record(page)
    dumped = DumpedStep(
        transmittance=splatter.selection.transmittance.to_numpy()[: splatter.selection.counts[page]],
        loss=float(splatter.loss[None]),
        gradients=Gaussians(*(getattr(fields, name).grad.to_numpy()[: fields.count] for name in fields.ARRAYS)),
        pull=fields.positional_gradients.to_numpy()[: fields.count],
    )
    splatter.update(1, *RATES)  # zeroes the gradients
    return dumped
