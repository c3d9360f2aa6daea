"""Projection of 3D Gaussians to 2D splats (EWA)."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from taichi_edges.views.cameras import DRAWN_FROM

if TYPE_CHECKING:
    from taichi_edges.splatting.gaussians import GaussianFields

SCREEN_BLUR = 0.3  # px^2 added to the 2D covariance; its loss of peak is compensated in the opacity
ALPHA_MIN = 1.0 / 255.0  # a smaller contribution is not drawn
ALPHA_MAX = 0.999
BOX_SIGMAS = 3.0  # half size of a splat's box in standard deviations, cut earlier where alpha falls below ALPHA_MIN
LOG2_E = 1.4426950408889634


@ti.func
def fast_exp2(x):
    """2^x in f32, x brought into -120..120: minimax polynomial, off by 1e-7; libm's exp costs twice the splat."""
    bounded = ti.min(ti.max(x, -120.0), 120.0)
    whole = ti.floor(bounded + 0.5)
    f = bounded - whole
    p = 1.32647271e-3 * f + 9.67151264e-3
    p = p * f + 5.55073374e-2
    p = p * f + 2.40222421e-1
    p = p * f + 6.93146978e-1
    p = p * f + 1.0
    return p * ti.bit_cast((ti.cast(whole, ti.i32) + 127) << 23, ti.f32)


@ti.func
def exact_exp2(x):
    """2^x in any precision, and differentiable."""
    return ti.exp(x * (1.0 / LOG2_E))


@ti.func
def rotation(quaternion):
    """(4,) w, x, y, z of any length -> 3x3 rotation matrix."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    two = 2.0 / (quaternion.dot(quaternion) + 1e-20)
    return ti.Matrix(
        [
            [1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
            [two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)],
            [two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)],
        ]
    )


class CameraFields:
    """All cameras of a scene on the device: world_to_camera (3, 4) and (fx, fy, cx, cy). No skew."""

    def __init__(self, intrinsics: np.ndarray, world_to_camera: np.ndarray, real: Any = ti.f32) -> None:
        count = 1 << int(np.ceil(np.log2(max(len(intrinsics), 64))))  # a changed size recompiles the projection
        dtype = np.float64 if real == ti.f64 else np.float32
        self.world_to_camera = ti.Matrix.field(3, 4, real, shape=count)
        self.pinhole = ti.Vector.field(4, real, shape=count)
        poses = np.zeros((count, 3, 4), dtype)
        poses[: len(world_to_camera)] = world_to_camera
        pinholes = np.zeros((count, 4), dtype)
        pinholes[: len(intrinsics)] = intrinsics[:, [0, 1, 0, 1], [0, 1, 2, 2]]
        self.world_to_camera.from_numpy(poses)
        self.pinhole.from_numpy(pinholes)


class SplatFields:
    """2D splats of one view: `splats` holds (u, v, conic a, b, c, opacity), `boxes` (u0, u1, v0, v1), ends exclusive.

    alpha(p) = opacity * exp(-(a du^2 + c dv^2) / 2 - b du dv), d = p - (u, v) in pixels. An empty box is not drawn.
    """

    def __init__(self, capacity: int, real: Any = ti.f32) -> None:
        self.splats = ti.Vector.field(6, real, shape=capacity, needs_grad=True)
        self.boxes = ti.Vector.field(4, ti.i32, shape=capacity)


def make_splat_of(gaussians: "GaussianFields", cameras: CameraFields, exp2: Callable) -> Callable:
    """ti.func splat_of(i, view) -> (splat, blurred variances along u and v, depth) of a Gaussian. exp2: ti.func."""
    means, log_scales = gaussians.means, gaussians.log_scales
    quaternions, opacity_logits = gaussians.quaternions, gaussians.opacity_logits
    poses, pinholes = cameras.world_to_camera, cameras.pinhole

    @ti.func
    def splat_of(i, view):
        pose, pinhole = poses[view], pinholes[view]
        camera_rotation = pose[:, :3]
        point = camera_rotation @ means[i] + pose[:, 3]
        inverse_depth = 1.0 / ti.max(point[2], DRAWN_FROM)
        x, y = point[0] * inverse_depth, point[1] * inverse_depth
        # M = J R_camera R S (2 x 3), the 2D covariance is M M^T. J: Jacobian of the pinhole at the mean.
        right, down, forward = camera_rotation[0, :], camera_rotation[1, :], camera_rotation[2, :]
        to_u = pinhole[0] * inverse_depth * (right - x * forward)
        to_v = pinhole[1] * inverse_depth * (down - y * forward)
        axes = rotation(quaternions[i])
        scales = ti.Vector([exp2(LOG2_E * log_scales[i][j]) for j in ti.static(range(3))])
        row_u = ti.Vector([to_u.dot(axes[:, j]) * scales[j] for j in ti.static(range(3))])
        row_v = ti.Vector([to_v.dot(axes[:, j]) * scales[j] for j in ti.static(range(3))])
        uu, uv, vv = row_u.dot(row_u), row_u.dot(row_v), row_v.dot(row_v)
        blurred_uu, blurred_vv = uu + SCREEN_BLUR, vv + SCREEN_BLUR
        inverse = 1.0 / (blurred_uu * blurred_vv - uv * uv)
        # The blur spreads the splat; its opacity falls so that the integral stays (Mip-Splatting, eq. 9).
        compensation = ti.sqrt(ti.max((uu * vv - uv * uv) * inverse, 1e-8))
        opacity = compensation / (1.0 + exp2(-LOG2_E * opacity_logits[i]))
        u, v = pinhole[0] * x + pinhole[2], pinhole[1] * y + pinhole[3]
        splat = ti.Vector([u, v, blurred_vv * inverse, -uv * inverse, blurred_uu * inverse, opacity])
        return splat, ti.Vector([blurred_uu, blurred_vv]), point[2]

    return splat_of


@ti.func
def box_of(splat, variances, depth, width, height):
    """(u0, u1, v0, v1) of the pixels that a splat may reach, ends exclusive; empty where it is not drawn."""
    reach = ti.sqrt(ti.min(2.0 * ti.log(ti.max(splat[5] / ALPHA_MIN, 1.0)), BOX_SIGMAS * BOX_SIGMAS))
    reach_u, reach_v = reach * ti.sqrt(variances[0]), reach * ti.sqrt(variances[1])
    u0 = ti.max(0, ti.cast(ti.ceil(splat[0] - reach_u), ti.i32))
    u1 = ti.min(width, ti.cast(ti.floor(splat[0] + reach_u), ti.i32) + 1)
    v0 = ti.max(0, ti.cast(ti.ceil(splat[1] - reach_v), ti.i32))
    v1 = ti.min(height, ti.cast(ti.floor(splat[1] + reach_v), ti.i32) + 1)
    if depth < DRAWN_FROM or splat[5] < ALPHA_MIN or u1 <= u0 or v1 <= v0:
        u1, v1 = u0, v0
    return ti.Vector([u0, u1, v0, v1])


def make_project(gaussians: "GaussianFields", cameras: CameraFields, target: SplatFields) -> Any:
    """Kernel project(count, view): GaussianFields -> SplatFields.splats, where the boxes are not empty.

    Its `.grad` is Taichi's own. Of a large scene a view sees a small part; the rest costs nothing on the way back.
    """
    splats, boxes = target.splats, target.boxes
    splat_of = make_splat_of(gaussians, cameras, exact_exp2)

    @ti.kernel
    def project(count: ti.i32, view: ti.i32):
        for i in range(count):
            if boxes[i][1] > boxes[i][0]:
                splat, _, _ = splat_of(i, view)
                splats[i] = splat

    return project
