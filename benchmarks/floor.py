"""The C floor: `floor.c` compiled by gcc and called with NumPy arrays, and the proof that it computes the same."""

import ctypes
import os
import platform
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).parent / "floor.c"
# The fastest code that gcc makes without changing what is computed: nobody asks about traps and errno.
FLAGS = ("-O3", "-march=native", "-fno-trapping-math", "-fno-math-errno", "-fopenmp", "-shared", "-fPIC")
X86_FLAGS = ("-mprefer-vector-width=256",)  # rows of a splat are short: wider vectors run half empty

# Both sides round alike (6e-8 for each factor of a product, 1e-7 for each exponential) but for the order of the factors
# and fused multiply-adds. ALPHA_MIN is a step: rounding may carry a few contributions of 0.004 across it.
CLOSE_TRANSMITTANCE = 1e-4  # of nearly all slots
FAR_SHARE = 1e-3  # of the slots may lie farther apart ...
FAR_TRANSMITTANCE = 0.02  # ... but not so far
CLOSE_LOSS = 1e-4  # relative
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
    flags = FLAGS + (X86_FLAGS if platform.machine() in ("x86_64", "AMD64") else ())
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "floor.so"
        command = [compiler, *flags, "-o", str(library), str(SOURCE), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise FloorMissing(f"gcc fails: {(done.stderr.strip().splitlines() or ['no message'])[0]}")
        return ctypes.CDLL(str(library))


@dataclass(frozen=True, eq=False)
class FloorStep:
    """What the floor makes of one step: transmittance (p,), gradients (n, 6) along the splats, pull (n,)."""

    transmittance: np.ndarray
    loss: float
    gradients: np.ndarray
    pull: np.ndarray


class Floor:
    """The forward and backward passes in C. Its arrays are kept, so that no pass pays for getting memory."""

    def __init__(self, library, count, capacity, threads):
        self.library, self.count, self.capacity, self.threads = library, count, capacity, threads
        self.splats, self.boxes = np.zeros((count, 6), np.float32), np.zeros((count, 4), np.int32)
        self.planes = np.ones((threads, capacity), np.float32)
        self.transmittance, self.adjoint = np.zeros((2, capacity), np.float32)
        self.loss = np.zeros(1, np.float32)
        self.gradients, self.pull = np.zeros((count, 6), np.float32), np.zeros(count, np.float32)

    def run(self, given, page):
        """Both passes over one page of a DumpedRound. Returns milliseconds (forward, backward)."""
        gaussians, (height, width), slots = given.gaussians, given.shape, int(given.counts[page])
        parameters = (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits)
        camera = (given.poses[page], given.pinholes[page], width, height)
        words, columns, targets = given.words[page], given.columns[page], given.targets[page]
        weights = given.weights[page].astype(np.float32)
        pixels = (words, columns, targets, slots, given.level, weights, self.capacity, self.threads)
        drawn = (self.splats, self.boxes, self.planes, self.transmittance, self.adjoint, self.loss)
        forward = _call(self.library.forward, self.count, *parameters, *camera, *pixels, *drawn)
        gathering = (self.threads, self.splats, self.boxes, self.adjoint, self.gradients, self.pull)
        backward = _call(self.library.backward, self.count, width, words, columns, *gathering)
        return forward, backward

    def run_round(self, given):
        """Milliseconds (forward, backward) per step of all pages."""
        return np.mean([self.run(given, page) for page in range(len(given.counts))], axis=0)

    def step(self, given, page):
        """One page as a FloorStep."""
        self.run(given, page)
        transmittance = self.transmittance[: given.counts[page]].copy()
        return FloorStep(transmittance, float(self.loss[0]), self.gradients.copy(), self.pull.copy())


def _call(function, *arguments):
    """Call a void C function with ints, floats and contiguous arrays; returns milliseconds."""
    converted = [_convert(argument) for argument in arguments]
    started = time.perf_counter()
    function(*converted)
    return (time.perf_counter() - started) * 1e3


def _convert(argument):
    """As C takes it."""
    if isinstance(argument, np.ndarray):
        assert argument.flags.c_contiguous and argument.dtype.itemsize == 4, (argument.dtype, argument.strides)
        return ctypes.c_void_p(argument.ctypes.data)
    return ctypes.c_float(argument) if isinstance(argument, float) else ctypes.c_int(argument)


def assert_same(step, floor_step, splat_slopes, direction):
    """FloorDiffers unless the floor's results are Taichi's.

    step: DumpedStep. floor_step: FloorStep. direction: Gaussians, in which the parameters move; splat_slopes: (n, 6)
    how the splats follow. A splat belongs to one Gaussian, so for each the floor's gradient along the splats must be
    Taichi's along the parameters.
    """
    off = np.abs(floor_step.transmittance - step.transmittance)
    if not np.isfinite(off).all() or (off > CLOSE_TRANSMITTANCE).mean() > FAR_SHARE or off.max() > FAR_TRANSMITTANCE:
        share = 100 * (off > CLOSE_TRANSMITTANCE).mean()
        raise FloorDiffers(f"transmittance: {share:.2f} % of the pixels differ, by up to {off.max():.2g}")
    if not abs(floor_step.loss - step.loss) <= CLOSE_LOSS * step.loss:
        raise FloorDiffers(f"loss: {floor_step.loss:.6g} instead of {step.loss:.6g}")
    slopes = sum(
        (getattr(step.gradients, name) * getattr(direction, name)).reshape(len(step.pull), -1).sum(axis=1)
        for name in ("means", "log_scales", "quaternions", "opacity_logits")
    )
    found = {
        "gradient": ((floor_step.gradients * splat_slopes).sum(axis=1), slopes),
        "absolute positional gradient": (floor_step.pull, step.pull),
    }
    for name, (values, wanted) in found.items():
        error = np.sqrt(((values - wanted) ** 2).sum() / max((wanted**2).sum(), 1e-30))
        if not error <= CLOSE_GRADIENT:
            raise FloorDiffers(f"{name}: off by {error:.2g} of its size")
