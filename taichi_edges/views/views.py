"""Views: everything the later stages know about the input. Written by the prepare stage as `views.npz`."""

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taichi_edges.files.artefacts import file_state, replacing
from taichi_edges.views.cameras import NEAR, Camera, Similarity, project
from taichi_edges.views.edgels import Edgels

EDGEL_ARRAYS = ("starts", "points", "normals", "strengths", "blurs", "outlines")  # the fields of Edgels, in order


@dataclass(frozen=True)
class Views:
    """Edge maps with their cameras, all of one image size.

    names:            (V,) names of the views, unique.
    edge_maps:        (V, H, W) uint8, 255 = certainly an edge.
    intrinsics:       (V, 3, 3) float64 pixels, pixel centres at integers.
    world_to_camera:  (V, 3, 4) float64, OpenCV axes, world = the unit cube.
    image_paths:      (V,) path of the colour image of each view, '' where there is none.
    similarity:       input frame -> unit cube.
    box:              (2, 3) the scene box in the unit cube.
    input_to_truth:   (4, 4) input frame -> frame of the ground truth (EMAP's `worldtogt`).
    pixel:            size of a pixel at what is in sight, unit-cube units; None: at the middle of the scene box.
    tolerance_px:     residual at which an edgel's weight has fallen to a quarter: by so much detector and poses err.
    edgels:           Edgels, the sub-pixel points through which the edge maps are drawn; None before they are traced.
    """

    names: tuple[str, ...]
    edge_maps: np.ndarray
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    image_paths: tuple[str, ...]
    similarity: Similarity = field(default_factory=Similarity)
    box: np.ndarray = field(default_factory=lambda: np.array([[0.0, 0, 0], [1, 1, 1]]))
    input_to_truth: np.ndarray = field(default_factory=lambda: np.eye(4))
    edgels: Edgels | None = None
    pixel: float | None = None
    tolerance_px: float = 0.5

    def __post_init__(self) -> None:
        count = len(self.edge_maps)
        assert self.edge_maps.dtype == np.uint8, self.edge_maps.dtype
        assert len(self.names) == len(self.image_paths) == count and len(set(self.names)) == count
        assert self.intrinsics.shape == (count, 3, 3) and self.world_to_camera.shape == (count, 3, 4)
        assert self.edgels is None or self.edgels.view_count == count

    def __len__(self) -> int:
        return len(self.names)

    @property
    def height(self) -> int:
        """Pixels."""
        return self.edge_maps.shape[1]

    @property
    def width(self) -> int:
        """Pixels."""
        return self.edge_maps.shape[2]

    def camera(self, view: int) -> Camera:
        """The Camera of one view."""
        return Camera(self.intrinsics[view], self.world_to_camera[view], self.width, self.height)

    def project(self, points: np.ndarray, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2), NaN behind the camera, and depths (n,) of (n, 3) unit-cube points in one view."""
        return project(points, self.intrinsics[view], self.world_to_camera[view])


def pixel_size(views: Views) -> float:
    """Size of a pixel at the scene, unit-cube units: `Views.pixel`, or else at the middle of the box."""
    if views.pixel is not None:
        return views.pixel
    forward, offset = views.world_to_camera[:, 2, :3], views.world_to_camera[:, 2, 3]
    depths = forward @ views.box.mean(axis=0) + offset
    in_front = np.maximum(depths, NEAR)  # a view that looks away says nothing about the scale
    return float(np.median(in_front / views.intrinsics[:, 0, 0]))


def write_views(path: Path | str, views: Views) -> Path:
    """Write `views.npz` (compressed NumPy archive; the keys are the fields of `Views`)."""
    with replacing(path) as unfinished, open(unfinished, "wb") as file:
        np.savez_compressed(
            file,
            names=np.array(views.names),
            edge_maps=views.edge_maps,
            intrinsics=views.intrinsics,
            world_to_camera=views.world_to_camera,
            image_paths=np.array(views.image_paths),
            similarity_scale=views.similarity.scale,
            similarity_offset=np.array(views.similarity.offset),
            box=views.box,
            input_to_truth=views.input_to_truth,
            pixel=np.nan if views.pixel is None else views.pixel,
            tolerance_px=views.tolerance_px,
            **{f"edgel_{name}": getattr(views.edgels, name) for name in EDGEL_ARRAYS if views.edgels is not None},
        )
    return Path(path)


def read_views(path: Path | str) -> Views:
    """Read `views.npz`. Every stage does: as long as the file stays the same, they share the arrays, read-only."""
    return _views_of(os.fspath(path), file_state(path))


@functools.lru_cache(maxsize=2)  # the views that edges are made from, and those held out
def _views_of(path: str, _state: tuple[int, ...]) -> Views:
    with np.load(path) as archive:
        views = Views(
            names=tuple(str(name) for name in archive["names"]),
            edge_maps=archive["edge_maps"],
            intrinsics=archive["intrinsics"],
            world_to_camera=archive["world_to_camera"],
            image_paths=tuple(str(path) for path in archive["image_paths"]),
            similarity=Similarity(float(archive["similarity_scale"]), tuple(archive["similarity_offset"].tolist())),
            box=archive["box"],
            input_to_truth=archive["input_to_truth"],
            edgels=_edgels_of(archive),
            pixel=None if np.isnan(archive["pixel"]) else float(archive["pixel"]),
            tolerance_px=float(archive["tolerance_px"]),
        )
    arrays = [views.edge_maps, views.intrinsics, views.world_to_camera, views.box, views.input_to_truth]
    arrays += [getattr(views.edgels, name) for name in EDGEL_ARRAYS if views.edgels is not None]
    for array in arrays:
        array.setflags(write=False)
    return views


def _edgels_of(archive: Mapping[str, np.ndarray]) -> Edgels | None:
    if "edgel_starts" not in archive:
        return None
    return Edgels(*(archive[f"edgel_{name}"] for name in EDGEL_ARRAYS))


def choose_views(views: Views, count: int) -> list[int]:
    """Indices, in order, of at most `count` views: the first, then always the one farthest from those chosen.

    Far is by the angle between viewing directions; where all look the same way, by the place in the sequence.
    """
    directions = views.world_to_camera[:, 2, :3]
    order = np.arange(len(views))
    chosen, nearest = [], np.full(len(views), np.inf)
    for _ in range(min(count, len(views))):
        chosen.append(int(np.argmax(nearest)))
        angles = np.arccos(np.clip(directions @ directions[chosen[-1]], -1.0, 1.0))
        # A thousandth of a radian for the sequence decides between equal angles and no others.
        nearest = np.minimum(nearest, angles + 1e-3 * np.abs(order - chosen[-1]) / len(views))
        nearest[chosen] = -1.0
    return sorted(chosen)
