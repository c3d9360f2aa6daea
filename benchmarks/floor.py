"""The C floor: `floor.c` compiled by gcc and called with NumPy arrays, and the proof that it computes the same."""

import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).parent / "floor.c"
FLAGS = ("-O3", "-march=native", "-fopenmp", "-shared", "-fPIC")
WORD = 32  # pixels in a word of the mask

# Both sides round alike (6e-8 for each factor of a product, 1e-7 for each exponential) but for the order of the factors
# and fused multiply-adds. ALPHA_MIN is a step: rounding may carry a few contributions of 0.004 across it.
CLOSE_TRANSMITTANCE = 1e-4  # of nearly all slots
FAR_SHARE = 1e-3  # of the slots may lie farther apart ...
FAR_TRANSMITTANCE = 0.02  # ... but not so far
CLOSE_GRADIENT = 1e-3  # over all Gaussians, relative, root mean square


class FloorMissing(Exception):
    """There is no C floor on this machine; the message says why."""


class FloorDiffers(AssertionError):
    """The C floor and Taichi do not compute the same, so that their times must not be compared."""


def compile_floor():
    """The library, built anew in a temporary folder. FloorMissing where gcc is not there or fails."""
    compiler = shutil.which("gcc")
    if compiler is None:
        raise FloorMissing("there is no gcc")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # its threads must not spin while Taichi is being timed
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "floor.so"
        command = [compiler, *FLAGS, "-o", str(library), str(SOURCE), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise FloorMissing(f"gcc fails: {(done.stderr.strip().splitlines() or ['no message'])[0]}")
        return ctypes.CDLL(str(library))


def pack_pixels(pixels, width, height):
    """Flat pixel numbers -> (height, ceil(width / 32)) uint32, bit b of word w is column 32 w + b."""
    chosen = np.zeros((height, -(-width // WORD) * WORD), bool)
    chosen[pixels // width, pixels % width] = True
    return np.packbits(chosen, axis=1, bitorder="little").view("<u4")


class Floor:
    """The forward and backward pass in C over the state of one view step."""

    def __init__(self, library, threads):
        self.library, self.threads = library, threads

    def run(self, step):
        """Both passes over a DumpedStep.

        Returns milliseconds (forward, backward), transmittance (p,), gradients (n, 6) along the splats, pull (n,).
        """
        count, slots, (height, width) = len(step.splats), len(step.pixels), step.shape
        mask = pack_pixels(step.pixels, width, height)
        planes = np.empty((self.threads, height, width), np.float32)
        adjoint = np.empty((height, width), np.float32)
        transmittance, gradients = np.zeros(slots, np.float32), np.zeros((count, 6), np.float32)
        pull = np.zeros(count, np.float32)
        view = (step.splats, step.boxes, mask, mask.shape[1], width)
        _call(self.library.clear, slots, step.pixels, width * height, self.threads, planes)
        drawing = (slots, step.pixels, self.threads, planes, transmittance)
        forward = _call(self.library.forward, count, *view, width * height, *drawing)
        gathering = (transmittance, step.d_transmittance, self.threads, adjoint, gradients, pull)
        backward = _call(self.library.backward, count, *view, slots, step.pixels, *gathering)
        return (forward, backward), transmittance, gradients, pull


def _call(function, *arguments):
    """Call a void C function with ints and contiguous arrays; returns milliseconds."""
    assert all(isinstance(a, int) or a.flags.c_contiguous for a in arguments)
    converted = [a if isinstance(a, int) else ctypes.c_void_p(a.ctypes.data) for a in arguments]
    started = time.perf_counter()
    function(*converted)
    return (time.perf_counter() - started) * 1e3


def assert_same(step, transmittance, gradients, pull, splat_slopes, direction):
    """FloorDiffers unless the floor's results are Taichi's.

    step: DumpedStep. direction: Gaussians, in which the parameters move; splat_slopes: (n, 6) how the splats follow. A
    splat belongs to one Gaussian, so for each the floor's gradient along the splats must be Taichi's along the
    parameters.
    """
    off = np.abs(transmittance - step.transmittance)
    if not np.isfinite(off).all() or (off > CLOSE_TRANSMITTANCE).mean() > FAR_SHARE or off.max() > FAR_TRANSMITTANCE:
        share = 100 * (off > CLOSE_TRANSMITTANCE).mean()
        raise FloorDiffers(f"transmittance: {share:.2f} % of the pixels differ, by up to {off.max():.2g}")
    slopes = sum(
        (getattr(step.gradients, name) * getattr(direction, name)).reshape(len(pull), -1).sum(axis=1)
        for name in ("means", "log_scales", "quaternions", "opacity_logits")
    )
    ours = {"gradient": (gradients * splat_slopes).sum(axis=1), "absolute positional gradient": pull}
    for (name, values), wanted in zip(ours.items(), (slopes, step.pull), strict=True):
        error = np.sqrt(((values - wanted) ** 2).sum() / max((wanted**2).sum(), 1e-30))
        if not error <= CLOSE_GRADIENT:
            raise FloorDiffers(f"{name}: off by {error:.2g} of its size")
