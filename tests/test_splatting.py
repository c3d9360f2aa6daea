"""The splatting kernels give the image of the formula and choose the pixels the paper asks for."""

import numpy as np
import pytest
import taichi as ti
from reference_splatting import (
    INSIDE,
    MOSTLY_EDGES,
    NO_EDGES,
    OBLIQUE,
    OUTSIDE,
    PARAMETERS,
    Scene,
    alphas,
    edge_weights,
    image_loss,
    project,
    random_gaussians,
    random_scene,
    render,
    selected,
)

from taichi_edges.splatting import splatter as splatter_module
from taichi_edges.splatting.gaussians import Gaussians, rotation_matrices, start_gaussians
from taichi_edges.splatting.projection import fast_exp2
from taichi_edges.splatting.selection import pack_mask

WIDTH, HEIGHT = 50, 40
VIEWS = (OUTSIDE, OBLIQUE, INSIDE)

# Largest error of C = 1 - prod (1 - a_i). |dC| <= sum T / (1 - a_i) |da_i| <= max |da_i| / a_i, however many Gaussians
# there are. The relative error of one a_i is some roundings (6e-8 in f32, 1e-16 in f64), of which the determinant of a
# needle's covariance makes up to 1e3 (the squared ratio of its axes in pixels), times the exponent, at most 5.5.
# The cuts (1/255, 3 sigma) are steps, which rounding may carry a pixel across: C must lie between the twin's images
# with cuts a little stricter and a little laxer (SLACK, by the same reckoning; boxes end at some 100 px).
TOLERANCE = {"f32": 3e-4, "f64": 1e-11}
SLACK = {"f32": 1e-3, "f64": 1e-9}


def assert_image(image, gaussians, camera, real):
    """`image` is the twin's, up to rounding."""
    height, width = image.shape
    strict = render(gaussians, camera, width, height, -SLACK[real])
    lax = render(gaussians, camera, width, height, SLACK[real])
    assert np.isfinite(image).all()
    assert (image >= strict - TOLERANCE[real]).all() and (image <= lax + TOLERANCE[real]).all()


# Images ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 511, 512, 513, 1025])  # 512: the fewest items Taichi gives a thread
@pytest.mark.parametrize("real", ["f64", "f32"])
def test_image_is_the_twins(open_splatter, seed, generator, real, count):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene, real, loss="whole_image")
    gaussians = random_gaussians(count, generator)
    splatter.load(gaussians)
    for view in VIEWS:
        image = splatter.render(view)
        assert image.shape == (HEIGHT, WIDTH)
        assert_image(image, gaussians, scene.camera(view), real)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("width", [31, 32, 33, 64, 100])  # the mask packs 32 columns into a word
def test_image_of_any_width_is_the_twins(open_splatter, seed, generator, width):
    scene = random_scene(seed, width, HEIGHT)
    splatter = open_splatter(scene, loss="whole_image")
    gaussians = random_gaussians(200, generator, large=1)
    splatter.load(gaussians)
    for view in VIEWS:
        assert_image(splatter.render(view), gaussians, scene.camera(view), "f64")


def test_random_inputs_reach_every_branch(seed, generator):
    """The comparisons above are worth something only if their inputs come across the cuts."""
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(1025, generator, large=1)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    centres, covariances, opacities = project(gaussians, *scene.camera(INSIDE))
    assert (opacities == 0).sum() > 50, "behind the camera"
    centres, covariances, opacities = project(gaussians, *scene.camera(OUTSIDE))
    half = 3 * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    low, high = centres - half, centres + half
    outside = ((high < 0) | (low > [WIDTH - 1, HEIGHT - 1])).any(axis=1)
    cut = ((low < 0) | (high > [WIDTH - 1, HEIGHT - 1])).any(axis=1) & ~outside
    assert outside.sum() > 10, "empty boxes"
    assert cut.sum() > 10, "boxes cut by the border"
    assert (opacities < 1 / 255).sum() > 10, "never drawn"
    contributions = alphas((centres, covariances, opacities), pixels)
    assert (contributions == 0.999).sum() > 0, "clamped"


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("threads", [1, 3])
def test_image_does_not_depend_on_the_number_of_threads(open_splatter, seed, generator, threads):
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(1025, generator)
    images = []
    for count in (threads, 2):
        splatter = open_splatter(scene, "f32", threads=count, loss="whole_image")
        splatter.load(gaussians)
        images.append(splatter.render(OUTSIDE))
    # The same factors in another order: a rounding of 6e-8 for each of at most 1025.
    np.testing.assert_allclose(1 - images[0], 1 - images[1], rtol=0, atol=1025 * 6e-8)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_schedule_of_the_gpu_gives_the_same_image(open_splatter, seed, generator):
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(513, generator)
    splatter = open_splatter(scene, loss="whole_image", schedule="log")
    splatter.load(gaussians)
    for view in VIEWS:
        assert_image(splatter.render(view), gaussians, scene.camera(view), "f64")


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_one_round_gaussian_by_hand(open_splatter):
    """sigma 2 px at the middle of a view along z: covariance 4 + 0.3, opacity times 4 / 4.3."""
    intrinsics = np.array([[[100.0, 0, 16], [0, 100, 16], [0, 0, 1]]])
    pose = np.eye(4)[None, :3]
    splatter = open_splatter(Scene(np.zeros((1, 33, 33), np.uint8), intrinsics, pose), loss="whole_image")
    splatter.load(Gaussians(np.array([[0.0, 0, 1]]), np.log(np.full((1, 3), 0.02)), np.eye(4)[:1], np.zeros(1)))
    image = splatter.render(0)
    assert image[16, 16] == pytest.approx(0.5 * 4 / 4.3, rel=1e-12)
    assert image[16, 19] == pytest.approx(0.5 * 4 / 4.3 * np.exp(-0.5 * 9 / 4.3), rel=1e-12)
    assert image[16, 22] > 1 / 255 and image[16, 23] == 0.0  # 3 sigma are 6.2 px
    np.testing.assert_allclose(image, image.T, atol=1e-15)
    np.testing.assert_allclose(image, image[::-1], atol=1e-15)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_views_do_not_leave_traces_in_each_other(open_splatter, seed, generator):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT), loss="whole_image")
    splatter.load(random_gaussians(300, generator))
    first = splatter.render(OUTSIDE)
    splatter.render(INSIDE)
    np.testing.assert_array_equal(splatter.render(OUTSIDE), first)
    splatter.load(random_gaussians(0, generator))
    np.testing.assert_array_equal(splatter.render(OUTSIDE), 0.0)


# Selections -----------------------------------------------------------------------------------------------------------


def test_mask_packs_bit_b_of_word_w_as_column_32_w_plus_b(generator):
    edges = generator.random((3, 71)) < 0.5
    words = pack_mask(edges)
    assert words.shape == (3, 3) and words.dtype == np.uint32
    columns = np.arange(96)
    unpacked = (words[:, columns // 32] >> (columns % 32).astype(np.uint32)) & 1
    np.testing.assert_array_equal(unpacked[:, :71], edges)
    assert not unpacked[:, 71:].any()


def assert_words(words, chosen):
    """The masks are those of `chosen` (H, W), and with each stands the number of chosen pixels before its word."""
    np.testing.assert_array_equal(words[:, :, 0], pack_mask(chosen))
    sizes = [row[first : first + 32].sum() for row in chosen for first in range(0, chosen.shape[1], 32)]
    np.testing.assert_array_equal(words[:, :, 1].ravel(), np.concatenate([[0], np.cumsum(sizes)[:-1]]))


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("threads", [1, 3])
def test_pages_hold_what_each_view_alone_would(open_splatter, seed, threads):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene, threads=threads)
    views, seeds = [OUTSIDE, NO_EDGES, OBLIQUE, OUTSIDE, MOSTLY_EDGES], [3, 4, 5, 6, 7]
    counts = splatter.select_pixels(views, seeds).copy()
    together = [selected(splatter, page) for page in range(len(views))]
    assert counts[1] == 0 and len(together[1][0]) == 0
    for page, (view, pixel_seed) in enumerate(zip(views, seeds, strict=True)):
        assert splatter.select_pixels(view, pixel_seed) == counts[page]
        for of_page, alone in zip(together[page], selected(splatter), strict=True):
            np.testing.assert_array_equal(of_page, alone)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_maps_too_large_for_one_array_are_handed_over_by_the_page(open_splatter, seed, monkeypatch):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    selections = []
    for most in (splatter_module.MOST_ELEMENTS, 1):
        monkeypatch.setattr(splatter_module, "MOST_ELEMENTS", most)
        splatter.select_pixels([MOSTLY_EDGES, OUTSIDE], [1, 2])
        selections.append([selected(splatter, page) for page in range(2)])
    for one, other in zip(*selections, strict=True):
        for array, same in zip(one, other, strict=True):
            np.testing.assert_array_equal(array, same)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_loss_and_gradients_are_those_of_the_page(open_splatter, seed, generator):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    gaussians = random_gaussians(300, generator)
    results = []
    for views, page in (([OUTSIDE, OBLIQUE, INSIDE], 1), ([OBLIQUE], 0)):
        splatter.load(gaussians)
        splatter.select_pixels(views, [8] * len(views))
        splatter.record(page)
        results.append((splatter.loss[None], splatter.fields.means.grad.to_numpy()))
    assert results[0][0] == results[1][0]
    np.testing.assert_array_equal(results[0][1], results[1][1])


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_whole_image_weighs_every_pixel_alike(open_splatter, seed):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene, loss="whole_image")
    assert splatter.select_pixels(OBLIQUE, 0) == WIDTH * HEIGHT
    pixels, weights, targets = selected(splatter)
    np.testing.assert_array_equal(pixels[:, 1] * WIDTH + pixels[:, 0], np.arange(WIDTH * HEIGHT))
    np.testing.assert_array_equal(weights, 1 / (WIDTH * HEIGHT))
    np.testing.assert_allclose(targets, scene.edge_maps[OBLIQUE].ravel() / 255, rtol=1e-15)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("view", [OBLIQUE, MOSTLY_EDGES, NO_EDGES])
def test_class_weights_give_edges_and_background_one_half_each(open_splatter, seed, view):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene, loss="class_weighted")
    assert splatter.select_pixels(view, 0) == WIDTH * HEIGHT
    _, weights, _ = selected(splatter)
    edges = scene.edge_maps[view].ravel() >= 128
    for pixels in (edges, ~edges):
        if pixels.any():
            np.testing.assert_allclose(weights[pixels], 0.5 / pixels.sum(), rtol=1e-15)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("view", [OUTSIDE, OBLIQUE, MOSTLY_EDGES])
def test_balanced_selection_has_all_edge_pixels_and_as_many_others(open_splatter, seed, view):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene)
    edges = scene.edge_maps[view] >= 128
    background = min(edges.sum(), (~edges).sum())
    choices = []
    for pixel_seed in (7, 7, 8):
        assert splatter.select_pixels(view, pixel_seed) == edges.sum() + background
        pixels, weights, targets = selected(splatter)
        columns, rows = pixels.T
        assert len(np.unique(pixels, axis=0)) == len(pixels), "no pixel twice"
        assert edges[rows, columns].sum() == edges.sum(), "every edge pixel"
        np.testing.assert_allclose(weights, 1 / len(pixels), rtol=1e-15)
        np.testing.assert_allclose(targets, scene.edge_maps[view][rows, columns] / 255, rtol=1e-15)
        chosen = np.zeros(edges.shape, bool)
        chosen[rows, columns] = True
        assert_words(splatter.selection.words.to_numpy()[0], chosen)
        choices.append(pixels)
    np.testing.assert_array_equal(choices[0], choices[1])
    if background == edges.sum():  # else the whole background is chosen, in another order
        assert (np.sort(choices[0], axis=0) != np.sort(choices[2], axis=0)).any(), "another seed chooses others"


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_background_pixels_are_drawn_alike(open_splatter, seed):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene)
    edges = scene.edge_maps[OUTSIDE] >= 128
    draws = 1000
    hits = np.zeros(edges.shape)
    for pixel_seed in range(draws):
        splatter.select_pixels(OUTSIDE, pixel_seed)
        columns, rows = selected(splatter)[0].T
        hits[rows, columns] += 1
    share = edges.sum() / (~edges).sum()
    deviations = (hits[~edges] - draws * share) / np.sqrt(draws * share * (1 - share))
    # 1700 nearly independent, nearly normal numbers: beyond 5.5 deviations in one run of 10^4; their variance is 1 up
    # to sqrt(2 / 1700) = 0.034, of which 6 are allowed.
    assert np.abs(deviations).max() < 5.5
    assert abs(deviations.var() - 1) < 0.2


def test_a_view_without_edge_pixels_selects_none(open_splatter, seed, generator):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    splatter.load(random_gaussians(20, generator))
    assert splatter.select_pixels(NO_EDGES, 0) == 0
    splatter.record()
    assert splatter.loss[None] == 0.0


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("loss", ["balanced", "class_weighted", "whole_image"])
def test_loss_is_the_twins(open_splatter, seed, generator, loss):
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(100, generator)
    splatter = open_splatter(scene, loss=loss)
    splatter.load(gaussians)
    for view in (*VIEWS, MOSTLY_EDGES):
        splatter.select_pixels(view, 3)
        splatter.record()
        expected = image_loss(gaussians, scene.camera(view), *selected(splatter))
        assert splatter.loss[None] == pytest.approx(expected, abs=1e-11)  # a mean of |C - target|: as exact as C


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_threshold_parts_edges_from_background_at_the_same_level_as_the_views(open_splatter):
    maps = np.arange(256, dtype=np.uint8).reshape(1, 16, 16)
    scene = Scene(maps, np.eye(3)[None], np.eye(4)[None, :3])
    splatter = open_splatter(scene, edge_threshold=0.4)
    splatter.select_pixels(0, 0)
    edges = np.flatnonzero(maps.ravel() >= 0.4 * 255)
    assert splatter.images.edge_counts[0] == len(edges)
    columns, rows = selected(splatter)[0].T
    assert np.isin(edges, rows * 16 + columns).all()


# Weights and flanks ---------------------------------------------------------------------------------------------------


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("share", [0.6, 1.0])
@pytest.mark.parametrize("loss", ["balanced", "whole_image", "class_weighted"])
def test_edge_pixels_weigh_what_the_strongest_edgel_near_says(open_splatter, seed, loss, share):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene, loss=loss, strength_weight=share)
    for view in (*VIEWS, MOSTLY_EDGES):  # INSIDE has no edgel
        splatter.select_pixels(view, 3)
        pixels, weights, targets = selected(splatter)
        edges = targets >= 127.5 / 255
        columns, rows = pixels.T
        expected = edge_weights(scene, view, 128, share)[rows, columns]
        own = splatter.selection.weights.to_numpy()[0, : len(pixels)]
        np.testing.assert_allclose(own, expected, rtol=1e-15)
        if own[edges].max() > 0:  # else none of them has a say
            equal = 0.5 if loss == "class_weighted" else edges.sum() / len(pixels)
            assert weights[edges].sum() == pytest.approx(equal, rel=1e-12), "the balance is kept"


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_weights_are_those_of_the_view_on_every_page(open_splatter, seed, monkeypatch):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene, strength_weight=0.6)
    for most in (splatter_module.MOST_ELEMENTS, 1):
        monkeypatch.setattr(splatter_module, "MOST_ELEMENTS", most)
        splatter.select_pixels([MOSTLY_EDGES, OUTSIDE, OBLIQUE], [1, 2, 3])
        for page, view in enumerate((MOSTLY_EDGES, OUTSIDE, OBLIQUE)):
            columns, rows = selected(splatter, page)[0].T
            own = splatter.selection.weights.to_numpy()[page, : len(columns)]
            np.testing.assert_allclose(own, edge_weights(scene, view, 128, 0.6)[rows, columns], rtol=1e-15)


def drawn_lines(seed):
    """A random scene with maps of some lines instead, and with points of which many are hidden."""
    generator = np.random.default_rng(seed)
    scene = random_scene(seed, WIDTH, HEIGHT)
    maps = np.zeros_like(scene.edge_maps)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for edge_map in maps:
        normal, at = generator.normal(size=2), generator.uniform([10, 10], [WIDTH - 10, HEIGHT - 10])
        across = ((columns - at[0]) * normal[0] + (rows - at[1]) * normal[1]) / np.linalg.norm(normal)
        edge_map[:] = np.rint(255 * np.exp(-0.5 * across**2))
    points = generator.uniform(-0.2, 1.2, (60, 3)).astype(np.float32).astype(np.float64)
    return Scene(maps, scene.intrinsics, scene.world_to_camera, scene.edgels), points


def hidden_pixels(scene, view, points):
    """(H, W) bool: within 5 px of the pixel of a point that has no edge pixel within 2 px; and points near a tie."""
    edges = scene.edge_maps[view] >= 128
    seen = points @ scene.world_to_camera[view, :, :3].T + scene.world_to_camera[view, :, 3]
    pixels = (seen / seen[:, 2:])[:, :2] @ scene.intrinsics[view, :2, :2].T + scene.intrinsics[view, :2, 2]
    hidden, tie = np.zeros_like(edges), (np.abs(pixels - np.floor(pixels) - 0.5) < 1e-3).any(axis=1)
    rows, columns = np.mgrid[: edges.shape[0], : edges.shape[1]]
    for (column, row), depth in zip(np.floor(pixels + 0.5), seen[:, 2], strict=True):
        if depth > 0 and 0 <= column < edges.shape[1] and 0 <= row < edges.shape[0]:
            window = (np.abs(columns - column) <= 2) & (np.abs(rows - row) <= 2)
            if not edges[window].any():
                hidden |= (columns - column) ** 2 + (rows - row) ** 2 <= 25
    return hidden, tie


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("schedule", ["product", "log"])
def test_flanks_are_in_the_mask_but_where_an_established_edge_is_hidden(open_splatter, seed, schedule):
    scene, points = drawn_lines(seed)
    ties = np.any([hidden_pixels(scene, view, points)[1] for view in range(5)], axis=0)
    points = points[~ties]  # single precision may round them to the next pixel
    splatter = open_splatter(scene, flanks=True, schedule=schedule)
    spared = 0
    for known in (points, points[:0]):
        splatter.take_in_flanks(known)
        for view in range(5):
            edges, line = scene.edge_maps[view] >= 128, scene.edge_maps[view] >= 3
            expected = edges | (line & ~hidden_pixels(scene, view, known)[0])
            spared += (line & ~expected).sum()
            assert splatter.select_pixels(view, 1) == expected.sum() + edges.sum()
            pixels, weights, _ = selected(splatter)
            assert len(np.unique(pixels, axis=0)) == len(pixels), "no pixel twice"
            chosen = np.zeros(edges.shape, bool)
            chosen[pixels[:, 1], pixels[:, 0]] = True
            assert chosen[expected].all()
            np.testing.assert_allclose(weights, 1 / len(pixels), rtol=1e-15)
    assert spared > 20, "the scene hides something"


# Gaussians ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_gaussians_grow_beyond_the_capacity_without_a_change(open_splatter, seed, generator):
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene, loss="whole_image", edge_threshold=0.6)  # of its own: the others stay small
    few, many = random_gaussians(10, generator), random_gaussians(5000, generator)
    splatter.load(few)
    splatter.render(OUTSIDE)
    moments = generator.random((2, 5000, 11))
    splatter.load(many, moments)
    assert splatter.fields.capacity == 8192
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(splatter.fields.gaussians(), name), getattr(many, name))
    np.testing.assert_array_equal(splatter.fields.moments(), moments)
    assert_image(splatter.render(OUTSIDE), many, scene.camera(OUTSIDE), "f64")
    splatter.load(few)
    assert_image(splatter.render(OUTSIDE), few, scene.camera(OUTSIDE), "f64")
    np.testing.assert_array_equal(splatter.fields.moments(), np.zeros((2, 10, 11)))


def test_start_gaussians_are_the_supplements(generator):
    points = generator.random((50, 3))
    gaussians = start_gaussians(points, generator, 0.004, 0.08)
    np.testing.assert_array_equal(gaussians.means, points.astype(np.float32))
    np.testing.assert_allclose(gaussians.scales, 0.004, rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, 0.08, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(gaussians.quaternions, axis=1), 1, rtol=1e-6)


def test_direction_is_the_axis_of_the_largest_scale(generator):
    gaussians = random_gaussians(50, generator)
    covariances = rotation_matrices(gaussians.quaternions) * gaussians.scales[:, None] ** 2
    covariances = covariances @ np.swapaxes(rotation_matrices(gaussians.quaternions), 1, 2)
    largest = np.linalg.eigh(covariances)[1][:, :, 2]
    # Eigenvectors turn by rounding / gap of the eigenvalues; among 50 random Gaussians gaps of 1e-6 do not occur.
    np.testing.assert_allclose(np.abs((largest * gaussians.directions()).sum(axis=1)), 1, atol=1e-9)


def test_fast_exp2_is_a_power_of_two_to_single_precision(taichi):

    @ti.kernel
    def evaluate(x: ti.types.ndarray(dtype=ti.f32, ndim=1), y: ti.types.ndarray(dtype=ti.f32, ndim=1)):
        for i in range(x.shape[0]):
            y[i] = fast_exp2(x[i])

    exponents = np.linspace(-115, 115, 1_000_001, dtype=np.float32)
    values = np.empty_like(exponents)
    evaluate(exponents, values)
    # The polynomial's 1e-7 and a rounding for each of its last two steps.
    np.testing.assert_allclose(values, np.exp2(exponents.astype(np.float64)), rtol=1e-7 + 2 * 6e-8)
    values = np.empty(3, np.float32)
    evaluate(np.array([-1e30, -120.0, 1e30], np.float32), values)
    np.testing.assert_allclose(values, [2.0**-120, 2.0**-120, 2.0**120], rtol=3e-7)
