"""Splatter: the fields and kernels of one scene, and one view step through the tape."""

import numpy as np
import taichi as ti

from taichi_edges.splatting.gaussians import GaussianFields, round_capacity
from taichi_edges.splatting.losses import NeighborFields, make_image_loss, make_regularizers
from taichi_edges.splatting.optimizer import BETA1, BETA2, make_adam
from taichi_edges.splatting.projection import CameraFields, SplatFields, make_project
from taichi_edges.splatting.selection import PixelSelection, make_select, pack_mask
from taichi_edges.splatting.splat import make_splat

LOSSES = ("balanced", "class_weighted", "whole_image")  # eq. 3 first; the other two are the options the paper names
GPU_ARCHS = ("cuda", "vulkan")


class EdgeImages:
    """The edge maps on the device: u8 maps, bit masks and lists of their edge pixels."""

    def __init__(self, edge_maps, threshold):
        """edge_maps: (V, H, W) uint8. threshold: of full scale; from here on a pixel is an edge pixel."""
        count, self.height, self.width = edge_maps.shape
        self.level = int(np.ceil(threshold * 255))
        edges = edge_maps >= self.level
        self.edge_counts = edges.reshape(count, -1).sum(axis=1).astype(np.int64)
        self.starts = np.concatenate([[0], np.cumsum(self.edge_counts)])
        pixels = np.concatenate([np.flatnonzero(edge) for edge in edges.reshape(count, -1)])
        self.maps = _to_device(edge_maps, ti.u8)
        self.words = _to_device(pack_mask(edges), ti.u32)
        self.pixels = _to_device(pixels if len(pixels) else np.zeros(1), ti.i32)


def _to_device(array, dtype):
    device = ti.ndarray(dtype, shape=array.shape)
    numpy_types = {ti.u8: np.uint8, ti.u32: np.uint32, ti.i32: np.int32}
    device.from_numpy(np.ascontiguousarray(array, dtype=numpy_types[dtype]))
    return device


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
        self.images = EdgeImages(edge_maps, edge_threshold)
        self.cameras = CameraFields(np.asarray(intrinsics), np.asarray(world_to_camera), real)
        height, width = self.images.height, self.images.width
        balanced = 2 * int(self.images.edge_counts.max())
        slots = round_capacity(min(balanced, height * width) if loss == "balanced" else height * width)
        planes = threads if schedule == "product" else 1
        self.selection = PixelSelection(height, width, slots, planes, real)
        self.loss = ti.field(real, shape=(), needs_grad=True)
        self._select_balanced, self._select_all = make_select(self.selection, schedule)
        self._image_loss = make_image_loss(self.selection, self.loss)
        self._neighbor_count = neighbors
        self._allocate(round_capacity(capacity))

    def _allocate(self, capacity):
        """Fields for `capacity` Gaussians and the kernels over them."""
        self.fields = GaussianFields(capacity, self.real)
        self.splats = SplatFields(capacity, self.real)
        self.neighbors = NeighborFields(capacity, self._neighbor_count, self.real)
        self._project = make_project(self.fields, self.cameras, self.splats)
        self._splat = make_splat(self.fields, self.splats, self.selection, self.threads, self.schedule)
        self._copy_neighbors, self._regularize = make_regularizers(self.fields, self.neighbors, self.loss)
        self._adam = make_adam(self.fields)

    def load(self, gaussians, moments=(None, None)):
        """Take over Gaussians (and Adam's moments); the capacity grows when they do not fit."""
        if len(gaussians) > self.fields.capacity:
            self._allocate(round_capacity(len(gaussians)))
        self.fields.load(gaussians, *moments)

    def select_pixels(self, view, seed):
        """Choose the view's pixels for the loss. Returns how many there are (0: the map has no edge pixel)."""
        images, selection = self.images, self.selection
        pixel_count = images.height * images.width
        edges = int(images.edge_counts[view])
        background = min(edges, pixel_count - edges)
        if self.loss_mode == "balanced":
            selection.count = edges + background
            arguments = (images.maps, images.words, images.pixels, selection.mask, selection.planes)
            place = (int(images.starts[view]), edges, background, int(seed))
            # Also for no pixels: it empties the mask, or the adjoint would visit the pixels of the view before.
            self._select_balanced(view, *arguments, *place, 1.0 / max(selection.count, 1))
            return selection.count
        weights = (1.0 / pixel_count, 1.0 / pixel_count)
        if self.loss_mode == "class_weighted":
            weights = (0.5 / max(edges, 1), 0.5 / max(pixel_count - edges, 1))
        selection.count = pixel_count
        self._select_all(view, images.maps, selection.mask, selection.planes, images.level, *weights)
        return selection.count

    def record(self, view, orient_weight=0.0, shape_weight=0.0):
        """Loss and gradients of the selected pixels, through the tape. Gradients ADD to what is there."""
        count, images = self.fields.count, self.images
        with ti.ad.Tape(loss=self.loss, clear_gradients=False):
            self._project(count, view, images.width, images.height)
            self._splat(count)
            self._image_loss(self.selection.count)
            if orient_weight or shape_weight:
                self._copy_neighbors(count)
                self._regularize(count, orient_weight, shape_weight)

    def update(self, step, means_rate, scales_rate, quaternions_rate, opacities_rate):
        """One Adam step (`step` counts from 1) with these learning rates; zeroes the gradients."""
        corrections = (1.0 / (1.0 - BETA1**step), 1.0 / (1.0 - BETA2**step))
        self._adam(self.fields.count, *corrections, means_rate, scales_rate, quaternions_rate, opacities_rate)

    def render(self, view):
        """(H, W) image C = 1 - T of the Gaussians in one view, every pixel evaluated. Needs a whole-image loss."""
        assert self.loss_mode != "balanced", "only a whole-image selection has every pixel"
        self.select_pixels(view, 0)
        self._project(self.fields.count, view, self.images.width, self.images.height)
        self._splat(self.fields.count)
        shape = (self.images.height, self.images.width)
        return 1.0 - self.selection.transmittance.to_numpy()[: self.selection.count].reshape(shape)
