"""Strokes that continue each other become one edge, those that repeat others go, and neither joins what is apart."""

import itertools

import numpy as np
import pytest
from edgel_scenes import pixel_everywhere
from placed_shapes import PLANE, Placing, any_shape

from taichi_edges.fitting.distances import distances_to
from taichi_edges.fitting.model_selection import Yardstick
from taichi_edges.geometry.shapes import EllipticArc, Line, Spline, polyline
from taichi_edges.refinement.continuation import (
    Merging,
    continued,
    partners_of_ends,
    smooth_paths,
    with_whole_circles,
    without_repeats,
)

PIXEL = 0.0025  # unit-cube units: an object as large as an image of 400 pixels
NOISE = 0.2 * PIXEL
YARDSTICK, PIXEL_AT = Yardstick(NOISE, PIXEL), pixel_everywhere(PIXEL)
SEEDS = range(3)
CHORDAL = 2e-5  # by which places on a chain of cubics seem to be off its chords


def everywhere(shape, parameters):
    """All views see everything."""
    return np.full(len(parameters), 10.0)


def only_along(*shapes):
    """Views that see what lies on the shapes."""

    def seen(shape, parameters):
        places = shape.at(parameters)
        return np.where(np.min([distances_to(one, places) for one in shapes], axis=0) < PIXEL, 10.0, 0.0)

    return seen


def line(*ends):
    return Line(np.array([[*end, 0.0] for end in ends]))


def arc(low, high, radius=0.15, centre=(0.0, 0.0)):
    """An arc in the plane z = 0, radians."""
    return EllipticArc(np.array([*centre, 0.0]), radius * PLANE, low, high)


def part(shape, low, high):
    """The part of a shape between two parameters: a line, an arc, or a chain of one cubic."""
    if shape.kind == "line":
        return Line(shape.at(np.array([low, high])))
    if shape.kind in ("arc", "circle"):
        return shape.over(*shape.angles(np.array([low, high])))
    points, slopes = shape.at(np.array([low, high])), derivative(shape, np.array([low, high])) * (high - low) / 3
    return Spline(np.array([[points[0], points[0] + slopes[0], points[1] - slopes[1], points[1]]]))


def derivative(shape, t):
    """(n, 3) of a chain of one cubic."""
    legs, t = 3 * np.diff(shape.curves[0], axis=0), t[:, None]
    return (1 - t) ** 2 * legs[0] + 2 * t * (1 - t) * legs[1] + t**2 * legs[2]


def backward(shape):
    """The same places the other way round."""
    if shape.kind == "line":
        return Line(shape.points[::-1])
    if shape.kind == "spline":
        return Spline(shape.curves[::-1, ::-1], shape.closed)
    return EllipticArc(shape.centre, shape.axes * np.array([[1.0], [-1.0]]), -shape.high, -shape.low)


def shifted(shape, generator, distance=0.5 * NOISE):
    """The shape moved to a random side."""
    way = generator.normal(size=3)
    return shape.transformed(lambda points: points + distance * way / np.linalg.norm(way))


def strokes_of(shapes, generator, move=0.5 * NOISE):
    """Shapes as the fit finds them: anywhere, each a little off, each in either direction, in any order."""
    place = Placing(generator, scale=1.0)
    moved = [shifted(shape.transformed(place), generator, move) for shape in shapes]
    turned = [backward(shape) if generator.random() < 0.5 else shape for shape in moved]
    return [turned[n] for n in generator.permutation(len(turned))], place


def apart(one, other):
    """The greatest distance of places on either of two shapes from the other, ends included."""
    return max(distances_to(one, polyline(other)).max(), distances_to(other, polyline(one)).max())


def same_places(found, others, tolerance):
    """Are the shapes the same, whatever their order and direction?"""
    near = np.array([[apart(one, other) < tolerance for other in others] for one in found]).reshape(-1, len(others))
    return len(found) == len(others) and near.any(axis=0).all() and near.any(axis=1).all()


WAVE = Spline(np.array([[[0, 0, 0], [0.1, 0.12, 0.02], [0.2, -0.12, 0.02], [0.3, 0.02, 0.0]]], dtype=float))
WHOLE = {"line": line((0, 0), (0.3, 0)), "arc": arc(0.2, 2.4), "spline": WAVE}


# ------------------------------------------------------------------------------------------------------------ joining


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("between", [-0.02, 0.0, 0.02])
@pytest.mark.parametrize("kind", WHOLE)
def test_two_halves_become_one(generator, kind, between, seed):
    whole, cut = WHOLE[kind], generator.uniform(0.3, 0.7)
    strokes, place = strokes_of([part(whole, 0, cut - between / 2), part(whole, cut + between / 2, 1)], generator)
    found, counts = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert [shape.kind for shape in found] == [kind] and counts == Merging(0, 1, 0)
    # Four noises; a chain of cubics that is parametrised anew a few times only is half a pixel short or long besides.
    assert apart(found[0], whole.transformed(place)) < 4 * NOISE + (0.5 * PIXEL if kind == "spline" else 0.0)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["line", "arc"])
def test_bad_stroke_in_the_middle_is_overruled(generator, kind, seed):
    """Between two long halves a short one that is bent and turned, as crossing edges bend it."""
    whole = WHOLE[kind]
    ends = part(whole, 0.46, 0.54).ends
    middle = ends.mean(axis=0) + [0, 0, 2.0 * NOISE]
    bad = Spline(np.array([[ends[0], middle, middle, ends[1]]]))
    strokes, place = strokes_of([part(whole, 0, 0.455), bad, part(whole, 0.545, 1)], generator, 0.2 * NOISE)
    found, counts = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert [shape.kind for shape in found] == [kind] and counts.joined == 2
    assert apart(found[0], whole.transformed(place)) < 3 * NOISE


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("radius", [0.02, 0.05, 0.1])
def test_fillet_between_two_lines_stays_an_arc_between_lines(generator, radius, seed):
    fillet = arc(-np.pi / 2, 0, radius)
    true = [line((-0.2, -radius), (0, -radius)), fillet, line((radius, 0), (radius, 0.25))]
    strokes, _place = strokes_of([part(shape, 0.02, 0.98) for shape in true], generator, 0.2 * NOISE)
    found, counts = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert sorted(shape.kind for shape in found) == ["arc", "line", "line"] and counts == Merging()
    assert same_places(found, strokes, 1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_gap_that_the_images_do_not_show_stays(generator, seed):
    halves = [line((0, 0), (0.15, 0)), line((0.15 + 8 * PIXEL, 0), (0.35, 0))]
    strokes, _ = strokes_of(halves, generator)
    assert len(continued(strokes, YARDSTICK, PIXEL_AT, only_along(*strokes))[0]) == 2
    assert len(continued(strokes, YARDSTICK, PIXEL_AT, everywhere)[0]) == 1


def test_gap_wider_than_asked_for_stays(generator):
    halves = [line((0, 0), (0.15, 0)), line((0.15 + 16 * PIXEL, 0), (0.35, 0))]
    strokes, _ = strokes_of(halves, generator)
    assert len(continued(strokes, YARDSTICK, PIXEL_AT, everywhere)[0]) == 2
    assert len(continued(strokes, YARDSTICK, PIXEL_AT, everywhere, 24.0)[0]) == 1


@pytest.mark.parametrize("turn", [0.3, 0.6, 1.5])
def test_corner_stays(generator, turn):
    corner = [line((-0.2, 0), (0, 0)), line((0, 0), (0.2 * np.cos(turn), 0.2 * np.sin(turn)))]
    strokes, _ = strokes_of(corner, generator)
    found, counts = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert same_places(found, strokes, 1e-12) and counts == Merging()


@pytest.mark.parametrize("seed", SEEDS)
def test_each_end_is_continued_once(generator, seed):
    """Two lines side by side end where one begins that is in line with the first of them."""
    beside = 2.5 * PIXEL
    fork = [line((0, 0), (0.1, 0)), line((0, beside), (0.1, beside)), line((0.11, 0), (0.25, 0))]
    strokes, place = strokes_of(fork, generator, 0.2 * NOISE)
    found, _ = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    whole = [line((0, 0), (0.25, 0)), fork[1]]
    assert same_places(found, [shape.transformed(place) for shape in whole], 4 * NOISE)


def test_ends_continue_each_other_both_ways(generator):
    strokes, _ = strokes_of([part(WHOLE["arc"], a, a + 0.24) for a in (0, 0.25, 0.5, 0.75)], generator)
    partner = partners_of_ends(strokes, YARDSTICK, PIXEL_AT, 12.0)
    assert len(partner) == 6 and all(partner[other] == end for end, other in partner.items())
    assert all(end[0] != other[0] for end, other in partner.items())


@pytest.mark.parametrize("seed", SEEDS)
def test_every_stroke_is_in_one_path_once(generator, seed):
    pieces = [part(WHOLE["arc"], a, a + 0.24) for a in (0, 0.25, 0.5)]
    round = [part(arc(0, 2 * np.pi, 0.05), a, a + 0.33) for a in (0, 1 / 3, 2 / 3)]
    strokes, _ = strokes_of([*pieces, *round, WHOLE["line"], any_shape("circle", generator)], generator)
    paths = smooth_paths(strokes, YARDSTICK, PIXEL_AT, 12.0)
    assert sorted(number for path, _ in paths for number, _ in path) == list(range(len(strokes)))
    assert sorted((len(path), closes) for path, closes in paths) == [(1, False), (1, False), (3, False), (3, True)]
    for path, _ in paths:
        ends = [strokes[number].ends[::-1] if turned else strokes[number].ends for number, turned in path]
        assert all(np.linalg.norm(a[1] - b[0]) < 12 * PIXEL for a, b in itertools.pairwise(ends))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("pieces", [1, 2, 3])
def test_strokes_that_come_back_to_their_start_are_one_ellipse(generator, pieces, seed):
    """Chains of cubics with gaps between them, also between the two ends of a single one."""
    whole = EllipticArc(np.zeros(3), np.array([[0.2, 0, 0], [0, 0.11, 0]]), 0.0, 2 * np.pi)
    joints = np.linspace(0.3, 0.3 + 2 * np.pi, pieces + 1)
    strokes = [Spline(whole.over(low + 0.02, high - 0.02).cubics()) for low, high in itertools.pairwise(joints)]
    strokes, _placing = strokes_of(strokes, generator)
    found, _ = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert [shape.kind for shape in found] == ["ellipse"]
    np.testing.assert_allclose(found[0].radii, [0.2, 0.11], atol=NOISE)


@pytest.mark.parametrize("seed", SEEDS)
def test_strokes_round_a_gap_that_no_image_shows_stay_open(generator, seed):
    whole = EllipticArc(np.zeros(3), np.array([[0.2, 0, 0], [0, 0.11, 0]]), 0.0, 2 * np.pi)
    stroke = whole.over(0.05, 2 * np.pi - 0.05)  # a gap of 4.4 px
    strokes, _ = strokes_of([Spline(stroke.cubics())], generator)
    found, _ = continued(strokes, YARDSTICK, PIXEL_AT, only_along(*strokes))
    assert len(found) == 1 and not found[0].closed


# ------------------------------------------------------------------------------------------------------------ circles


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("cuts", [(0.0, 0.5), (0.0, 0.3, 0.65), (0.0, 0.2, 0.5, 0.6)])
def test_parts_of_a_circle_become_the_circle(generator, cuts, seed):
    whole = arc(0, 2 * np.pi)
    parts = [part(whole, a, b - 0.01) for a, b in zip(cuts, (*cuts[1:], 1.0), strict=True)]
    strokes, place = strokes_of(parts, generator, 0.3 * NOISE)
    found, counts = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert [shape.kind for shape in found] == ["circle"] and counts.circles == 1
    assert apart(found[0], whole.transformed(place)) < 2 * NOISE


@pytest.mark.parametrize("seed", SEEDS)
def test_circle_that_the_images_show_is_completed(generator, seed):
    whole = arc(0, 2 * np.pi)
    (stroke,), place = strokes_of([part(whole, 0, 0.7)], generator, 0.0)
    true = whole.transformed(place)
    assert [shape.kind for shape in continued([stroke], YARDSTICK, PIXEL_AT, only_along(true))[0]] == ["circle"]
    assert continued([stroke], YARDSTICK, PIXEL_AT, only_along(stroke))[0] == [stroke]


def test_less_than_half_a_circle_says_nothing_of_the_rest(generator):
    (stroke,), _ = strokes_of([arc(0, 0.4 * 2 * np.pi)], generator)
    assert continued([stroke], YARDSTICK, PIXEL_AT, everywhere)[0] == [stroke]


@pytest.mark.parametrize("seed", SEEDS)
def test_line_that_touches_a_circle_stays(generator, seed):
    whole = arc(0, 2 * np.pi)
    parts = [part(whole, 0, 0.49), part(whole, 0.5, 0.99), line((0.15, 0), (0.15, 0.2))]
    strokes, _place = strokes_of(parts, generator, 0.3 * NOISE)
    found, circles = with_whole_circles(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert circles == 1 and sorted(shape.kind for shape in found) == ["circle", "line"]


def test_round_slot_stays_two_arcs_and_two_lines(generator):
    ends = [arc(0, np.pi, 0.05, (0, 0.1)), arc(np.pi, 2 * np.pi, 0.05, (0, -0.1))]
    sides = [line((0.05, -0.1), (0.05, 0.1)), line((-0.05, -0.1), (-0.05, 0.1))]
    strokes, _ = strokes_of([part(shape, 0.02, 0.98) for shape in (*ends, *sides)], generator, 0.2 * NOISE)
    seen = only_along(*strokes)
    found, counts = continued(strokes, YARDSTICK, PIXEL_AT, seen)
    assert same_places(found, strokes, 1e-12) and counts == Merging()


# ------------------------------------------------------------------------------------------------------------ repeats


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["line", "arc", "spline"])
def test_stroke_beside_a_longer_one_goes(generator, kind, seed):
    whole = WHOLE[kind]
    shorter = part(whole, 0.2, 0.7).transformed(lambda points: points + [0, 0, 1.5 * NOISE])
    strokes, place = strokes_of([whole, shorter], generator, 0.0)
    found, counts = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert counts == Merging(0, 0, 1) and apart(found[0], whole.transformed(place)) < CHORDAL


@pytest.mark.parametrize("kind", ["line", "arc"])
def test_parallel_edges_four_noises_apart_stay(generator, kind):
    whole = WHOLE[kind]
    beside = whole.transformed(lambda points: points + [0, 0, 4 * NOISE])
    strokes, _ = strokes_of([whole, beside], generator, 0.0)
    assert same_places(continued(strokes, YARDSTICK, PIXEL_AT, everywhere)[0], strokes, 1e-12)


def test_stroke_beside_two_others_goes(generator):
    halves = [line((0, 0), (0.2, 0)), line((0.2, 0), (0.4, 0.02))]
    strokes, _ = strokes_of([*halves, line((0.14, 0), (0.24, 0.0022))], generator, 0.0)
    assert len(without_repeats(strokes, YARDSTICK, PIXEL_AT)) == 2


def test_short_stroke_across_a_long_one_stays(generator):
    strokes, _ = strokes_of([line((0, 0), (0.3, 0)), line((0.1, -2 * NOISE), (0.1, 2 * NOISE))], generator, 0.0)
    assert len(without_repeats(strokes, YARDSTICK, PIXEL_AT)) == 2


def test_stroke_that_goes_on_beyond_its_neighbour_stays(generator):
    strokes, _ = strokes_of([line((0, 0), (0.3, 0)), line((0.25, NOISE), (0.4, NOISE))], generator, 0.0)
    assert len(without_repeats(strokes, YARDSTICK, PIXEL_AT)) == 2


# ----------------------------------------------------------------------------------------------------------- in general


def drawing():
    """A part with all of it: cut lines and arcs, a fillet, a hole in pieces, a repeated stroke, one that is nowhere."""
    return [
        line((-0.3, -0.1), (-0.15, -0.1)),
        line((-0.14, -0.1), (-0.001, -0.1)),
        arc(-np.pi / 2, 0, 0.1),
        line((0.1, 0.002), (0.1, 0.3)),
        line((0.1, 0.1), (0.1, 0.2)).transformed(lambda points: points + [0, 0, NOISE]),
        arc(0.0, 3.0, 0.06, (-0.15, 0.1)),
        arc(3.02, 6.26, 0.06, (-0.15, 0.1)),
        WAVE.transformed(lambda points: points + [-0.2, 0, 0.1]),
    ]


@pytest.mark.parametrize("seed", SEEDS)
def test_order_and_direction_of_the_strokes_do_not_matter(generator, seed):
    place = Placing(generator, scale=1.0)
    strokes = [shifted(shape.transformed(place), generator, 0.2 * NOISE) for shape in drawing()]
    first, counts = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)
    assert sorted(shape.kind for shape in first) == ["arc", "circle", "line", "line", "spline"]
    assert counts == Merging(1, 2, 1)
    for _ in range(3):
        turned = [backward(shape) if generator.random() < 0.5 else shape for shape in strokes]
        found, again = continued([turned[n] for n in generator.permutation(8)], YARDSTICK, PIXEL_AT, everywhere)
        # The robust fits converge to the same shape but not to the last bit: a hundredth of the noise.
        assert again == counts and same_places(found, first, 0.05 * NOISE)


def test_same_twice(generator):
    strokes, _ = strokes_of(drawing(), generator)
    one, other = (continued(strokes, YARDSTICK, PIXEL_AT, everywhere)[0] for _ in range(2))
    assert all(np.array_equal(polyline(a), polyline(b)) for a, b in zip(one, other, strict=True))


def test_continued_edges_stay_as_they_are(generator):
    strokes, _ = strokes_of(drawing(), generator, 0.2 * NOISE)
    once = continued(strokes, YARDSTICK, PIXEL_AT, everywhere)[0]
    twice, counts = continued(once, YARDSTICK, PIXEL_AT, everywhere)
    assert counts == Merging() and same_places(twice, once, CHORDAL)


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_anything_to_continue(generator, count):
    strokes = [any_shape("spline", generator)] * count
    assert continued(strokes, YARDSTICK, PIXEL_AT, everywhere) == (strokes, Merging())
