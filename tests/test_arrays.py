"""What rooms share: columns, ragged ranges, components of graphs, the robust weight; against plain Python."""

from dataclasses import dataclass

import numpy as np
import pytest
import taichi as ti

from taichi_edges.arrays.columns import Columns
from taichi_edges.arrays.components import components
from taichi_edges.arrays.ranges import ragged
from taichi_edges.arrays.robust import geman_mcclure, widening
from taichi_edges.evidence import edgel_matching

# ------------------------------------------------------------------------------------------------------------ columns


@dataclass(frozen=True)
class Names(Columns):
    letters: np.ndarray


@dataclass(frozen=True)
class Things(Columns):
    """All that a field may be."""

    places: np.ndarray
    names: Names
    noise: float
    slopes: np.ndarray | None = None


THINGS = Things(np.arange(12.0).reshape(4, 3), Names(np.array(list("abcd"))), 0.5)


def told(things):
    """The things as lists."""
    slopes = things.slopes if things.slopes is None else things.slopes.tolist()
    return len(things), things.places[:, 0].tolist(), "".join(things.names.letters), things.noise, slopes


@pytest.mark.parametrize("chosen", [np.array([False, True, False, True]), np.array([1, 3]), slice(1, 4, 2)])
def test_chosen_rows_of_all_columns_are_kept_and_what_is_about_all_stays(chosen):
    assert told(THINGS.keep(chosen)) == (2, [3.0, 9.0], "bd", 0.5, None)


def test_rows_are_joined_in_order():
    some, others = THINGS.keep([2]), THINGS.keep([0, 1])
    assert told(Things.joined([some, others])) == (3, [6.0, 0.0, 3.0], "cab", 0.5, None)
    assert told(Things.joined([THINGS])) == told(THINGS)


def test_columns_that_are_there_are_joined_and_others_stay_away():
    full = Things(THINGS.places, THINGS.names, 0.5, np.arange(4))
    assert told(Things.joined([full, full.keep([3])]))[-1] == [0, 1, 2, 3, 3]


def test_what_is_about_all_rows_must_be_the_same_to_join_them():
    with pytest.raises(AssertionError):
        Things.joined([THINGS, Things(THINGS.places, THINGS.names, 0.6)])


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
