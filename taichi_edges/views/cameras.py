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

NEAR = 0.01  # unit-cube units: nearer than this counts as behind the camera

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # right-multiplies camera-to-world: flips the y and z camera axes


@dataclass(frozen=True)
class Similarity:
    """x_unit = scale * x_input + offset: from the frame of the input into the unit cube.

    scale: unit-cube units per input unit. offset: (3,) in unit-cube units.
    """

    scale: float = 1.0
    offset: tuple = (0.0, 0.0, 0.0)

    def to_unit(self, points):
        """(..., 3) points of the input frame -> the unit cube."""
        return np.asarray(points) * self.scale + np.asarray(self.offset)

    def to_input(self, points):
        """(..., 3) points of the unit cube -> the input frame."""
        return (np.asarray(points) - np.asarray(self.offset)) / self.scale

    @staticmethod
    def of_box(box):
        """The similarity that brings `box`, (2, 3) corners input units, into the unit cube, its longest side to 1."""
        box = np.asarray(box, dtype=np.float64)
        scale = 1.0 / float((box[1] - box[0]).max())
        return Similarity(scale, tuple(float(x) for x in -box[0] * scale))


def project(points, intrinsics, world_to_camera):
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


def inside_image(pixels, width, height):
    """(n,) bool: which of the (n, 2) pixels round to a pixel of the image (NaN does not)."""
    u, v = pixels[:, 0], pixels[:, 1]
    with np.errstate(invalid="ignore"):
        return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def transform(matrix, points):
    """(n, 3) points through a (4, 4) affine matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def invert_pose(camera_to_world):
    """(..., 4, 4) or (..., 3, 4) rigid camera-to-world -> (..., 3, 4) world-to-camera (or the other way round)."""
    rotation = np.swapaxes(camera_to_world[..., :3, :3], -1, -2)
    translation = -(rotation @ camera_to_world[..., :3, 3:4])
    return np.concatenate([rotation, translation], axis=-1)
