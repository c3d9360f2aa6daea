"""Forking clusters become chains; chains are cut where straight meets curved."""

import numpy as np
import pytest

from taichi_edges.edges.branches import separate_branches
from taichi_edges.edges.segmentation import split_clusters

NOISE = 1e-3


def noisy(points, seed):
    return points + np.random.default_rng(seed).normal(scale=NOISE, size=points.shape)


def arc(radius, start, end, count):
    angle = np.linspace(start, end, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)


def line(start, end, count):
    return np.linspace(start, end, count)


@pytest.mark.parametrize("seed", range(3))
def test_a_tangent_line_and_its_circle_are_separated(seed):
    rim = arc(0.2, -1.2, 1.2, 100)
    tangent = line([0.2, 0.0, 0.0], [0.2, 0.4, 0.0], 60)[5:]
    points = noisy(np.concatenate([rim, tangent]), seed)
    labels = separate_branches(points, np.zeros(len(points), int), 8)
    upper_rim, far_tangent = slice(75, 100), slice(120, 155)
    assert len(set(labels[upper_rim]) - {-1}) == 1 and len(set(labels[far_tangent]) - {-1}) == 1
    assert labels[90] != labels[140]


@pytest.mark.parametrize("seed", range(3))
def test_chains_and_loops_are_left_whole(seed):
    for points in (arc(0.2, 0, 2 * np.pi, 150)[:-1], line([0, 0, 0], [0.5, 0.1, 0], 60), arc(0.3, 0, 2, 80)):
        labels = separate_branches(noisy(points, seed), np.zeros(len(points), int), 8)
        assert (labels == 0).mean() > 0.98


def test_small_branches_are_unassigned_and_numbers_are_consecutive():
    trunk = line([0, 0, 0], [0.5, 0, 0], 80)
    twig = line([0.25, 0.01, 0], [0.25, 0.06, 0], 5)
    other = line([0, 0.5, 0], [0.5, 0.5, 0], 40)
    points = noisy(np.concatenate([trunk, twig, other]), 0)
    labels = separate_branches(points, np.array([0] * 85 + [1] * 40), 10)
    assert set(labels[82:85]) == {-1}
    assert set(labels) == {-1, 0, 1}


@pytest.mark.parametrize("seed", range(3))
def test_a_filleted_corner_becomes_line_arc_line(seed):
    first = line([-0.3, -0.1, 0], [0, -0.1, 0], 60)
    bend = arc(0.1, -np.pi / 2, 0, 40)
    last = line([0.1, 0, 0], [0.1, 0.3, 0], 60)
    points = noisy(np.concatenate([first, bend[1:], last[1:]]), seed)
    labels = split_clusters(points, np.zeros(len(points), int), 8)
    assert len(set(labels)) == 3
    assert len({labels[20], labels[78], labels[130]}) == 3
    # Each point carries about 5 mm of edge; the cuts are at most a station (5 points) and the sagitta's 3 points off.
    for kind, truth in ((20, slice(0, 60)), (78, slice(60, 99)), (130, slice(99, 158))):
        assert (labels[truth] == labels[kind]).mean() > 0.75


@pytest.mark.parametrize("seed", range(3))
def test_smooth_curves_and_lines_are_not_cut(seed):
    for points in (arc(0.2, 0, 2 * np.pi, 150)[:-1], arc(0.3, 0, 2, 80), line([0, 0, 0], [0.7, 0.2, 0.1], 90)):
        labels = split_clusters(noisy(points, seed), np.zeros(len(points), int), 10)
        assert set(labels) == {0}


def test_unassigned_points_stay_so():
    points = noisy(line([0, 0, 0], [0.5, 0, 0], 40), 1)
    labels = np.array([-1] * 10 + [0] * 30)
    assert (split_clusters(points, labels, 8)[:10] == -1).all()
    assert (separate_branches(points, labels, 8)[:10] == -1).all()
