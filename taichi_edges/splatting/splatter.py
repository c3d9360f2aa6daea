"""Splatter: the fields and kernels of one scene, and one view step through the tape."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from taichi_edges.kernels.device import upload
from taichi_edges.splatting.edge_weights import EdgeWeights, weigh_edge_pixels
from taichi_edges.splatting.gaussians import GaussianFields, Gaussians, round_capacity
from taichi_edges.splatting.losses import NeighborFields, make_regularizers
from taichi_edges.splatting.optimizer import BETA1, BETA2, make_adam
from taichi_edges.splatting.projection import CameraFields, SplatFields
from taichi_edges.splatting.selection import WORD, PixelSelection, make_select, pack_mask
from taichi_edges.splatting.splat import make_compare
from taichi_edges.splatting.visibility import mask_with_flanks

if TYPE_CHECKING:
    from taichi_edges.views.edgels import Edgels

LOSSES = ("balanced", "class_weighted", "whole_image")  # eq. 3 first; the other two are the options the paper names
GPU_ARCHS = ("cuda", "vulkan")
MOST_ELEMENTS = 1 << 31  # of an array that a kernel is given: Taichi's indices are 32 bits wide
PAGES = 16  # views whose pixels are selected in one launch
LINE_FOOT = 0.011  # of full scale; from here on a pixel is one of a line: 3 standard deviations of its profile


class EdgeImages:
    """The edge maps as the kernels read them: maps, bit masks of their edge pixels, and what those weigh.

    On a CPU the kernels read the given u8 maps (V, H, W) where they are: a copy would double the largest thing in
    memory. A GPU gets a copy, view by view, four pixels in a u32: (V, H W / 4). Taichi would copy byte by byte.

    mask_words, mask_counts: bit masks (V, H, W / 32) of the pixels that are selected for sure, and their numbers (V,):
    to begin with the edge pixels, edge_words and edge_counts; line_words and line_counts with the flanks of the lines,
    where those are wanted. weights: None, or EdgeWeights on the host; starts (V, H) and values (n,), in a u32 four of
    them, are for the kernels.
    """

    def __init__(
        self,
        edge_maps: np.ndarray,
        threshold: float,
        weigh: Callable[[np.ndarray, int], EdgeWeights] | None = None,
        flanks: bool = False,
        on_gpu: bool = False,
    ) -> None:
        """edge_maps: (V, H, W) uint8. threshold: of full scale; from here on a pixel is an edge pixel.

        weigh: function (edge_maps, level) -> EdgeWeights, or None. flanks: whether they are wanted.
        """
        _, self.height, self.width = edge_maps.shape
        self.level = int(np.ceil(threshold * 255))
        words, self.edge_counts = bright_words(edge_maps, self.level)
        self.maps = _upload_maps(edge_maps) if on_gpu else np.ascontiguousarray(edge_maps)
        self.edge_words = upload(words)
        self.mask_words, self.mask_counts = self.line_words, self.line_counts = self.edge_words, self.edge_counts
        if flanks:
            words, self.line_counts = bright_words(edge_maps, min(int(np.ceil(LINE_FOOT * 255)), self.level))
            self.line_words = upload(words)
        self.weights = weigh(edge_maps, self.level) if weigh else None
        weights = self.weights or EdgeWeights(np.zeros((1, 1), np.int32), np.zeros(1, np.uint8), np.ones(1))
        values = np.pad(weights.values, (0, -len(weights.values) % 4 or 4 * (len(weights.values) == 0)))
        self.starts, self.values = upload(weights.starts), upload(values.view("<u4") if on_gpu else values)


def bright_words(edge_maps: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Bit masks (V, H, W / 32) uint32 of the pixels of (V, H, W) uint8 maps from `level` on, and their numbers (V,)."""
    count, height, width = edge_maps.shape
    words, counts = np.zeros((count, height, -(-width // WORD)), np.uint32), np.zeros(count, np.int64)
    for view, edge_map in enumerate(edge_maps):
        bright = edge_map >= level
        counts[view] = np.count_nonzero(bright)
        words[view] = pack_mask(bright)
    return words, counts


def _upload_maps(edge_maps: np.ndarray) -> ti.Ndarray:
    """(V, H, W) uint8 -> ndarray (V, ceil(H W / 4)) of u32 on the device, the first pixel in the lowest byte."""
    count, pixels = len(edge_maps), edge_maps[0].size
    device = ti.ndarray(ti.u32, shape=(count, -(-pixels // 4)))
    packed = np.zeros(4 * device.shape[1], np.uint8)
    for view in range(count):
        packed[:pixels] = edge_maps[view].ravel()
        put_view(view, packed.view("<u4"), device)
        ti.sync()  # or the copies on their way would pile up
    return device


@ti.kernel
def put_view(
    view: ti.i32, values: ti.types.ndarray(dtype=ti.u32, ndim=1), device: ti.types.ndarray(dtype=ti.u32, ndim=2)
):
    """Row `view` of `device` from the host."""
    for i in range(values.shape[0]):
        device[view, i] = values[i]


class Splatter:
    """All that is needed to render and to optimise edge Gaussians against the edge maps of a scene.

    ti.init must have been called. edge_maps (V, H, W) uint8; intrinsics (V, 3, 3); world_to_camera (V, 3, 4).
    threads: those Taichi was started with. schedule: 'product' for a CPU, 'log' for a GPU. edgels: Edgels or None,
    whose strengths make up the share `strength_weight` of what the edge pixels near them weigh in the loss. flanks:
    whether `take_in_flanks` will be called.
    """

    def __init__(
        self,
        edge_maps: np.ndarray,
        intrinsics: np.ndarray,
        world_to_camera: np.ndarray,
        capacity: int,
        edge_threshold: float = 0.5,
        loss: str = "balanced",
        neighbors: int = 4,
        threads: int = 1,
        schedule: str = "product",
        real: Any = ti.f32,
        edgels: "Edgels | None" = None,
        strength_weight: float = 0.0,
        flanks: bool = False,
    ) -> None:
        assert loss in LOSSES and (loss == "balanced" or not flanks), loss
        self.loss_mode, self.threads, self.schedule, self.real = loss, threads, schedule, real
        weigh = None
        if edgels is not None and strength_weight > 0:
            weigh = partial(weigh_edge_pixels, edgels=edgels, share=strength_weight)
        self.images = EdgeImages(edge_maps, edge_threshold, weigh, flanks, on_gpu=schedule == "log")
        self.projections = np.asarray(intrinsics) @ np.asarray(world_to_camera)
        self.cameras = CameraFields(np.asarray(intrinsics), np.asarray(world_to_camera), real)
        height, width, balanced = self.images.height, self.images.width, loss == "balanced"
        most = int((self.images.edge_counts + self.images.line_counts).max()) if balanced else height * width
        slots = round_capacity(min(most, height * width))
        pages, planes = PAGES if balanced else 1, threads if schedule == "product" else 1
        self.selection = PixelSelection(height, width, slots, pages, planes, real)
        self.loss = ti.ndarray(real, shape=(), needs_grad=True)  # a field would take the tape two launches to reset
        self._select = make_select(self.selection, threads, schedule, self.images.level if weigh else None)
        self._neighbor_count = neighbors
        self._allocate(round_capacity(capacity))

    def _allocate(self, capacity: int) -> None:
        """Fields for `capacity` Gaussians and the kernels over them."""
        self.fields = GaussianFields(capacity, self.real)
        self.splats = SplatFields(capacity, self.real)
        self.neighbors = NeighborFields(capacity, self._neighbor_count, self.real)
        arguments = (self.fields, self.cameras, self.splats, self.selection, self.loss, self.threads, self.schedule)
        self._compare = make_compare(*arguments)
        self._regularize = make_regularizers(self.fields, self.neighbors, self.loss)
        self._adam = make_adam(self.fields)

    def load(self, gaussians: Gaussians, moments: tuple[np.ndarray | None, np.ndarray | None] = (None, None)) -> None:
        """Take over Gaussians (and Adam's moments); the capacity grows when they do not fit."""
        if len(gaussians) > self.fields.capacity:
            self._allocate(round_capacity(len(gaussians)))
        self.fields.load(gaussians, *moments)

    def select_pixels(self, views: np.ndarray | int, seeds: np.ndarray | int) -> np.ndarray:
        """Choose the pixels for the loss in up to `selection.pages` views; view i of them goes to page i.

        views, seeds: (n,) ints, or one of each. Returns how many pixels each has (0: its map has no edge pixel).
        """
        images, selection = self.images, self.selection
        views, seeds = np.atleast_1d(views).astype(np.int32), np.atleast_1d(seeds).astype(np.uint32)
        pixel_count = images.height * images.width
        if self.loss_mode == "balanced":
            masked = images.mask_counts[views]
            backgrounds = np.minimum(images.edge_counts[views], pixel_count - masked)
            selection.counts[: len(views)] = masked + backgrounds
            backgrounds[masked + backgrounds == pixel_count] = -1  # all of them: nothing to draw
        else:
            backgrounds = np.full(len(views), -1)
            selection.counts[: len(views)] = pixel_count
        selection.views[: len(views)] = views
        maps, words, starts = images.maps, images.mask_words, images.starts
        if isinstance(maps, np.ndarray) and maps.size >= MOST_ELEMENTS:
            maps, words = maps[views], words[views]
            starts = starts[views] if images.weights else starts
            views = np.arange(len(views), dtype=np.int32)
        inputs = (maps, words, starts, images.values, selection.words)
        self._select(len(views), views, seeds, backgrounds.astype(np.int32), *inputs)
        return selection.counts[: len(views)]

    def take_in_flanks(self, points: np.ndarray) -> None:
        """From the next selection on, the flanks of the lines are in the mask (see `visibility`).

        points: (n, 3) unit cube, on edges that are known to be there: where one of them is hidden, flanks are not.
        """
        images = self.images
        masks = mask_with_flanks(images.edge_words, images.line_words, images.width, self.projections, points)
        images.mask_words, images.mask_counts = masks

    def weights(self, page: int) -> tuple[float, float]:
        """What the own weights of the edge pixels and of the background pixels of a page are multiplied by in the loss.

        Edge pixels weigh so much on average: the balance of edges and background is that of pixels that weigh alike.
        """
        pixel_count = self.images.height * self.images.width
        view = int(self.selection.views[page])
        edges = int(self.images.edge_counts[view])
        edge_weight = background_weight = 1.0 / max(int(self.selection.counts[page]), 1)
        if self.loss_mode == "class_weighted":
            edge_weight, background_weight = 0.5 / max(edges, 1), 0.5 / max(pixel_count - edges, 1)
        mean = self.images.weights.means[view] if self.images.weights else 1.0
        return float(edge_weight / mean), background_weight

    def draw(self, page: int = 0) -> None:
        """Transmittance at the pixels selected in `page`, and their loss, added to what is there."""
        level = (self.images.level - 0.5) / 255
        self._compare(self.fields.count, page, int(self.selection.views[page]), level, *self.weights(page))

    def record(self, page: int = 0, orient_weight: float = 0.0, shape_weight: float = 0.0) -> None:
        """Loss and gradients of the pixels selected in `page`, through the tape. Gradients ADD to what is there."""
        with ti.ad.Tape(loss=self.loss, clear_gradients=False):
            self.draw(page)
            if orient_weight or shape_weight:
                self._regularize(self.fields.count, orient_weight, shape_weight)

    def update(
        self, step: int, means_rate: float, scales_rate: float, quaternions_rate: float, opacities_rate: float
    ) -> None:
        """One Adam step (`step` counts from 1) with these learning rates; zeroes the gradients."""
        corrections = (1.0 / (1.0 - BETA1**step), 1.0 / (1.0 - BETA2**step))
        self._adam(self.fields.count, *corrections, means_rate, scales_rate, quaternions_rate, opacities_rate)

    def render(self, view: int) -> np.ndarray:
        """(H, W) image C = 1 - T of the Gaussians in one view, every pixel evaluated. Needs a whole-image loss."""
        assert self.loss_mode != "balanced", "only a whole-image selection has every pixel"
        self.select_pixels(view, 0)
        self.draw()
        shape = (self.images.height, self.images.width)
        return 1.0 - self.selection.transmittance.to_numpy()[: shape[0] * shape[1]].reshape(shape)
