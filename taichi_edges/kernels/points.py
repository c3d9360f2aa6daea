"""What kernels over points and views share: argument types, cameras, points and the pixels they fall on."""

import numpy as np
import taichi as ti

WORD = 32  # points in a word that holds one bit of each

F32_1D, F32_2D = ti.types.ndarray(dtype=ti.f32, ndim=1), ti.types.ndarray(dtype=ti.f32, ndim=2)
F32_3D, U8_3D = ti.types.ndarray(dtype=ti.f32, ndim=3), ti.types.ndarray(dtype=ti.u8, ndim=3)
I32_1D, I32_2D = ti.types.ndarray(dtype=ti.i32, ndim=1), ti.types.ndarray(dtype=ti.i32, ndim=2)
I32_3D, U32_2D = ti.types.ndarray(dtype=ti.i32, ndim=3), ti.types.ndarray(dtype=ti.u32, ndim=2)


def blocks_of(points: np.ndarray | ti.Ndarray) -> tuple[int, int]:
    """How kernels divide the n points of an array: (points of a block, number of blocks), their first arguments.

    On a CPU a camera is loaded once for a whole block; on a GPU every point has a thread of its own. An argument, and
    not calculated from the shape in the kernel, because Taichi does not compile such loops for Vulkan.
    """
    size = WORD if ti.lang.impl.current_cfg().arch == ti.cpu else 1
    return size, -(-points.shape[0] // size)


@ti.func
def load_camera(projections: ti.template(), view):
    """One of (b, 3, 4) projections, intrinsics @ world_to_camera."""
    return ti.Matrix([[projections[view, i, j] for j in ti.static(range(4))] for i in ti.static(range(3))])


@ti.func
def load_point(points: ti.template(), i):
    """One of (n, 3) points, homogeneous."""
    return ti.Vector([points[i, 0], points[i, 1], points[i, 2], 1.0])


@ti.func
def nearest_pixel(h):
    """Row and column of the pixel that a point with the projection h = (u w, v w, w) falls on; w is positive."""
    inverse = 1.0 / h[2]
    return ti.cast(ti.floor(h[1] * inverse + 0.5), ti.i32), ti.cast(ti.floor(h[0] * inverse + 0.5), ti.i32)
