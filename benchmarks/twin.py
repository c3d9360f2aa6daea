"""The slow twin of the tests, `tests/reference_splatting.py`: as a competitor, and as the judge of gradients."""

import importlib.util
import sys
import time
from pathlib import Path

import numpy as np

from taichi_edges.splatting.gaussians import Gaussians

SOURCE = Path(__file__).parent.parent / "tests" / "reference_splatting.py"
FEW = 64  # Gaussians that are timed: what the twin takes is proportional, for it visits every pixel with each
PARAMETERS = 11  # of a Gaussian: the twin's gradient costs one complex evaluation for each
TINY = 1e-30  # of a complex step


def load_twin():
    """The module."""
    spec = importlib.util.spec_from_file_location("reference_splatting", SOURCE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def time_twin(twin, splatter, gaussians, camera):
    """Milliseconds (loss, gradient) of the twin for all Gaussians over the selected pixels, scaled up from FEW."""
    few = _double(gaussians.keep(slice(FEW)))
    pixels, weights, targets = twin.selected(splatter)
    scale = len(gaussians) / len(few)

    def loss(moved):
        return twin.image_loss(moved, camera, pixels, weights, targets)

    started = time.perf_counter()
    loss(few)
    halfway = time.perf_counter()
    twin.slope(loss, few, few)  # one derivative by a complex step; the gradient takes one for each parameter
    ended = time.perf_counter()
    return (halfway - started) * scale * 1e3, (ended - halfway) * scale * PARAMETERS * len(gaussians) * 1e3


def random_direction(count, pixel, generator):
    """A direction for all parameters at once, as Gaussians. pixel: world units of one, the scale of the means."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,))
    means, *others = (generator.normal(size=shape) for shape in shapes)
    return Gaussians(means * pixel, *others)


def splat_slopes(twin, gaussians, camera, direction):
    """(n, 6) derivatives of the splats (u, v, conic a, b, c, opacity) when the parameters move along `direction`."""
    gaussians = _double(gaussians)
    moved = {name: getattr(gaussians, name) + 1j * TINY * getattr(direction, name) for name in twin.PARAMETERS}
    centres, covariances, opacities = twin.project(Gaussians(**moved), *camera)
    conics = np.linalg.inv(covariances)
    splats = [*centres.T, conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1], opacities]
    return np.stack([values.imag for values in splats], axis=1) / TINY


def _double(gaussians):
    """The same in float64."""
    arrays = (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits)
    return Gaussians(*(array.astype(np.float64) for array in arrays))
