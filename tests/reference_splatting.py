"""The slow twin of the splatting kernels in float64 NumPy, to be checked against the paper by eye.

n Gaussians, p pixels. Everything also takes complex parameters: the decisions (which pixel is drawn, which scale is the
largest, on which side of the target a pixel is) look at real parts only, so that the imaginary part of a result, after
a tiny imaginary step of one parameter, is its exact derivative with those decisions held. Ordinary differences would
jump wherever the step carries a pixel over a cut.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from taichi_edges.splatting.gaussians import Gaussians
from taichi_edges.synthetic.rendering import look_at
from taichi_edges.views.edgels import Edgels

PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits")


def rotations(quaternions):
    """(n, 4) w, x, y, z -> (n, 3, 3): R = (w^2 - v.v) 1 + 2 v v^T + 2 w [v]x of the normalised quaternion."""
    unit = quaternions / np.sqrt((quaternions**2).sum(axis=1, keepdims=True))
    w, v = unit[:, 0, None, None], unit[:, 1:]
    cross = np.cross(np.eye(3)[None], v[:, None])  # (n, 3, 3): cross @ a = v x a
    return (w**2 - (v**2).sum(axis=1)[:, None, None]) * np.eye(3) + 2 * v[:, :, None] * v[:, None] + 2 * w * cross


def project(gaussians, intrinsics, world_to_camera):
    """Splats in one view: centres (n, 2) px, blurred covariances (n, 2, 2) px^2, opacities (n,), 0 near or behind."""
    camera_rotation = world_to_camera[:, :3]
    x, y, z = (gaussians.means @ camera_rotation.T + world_to_camera[:, 3]).T
    in_front = z.real >= 0.05
    z = np.where(in_front, z, 1.0)
    fx, fy, cx, cy = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    zero = np.zeros_like(z)
    jacobians = np.moveaxis(np.array([[fx / z, zero, -fx * x / z**2], [zero, fy / z, -fy * y / z**2]]), 2, 0)
    factors = jacobians @ camera_rotation @ rotations(gaussians.quaternions) * np.exp(gaussians.log_scales)[:, None]
    sharp = factors @ np.swapaxes(factors, 1, 2)  # J R_camera Sigma R_camera^T J^T
    blurred = sharp + 0.3 * np.eye(2)
    shrunk = np.linalg.det(sharp) / np.linalg.det(blurred)
    compensation = np.sqrt(np.where(shrunk.real > 1e-8, shrunk, 1e-8))
    opacities = np.where(in_front, compensation / (1 + np.exp(-gaussians.opacity_logits)), 0.0)
    return np.stack([fx * x / z + cx, fy * y / z + cy], axis=1), blurred, opacities


def alphas(splats, pixels, slack=0.0):
    """(n, p) contributions a_i(p), 0 where not drawn. pixels: (p, 2) columns and rows.

    Drawn: at least 1/255, inside the box of 3 standard deviations. slack: relative for the first, in px for the second.
    """
    centres, covariances, opacities = splats
    d = pixels - centres[:, None]
    alpha = opacities[:, None] * np.exp(-0.5 * np.einsum("npi,nij,npj->np", d, np.linalg.inv(covariances), d))
    half_sizes = 3 * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).real) + slack
    drawn = (alpha.real >= (1 - slack) / 255) & (np.abs(d.real) <= half_sizes[:, None]).all(axis=2)
    return np.where(drawn, np.where(alpha.real < 0.999, alpha, 0.999), 0.0)


def render(gaussians, camera, width, height, slack=0.0):
    """(height, width) image C = 1 - prod_i (1 - a_i). camera: intrinsics (3, 3) and world_to_camera (3, 4)."""
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    return 1 - np.prod(1 - alphas(project(gaussians, *camera), pixels, slack), axis=0).reshape(height, width)


def absolute(values):
    """|values|, of which the side is chosen by the real part."""
    return np.where(values.real < 0, -values, values)


def image_loss(gaussians, camera, pixels, weights, targets):
    """L_proj (eq. 3) over given pixels (p, 2): the weighted sum of |C - target|."""
    transmittance = np.prod(1 - alphas(project(gaussians, *camera), pixels), axis=0)
    return (weights * absolute(1 - transmittance - targets)).sum()


def orient_loss(gaussians, neighbors):
    """L_orient (text of 3.2): 1 - mean |d_i . (mu_i - mu_j)| / |mu_i - mu_j| over the neighbours j (n, k) of all i."""
    largest = gaussians.log_scales.real.argmax(axis=1)
    directions = rotations(gaussians.quaternions)[np.arange(len(largest)), :, largest]
    offsets = gaussians.means[:, None] - gaussians.means[neighbors]
    lengths = np.sqrt((offsets**2).sum(axis=2))
    return 1 - (absolute((directions[:, None] * offsets).sum(axis=2)) / lengths).mean()


def shape_loss(gaussians):
    """L_shape (eq. 5): the mean ratio of the second largest to the largest scale."""
    order = np.argsort(gaussians.log_scales.real, axis=1)
    scales = np.take_along_axis(np.exp(gaussians.log_scales), order, axis=1)
    return (scales[:, 1] / scales[:, 2]).mean()


def gradient(loss, gaussians):
    """Gaussians whose arrays are the derivatives of loss(gaussians), one complex step for each parameter."""
    derivatives = {}
    for name in PARAMETERS:
        values = getattr(gaussians, name)
        derivatives[name] = np.zeros(values.shape)
        for index in np.ndindex(values.shape):
            moved = values.astype(complex)
            moved[index] += 1e-30j
            derivatives[name][index] = loss(replace(gaussians, **{name: moved})).imag / 1e-30
    return Gaussians(**derivatives)


def slope(loss, gaussians, directions):
    """Derivative of loss(gaussians) when all parameters move at once along `directions` (Gaussians)."""
    moved = {name: getattr(gaussians, name) + 1e-30j * getattr(directions, name) for name in PARAMETERS}
    return loss(Gaussians(**moved)).imag / 1e-30


# Inputs ---------------------------------------------------------------------------------------------------------------

OUTSIDE, OBLIQUE, INSIDE, NO_EDGES, MOSTLY_EDGES = range(5)  # the views of a random scene


@dataclass(frozen=True, eq=False)
class Scene:
    """Edge maps (V, H, W) uint8 with their cameras, intrinsics (V, 3, 3) and world_to_camera (V, 3, 4), and Edgels."""

    edge_maps: np.ndarray
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    edgels: Edgels | None = None

    def camera(self, view):
        """Intrinsics and pose of a view."""
        return self.intrinsics[view], self.world_to_camera[view]


@cache
def random_scene(seed, width=50, height=40, grey=True):
    """Five views of the unit cube with random maps in all grey levels, or in black and white.

    The cube is larger than the images, so boxes are cut on all sides; one camera stands inside the cube, so Gaussians
    lie behind it and on its near plane. fx != fy, and the principal point is off the middle.
    """
    generator = np.random.default_rng(seed)
    edge_maps = generator.integers(0, 128, (5, height, width)).astype(np.uint8)
    for view, share in {OUTSIDE: 0.15, OBLIQUE: 0.1, INSIDE: 0.2, MOSTLY_EDGES: 0.7}.items():
        edges = generator.random((height, width)) < share
        edge_maps[view][edges] = generator.integers(128, 256, edges.sum())
    if not grey:
        edge_maps = np.where(edge_maps < 128, 0, 255).astype(np.uint8)
    intrinsics = np.array([[1.9 * width, 0, 0.45 * width], [0, 2.1 * width, 0.55 * height], [0, 0, 1]])
    centres = np.array([[0.4, -1.0, 0.8], [2.0, 1.5, 1.9], [0.5, 0.45, 0.55], [-1.0, 0.3, 0.2], [0.6, 2.0, -0.4]])
    poses = np.stack([look_at(centre, generator.uniform(0.4, 0.6, 3)) for centre in centres])
    edgels = Edgels.of_views(random_edgels(count, width, height, generator) for count in (30, 60, 0, 20, 90))
    return Scene(edge_maps, np.repeat(intrinsics[None], 5, axis=0), poses, edgels)


def random_edgels(count, width, height, generator):
    """Points (n, 2), some outside the image and some together in a pixel, normals (n, 2) and strengths (n,)."""
    points = generator.uniform([-3, -3], [width + 2, height + 2], (count, 2))
    points[: count // 4] = points[count // 4 : 2 * (count // 4)]
    return points, np.tile([1.0, 0.0], (count, 1)), generator.random(count)


def edge_weights(scene, view, level, share):
    """(H, W) weights of the pixels of a view in their class: 1 - share + share * strength, 1 of the background.

    The strength of an edge pixel is that of the strongest edgel within 2 px in columns and in rows, 0 without one; in
    steps of 1/255, as the weight is.
    """
    edge_map = scene.edge_maps[view]
    points, _, strengths = scene.edgels.of_view(view)
    weights = np.ones(edge_map.shape)
    for row, column in np.argwhere(edge_map >= level):
        inside = ((np.rint(points) >= 0) & (np.rint(points) <= np.array(edge_map.shape)[::-1] - 1)).all(axis=1)
        near = inside & (np.abs(np.rint(points) - [column, row]).max(axis=1, initial=0) <= 2)
        strength = float(np.rint(255 * strengths[near]).max(initial=0))
        weights[row, column] = np.rint(255 * (1 - share) + share * strength) / 255
    return weights


def random_gaussians(count, generator, large=0):
    """Gaussians of all shapes and opacities: needles, discs, balls, some too faint to be drawn.

    Standard deviations from 0.005 to at most 0.08 in the cube, 0.3 to 6 px in images of 50 x 40 seen from outside; the
    more Gaussians, the smaller, so that the images are not white. The first `large` fill the images and are clamped to
    0.999 in their middle. In float64, but exact in float32.
    """
    low, high = np.log(0.005), np.log(min(0.08, 0.6 / np.sqrt(max(count, 1))))
    arrays = (
        generator.random((count, 3)),
        generator.uniform(low, high, (count, 3)),
        generator.normal(size=(count, 4)) * generator.uniform(0.5, 2, (count, 1)),
        generator.uniform(-6.5, 9.0, count),
    )
    arrays[0][:large] = 0.4 + 0.2 * arrays[0][:large]
    arrays[1][:large] += np.log(0.6) - low  # 40 px: the blur takes less than 0.0002 off the opacity of 0.9998
    arrays[3][:large] = 8.5
    return Gaussians(*(array.astype(np.float32).astype(np.float64) for array in arrays))


# What a Splatter has chosen ------------------------------------------------------------------------------------------


def selected(splatter, page=0):
    """Columns and rows (p, 2), weights and targets (p,) of the pixels selected in a page, in the order of the slots."""
    selection, count = splatter.selection, int(splatter.selection.counts[page])
    chosen = unpacked(selection.words.to_numpy()[page, :, :, 0])
    rows, columns = np.nonzero(chosen)
    np.testing.assert_array_equal(selection.columns.to_numpy()[page, :count], columns)
    targets = selection.targets.to_numpy()[page, :count]
    images = splatter.images
    maps = images.maps
    if not isinstance(maps, np.ndarray):  # four pixels in a word
        pixels = maps.to_numpy().astype("<u4").view(np.uint8)[:, : images.height * images.width]
        maps = pixels.reshape(-1, images.height, images.width)
    edges = maps[selection.views[page], rows, columns] >= images.level
    weights = selection.weights.to_numpy()[page, :count].astype(np.float64)
    return np.stack([columns, rows], axis=1), weights * np.where(edges, *splatter.weights(page)), targets


def unpacked(masks):
    """(H, words) uint32 -> (H, 32 words) bool, bit b of word w at column 32 w + b."""
    return np.unpackbits(np.ascontiguousarray(masks, "<u4").view(np.uint8), axis=1, bitorder="little").astype(bool)


def transmittance(splatter, page=0):
    """(p,) T at the selected pixels of the page that was drawn last."""
    return splatter.selection.transmittance.to_numpy()[: splatter.selection.counts[page]]
