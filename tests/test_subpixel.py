"""The sub-pixel detector: planted edges are found where they are, and nothing else is."""

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from taichi_edges.detectors.subpixel import detect_edgels, trace_pictures
from taichi_edges.errors import UserError
from taichi_edges.views.light import light_of_srgb
from taichi_edges.views.pictures import as_picture, levels_per_light, read_picture

SIZE = 96
FINE = 16  # samples along each side of a pixel inside a circle
BORDER = 6  # px along the image's border, where edges are cut


def encoded(light):
    """(...) uint8 sRGB of linear light in 0..1."""
    light = np.clip(light, 0.0, 1.0)
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * values).astype(np.uint8)


def disk(centre, radius):
    """(SIZE, SIZE) share of each pixel inside a circle."""
    steps = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    inside = np.hypot(steps - centre[0], steps[:, None] - centre[1]) < radius
    return inside.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))


def half_plane(angle, centre):
    """Exact share of the pixels on one side of a line, and the signed distances (n,) of points from it."""
    normal = np.array([np.cos(angle), np.sin(angle)])

    def distance(points):
        return (points - np.asarray(centre)) @ normal

    # Integrated along u and v, the step becomes a quadratic; the share is its second difference over the pixel.
    wide, narrow = np.maximum(np.abs(normal), 1e-4)
    away = distance(np.moveaxis(np.indices((SIZE, SIZE))[::-1], 0, -1).astype(float))
    corners = [(side * 0.5 * (wide + sign * narrow), sign) for side in (1, -1) for sign in (1, -1)]
    share = sum(sign * np.maximum(away + offset, 0) ** 2 for offset, sign in corners) / (2 * wide * narrow)
    return share.clip(0, 1), distance


def mixed(share, low, high):
    """8-bit picture with light `low` where the share is 0 and `high` where it is 1; colours (3,) or numbers."""
    share = share[:, :, None] if np.ndim(low) else share
    return encoded((1 - share) * np.asarray(low) + share * np.asarray(high))


def within(points):
    """(n,) bool: not near the image's border."""
    return ((points > BORDER) & (points < SIZE - 1 - BORDER)).all(axis=1)


def noisy(picture, sigma, generator):
    """The 8-bit picture with normal noise of `sigma` grey levels."""
    return np.clip(np.rint(picture + sigma * generator.standard_normal(picture.shape)), 0, 255).astype(np.uint8)


def test_lines_are_found_to_a_tenth_of_a_pixel_whatever_their_angle_and_contrast(generator):
    errors = []
    for angle in generator.uniform(0, 2 * np.pi, 12):
        share, distance = half_plane(angle, generator.uniform(42, 54, 2))
        points, normals, strengths, *_ = detect_edgels(mixed(share, *generator.permutation([0.05, 0.9])))
        inner = within(points)
        errors.append(distance(points[inner]))
        length = np.ptp(points @ [-np.sin(angle), np.cos(angle)])
        assert length > 0.7 * SIZE and 0.6 * length < len(points) < 1.5 * length  # about one for each pixel
        assert np.abs(normals[inner] @ [np.cos(angle), np.sin(angle)]).min() > 0.99
        assert strengths.min() > 0.7 and strengths.max() <= 1.0
    errors = np.concatenate(errors)
    assert np.abs(errors).max() < 0.1
    assert np.median(np.abs(errors)) < 0.03
    assert abs(np.median(errors)) < 0.01


def blurred(angle, centre, sigma):
    """8-bit picture of a step that is blurred by `sigma` px before the pixels blur it."""
    steps = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    away = (steps - centre[0]) * np.cos(angle) + (steps[:, None] - centre[1]) * np.sin(angle)
    share = ndtr(away / sigma) if sigma else (away > 0).astype(float)
    return mixed(share.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3)), 0.1, 0.8)


def blurs_of(picture):
    """Blurs of the edgels that are not near the border."""
    points, _, _, blurs, _ = detect_edgels(picture)
    assert len(points) == len(blurs) > 0.7 * SIZE
    return blurs[within(points)]


@pytest.mark.parametrize("sigma", [0.5, 0.8, 1.5, 2.5])
def test_a_blurred_step_tells_by_how_much(sigma, generator):
    for angle in generator.uniform(0, 2 * np.pi, 4):
        blurs = blurs_of(blurred(angle, generator.uniform(42, 54, 2), sigma))
        assert np.median(blurs) == pytest.approx(sigma, rel=0.2) and np.abs(blurs / sigma - 1).max() < 0.4


def test_a_sharp_step_is_not_blurred(generator):
    for angle in generator.uniform(0.25, np.pi / 2 - 0.25, 6) + np.pi / 2 * generator.integers(0, 4, 6):
        assert np.quantile(blurs_of(blurred(angle, generator.uniform(42, 54, 2), 0)), 0.9) < 0.2


def test_a_sharp_step_along_the_pixels_looks_blurred_by_less_than_half_a_pixel(generator):
    """How wide its gradient seems depends on where in a pixel it is: up to 0.44 px at the pixel's centre."""
    for angle in np.pi / 2 * np.arange(4):
        assert blurs_of(blurred(angle, generator.uniform(42, 54, 2), 0)).max() < 0.48


@pytest.mark.parametrize("radius", [5.0, 12.0, 30.0])
def test_circles_are_found_to_a_tenth_of_a_pixel(radius, generator):
    centre = generator.uniform(46, 50, 2)
    points, normals, *_ = detect_edgels(mixed(disk(centre, radius), 0.6, 0.2))
    away = points - centre
    errors = np.hypot(*away.T) - radius
    assert np.abs(errors).max() < 0.1
    assert np.median(np.abs(errors)) < 0.06
    angles = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    assert np.diff(np.concatenate([angles, angles[:1] + 2 * np.pi])).max() < 3 / radius  # no gap of three pixels
    assert ((normals * away).sum(axis=1) > 0).all()  # towards the light, which is outside


@pytest.mark.parametrize("light", [0.0, 0.2, 1.0])
def test_outlines_of_straight_alpha_are_not_biased_and_need_no_background(light, generator):
    share, distance = half_plane(generator.uniform(0, 2 * np.pi), generator.uniform(42, 54, 2))
    colours = np.full((SIZE, SIZE, 3), encoded(light))
    colours[share < 0.004] = generator.integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)[share < 0.004]  # garbage
    picture = np.dstack([colours, np.rint(255 * share).astype(np.uint8)])
    points, normals, strengths, _, outlines = detect_edgels(picture)
    assert outlines.all() and (distance(points + normals) > distance(points)).all()  # normals point to the object
    errors = distance(points[within(points)])
    assert len(errors) > 0.6 * (SIZE - 2 * BORDER)
    assert np.abs(errors).max() < 0.1
    assert abs(np.median(errors)) < 0.02
    assert strengths.min() > 0.7


def test_a_faint_crease_beside_the_outline_is_found():
    share, distance = half_plane(0.3, (40.2, 47.9))
    crease, from_crease = half_plane(0.3, (43.2, 47.9))
    light = 0.50 + 0.03 * crease
    picture = np.dstack([encoded(light)] * 3 + [np.rint(255 * share).astype(np.uint8)])
    points, *_, outlines = detect_edgels(picture)
    on_crease = np.abs(from_crease(points)) < 1
    assert not outlines[on_crease].any() and outlines[~on_crease].all()
    assert on_crease.sum() > 0.8 * SIZE
    assert np.abs(np.median(from_crease(points[on_crease]))) < 0.1
    assert (np.minimum(np.abs(from_crease(points)), np.abs(distance(points))) < 0.3).all()


def test_an_edge_between_colours_of_equal_brightness_is_found():
    share, distance = half_plane(0.8, (48.3, 47.6))
    picture = mixed(share, [0.3, 0.4, 0.5], [0.5, 0.4, 0.3])  # one mean, and one green
    points, *_ = detect_edgels(picture)
    inner = within(points)
    assert inner.sum() > 60
    assert np.abs(distance(points[inner])).max() < 0.1


def test_a_long_faint_crease_is_found_in_noise_that_alone_gives_next_to_nothing(generator):
    share, distance = half_plane(0.4, (48.3, 47.6))
    level, step, sigma = 120.0, 6.0, 2.0  # grey levels
    blank = np.full((SIZE, SIZE, 3), level)
    crease = blank + step * share[:, :, None]
    points, *_ = detect_edgels(noisy(crease, sigma, generator))
    near = np.abs(distance(points)) < 1.5
    assert near.sum() > 0.7 * SIZE
    assert (~near).sum() < 0.1 * SIZE
    assert abs(np.median(distance(points[near]))) < 0.15
    false = [len(detect_edgels(noisy(blank, noise, generator))[0]) for noise in (0.5, 2.0, 8.0, 30.0)]
    assert max(false) < 0.003 * SIZE**2


@pytest.mark.parametrize("lights", [(0.2, 0.8, 0.3), (0.2, 0.4, 0.8)])
def test_two_edges_three_pixels_apart_are_two(lights):
    first, from_first = half_plane(0.5, (47.0, 48.0))
    second, from_second = half_plane(0.5, (47.0 + 3 * np.cos(0.5), 48.0 + 3 * np.sin(0.5)))
    light = lights[0] + (lights[1] - lights[0]) * first + (lights[2] - lights[1]) * second
    points, *_ = detect_edgels(encoded(light))
    for distance in (from_first, from_second):
        errors = distance(points[within(points)])
        near = np.abs(errors) < 0.5
        assert near.sum() > 60
        assert np.median(np.abs(errors[near])) < 0.1


@pytest.mark.parametrize("width", [1.5, 2.0, 2.5])
@pytest.mark.parametrize("ratio", [1.0, 0.6])
def test_both_sides_of_a_thin_line_are_found_where_they_are(width, ratio, generator):
    """Their blurs overlap: the gradient's maxima are never less than two blurs, 1.7 px, apart, here 2.1 to 2.6."""
    errors, blurs = [], []
    for angle in generator.uniform(0, 2 * np.pi, 8):
        across, middle = np.array([np.cos(angle), np.sin(angle)]), generator.uniform(46, 50, 2)
        first, second = (half_plane(angle, middle + side * across * width / 2) for side in (-1, 1))
        points, *_, blur, _ = detect_edgels(encoded(0.3 + 0.4 * first[0] - 0.4 * ratio * second[0]))
        inner = within(points)
        side = (points[inner] - middle) @ across > 0
        errors.append(np.where(side, second[1](points[inner]), -first[1](points[inner])))  # outwards
        blurs.append(blur[inner])
    errors = np.concatenate(errors)
    assert len(errors) > 8 * 100  # both sides
    assert abs(np.median(errors)) < 0.17 and np.quantile(np.abs(errors), 0.9) < 0.35
    if width < 2.5:
        assert np.isnan(np.concatenate(blurs)).mean() > 0.6  # how wide a maximum is does not tell anything here


@pytest.mark.parametrize("radius", [2.0, 2.5, 4.0])
def test_holes_of_a_few_pixels_are_found_sharp_and_where_they_are(generator, radius):
    for _ in range(6):
        centre = generator.uniform(44, 52, 2)
        points, _, _, blurs, _ = detect_edgels(mixed(disk(centre, radius), 0.6, 0.1))
        away = np.linalg.norm(points - centre, axis=1)
        assert np.abs(away - radius).max() < 0.75 and abs(np.median(away) - radius) < 0.2
        turns = np.sort(np.arctan2(*(points - centre).T))
        assert np.diff(np.append(turns, turns[0] + 2 * np.pi)).max() < np.radians(130)  # all the way round
        assert not (blurs > 0.48).any()  # unknown, or as sharp as a sharp step may look


def test_slots_beside_each_other_are_no_clutter():
    rows, columns = np.mgrid[:SIZE, :SIZE]
    slot = (rows % 8 < 3) & (columns % 14 < 10) & (np.minimum(rows, columns) > 8) & (np.maximum(rows, columns) < 86)
    points = detect_edgels(np.where(slot, 90, 200).astype(np.uint8))[0]
    sides = [(row, column) for row in range(16, 80, 8) for column in range(14, 80, 14)]
    found = [np.hypot(points[:, 0] - (column + 4.5), points[:, 1] - (row - 0.5)).min() < 1.0 for row, column in sides]
    assert np.mean(found) > 0.9


def test_blank_pictures_shading_and_its_rounding_give_nothing():
    assert len(detect_edgels(np.full((SIZE, SIZE, 3), 90, np.uint8))[0]) == 0
    assert len(detect_edgels(np.zeros((SIZE, SIZE, 4), np.uint8))[0]) == 0  # nothing but background
    assert len(detect_edgels(np.zeros((3, 3, 3), np.uint8))[0]) == 0
    rows, columns = np.mgrid[:SIZE, :SIZE]
    for ramp in (0.07 * columns + 0.02 * rows, 1.9 * columns + 0.5 * rows):  # steps of a level far apart; steep
        assert len(detect_edgels(np.rint(20 + ramp).astype(np.uint8))[0]) == 0
    ball = 1 - ((columns - 48) ** 2 + (rows - 48) ** 2) / SIZE**2
    assert len(detect_edgels(encoded(0.8 * ball))[0]) == 0


def test_texture_gives_few_edgels_and_an_edge_across_it_stands_out(generator):
    share, distance = half_plane(1.2, (48.0, 48.0))
    texture = cv2.GaussianBlur(generator.standard_normal((SIZE, SIZE)), (0, 0), 1.0)
    grain = np.clip(120 + 40 * texture, 0, 255)
    assert len(detect_edgels(grain.astype(np.uint8))[0]) < 0.02 * SIZE**2
    points, *_ = detect_edgels(np.clip(grain - 60 + 120 * share, 0, 255).astype(np.uint8))
    assert (np.abs(distance(points)) < 2).sum() > 0.7 * SIZE


def test_grey_deep_and_linear_images_say_the_same():
    share, distance = half_plane(0.5, (47.3, 48.1))
    light = 0.2 + 0.5 * share
    grey = encoded(light)
    expected = detect_edgels(grey)[0]
    colour = detect_edgels(np.dstack([grey] * 3))[0]
    np.testing.assert_allclose(colour, expected, atol=1e-3)
    np.testing.assert_allclose(detect_edgels(grey.astype(np.uint16) * 257)[0], expected, atol=1e-3)
    linear = detect_edgels(light.astype(np.float32))[0]  # pixels that tie may change places: 8 bits are rounded
    assert len(linear) == pytest.approx(len(expected), abs=5)
    assert np.median(distance(linear)) == pytest.approx(np.median(distance(expected)), abs=0.01)
    opaque = np.dstack([grey, grey, grey, np.full_like(grey, 255)])
    np.testing.assert_allclose(detect_edgels(opaque)[0], expected, atol=1e-3)


def test_an_image_that_was_smoothed_in_its_encoded_values_is_read_with_exponent_one():
    share, distance = half_plane(0.5, (47.3, 48.1))
    drawn = np.rint(255 * share).astype(np.uint8)
    offsets = {
        exponent: np.median(distance(detect_edgels(as_picture(drawn, exponent))[0])) for exponent in (None, 1.0, 2.2)
    }
    assert abs(offsets[1.0]) < 0.01
    assert offsets[None] > 0.1 and offsets[2.2] > 0.1  # towards the light


@pytest.mark.parametrize("exponent", [None, 1.0, 2.2, 6.0])
def test_levels_per_light_is_the_slope_of_the_encoding(exponent):
    values = np.linspace(0.1, 1.0, 50)
    light = light_of_srgb(values).astype(float) if exponent is None else values**exponent
    middle = 0.5 * (light[1:] + light[:-1])
    slopes = 255 * np.diff(values) / np.diff(light)
    np.testing.assert_allclose(levels_per_light(middle, exponent), slopes, rtol=0.15)


def write_pictures(folder, generator, count=5):
    """Paths of some lossless images of noisy lines."""
    paths = []
    for index in range(count):
        share, _ = half_plane(generator.uniform(0, 7), generator.uniform(40, 56, 2))
        paths.append(str(folder / f"{index}.png"))
        cv2.imwrite(paths[-1], noisy(mixed(share, [0.2, 0.3, 0.4], [0.5, 0.5, 0.2]), 3.0, generator))
    return paths


def test_tracing_does_not_depend_on_the_threads_and_a_view_without_picture_has_no_edgels(tmp_path, generator):
    paths = write_pictures(tmp_path, generator)
    paths.insert(2, "")
    done = []
    (one, _), (three, _) = trace_pictures(paths, threads=1), trace_pictures(paths, threads=3, report=done.append)
    for name in ("starts", "points", "normals", "strengths"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
    assert one.view_count == 6 and len(one.of_view(2)[0]) == 0 and np.diff(one.starts)[[0, 1, 3, 4, 5]].min() > 50
    assert done == [1, 2, 3, 4, 5, 6]
    np.testing.assert_allclose(one.of_view(0)[0], detect_edgels(read_picture(paths[0]))[0], atol=1e-4)


def test_an_image_that_cannot_be_read_is_named_in_one_line(tmp_path, generator):
    whole = write_pictures(tmp_path, generator, 1)[0]
    truncated, text = tmp_path / "truncated.png", tmp_path / "text.tif"
    truncated.write_bytes((tmp_path / "0.png").read_bytes()[:-50])
    text.write_text("not an image at all")
    for path, problem in ((truncated, "truncated"), (text, "cannot be|can be read"), (tmp_path / "no.png", "no such")):
        with pytest.raises(UserError, match=problem) as caught:
            trace_pictures([whole, str(path)], threads=2)
        assert str(path) in str(caught.value) and "leave this view out" in str(caught.value)


def test_directories_and_odd_channels_are_refused_as_well(tmp_path):
    with pytest.raises(UserError, match="no such image"):
        read_picture(tmp_path)
