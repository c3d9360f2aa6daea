"""Edgels in order along 2D edges."""

import numpy as np
import pytest
from edgel_scenes import line, views_of

from taichi_edges.detectors.paths import ordered_paths
from taichi_edges.views.edgels import Edgels


def edgels_of(*views):
    """Edgels of views, each (points, normals)."""
    return Edgels.of_views((points, normals, np.ones(len(points))) for points, normals in views)


def straight(start, angle, count):
    """(points, normals) of edgels 1 px apart."""
    along = np.array([np.cos(angle), np.sin(angle)])
    return np.asarray(start) + np.arange(count)[:, None] * along, np.tile([-along[1], along[0]], (count, 1))


def shuffled(generator, *parts):
    """The edgels of some parts in random order, with normals of random sign; and (n,) where each comes from."""
    points, normals = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    order = generator.permutation(len(points))
    return (points[order], normals[order] * generator.choice([-1, 1], (len(points), 1))), order


def same_way_or_back(path, expected):
    return path.tolist() in (expected, expected[::-1])


def test_edgels_follow_each_other_along_their_edge(generator):
    (points, normals), order = shuffled(generator, straight([5.3, 7.1], generator.uniform(0, np.pi), 60))
    (path,) = ordered_paths(edgels_of((points, normals)))
    assert same_way_or_back(order[path], list(range(60)))


def test_a_corner_ends_a_path(generator):
    one, other = straight([10, 10], 0.3, 40), straight([10, 10], 0.3 + np.radians(70), 30)
    (points, normals), order = shuffled(generator, one, tuple(array[1:] for array in other))
    paths = ordered_paths(edgels_of((points, normals)))
    assert sorted(len(path) for path in paths) == [29, 40]
    for path in paths:
        assert len(set((order[path] >= 40).tolist())) == 1


def test_a_loop_is_one_path_all_around(generator):
    angles = np.arange(0, 2 * np.pi, 1 / 20)[:-1]
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    (points, normals), order = shuffled(generator, (50 + 20 * normals, normals))
    (path,) = ordered_paths(edgels_of((points, normals)))
    steps = np.diff(order[path]) % len(angles)
    assert len(path) == len(angles) and (set(steps.tolist()) in ({1}, {len(angles) - 1}))


def test_paths_beside_each_other_stay_apart(generator):
    (points, normals), order = shuffled(generator, straight([5, 5], 0.2, 50), straight([5, 7], 0.2, 50))
    paths = ordered_paths(edgels_of((points, normals)))
    assert len(paths) == 2 and all(same_way_or_back(order[path] % 50, list(range(50))) for path in paths)


def test_paths_keep_to_their_views_and_no_edgel_is_on_two(generator):
    views = views_of([line([0.2, 0.3, 0.3], [0.8, 0.35, 0.4])], generator, noise_px=0.1, count=5, apart=1.0)
    paths = ordered_paths(views.edgels)
    assert all(len(set(views.edgels.views[path].tolist())) == 1 for path in paths)
    every = np.concatenate(paths)
    assert len(every) == len(set(every.tolist())) > 0.98 * len(views.edgels)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_edgels_are_no_path(count):
    assert ordered_paths(edgels_of(straight([5, 5], 0.2, count), straight([5, 5], 0.2, 0))) == []
