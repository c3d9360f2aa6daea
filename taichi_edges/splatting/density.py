"""Density control: which Gaussians go, which are doubled. Optimiser moments go along (NumPy, between steps)."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.columns import Columns
from taichi_edges.evidence.support import exclusive_support
from taichi_edges.splatting.gaussians import Gaussians

if TYPE_CHECKING:
    from taichi_edges.views.views import Views


@dataclass(frozen=True)
class Population(Columns):
    """Gaussians with Adam's two moments, (n, 11) each, and the positional gradients since the last change, (n,)."""

    gaussians: Gaussians
    first_moments: np.ndarray
    second_moments: np.ndarray
    positional_gradients: np.ndarray


def cull_opacity(population: Population, minimum: float) -> Population:
    """Those with at least this opacity."""
    return population.keep(population.gaussians.opacities >= minimum)


def cull_support(population: Population, views: "Views", minimum: float, threshold: float) -> Population:
    """Those that the edge maps support in at least this share of the views, shared support not counted twice.

    views: Views. threshold: of full scale. ti.init must have been called.
    """
    means = population.gaussians.means.astype(np.float64)
    return population.keep(exclusive_support(views, means, threshold) >= minimum)


def duplicate(
    population: Population, share: float, copies: int, distance: float, maximum: int, generator: np.random.Generator
) -> Population:
    """Copies of the Gaussians that the image pulls at most, moved by a normal offset, with moments of zero.

    share: the relative gradient from which on a Gaussian is copied: gradients are scaled to 0..1 over all Gaussians
    at that moment, as the release of EdgeGaussians does, because their absolute size depends on the image.
    copies: per Gaussian. distance: standard deviation of the offset, unit-cube units. maximum: Gaussians in all.
    """
    gradients = population.positional_gradients
    spread = float(np.ptp(gradients)) if len(population) else 0.0
    if spread == 0.0 or copies == 0:
        return population
    chosen = np.flatnonzero((gradients - gradients.min()) / spread > share)
    chosen = np.tile(chosen, copies)[: max(maximum - len(population), 0)]
    source = population.gaussians.keep(chosen)
    offset = generator.normal(size=(len(chosen), 3)).astype(np.float32) * np.float32(distance)
    zeros = np.zeros((len(chosen), 11), population.first_moments.dtype)
    moved = replace(source, means=source.means + offset)
    return Population.joined([population, Population(moved, zeros, zeros, np.zeros(len(chosen), gradients.dtype))])
