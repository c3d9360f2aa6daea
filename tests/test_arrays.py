"""What rooms share: ragged ranges, components of graphs, the robust weight; against plain Python."""

import numpy as np
import pytest
import taichi as ti

from taichi_edges.arrays.components import components
from taichi_edges.arrays.ranges import ragged
from taichi_edges.arrays.robust import geman_mcclure, widening
from taichi_edges.evidence import edgel_matching

# ------------------------------------------------------------------------------------------------- ranges, components


@pytest.mark.parametrize("seed", range(3))
def test_ragged_ranges_are_those_of_a_loop(generator, seed):
    counts = generator.integers(0, 4, generator.integers(0, 9))
    of, entries = ragged(counts)
    pairs = [(number, entry) for number, count in enumerate(counts) for entry in range(count)]
    assert list(zip(of.tolist(), entries.tolist(), strict=True)) == pairs


@pytest.mark.parametrize("seed", range(5))
def test_components_are_those_of_spreading_labels_numbered_by_their_first_nodes(generator, seed):
    count = int(generator.integers(0, 30))
    first, second = generator.integers(0, count, (2, count // 2)) if count else np.zeros((2, 0), int)
    labels = np.arange(count)
    for _ in range(count):
        for one, other in zip(first, second, strict=True):
            labels[[one, other]] = min(labels[one], labels[other])
    np.testing.assert_array_equal(components(count, first, second), np.unique(labels, return_inverse=True)[1])


# --------------------------------------------------------------------------------------------------- the robust weight


def test_robust_weight_has_fallen_to_a_quarter_at_the_scale_and_takes_the_strength_along():
    squared = np.array([0.0, 1.0, 9.0])
    np.testing.assert_array_equal(geman_mcclure(squared), [1.0, 0.25, 0.01])
    np.testing.assert_array_equal(geman_mcclure(squared, np.array([0.5, 2.0, 100.0])), [0.5, 0.5, 1.0])
    np.testing.assert_allclose(widening(squared) ** -2.0, geman_mcclure(squared))
    assert geman_mcclure(squared.astype(np.float32)).dtype == np.float32


@ti.kernel
def weigh(squared: ti.types.ndarray(ti.f32, 1), strengths: ti.types.ndarray(ti.f32, 1)):
    """Replaces the squares by their weights."""
    for i in range(squared.shape[0]):
        squared[i] = edgel_matching.geman_mcclure(squared[i], strengths[i])


def test_kernels_weigh_alike(start_taichi, generator):
    start_taichi("f32", 1)
    squared, strengths = generator.uniform(0, 20, (2, 100)).astype(np.float32)
    found = squared.copy()
    weigh(found, strengths)
    np.testing.assert_allclose(found, geman_mcclure(squared, strengths), rtol=1e-6)
