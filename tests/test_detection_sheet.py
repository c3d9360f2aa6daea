"""The sheet that shows what the detector gave: its size, its numbers, and that its colours mean what they say."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from taichi_edges.detectors import detection_sheet as sheet
from taichi_edges.detectors.detection_sheet import (
    NEGATIVE,
    POSITIVE,
    UNKNOWN,
    ZERO,
    median_and_mad,
    residual_colours,
    write_detection_sheet,
)
from taichi_edges.views.edgels import Edgels
from taichi_edges.views.views import Views


def make_views(generator, count=3, width=160, height=120, edgels_each=200, image_paths=None):
    """Views that look in different directions, with random edgels."""
    rotations = [cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0] for angle in np.linspace(0, 3, count)]
    edgels = []
    for _ in range(count):
        angles = generator.uniform(0, 2 * np.pi, edgels_each)
        points = generator.uniform(0, (width - 1, height - 1), (edgels_each, 2))
        edgels.append((points, np.stack([np.cos(angles), np.sin(angles)], axis=1), generator.random(edgels_each)))
    return Views(
        names=tuple(f"view {index}" for index in range(count)),
        edge_maps=generator.integers(0, 256, (count, height, width), dtype=np.uint8),
        intrinsics=np.tile(np.eye(3), (count, 1, 1)),
        world_to_camera=np.stack([np.column_stack([rotation, np.zeros(3)]) for rotation in rotations]),
        image_paths=image_paths or ("",) * count,
        edgels=Edgels.of_views(edgels),
    )


def read(path):
    """(H, W, 3) uint8 RGB."""
    return cv2.imread(str(path))[:, :, ::-1]


def expected_size(rows, columns, cell_height):
    """(height, width) px."""
    row = sheet.LINE + 8 + cell_height + sheet.GAP
    return 5 * sheet.LINE + sheet.GAP + rows * row, sheet.GAP + columns * (sheet.CELL_WIDTH + sheet.GAP)


def has_colour(picture, colour):
    return bool((picture == np.array(colour)).all(axis=-1).any())


@pytest.mark.parametrize("count, rows", [(1, 1), (4, 4), (50, 4)])
def test_a_row_for_each_of_four_views(tmp_path, generator, count, rows):
    views = make_views(generator, count, edgels_each=50)
    residuals = generator.normal(size=len(views.edgels))
    path = write_detection_sheet(tmp_path / "sheet.png", views, residuals, generator.random(len(residuals)) < 0.5)
    assert path == tmp_path / "sheet.png" and [p.name for p in tmp_path.iterdir()] == ["sheet.png"]
    assert read(path).shape[:2] == expected_size(rows, 6, 300)


@pytest.mark.slow(reason="draws large sheets")
@pytest.mark.parametrize(
    "width, height, cell_height",
    [(64, 48, 300), (1600, 1200, 300), (300, 900, 480), (900, 100, 240), (3, 2, 267), (401, 299, 298)],
)
def test_views_of_any_size(tmp_path, generator, width, height, cell_height):
    views = make_views(generator, 2, width, height, edgels_each=3000)
    path = write_detection_sheet(tmp_path / "sheet.png", views, generator.normal(size=len(views.edgels)))
    assert read(path).shape[:2] == expected_size(2, 6, cell_height)


def test_without_residuals_their_columns_are_left_out(tmp_path, generator):
    path = write_detection_sheet(tmp_path / "sheet.png", make_views(generator))
    assert read(path).shape[:2] == expected_size(3, 4, 300)


def test_views_without_edgels_and_without_known_residuals(tmp_path, generator):
    views = make_views(generator, 3)
    starts = views.edgels.starts
    keep = np.ones(len(views.edgels), bool)
    keep[starts[1] : starts[2]] = False
    views = replace(views, edgels=views.edgels.keep(keep))
    count = len(views.edgels)
    write_detection_sheet(tmp_path / "some.png", views, generator.normal(size=count), np.zeros(count, bool))
    write_detection_sheet(tmp_path / "unknown.png", views, np.full(count, np.nan), np.ones(count))
    none = replace(views, edgels=views.edgels.keep(np.zeros(count, bool)))
    path = write_detection_sheet(tmp_path / "none.png", none, np.zeros(0), np.zeros(0, bool))
    assert read(path).shape[:2] == expected_size(3, 6, 300)


# --- Pictures ---


def test_pictures_are_read_by_the_reader_that_is_given(tmp_path, generator):
    views = make_views(generator, 2, image_paths=("one", "two"))
    colours = {"one": (200, 30, 10), "two": (10, 20, 230)}

    def read_picture(path):
        return np.full((240, 320, 3), colours[path], np.uint8)  # twice the size of the views

    picture = read(write_detection_sheet(tmp_path / "sheet.png", views, picture_reader=read_picture))
    first = picture[:, : sheet.GAP + sheet.CELL_WIDTH]
    assert all(has_colour(first, colour) for colour in colours.values())


def test_a_picture_file_is_read_in_its_colours(tmp_path, generator):
    file = tmp_path / "red.png"
    cv2.imwrite(str(file), np.full((120, 160, 3), (10, 30, 200), np.uint8))  # BGR
    views = make_views(generator, 1, image_paths=(str(file),))
    assert has_colour(read(write_detection_sheet(tmp_path / "sheet.png", views)), (200, 30, 10))


def test_missing_unreadable_and_foreign_pictures_give_way_to_the_edge_map(tmp_path, generator):
    (tmp_path / "broken.png").write_bytes(b"nothing")
    cv2.imwrite(str(tmp_path / "square.png"), np.full((50, 50, 3), (10, 30, 200), np.uint8))
    paths = ("", str(tmp_path / "nowhere.png"), str(tmp_path / "broken.png"), str(tmp_path / "square.png"))
    views = make_views(generator, 4, image_paths=paths)
    picture = read(write_detection_sheet(tmp_path / "sheet.png", views))
    assert picture.shape[:2] == expected_size(4, 4, 300) and not has_colour(picture, (200, 30, 10))


def test_names_of_any_letters_and_length_are_written(tmp_path, generator):
    views = replace(make_views(generator, 2), names=("ansicht_äöü_図", "long " * 60))
    assert read(write_detection_sheet(tmp_path / "sheet.png", views)).shape[:2] == expected_size(2, 4, 300)


# --- Colours and numbers ---


def test_colours_tell_the_sign_and_saturate():
    residuals = np.array([-9.0, -2.0, 0.0, 2.0, 9.0, np.nan])
    expected = [NEGATIVE, NEGATIVE, ZERO, POSITIVE, POSITIVE, UNKNOWN]
    np.testing.assert_array_equal(residual_colours(residuals, 2.0), expected)
    between = residual_colours(np.array([-1.0, 1.0]), 2.0).astype(int)
    np.testing.assert_allclose(between, (np.array([NEGATIVE, POSITIVE]) + ZERO) / 2, atol=0.51)


@pytest.mark.parametrize("sign, colour, other", [(1, POSITIVE, NEGATIVE), (-1, NEGATIVE, POSITIVE)])
def test_a_planted_residual_is_drawn_in_its_colour_at_its_place(generator, sign, colour, other):
    views = make_views(generator, 1, edgels_each=0)
    point = np.array([[70.25, 61.6]])
    views = replace(views, edgels=Edgels.of_views([(point, np.array([[1.0, 0.0]]), np.array([1.0]))]))
    cell = (400, 300)
    content = sheet.content_of(views, 0, np.array([sign * 3.0]), None, 1.0, cell, None)
    drawn = sheet.magnified_residuals(content, cell)
    assert has_colour(drawn, colour) and not has_colour(drawn, other)
    rows, columns = np.nonzero((drawn == colour).all(axis=2))
    left, top, width, _ = content.window
    scale = cell[0] / width
    where = (np.array([columns.mean(), rows.mean()]) + 0.5) / scale - 0.5 + (left, top)
    np.testing.assert_allclose(where, point[0], atol=0.5 / scale)


def test_residuals_on_the_sheet_have_both_colours_only_where_there_are_both(tmp_path, generator):
    views = make_views(generator, 2)
    residuals = generator.uniform(20, 30, len(views.edgels))  # beyond every colour bar
    cells = slice(5 * sheet.LINE + sheet.GAP, None)  # below the colour bars
    outward = read(write_detection_sheet(tmp_path / "out.png", views, residuals))[cells]
    inward = read(write_detection_sheet(tmp_path / "in.png", views, -residuals))[cells]
    assert has_colour(outward, POSITIVE) and not has_colour(outward, NEGATIVE)
    assert has_colour(inward, NEGATIVE) and not has_colour(inward, POSITIVE)


def test_edgels_without_a_residual_are_grey(generator):
    views, cell = make_views(generator, 1), (400, 300)
    content = sheet.content_of(views, 0, np.full(len(views.edgels), np.nan), None, 1.0, cell, None)
    drawn = sheet.magnified_residuals(replace(content, picture=np.zeros((120, 160, 3), np.uint8)), cell)
    assert has_colour(drawn, UNKNOWN) and not has_colour(drawn, POSITIVE) and not has_colour(drawn, NEGATIVE)


def test_strong_edgels_differ_from_weak_ones():
    weak, middle, strong = sheet.strength_colours(np.array([0.0, 0.5, 1.0])).astype(int)
    assert weak[2] > weak[0] and middle[1] > middle[0] and strong[0] > 200 and strong[2] < 100  # blue, green, yellow


def test_median_and_mad_leave_out_what_is_unknown():
    assert median_and_mad(np.array([1.0, np.nan, 2.0, 4.0])) == (2.0, 1.0, 3)
    assert median_and_mad(np.array([np.nan]))[2] == 0


def test_the_colour_bar_ends_at_a_round_number_that_holds_most():
    assert sheet.colour_limit(np.array([0.3, -0.4, np.nan])) == 0.5
    assert sheet.colour_limit(np.r_[np.full(99, 0.05), 8.0]) == 0.1
    assert (
        sheet.colour_limit(np.array([500.0])) == 10.0
        and sheet.colour_limit(np.zeros(0)) == 0.1
        and sheet.colour_limit(None) == 0.1
    )


def test_the_part_with_most_edgels_is_magnified(generator):
    size, cell = (800, 600), (400, 300)
    crowd = generator.uniform((500, 300), (570, 350), (300, 2))
    points = np.concatenate([crowd, generator.uniform(0, (799, 599), (100, 2)), [[-3.0, 700.0]]])
    left, top, width, height = sheet.busiest_window(points, None, None, size, cell)
    assert (width, height) == (80, 60)
    inside = ((crowd >= (left - 0.5, top - 0.5)) & (crowd < (left + width - 0.5, top + height - 0.5))).all(axis=1)
    assert inside.mean() > 0.95


def test_the_magnified_part_shows_both_kinds_and_known_residuals(generator):
    size, cell = (800, 600), (400, 300)
    crowd, mixed = generator.uniform(100, 140, (400, 2)), generator.uniform(400, 440, (200, 2))
    points, silhouette = np.concatenate([crowd, mixed]), np.r_[np.ones(400, bool), np.arange(200) % 2 == 0]
    left, _, width, _ = sheet.busiest_window(points, None, silhouette, size, cell)
    assert left + width > 400  # 400 of one kind lose against 100 of each
    residuals = np.r_[np.full(400, np.nan), np.ones(200)]
    left, _, width, _ = sheet.busiest_window(points, residuals, None, size, cell)
    assert left + width > 400


def test_window_sums_count_points(generator):
    points = generator.uniform(0, (12, 9), (60, 2))
    sums = sheet.window_sums(points, (13, 10), (4, 3))
    assert sums.shape == (8, 10)
    columns, rows = np.rint(points).astype(int).T
    for top, left in ((0, 0), (7, 9), (3, 5)):
        inside = (columns >= left) & (columns < left + 4) & (rows >= top) & (rows < top + 3)
        assert sums[top, left] == inside.sum()
