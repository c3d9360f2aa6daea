"""Short lines that nobody has found, between vertices that are known: where the images show them, and only there."""

import numpy as np
import pytest
from edgel_scenes import either_errors, views_of

from taichi_edges.evidence.edgel_matching import EdgelMatching
from taichi_edges.geometry.shapes import Line
from taichi_edges.geometry.wireframe import Edge, Wireframe
from taichi_edges.refinement.completion import LONGEST_PX, MOST_PAIRS, clear_places, completed, open_pairs

NEAR, FAR = np.array([[0.4, 0.4, 0.35], [0.48, 0.42, 0.35]]), np.array([[0.35, 0.7, 0.5], [0.55, 0.75, 0.45]])
SEEDS = range(2)
VIEWS = 16


def turned(points, generator):
    """The points turned about the upright axis through the middle of the cube: round the ring of cameras."""
    angle = generator.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return (points - 0.5) @ turn.T + 0.5


def bridge(generator):
    """The Wireframe of two vees whose tips are near each other, and (2, 3) the tips.

    From each of the two tips, vertices 0 and 1, lines go to two vertices that are far away.
    """
    vertices = turned(np.concatenate([NEAR, FAR, FAR + [0.1, -0.5, 0.3]]), generator)
    pairs = [(0, 2), (0, 4), (1, 3), (1, 5)]
    edges = tuple(Edge(Line(vertices[list(pair)]), pair) for pair in pairs)
    return Wireframe(vertices, edges, np.zeros((0, 2), np.int64)), vertices[:2]


def curve_of(shape):
    """A shape as a curve of edgel_scenes."""
    return lambda s: shape.at(np.asarray(s))


def matching_of(shapes, generator, **settings):
    curves = [curve_of(shape) for shape in shapes]
    return EdgelMatching(views_of(curves, generator, noise_px=0.1, count=VIEWS, **settings))


@either_errors()
@pytest.mark.parametrize("seed", SEEDS)
def test_missing_line_is_found(taichi, generator, seed, errors):
    wireframe, tips = bridge(generator)
    found, count = completed(wireframe, matching_of([*wireframe.shapes, Line(tips)], generator, errors=errors))
    assert count == 1 and len(found) == len(wireframe) + 1
    assert set(found.edges[-1].vertices) == {0, 1}
    np.testing.assert_array_equal(found.edges[-1].shape.points, found.vertices[list(found.edges[-1].vertices)])
    np.testing.assert_array_equal(found.vertices, wireframe.vertices)


@either_errors()
@pytest.mark.parametrize("seed", SEEDS)
def test_missing_lines_do_not_lie_on_each_other(taichi, generator, seed, errors):
    """The images show a line from tip to tip, and a third vertex lies on it: two lines meet there, and no third one."""
    wireframe, tips = bridge(generator)
    middle, far = tips.mean(axis=0), turned(np.array([[0.44, 0.6, 0.5], [0.47, 0.3, 0.6]]), generator)
    vertices = np.concatenate([wireframe.vertices, middle[None], far])
    stems = tuple(Edge(Line(vertices[[6, end]]), (6, end)) for end in (7, 8))
    wireframe = Wireframe(vertices, wireframe.edges + stems, wireframe.contacts)
    found, _ = completed(wireframe, matching_of([*wireframe.shapes, Line(tips)], generator, errors=errors))
    assert (0, 1) not in {tuple(sorted(edge.vertices)) for edge in found.edges}


@either_errors()
@pytest.mark.parametrize("hidden", [0.2, 0.4])
def test_missing_line_may_be_hidden_in_some_views(taichi, generator, hidden, errors):
    wireframe, tips = bridge(generator)
    assert (
        completed(wireframe, matching_of([*wireframe.shapes, Line(tips)], generator, hidden=hidden, errors=errors))[1]
        == 1
    )


@either_errors()
@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_is_added_where_the_images_show_nothing(taichi, generator, seed, errors):
    wireframe, _ = bridge(generator)
    assert completed(wireframe, matching_of(wireframe.shapes, generator, errors=errors))[1] == 0


@either_errors()
def test_half_a_line_is_none(taichi, generator, errors):
    wireframe, tips = bridge(generator)
    half = Line(np.array([tips[0], tips.mean(axis=0)]))
    assert completed(wireframe, matching_of([*wireframe.shapes, half], generator, errors=errors))[1] == 0


@either_errors()
def test_line_that_is_known_is_not_added_again(taichi, generator, errors):
    wireframe, tips = bridge(generator)
    once, _ = completed(wireframe, matching_of([*wireframe.shapes, Line(tips)], generator, errors=errors))
    assert completed(once, matching_of(once.shapes, generator, errors=errors))[1] == 0


@either_errors()
def test_edge_in_the_way_owns_its_edgels(taichi, generator, errors):
    """A line through both tips that ends in neither."""
    wireframe, tips = bridge(generator)
    along = Line(Line(tips).at(np.array([-0.5, 1.5])))
    matching = matching_of([*wireframe.shapes, along], generator, errors=errors)
    vertices = np.concatenate([wireframe.vertices, along.ends])
    edges = (*wireframe.edges, Edge(along, (6, 7)))
    assert completed(Wireframe(vertices, edges, wireframe.contacts), matching)[1] == 0


@either_errors()
def test_free_ends_are_not_completed(taichi, generator, errors):
    """Only vertices in which edges meet are known well enough."""
    wireframe, tips = bridge(generator)
    matching = matching_of([*wireframe.shapes, Line(tips)], generator, errors=errors)
    assert completed(wireframe.keep(np.array([True, True, True, False])), matching)[1] == 0


# -------------------------------------------------------------------------------------------------------------- pairs


def test_pairs_are_near_and_open_and_of_vertices_where_edges_meet(generator):
    """Against all pairs, one by one."""
    vertices, pixels = generator.random((40, 3)), generator.uniform(0.002, 0.006, 40)
    joined = {tuple(sorted(pair)) for pair in generator.integers(0, 40, (50, 2)).tolist() if pair[0] != pair[1]}
    edges = tuple(Edge(Line(vertices[list(pair)]), pair) for pair in sorted(joined))
    wireframe = Wireframe(vertices, edges, np.array([[0, 1], [5, 2]]))
    found, degrees = open_pairs(wireframe, pixels), wireframe.degrees
    expected = {
        (i, j)
        for j in range(40)
        for i in range(j)
        if 4 <= 2 * np.linalg.norm(vertices[i] - vertices[j]) / (pixels[i] + pixels[j]) <= LONGEST_PX
        and min(degrees[i], degrees[j]) >= 2
        and (i, j) not in joined
    }
    assert {tuple(sorted(pair)) for pair in found.tolist()} == expected and len(found) == len(expected) > 0
    lengths = np.linalg.norm(vertices[found[:, 0]] - vertices[found[:, 1]], axis=1)
    assert (np.diff(lengths) >= 0).all() and len(found) <= MOST_PAIRS


@pytest.mark.parametrize("count", [0, 1])
def test_no_pairs_of_hardly_any_vertices(count):
    wireframe = Wireframe.loose([Line(np.eye(3)[:2])] * count)
    assert len(open_pairs(wireframe, np.full(len(wireframe.vertices), 0.001))) == 0


@pytest.mark.parametrize("pixels", [4.0, 7.3, 60.0])
def test_places_between_are_a_pixel_apart_and_clear_of_the_ends(pixels):
    line = Line(np.array([[0.0, 0, 0], [pixels * 0.002, 0, 0]]))
    places = line.at(clear_places(line, 0.002))[:, 0] / 0.002
    assert places[0] == pytest.approx(pixels - places[-1]) and places[0] >= min(2.0, 0.3 * pixels) - 1e-9
    assert np.diff(places).max() <= 1.5 and len(places) >= 3
