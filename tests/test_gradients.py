"""Gradients through the tape are those of the formula: hand adjoint, Taichi's own, regularisers, Adam."""

from dataclasses import replace

import numpy as np
import pytest
from autodiff_splatting import autodiff_of
from gradient_checks import assert_gradients, gradients, random_neighbors
from reference_splatting import (
    INSIDE,
    NO_EDGES,
    OBLIQUE,
    OUTSIDE,
    PARAMETERS,
    alphas,
    gradient,
    image_loss,
    orient_loss,
    project,
    random_gaussians,
    random_scene,
    selected,
    shape_loss,
    slope,
    transmittance,
)

from taichi_edges.splatting.gaussians import Gaussians

WIDTH, HEIGHT = 50, 40
VIEWS = (OUTSIDE, OBLIQUE, INSIDE)

# Of a group's largest derivative. The twin's derivatives are exact (complex steps), so only rounding is left: 1e-16 in
# f64 and 6e-8 in f32, times up to 1e3 for the determinant of a needle (see test_splatting.py), times 1e3 for
# 1 / (1 - a) at a = 0.999 in f64; in f32 the Gaussians have no such alphas.
TOLERANCE = {"f64": 1e-9, "f32": 2e-4}


# The image loss -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("record", ["hand adjoint", "Taichi's own"])
@pytest.mark.parametrize("large", [0, 2])
@pytest.mark.parametrize("view", VIEWS)
def test_gradients_of_the_image_loss(open_splatter, seed, generator, view, large, record):
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(25, generator, large)
    splatter = open_splatter(scene)
    splatter.load(gaussians)
    splatter.select_pixels(view, 1)
    pixels = selected(splatter)
    splatter.record() if record == "hand adjoint" else autodiff_of(splatter).record()
    expected = gradient(lambda moved: image_loss(moved, scene.camera(view), *pixels), gaussians)
    assert_gradients(gradients(splatter), expected, TOLERANCE["f64"])


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize("record", ["hand adjoint", "Taichi's own"])
def test_gradients_of_the_loss_with_weights_and_flanks(open_splatter, seed, generator, record):
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(25, generator)
    splatter = open_splatter(scene, strength_weight=0.7, flanks=True)
    splatter.take_in_flanks(gaussians.means)
    splatter.load(gaussians)
    for view in (OUTSIDE, OBLIQUE):
        splatter.select_pixels(view, 1)
        pixels = selected(splatter)
        assert len(np.unique(pixels[1])) > 10, "many weights"
        splatter.load(gaussians)
        splatter.record() if record == "hand adjoint" else autodiff_of(splatter).record()
        expected = gradient(lambda moved: image_loss(moved, scene.camera(view), *pixels), gaussians)
        assert_gradients(gradients(splatter), expected, TOLERANCE["f64"])


@pytest.mark.parametrize("view", VIEWS)
def test_hand_adjoint_equals_taichis_own(open_splatter, seed, generator, view):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    gaussians = random_gaussians(600, generator)
    results = []
    for record in (splatter.record, autodiff_of(splatter).record):
        splatter.load(gaussians)
        splatter.select_pixels(view, 2)
        plain = record()
        results.append((transmittance(splatter) if plain is None else plain, gradients(splatter)))
    # A product against a sum of logarithms of some 100 factors: the rounding of 1e-16 for each of them. In the
    # gradients times up to 1e3 for 1 / (1 - a), times up to 1e3 in the projection of needles.
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=1e-12, atol=1e-300)
    assert_gradients(results[0][1], results[1][1], 1e-10)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
@pytest.mark.parametrize(
    "real, count", [("f64", 1), ("f64", 512), ("f64", 513), ("f64", 1025), ("f32", 513), ("f32", 1025)]
)
def test_slope_of_the_image_loss_with_many_gaussians(open_splatter, seed, generator, real, count):
    """A whole group moves at once: one number checks it, at the sizes where another thread comes in.

    The maps are black and white, so that rounding cannot carry C to the other side of the target.
    """
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT, grey=False), random_gaussians(count, generator)
    splatter = open_splatter(scene, real)
    for view in VIEWS:
        splatter.load(gaussians)
        splatter.select_pixels(view, 4)
        splatter.record()
        computed, pixels = gradients(splatter), selected(splatter)
        for name in PARAMETERS:  # along the computed gradient itself, where nothing cancels
            still = {other: np.zeros_like(getattr(gaussians, other)) for other in PARAMETERS}
            along = Gaussians(**{**still, name: getattr(computed, name).astype(np.float64)})
            expected = slope(lambda moved: image_loss(moved, scene.camera(view), *pixels), gaussians, along)
            squared_length = (getattr(along, name) ** 2).sum()
            assert squared_length == pytest.approx(expected, rel=TOLERANCE[real], abs=1e-30), (view, name)


def test_gaussians_that_are_not_drawn_have_gradients_of_zero(open_splatter, seed):
    """Behind the camera, beside the image, too faint, too small: 0, not NaN, which Adam would never get rid of."""
    scene = random_scene(seed, WIDTH, HEIGHT)
    splatter = open_splatter(scene)
    means = np.array([[0.5, -3.0, 1.5], [0.4, -1.0, 0.8], [3.0, 0.5, 0.5], *np.full((3, 3), 0.5)])
    scales, logits = np.full((6, 3), 0.02), np.array([4.0, 4.0, 4.0, -6.0, -80.0, 2.0])
    scales[5] = 1e-5
    splatter.load(Gaussians(means, np.log(scales), np.tile([0.3, 0.1, -0.5, 0.2], (6, 1)), logits))
    splatter.select_pixels(OUTSIDE, 0)
    splatter.record()
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(gradients(splatter), name), 0.0)
    assert transmittance(splatter).min() == 1.0


def test_gradients_add_up_until_adam_has_used_them(open_splatter, seed, generator):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    gaussians = random_gaussians(600, generator)
    splatter.neighbors.load(random_neighbors(600, generator))

    def record(view):
        splatter.select_pixels(view, 5)
        splatter.record(0, 0.5, 0.25)
        return splatter.loss[None]

    parts, losses = [], []
    for view in (OUTSIDE, INSIDE):
        splatter.load(gaussians)
        losses.append(record(view))
        parts.append(gradients(splatter))
    splatter.load(gaussians)
    # The loss itself does not add up: it is the recorded view's. A sum of 600 pixels in any order: 600 roundings.
    assert [record(OUTSIDE), record(INSIDE)] == pytest.approx(losses, rel=1e-13)
    total = Gaussians(*(getattr(parts[0], name) + getattr(parts[1], name) for name in PARAMETERS))
    assert_gradients(gradients(splatter), total, 1e-14)
    splatter.update(1, 0.0, 0.0, 0.0, 0.0)
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(gradients(splatter), name), 0.0)
        np.testing.assert_array_equal(getattr(splatter.fields.gaussians(), name), getattr(gaussians, name))


def test_positional_gradients_add_up_absolute_pulls(open_splatter, seed, generator):
    """AbsGS: pixel by pixel |dL / du| and |dL / dv|, so that pulls to opposite sides do not cancel."""
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(40, generator)
    splatter = open_splatter(scene)
    splatter.load(gaussians)
    expected = np.zeros(40)
    for view in VIEWS:
        splatter.select_pixels(view, 6)
        splatter.record()
        pixels, weights, _ = selected(splatter)
        splats = project(gaussians, *scene.camera(view))
        a = alphas(splats, pixels)
        offsets = pixels - splats[0][:, None]
        slopes = np.einsum("npi,nij->npj", offsets, np.linalg.inv(splats[1])) * a[:, :, None]  # da / d(u, v)
        pulls = np.abs(slopes) * (weights * np.prod(1 - a, axis=0) / (1 - a))[:, :, None]
        expected += np.sqrt((pulls.sum(axis=1) ** 2).sum(axis=1))
    accumulated = splatter.fields.positional_gradients.to_numpy()[:40]
    np.testing.assert_allclose(accumulated, expected, rtol=1e-9, atol=1e-9 * expected.max())
    splatter.load(gaussians)
    np.testing.assert_array_equal(splatter.fields.positional_gradients.to_numpy(), 0.0)


# Regularisers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.0, 1.0), (0.3, 0.7)])
@pytest.mark.parametrize("count", [5, 40])
def test_gradients_of_the_regularizers(open_splatter, seed, generator, count, weights):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    gaussians, neighbors = random_gaussians(count, generator), random_neighbors(count, generator)
    splatter.load(gaussians)
    splatter.neighbors.load(neighbors)
    splatter.select_pixels(NO_EDGES, 0)  # no pixels: the regularisers alone
    splatter.record(0, *weights)

    def loss(moved):
        return weights[0] * orient_loss(moved, neighbors) + weights[1] * shape_loss(moved)

    # Taichi divides by sqrt(length^2 + 1e-12) against coinciding points; neighbours here are about 0.1 apart, but of
    # 40 random points some are 0.01: relative 1e-12 / 0.01^2 / 2.
    assert splatter.loss[None] == pytest.approx(loss(gaussians), rel=1e-8)
    assert_gradients(gradients(splatter), gradient(loss, gaussians), 1e-7)


@pytest.mark.slow(reason="has a slow twin")
def test_regularizers_and_image_loss_add_up(open_splatter, seed, generator):
    """Eq. 6, f32, in the sizes of a real run."""
    scene, gaussians = random_scene(seed, WIDTH, HEIGHT), random_gaussians(600, generator)
    splatter = open_splatter(scene, "f32")
    neighbors = random_neighbors(600, generator)
    parts = []
    for view, weights in ((OUTSIDE, (0.0, 0.0)), (NO_EDGES, (0.3, 0.7)), (OUTSIDE, (0.3, 0.7))):
        splatter.load(gaussians)
        splatter.neighbors.load(neighbors)
        splatter.select_pixels(view, 9)
        splatter.record(0, *weights)
        parts.append((splatter.loss[None], gradients(splatter)))
    assert parts[0][0] + parts[1][0] == pytest.approx(parts[2][0], rel=1e-5)
    total = Gaussians(*(getattr(parts[0][1], name) + getattr(parts[1][1], name) for name in PARAMETERS))
    assert_gradients(parts[2][1], total, 1e-5)


@pytest.mark.slow(reason="has a slow twin")
def test_orientation_pulls_neighbours_as_much_as_it_pulls_the_gaussian(open_splatter, seed, generator):
    """L_orient does not change when all points move together, so the gradients of the means sum to zero."""
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    splatter.load(random_gaussians(600, generator))
    splatter.neighbors.load(random_neighbors(600, generator))
    splatter.select_pixels(NO_EDGES, 0)
    for _ in range(2):  # what the neighbours were given is used up, and does not come twice
        splatter.record(0, 1.0, 0.0)
        means = gradients(splatter).means
        assert np.abs(means.sum(axis=0)).max() < 1e-13 * np.abs(means).sum()


def test_orientation_of_coinciding_gaussians_is_finite(open_splatter, seed, generator):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    gaussians = random_gaussians(6, generator)
    splatter.load(replace(gaussians, means=np.tile(gaussians.means[:1], (6, 1)), log_scales=np.zeros((6, 3))))
    splatter.neighbors.load(random_neighbors(6, generator))
    splatter.select_pixels(NO_EDGES, 0)
    splatter.record(0, 1.0, 1.0)
    assert splatter.loss[None] == pytest.approx(2.0)  # no alignment, and all scales are alike
    for name in PARAMETERS:
        assert np.isfinite(getattr(gradients(splatter), name)).all(), name


# Adam -----------------------------------------------------------------------------------------------------------------


def test_adam_is_adam(open_splatter, seed, generator):
    """Kingma and Ba 2015, algorithm 1, with a rate for each group; a rate of 0 holds a group, its moments go on."""
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT))
    gaussians = random_gaussians(30, generator)
    splatter.load(gaussians)
    expected = {name: getattr(gaussians, name).copy() for name in PARAMETERS}
    first = {name: np.zeros_like(values) for name, values in expected.items()}
    second = {name: np.zeros_like(values) for name, values in expected.items()}
    for step in range(1, 7):
        rates = dict(zip(PARAMETERS, (1e-3, 2e-4, 1e-3, 3e-2) if step > 2 else (1e-3, 0.0, 0.0, 0.0), strict=True))
        for name in PARAMETERS:
            g = generator.normal(size=expected[name].shape) * 1e-4
            field = getattr(splatter.fields, name).grad
            field.from_numpy(np.concatenate([g, np.zeros((splatter.fields.capacity - 30, *g.shape[1:]))]))
            first[name] = 0.9 * first[name] + 0.1 * g
            second[name] = 0.999 * second[name] + 0.001 * g**2
            corrected = first[name] / (1 - 0.9**step), second[name] / (1 - 0.999**step)
            expected[name] -= rates[name] * corrected[0] / (np.sqrt(corrected[1]) + 1e-15)
        splatter.update(step, *rates.values())
    for name in PARAMETERS:
        np.testing.assert_allclose(getattr(splatter.fields.gaussians(), name), expected[name], rtol=1e-12, atol=1e-14)
    for moments, twin in zip(splatter.fields.moments(), (first, second), strict=True):
        flat = np.concatenate([twin[name].reshape(30, -1) for name in PARAMETERS], axis=1)
        np.testing.assert_allclose(moments, flat, rtol=1e-12, atol=1e-18)


@pytest.mark.slow(reason="builds the kernels of another Splatter")
def test_two_runs_with_one_seed_are_equal_to_the_last_bit(open_splatter, seed, generator):
    splatter = open_splatter(random_scene(seed, WIDTH, HEIGHT), "f32", threads=2)
    gaussians, neighbors = random_gaussians(1500, generator), random_neighbors(1500, generator)
    seeds = generator.integers(0, 1 << 32, 30)
    runs = []
    for _ in range(2):
        splatter.load(gaussians)
        splatter.neighbors.load(neighbors)
        for step, pixel_seed in enumerate(seeds):
            view = VIEWS[step % 3]
            splatter.select_pixels(view, pixel_seed)
            splatter.record(0, *((0.1, 0.1) if step % 5 == 0 else (0.0, 0.0)))
            splatter.update(step + 1, 1e-3, 2e-4, 1e-3, 3e-2)
        runs.append((splatter.fields.gaussians(), splatter.fields.moments()))
    for name in PARAMETERS:
        assert getattr(runs[0][0], name).tobytes() == getattr(runs[1][0], name).tobytes(), name
        assert np.isfinite(getattr(runs[0][0], name)).all()
        assert (getattr(runs[0][0], name) != getattr(gaussians, name)).mean() > 0.5, "it did train"
    np.testing.assert_array_equal(runs[0][1], runs[1][1])


# The twin itself ------------------------------------------------------------------------------------------------------


def test_complex_steps_agree_with_central_differences(seed, generator):
    """Of Gaussians so large that no pixel is near a cut and of targets that C cannot reach."""
    scene = random_scene(seed, WIDTH, HEIGHT)
    gaussians = random_gaussians(3, generator, large=3)
    means, logits = generator.uniform(0.3, 0.7, (3, 3)), generator.uniform(-1, 1, 3)
    gaussians = replace(gaussians, means=means, opacity_logits=logits)
    pixels = np.stack([generator.integers(0, WIDTH, 100), generator.integers(0, HEIGHT, 100)], axis=1)
    weights = generator.random(100)
    neighbors = np.array([[1, 2], [0, 2], [0, 1]])

    def loss(moved):
        projected = image_loss(moved, scene.camera(OUTSIDE), pixels, weights, np.ones(100))
        return projected + orient_loss(moved, neighbors) + shape_loss(moved)

    exact, step = gradient(loss, gaussians), 1e-5
    for name in PARAMETERS:
        for index in np.ndindex(getattr(gaussians, name).shape):
            sides = []
            for sign in (1, -1):
                values = getattr(gaussians, name).copy()
                values[index] += sign * step
                sides.append(loss(replace(gaussians, **{name: values})))
            # The loss is about 30: rounding 30 * 1e-16 / 1e-5; third derivatives times 1e-10 / 6.
            assert (sides[0] - sides[1]) / (2 * step) == pytest.approx(getattr(exact, name)[index], rel=1e-6, abs=1e-7)
