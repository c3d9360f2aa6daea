"""The schedule of a GPU does what that of a CPU does: on the CPU itself, and on every GPU there is.

Mesa's software driver is a Vulkan device too. Compared with the CPU's own schedule, which other tests prove: in f64, so
that the schedule of a GPU shows only its own roundings.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gradient_checks import assert_gradients, gradients, random_neighbors
from paper_training import paper_training
from reference_splatting import (
    INSIDE,
    MOSTLY_EDGES,
    NO_EDGES,
    OBLIQUE,
    OUTSIDE,
    PARAMETERS,
    Scene,
    alphas,
    project,
    random_gaussians,
    random_scene,
    selected,
    transmittance,
)
from scipy.spatial import cKDTree

from taichi_edges.progress import Progress
from taichi_edges.splatting.gaussians import start_gaussians
from taichi_edges.splatting.training import Training
from taichi_edges.synthetic.parts import PARTS
from taichi_edges.synthetic.visibility import sample_edges

pytestmark = pytest.mark.slow(reason="builds the kernels of every device and schedule")

DEVICES = {"cpu-f64": ("cpu", "f64"), "cpu-f32": ("cpu", "f32"), "vulkan": ("vulkan", "f32"), "cuda": ("cuda", "f32")}
WIDTH, HEIGHT = 50, 40
VIEWS = (OUTSIDE, OBLIQUE, INSIDE)
PIXEL = 0.02  # at the block below, unit-cube units

# Errors of T, and of gradients relative to a group's largest. f64: a product against a sum of logarithms of some 100
# factors, 1e-16 for each, in gradients times up to 1e3 for 1 / (1 - a), times up to 1e3 in the projection of needles.
# f32: 6e-8 times 1e3 as in test_splatting.py, in gradients more for the needles next to the camera inside the cube.
# Where a GPU takes the logarithm near 1 with an error of 5e-7, as Vulkan allows, that is 5e-5 for some 100 factors.
IMAGE = {"f64": 1e-12, "f32": 3e-4}
GRADIENT = {"f64": 1e-10, "f32": 5e-4}


# Inputs ---------------------------------------------------------------------------------------------------------------


def far_from_cuts(gaussians, scene, slack=1e-3):
    """Those of the Gaussians that have no pixel near a cut (1/255, 3 sigma, 0.999).

    The roundings of f32 carry a pixel across a cut now and then (`slack` as SLACK in test_splatting.py), and what it
    has been worth is then missing from the gradient, which is no error.
    """
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    far = np.ones(len(gaussians), bool)
    for view in VIEWS:
        splats = project(gaussians, *scene.camera(view))
        strict, lax = alphas(splats, pixels, -slack), alphas(splats, pixels, slack)
        far &= ((strict > 0) == (lax > 0)).all(axis=1) & (lax < 0.999 - slack).all(axis=1)
    return gaussians.keep(far)


@pytest.fixture(scope="module")
def inputs(seed):
    """What every device gets. The maps are black and white, so that no rounding carries C across the target."""
    generator = np.random.default_rng(seed)
    scene = random_scene(seed, WIDTH, HEIGHT, grey=False)
    gaussians = random_gaussians(600, generator)
    gaussians = replace(gaussians, opacity_logits=np.minimum(gaussians.opacity_logits, 4.0))
    gaussians = far_from_cuts(gaussians, scene)
    assert len(gaussians) > 400
    return SimpleNamespace(
        scene=scene,
        gaussians=gaussians,
        many=random_gaussians(5000, generator),  # more than the capacity to start with
        neighbors=random_neighbors(len(gaussians), generator),
        pulls=[[generator.normal(size=getattr(gaussians, n).shape) * 1e-4 for n in PARAMETERS] for _ in range(6)],
        page_views=generator.permutation(np.repeat(np.arange(5), 4))[:16],
        page_seeds=generator.integers(0, 1 << 32, 16),
        large=large_scene(generator),
    )


def large_scene(generator):
    """Maps of 401 x 403, which fits into no words, with few, many and very many edge pixels."""
    shares = np.array([0.02, 0.2, 0.45])
    maps = generator.integers(0, 256, (3, 401, 403)) * (generator.random((3, 401, 403)) < 2 * shares[:, None, None])
    return Scene(maps.astype(np.uint8), np.repeat(np.eye(3)[None], 3, 0), np.repeat(np.eye(4)[None, :3], 3, 0))


# Measurements ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured(open_splatter, inputs):
    """measured(arch, real, schedule) -> what a device makes of the inputs; measured once."""
    known = {}

    def measured_on(*device):
        if device not in known:
            known[device] = measure(open_splatter, inputs, *device)
        return known[device]

    return measured_on


@pytest.fixture(scope="module", params=DEVICES)
def results(request, measured):
    """(real, what the schedule of a GPU makes of the inputs on a device, what the CPU's own does in f64)."""
    arch, real = DEVICES[request.param]
    return real, measured(arch, real, "log"), measured("cpu", "f64", "product")


def measure(open_splatter, inputs, arch, real, schedule):
    """All measurements on one device, in one program."""
    options = {"arch": arch, "real": real, "schedule": schedule}
    found = SimpleNamespace()
    found.large = pages(open_splatter(inputs.large, **options), [0, 1, 2], [1, 2, 3])
    splatter = open_splatter(inputs.scene, loss="class_weighted", **options)
    found.whole_image = pages(splatter, [OBLIQUE], [0])
    splatter.load(inputs.gaussians)
    found.image = splatter.render(OBLIQUE)
    splatter = open_splatter(inputs.scene, strength_weight=0.7, flanks=True, **options)
    splatter.take_in_flanks(inputs.gaussians.means)
    found.weighted = pages(splatter, inputs.page_views, inputs.page_seeds)
    found.weighted_views = [record(splatter, inputs, view) for view in VIEWS]
    splatter = open_splatter(inputs.scene, **options)
    found.pages = pages(splatter, inputs.page_views, inputs.page_seeds)
    found.views = [record(splatter, inputs, view) for view in VIEWS]
    found.regularizers = [record(splatter, inputs, NO_EDGES, weights) for weights in ((0.3, 0.0), (0.0, 0.7))]
    found.both = record(splatter, inputs, OUTSIDE, (0.3, 0.7))
    found.two_views = two_views(splatter, inputs)
    found.adam = adam(splatter, inputs)
    splatter.load(inputs.gaussians.keep(slice(0)))
    splatter.select_pixels(OUTSIDE, 4)
    splatter.record()
    found.empty = splatter.loss[None], transmittance(splatter)
    splatter.load(inputs.many)
    splatter.select_pixels(OUTSIDE, 4)
    splatter.record()
    found.many = splatter.loss[None], transmittance(splatter)
    return found


def pages(splatter, views, seeds):
    """Of every page the masks with the counts before them, and columns and rows, weights and targets."""
    counts = splatter.select_pixels(views, seeds).copy()
    words = splatter.selection.words.to_numpy()
    found = [(words[page], *selected(splatter, page)) for page in range(len(views))]
    assert [len(page[1]) for page in found] == list(counts)
    return found


def record(splatter, inputs, view, weights=(0.0, 0.0)):
    """A view step on fresh Gaussians, without Adam."""
    splatter.load(inputs.gaussians)
    splatter.neighbors.load(inputs.neighbors)
    splatter.select_pixels([NO_EDGES, view], [3, 4])
    splatter.record(1, *weights)
    return SimpleNamespace(
        loss=splatter.loss[None],
        transmittance=transmittance(splatter, 1),
        gradients=gradients(splatter),
        positional=splatter.fields.positional_gradients.to_numpy()[: len(inputs.gaussians)],
    )


def two_views(splatter, inputs):
    """Gradients and positional gradients after two view steps, and the gradients after Adam with rates of 0."""
    splatter.load(inputs.gaussians)
    splatter.neighbors.load(inputs.neighbors)
    for view in (OUTSIDE, OBLIQUE):
        splatter.select_pixels(view, 4)
        splatter.record(0, 0.3, 0.7)
    both = gradients(splatter)
    positional = splatter.fields.positional_gradients.to_numpy()[: len(inputs.gaussians)]
    splatter.update(1, 0.0, 0.0, 0.0, 0.0)
    return SimpleNamespace(gradients=both, positional=positional, used=gradients(splatter))


def adam(splatter, inputs):
    """Gaussians and moments after six steps of Adam with given gradients."""
    splatter.load(inputs.gaussians)
    fields = splatter.fields
    for step, pulls in enumerate(inputs.pulls, start=1):
        for name, pull in zip(PARAMETERS, pulls, strict=True):
            gradient = getattr(fields, name).grad
            whole = np.zeros_like(gradient.to_numpy())
            whole[: len(pull)] = pull
            gradient.from_numpy(whole)
        splatter.update(step, 1e-3, 2e-4 if step > 2 else 0.0, 1e-3, 3e-2)
    return fields.gaussians(), fields.moments()


# Selections -----------------------------------------------------------------------------------------------------------


def assert_pages(actual, expected):
    """The same pixels in the same slots; targets and weights to single precision."""
    assert len(actual) == len(expected)
    for page, of_cpu in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(page[0], of_cpu[0])
        np.testing.assert_array_equal(page[1], of_cpu[1])
        np.testing.assert_allclose(page[2], of_cpu[2], rtol=2 * 6e-8)
        np.testing.assert_allclose(page[3], of_cpu[3], rtol=2 * 6e-8)


def test_selections_of_all_pages_are_the_cpus(results, inputs):
    assert {NO_EDGES, MOSTLY_EDGES} <= set(inputs.page_views)
    _, actual, expected = results
    assert_pages(actual.pages, expected.pages)


def test_selections_with_weights_and_flanks_are_the_cpus(results):
    _, actual, expected = results
    assert_pages(actual.weighted, expected.weighted)


def test_selections_of_large_images_are_the_cpus(results):
    """So many words, draws and pixels that one thread for a page would be cut short by Mesa's software driver."""
    _, actual, expected = results
    assert_pages(actual.large, expected.large)


def test_selections_of_whole_images_are_the_cpus(results):
    _, actual, expected = results
    assert_pages(actual.whole_image, expected.whole_image)


# Images and gradients -------------------------------------------------------------------------------------------------


def test_images_are_the_cpus(results):
    real, actual, expected = results
    for view, of_cpu in zip(actual.views, expected.views, strict=True):
        np.testing.assert_allclose(view.transmittance, of_cpu.transmittance, rtol=0, atol=IMAGE[real])
        assert view.loss == pytest.approx(of_cpu.loss, abs=IMAGE[real])  # a mean of |C - target|: as exact as C
    np.testing.assert_allclose(actual.image, expected.image, rtol=0, atol=IMAGE[real])


def test_gradients_are_the_cpus(results):
    real, actual, expected = results
    for view, of_cpu in zip(actual.views, expected.views, strict=True):
        assert_gradients(view.gradients, of_cpu.gradients, GRADIENT[real])
        scale = of_cpu.positional.max()
        np.testing.assert_allclose(view.positional, of_cpu.positional, rtol=0, atol=GRADIENT[real] * scale)


def test_gradients_with_weights_and_flanks_are_the_cpus(results):
    real, actual, expected = results
    for view, of_cpu in zip(actual.weighted_views, expected.weighted_views, strict=True):
        assert view.loss == pytest.approx(of_cpu.loss, abs=IMAGE[real])
        assert_gradients(view.gradients, of_cpu.gradients, GRADIENT[real])


def test_regularizers_are_the_cpus(results):
    """Sums of 600 and some numbers that cancel little: 600 roundings of 6e-8 in f32."""
    real, actual, expected = results
    tolerance = {"f64": 1e-13, "f32": 4e-5}[real]
    for of_device, of_cpu in zip(actual.regularizers, expected.regularizers, strict=True):
        assert of_device.loss == pytest.approx(of_cpu.loss, rel=tolerance)
        assert_gradients(of_device.gradients, of_cpu.gradients, tolerance)


def test_image_loss_and_regularizers_add_up_as_on_the_cpu(results):
    real, actual, expected = results
    assert actual.both.loss == pytest.approx(expected.both.loss, abs=IMAGE[real])
    assert_gradients(actual.both.gradients, expected.both.gradients, GRADIENT[real])


def test_gradients_add_up_until_adam_has_used_them(results):
    real, actual, expected = results
    assert_gradients(actual.two_views.gradients, expected.two_views.gradients, GRADIENT[real])
    atol = GRADIENT[real] * expected.two_views.positional.max()
    np.testing.assert_allclose(actual.two_views.positional, expected.two_views.positional, rtol=0, atol=atol)
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(actual.two_views.used, name), 0.0)


def test_adam_is_the_cpus(results):
    """Six steps: each rounds a parameter of up to 9 once and makes a step of up to 0.03 from a dozen operations."""
    real, actual, expected = results
    epsilon = {"f64": 1.2e-16, "f32": 6e-8}[real]
    gaussians, moments = actual.adam
    for name in PARAMETERS:
        atol = 6 * (9 + 12 * 0.03) * epsilon
        np.testing.assert_allclose(getattr(gaussians, name), getattr(expected.adam[0], name), rtol=0, atol=atol)
    for of_device, of_cpu in zip(moments, expected.adam[1], strict=True):
        np.testing.assert_allclose(of_device, of_cpu, rtol=0, atol=50 * epsilon * np.abs(of_cpu).max())


def test_no_gaussians_leave_the_image_black(results):
    real, actual, expected = results
    np.testing.assert_array_equal(actual.empty[1], 1.0)
    assert actual.empty[0] == pytest.approx(expected.empty[0], abs=IMAGE[real])


def test_gaussians_grow_beyond_the_capacity(results):
    """Not chosen to be far from cuts: a pixel carried across one is off by 1/255 of its T, and few have two."""
    real, actual, expected = results
    difference = np.abs(actual.many[1] - expected.many[1])
    assert (difference < IMAGE[real]).mean() > (0.97 if real == "f32" else 0.9999)
    assert difference.max() < IMAGE[real] + (4 / 255 if real == "f32" else 0)
    assert actual.many[0] == pytest.approx(expected.many[0], abs=2 * IMAGE[real])


# Training -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(start_taichi, clean_block, seed):
    """trained(arch, schedule) -> Gaussians, losses of the view steps and log records of a short run in f32."""
    views, _ = clean_block(12, 96)
    edges = sample_edges(PARTS["block"](), 0.002).points
    generator = np.random.default_rng(seed)
    on = edges[generator.choice(len(edges), 500, replace=False)] + generator.normal(size=(500, 3)) * PIXEL / 2
    start = start_gaussians(np.concatenate([on, generator.random((200, 3))]), generator, 0.01, 0.08)
    density = {"duplicate_at": [], "cull_support_at": [0.5], "cull_opacity_at": [0.8]}
    config = paper_training(
        epochs=0, steps=60, only_means=0.2, regularize_from=0.6, regularize_every=4, density=density, settled=0.0
    )
    known = {}

    def trained_on(arch, schedule):
        if (arch, schedule) not in known:
            start_taichi("f32", 2, arch)
            # The arch of a Training says no more than which schedule it takes.
            arch_of_schedule = {"log": "vulkan", "product": "cpu"}[schedule]
            training = Training(views, config, np.random.default_rng(5), threads=2, arch=arch_of_schedule)
            known[arch, schedule] = (start, *training.run(start, Progress()))
            kept.append(training)
        return known[arch, schedule]

    return trained_on


kept = []  # ndarrays that are freed after a second ti.init damage the new program: these are freed at the end


@pytest.mark.parametrize("arch", ["cpu", "vulkan", "cuda"])
def test_training_ends_with_the_gaussians_of_the_cpu(trained, arch):
    """Culls by support and by opacity, positions alone, all parameters, regularisers.

    Roundings grow: where a gradient is next to nothing, Adam makes a whole step of its sign. So do those of another
    number of threads on the CPU, with which all but a few Gaussians of a hundred end within a thousandth of a pixel.
    """
    _, actual, records = trained(arch, "log")
    start, expected, of_cpu = trained("cpu", "product")
    assert len(expected) < len(start) - 50, "culled"
    assert (records[-1].step, of_cpu[-1].step) == (60, 60)
    # A Gaussian culled or not by a rounding: one of a hundred may be so near a threshold.
    assert abs(len(actual) - len(expected)) <= 0.01 * len(expected)
    for record_of_device, record_of_cpu in zip(records, of_cpu, strict=True):
        # The loss is a mean over more than 100 pixels, which one Gaussian more or less changes in a few.
        assert record_of_device.loss == pytest.approx(record_of_cpu.loss, rel=0.005)
    distances, nearest = cKDTree(expected.means).query(actual.means)
    assert np.quantile(distances, 0.9) < PIXEL / 100
    close = distances < PIXEL / 100
    of_cpu = expected.keep(nearest)
    assert np.quantile(np.abs(actual.opacities - of_cpu.opacities)[close], 0.99) < 0.01
    assert np.quantile(np.abs(actual.log_scales - of_cpu.log_scales)[close], 0.99) < 0.01
    assert np.quantile(np.abs((actual.directions() * of_cpu.directions()).sum(axis=1))[close], 0.01) > 0.99
