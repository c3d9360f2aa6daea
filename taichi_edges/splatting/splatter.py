"""Splatter: the fields and kernels of one scene, and one view step through the tape."""

import numpy as np
import taichi as ti

from taichi_edges.splatting.gaussians import GaussianFields, round_capacity
from taichi_edges.splatting.losses import NeighborFields, make_regularizers
from taichi_edges.splatting.optimizer import BETA1, BETA2, make_adam
from taichi_edges.splatting.projection import CameraFields, SplatFields
from taichi_edges.splatting.selection import WORD, PixelSelection, make_select, pack_mask
from taichi_edges.splatting.splat import make_compare

LOSSES = ("balanced", "class_weighted", "whole_image")  # eq. 3 first; the other two are the options the paper names
GPU_ARCHS = ("cuda", "vulkan")
MOST_ELEMENTS = 1 << 31  # of an array that a kernel is given: Taichi's indices are 32 bits wide
PAGES = 16  # views whose pixels are selected in one launch


class EdgeImages:
    """The edge maps as the kernels read them: maps and bit masks of their edge pixels.

    On a CPU the kernels read the given u8 maps (V, H, W) where they are: a copy would double the largest thing in
    memory. A GPU gets a copy, view by view, four pixels in a u32: (V, H W / 4). Taichi would copy byte by byte.
    """

    def __init__(self, edge_maps, threshold, on_gpu=False):
        """edge_maps: (V, H, W) uint8. threshold: of full scale; from here on a pixel is an edge pixel."""
        count, self.height, self.width = edge_maps.shape
        self.level = int(np.ceil(threshold * 255))
        self.edge_counts = np.zeros(count, np.int64)
        words = np.zeros((count, self.height, -(-self.width // WORD)), np.uint32)
        for view, edge_map in enumerate(edge_maps):
            edges = edge_map >= self.level
            self.edge_counts[view] = np.count_nonzero(edges)
            words[view] = pack_mask(edges)
        self.maps = _upload_maps(edge_maps) if on_gpu else np.ascontiguousarray(edge_maps)
        self.words = words
        if on_gpu:
            self.words = ti.ndarray(ti.u32, shape=words.shape)
            self.words.from_numpy(words)


def _upload_maps(edge_maps):
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
    threads: those Taichi was started with. schedule: 'product' for a CPU, 'log' for a GPU.
    """

    def __init__(
        self,
        edge_maps,
        intrinsics,
        world_to_camera,
        capacity,
        edge_threshold=0.5,
        loss="balanced",
        neighbors=4,
        threads=1,
        schedule="product",
        real=ti.f32,
    ):
        assert loss in LOSSES, loss
        self.loss_mode, self.threads, self.schedule, self.real = loss, threads, schedule, real
        self.images = EdgeImages(edge_maps, edge_threshold, on_gpu=schedule == "log")
        self.cameras = CameraFields(np.asarray(intrinsics), np.asarray(world_to_camera), real)
        height, width = self.images.height, self.images.width
        balanced = loss == "balanced"
        most = min(2 * int(self.images.edge_counts.max()), height * width) if balanced else height * width
        slots = round_capacity(most)
        pages, planes = PAGES if balanced else 1, threads if schedule == "product" else 1
        self.selection = PixelSelection(height, width, slots, pages, planes, real)
        self.loss = ti.ndarray(real, shape=(), needs_grad=True)  # a field would take the tape two launches to reset
        self._select = make_select(self.selection, threads, schedule)
        self._neighbor_count = neighbors
        self._allocate(round_capacity(capacity))

    def _allocate(self, capacity):
        """Fields for `capacity` Gaussians and the kernels over them."""
        self.fields = GaussianFields(capacity, self.real)
        self.splats = SplatFields(capacity, self.real)
        self.neighbors = NeighborFields(capacity, self._neighbor_count, self.real)
        arguments = (self.fields, self.cameras, self.splats, self.selection, self.loss, self.threads, self.schedule)
        self._compare = make_compare(*arguments)
        self._regularize = make_regularizers(self.fields, self.neighbors, self.loss)
        self._adam = make_adam(self.fields)

    def load(self, gaussians, moments=(None, None)):
        """Take over Gaussians (and Adam's moments); the capacity grows when they do not fit."""
        if len(gaussians) > self.fields.capacity:
            self._allocate(round_capacity(len(gaussians)))
        self.fields.load(gaussians, *moments)

    def select_pixels(self, views, seeds):
        """Choose the pixels for the loss in up to `selection.pages` views; view i of them goes to page i.

        views, seeds: (n,) ints, or one of each. Returns how many pixels each has (0: its map has no edge pixel).
        """
        images, selection = self.images, self.selection
        views, seeds = np.atleast_1d(views).astype(np.int32), np.atleast_1d(seeds).astype(np.uint32)
        pixel_count = images.height * images.width
        edges = images.edge_counts[views]
        if self.loss_mode == "balanced":
            backgrounds = np.minimum(edges, pixel_count - edges)
            selection.counts[: len(views)] = edges + backgrounds
            backgrounds[edges + backgrounds == pixel_count] = -1  # all of them: nothing to draw
        else:
            backgrounds = np.full(len(views), -1)
            selection.counts[: len(views)] = pixel_count
        selection.views[: len(views)] = views
        maps, words = images.maps, images.words
        if isinstance(maps, np.ndarray) and maps.size >= MOST_ELEMENTS:
            maps, words, views = maps[views], words[views], np.arange(len(views), dtype=np.int32)
        self._select(len(views), views, seeds, backgrounds.astype(np.int32), maps, words, selection.words)
        return selection.counts[: len(views)]

    def weights(self, page):
        """Weights of an edge pixel and of a background pixel of a page in the loss."""
        pixel_count = self.images.height * self.images.width
        edges = int(self.images.edge_counts[self.selection.views[page]])
        if self.loss_mode == "class_weighted":
            return 0.5 / max(edges, 1), 0.5 / max(pixel_count - edges, 1)
        return (1.0 / max(int(self.selection.counts[page]), 1),) * 2

    def draw(self, page=0):
        """Transmittance at the pixels selected in `page`, and their loss, added to what is there."""
        level = (self.images.level - 0.5) / 255
        self._compare(self.fields.count, page, int(self.selection.views[page]), level, *self.weights(page))

    def record(self, page=0, orient_weight=0.0, shape_weight=0.0):
        """Loss and gradients of the pixels selected in `page`, through the tape. Gradients ADD to what is there."""
        with ti.ad.Tape(loss=self.loss, clear_gradients=False):
            self.draw(page)
            if orient_weight or shape_weight:
                self._regularize(self.fields.count, orient_weight, shape_weight)

    def update(self, step, means_rate, scales_rate, quaternions_rate, opacities_rate):
        """One Adam step (`step` counts from 1) with these learning rates; zeroes the gradients."""
        corrections = (1.0 / (1.0 - BETA1**step), 1.0 / (1.0 - BETA2**step))
        self._adam(self.fields.count, *corrections, means_rate, scales_rate, quaternions_rate, opacities_rate)

    def render(self, view):
        """(H, W) image C = 1 - T of the Gaussians in one view, every pixel evaluated. Needs a whole-image loss."""
        assert self.loss_mode != "balanced", "only a whole-image selection has every pixel"
        self.select_pixels(view, 0)
        self.draw()
        shape = (self.images.height, self.images.width)
        return 1.0 - self.selection.transmittance.to_numpy()[: shape[0] * shape[1]].reshape(shape)
