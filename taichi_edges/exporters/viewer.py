"""A window that shows the oriented points and the edges."""

import contextlib
import io
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.exporters.line_sets import build_line_set

if TYPE_CHECKING:
    from open3d.visualization import Visualizer

    from taichi_edges.geometry.wireframe import Wireframe

POINT_COLOUR = (0.55, 0.55, 0.55)
DIRECTION_COLOUR = (0.78, 0.78, 0.78)  # pale, so that the edges stand out
DIRECTION_LENGTH = 0.01  # of the diagonal of the points' box
VIEW_FROM = (0.6, -0.8, 0.5)  # obliquely from above, for scenes whose z points up
VIEW_ZOOM = 1.0  # Open3D's own 0.7 cuts off the corners of a cube seen obliquely


def build_geometries(points: np.ndarray, directions: np.ndarray, wireframe: "Wireframe") -> list:
    """What the window shows: a PointCloud, a LineSet of short segments along the directions, a LineSet of the edges.

    points: (n, 3) world units. directions: (n, 3) unit vectors. wireframe: Wireframe in the same frame.
    Empty geometries are left out, because Open3D warns about each.
    """
    import open3d as o3d

    points, directions = np.asarray(points, np.float64), np.asarray(directions, np.float64)
    geometries = []
    if len(points):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.paint_uniform_color(POINT_COLOUR)
        reach = 0.5 * DIRECTION_LENGTH * np.linalg.norm(np.ptp(points, axis=0)) * directions
        ends = np.stack([points - reach, points + reach], axis=1).reshape(-1, 3)
        pairs = np.arange(len(ends), dtype=np.int32).reshape(-1, 2)
        ticks = o3d.geometry.LineSet(o3d.utility.Vector3dVector(ends), o3d.utility.Vector2iVector(pairs))
        ticks.paint_uniform_color(DIRECTION_COLOUR)
        geometries += [cloud, ticks]
    if len(wireframe):
        geometries.append(build_line_set(wireframe))
    return geometries


def has_display() -> bool:
    """Whether a window can be opened, as far as that can be told without trying: only Linux tells by a variable."""
    return not sys.platform.startswith("linux") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def show(
    points: np.ndarray, directions: np.ndarray, wireframe: "Wireframe", written_files: Iterable[Path | str]
) -> None:
    """Open a window and return when it is closed.

    points, directions, wireframe: as in `build_geometries`. written_files: what to open instead where there is no
    display.
    """
    instead = f"open {', '.join(str(name) for name in written_files)} instead"
    if not has_display():
        raise UserError(f"viewer: no display (neither DISPLAY nor WAYLAND_DISPLAY is set); {instead}")
    geometries = build_geometries(points, directions, wireframe)
    if not geometries:
        raise UserError("viewer: there are neither points nor edges to show; run the stages before it")
    window = _open_window(instead)
    for geometry in geometries:
        window.add_geometry(geometry)
    window.get_render_option().point_size = 2.0
    control = window.get_view_control()
    control.set_front(VIEW_FROM)
    control.set_up((0.0, 0.0, 1.0))
    control.set_zoom(VIEW_ZOOM)
    window.run()
    window.destroy_window()


def _open_window(instead: str) -> "Visualizer":
    """What draw_geometries opens; but where that only warns, or draws offscreen for ever, this raises.

    Open3D from 0.20 on turns to offscreen EGL where a display is named but cannot be reached, and says so only in
    its log, which it prints through Python.
    """
    import open3d as o3d

    window = o3d.visualization.Visualizer()
    log = io.StringIO()
    with contextlib.redirect_stdout(log):
        opened = window.create_window("taichi_edges")
    if opened and "offscreen" not in log.getvalue().lower():
        return window
    if opened:
        window.destroy_window()
    raise UserError(f"viewer: the display cannot be reached or has no OpenGL; {instead}")
