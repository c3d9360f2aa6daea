"""Pinhole cameras. Every coordinate convention of the project is stated here, once.

Camera axes    as in OpenCV: x right, y down, z forward (the viewing direction).
Pixels         centres lie at INTEGER coordinates: pixel (row i, column j) is the point (u, v) = (j, i). A reader whose
               format puts the first centre at (0.5, 0.5) subtracts 0.5 from cx and cy.
World          one similarity brings the scene box into the unit cube for training (see `Similarity`). Everything that
               leaves the project is in the frame of the INPUT. "1 mm" of the metrics is 0.001 of the unit cube.
Quaternions    (w, x, y, z).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

# Near planes, in unit-cube units. `splatting/visibility.py` alone has another: what is in front at all hides nothing.
NEAR = 0.01  # what is nearer counts as behind the camera
TRIED_FROM = 2 * NEAR  # inverse depths that are tried lie evenly: half of them would be nearer than this
DRAWN_FROM = 5 * NEAR  # a nearer Gaussian would fill the image: it is not drawn, and its camera does not vote

AT_ONCE = 4096  # points that are looked up in all views together

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # right-multiplies camera-to-world: flips the y and z camera axes


@dataclass(frozen=True)
class Similarity:
    """x_unit = scale * x_input + offset: from the frame of the input into the unit cube.

    scale: unit-cube units per input unit. offset: (3,) in unit-cube units.
    """

    scale: float = 1.0
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)

    def to_unit(self, points: ArrayLike) -> np.ndarray:
        """(..., 3) points of the input frame -> the unit cube."""
        return np.asarray(points) * self.scale + np.asarray(self.offset)

    def to_input(self, points: ArrayLike) -> np.ndarray:
        """(..., 3) points of the unit cube -> the input frame."""
        return (np.asarray(points) - np.asarray(self.offset)) / self.scale

    @staticmethod
    def of_box(box: ArrayLike) -> "Similarity":
        """The similarity that brings `box`, (2, 3) corners input units, into the unit cube, its longest side to 1."""
        low, high = np.asarray(box, dtype=np.float64)
        scale = 1.0 / float((high - low).max())
        return Similarity(scale, tuple(float(x) for x in -low * scale))


def project(points: np.ndarray, intrinsics: np.ndarray, world_to_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pinhole projection of world points.

    points: (n, 3) world units. intrinsics: (3, 3) pixels. world_to_camera: (3, 4).
    Returns (n, 2) pixels, centres at integers, and (n,) depths in world units.
    Points nearer than NEAR, or behind the camera, get NaN pixels.
    """
    camera_points = points @ world_to_camera[:, :3].T + world_to_camera[:, 3]
    depths = camera_points[:, 2]
    safe = np.where(depths > NEAR, depths, np.nan)
    homogeneous = camera_points @ intrinsics.T
    return homogeneous[:, :2] / safe[:, None], depths


@dataclass(frozen=True)
class Camera:
    """One view. intrinsics: (3, 3) pixels. world_to_camera: (3, 4). width, height: pixels."""

    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    width: int
    height: int

    @property
    def centre(self) -> np.ndarray:
        """(3,) where it stands."""
        return camera_centre(self.world_to_camera)

    @property
    def planes(self) -> np.ndarray:
        """(5, 4): the homogeneous images (u d, v d, d, 1) that are in sight have no negative product with any."""
        return frustum_planes(self.width, self.height)

    def homogeneous(self, points: np.ndarray) -> np.ndarray:
        """(n, 4): u d, v d, d and 1 of (n, 3) points at depth d."""
        seen = (points @ self.world_to_camera[:, :3].T + self.world_to_camera[:, 3]) @ self.intrinsics.T
        return np.column_stack([seen, np.ones(len(points))])

    def project_lines(self, points: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(n, 2) pixels of (n, 3) points, (n, 2) unit images of their directions, and whether they are in sight."""
        seen, moved = self.homogeneous(points), directions @ (self.intrinsics @ self.world_to_camera[:, :3]).T
        inside = (self.planes @ seen.T >= 0).all(axis=0)
        depths = np.where(inside, seen[:, 2], 1.0)[:, None]
        pixels = seen[:, :2] / depths
        along = moved[:, :2] - pixels * moved[:, 2:]
        return pixels, along / np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None], inside

    def slopes(self, points: np.ndarray) -> np.ndarray:
        """(n, 2, 3): px that the projection of each (n, 3) point moves for a unit step along each axis of the world."""
        homogeneous = self.homogeneous(points)
        depths = homogeneous[:, 2, None, None]
        rows = self.intrinsics @ self.world_to_camera[:, :3]
        return (rows[None, :2] - homogeneous[:, :2, None] / depths * rows[2]) / depths


@dataclass(frozen=True)
class Cameras:
    """Those of V views, for points that are each looked at in a view of their own.

    matrices: (V, 3, 4) point -> homogeneous pixel. centres: (V, 3). focal: (V,) px.
    """

    matrices: np.ndarray
    centres: np.ndarray
    focal: np.ndarray

    @staticmethod
    def of(matrices: np.ndarray) -> "Cameras":
        """From (V, 3, 4) matrices intrinsics @ world_to_camera."""
        centres = -np.linalg.solve(matrices[:, :, :3], matrices[:, :, 3:])[:, :, 0]
        return Cameras(matrices, centres, np.sqrt(np.abs(np.linalg.det(matrices[:, :, :3]))))

    def project(self, points: np.ndarray, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2), NaN behind the camera, and depths (n,) of points (n, 3), each in its own view (n,)."""
        matrices = self.matrices[views]
        homogeneous = np.einsum("nij,nj->ni", matrices[:, :, :3], points) + matrices[:, :, 3]
        depths = homogeneous[:, 2]
        return homogeneous[:, :2] / np.where(depths > NEAR, depths, np.nan)[:, None], depths

    def pixel_at(self, points: np.ndarray, width: int, height: int, otherwise: float = np.nan) -> np.ndarray:
        """(n,) size of a pixel at each of (n, 3) points, in their units; `otherwise` where no view has it in its image.

        Depth / focal length, the median over the views that have the point in their image: neither a close-up nor a
        view from afar tells how well all of them together see a place. width, height: of the images, px.
        """
        found = [np.zeros(0)]
        for first in range(0, len(points), AT_ONCE):
            seen = self.matrices[:, :, :3] @ points[first : first + AT_ONCE].T + self.matrices[:, :, 3:]  # (V, 3, n)
            depths = np.where(seen[:, 2] > NEAR, seen[:, 2], np.nan)
            pixels = np.moveaxis(seen[:, :2] / depths[:, None], 1, 2)
            inside = inside_image(pixels.reshape(-1, 2), width, height).reshape(depths.shape)
            sizes = np.sort(np.where(inside, depths / self.focal[:, None], np.inf), axis=0)
            counts = inside.sum(axis=0)
            middle = np.clip([(counts - 1) // 2, counts // 2], 0, len(sizes) - 1)
            medians = np.take_along_axis(sizes, middle, axis=0).mean(axis=0)
            found.append(np.where(counts > 0, medians, otherwise))
        return np.concatenate(found)


def camera_centre(world_to_camera: np.ndarray) -> np.ndarray:
    """(3,) where a camera of (3, 4) world_to_camera stands."""
    return -world_to_camera[:, :3].T @ world_to_camera[:, 3]


def frustum_planes(width: int, height: int, margin: float = 0.5) -> np.ndarray:
    """(5, 4) planes: what an image shows has no negative product (u d, v d, d, 1) with any, d being the depth.

    Near, left, right, top, bottom. margin: pixels beyond the centres of the outermost ones that still count.
    """
    right, below = width - 1 + margin, height - 1 + margin
    return np.array([[0, 0, 1, -NEAR], [1, 0, margin, 0], [-1, 0, right, 0], [0, 1, margin, 0], [0, -1, below, 0]])


def shares_inside(begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(c,) shares between which segments are on the right side of all planes; where low >= high they nowhere are.

    begin, end: (p, c) signed distances of their ends from the planes.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = begin / (begin - end)
    low = np.where((begin < 0) & (end >= 0), crossing, np.where(begin < 0, 1.0, 0.0)).max(axis=0)
    high = np.where((end < 0) & (begin >= 0), crossing, np.where(end < 0, 0.0, 1.0)).min(axis=0)
    return low, high


def inside_image(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """(n,) bool: which of the (n, 2) pixels round to a pixel of the image (NaN does not)."""
    u, v = pixels[:, 0], pixels[:, 1]
    with np.errstate(invalid="ignore"):
        return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def transform(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 3) points through a (4, 4) affine matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def invert_pose(camera_to_world: np.ndarray) -> np.ndarray:
    """(..., 4, 4) or (..., 3, 4) rigid camera-to-world -> (..., 3, 4) world-to-camera (or the other way round)."""
    rotation = np.swapaxes(camera_to_world[..., :3, :3], -1, -2)
    translation = -(rotation @ camera_to_world[..., :3, 3:4])
    return np.concatenate([rotation, translation], axis=-1)
