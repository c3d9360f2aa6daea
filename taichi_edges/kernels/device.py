"""Arrays on their way to Taichi kernels and back: a CPU works on NumPy's own memory, a GPU on copies."""

import numpy as np
import taichi as ti


def is_running(arch, threads):
    """Whether Taichi runs on this arch ('cpu', 'cuda' or 'vulkan') with this number of CPU threads, and in f32."""
    if ti.lang.impl.get_runtime().prog is None:
        return False
    running = ti.lang.impl.current_cfg()
    wanted = (getattr(ti, arch), threads, ti.f32)
    return (running.arch, running.cpu_max_num_threads, running.default_fp) == wanted


def threads():
    """The number of CPU threads Taichi was started with."""
    return ti.lang.impl.current_cfg().cpu_max_num_threads


def upload(array):
    """What kernels take for a NumPy array: on a CPU the array itself, on a GPU a copy in its memory."""
    array = np.ascontiguousarray(array)
    if ti.lang.impl.current_cfg().arch == ti.cpu:
        return array
    copy = ti.ndarray(ti.lang.util.to_taichi_type(array.dtype), shape=array.shape)
    copy.from_numpy(array)
    return copy


def download(array):
    """What kernels have written to the `upload` of an array, as a NumPy array."""
    return array if isinstance(array, np.ndarray) else array.to_numpy()
