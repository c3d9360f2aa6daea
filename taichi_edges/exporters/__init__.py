"""Files that people open: splats, oriented points, edges for CAD programs and as line sets, overlays, and a window.

The writers take world coordinates as they are: whoever calls them has brought them into the frame of the input.
Only the overlays take the unit cube, because that is the frame of `Views`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_edges.exporters.dxf import write_dxf
from taichi_edges.exporters.line_sets import write_line_set_obj, write_line_set_ply
from taichi_edges.exporters.step import write_step

if TYPE_CHECKING:
    from taichi_edges.geometry.wireframe import Wireframe

# suffix -> function(path, wireframe)
EXPORTERS: "dict[str, Callable[[Path | str, Wireframe], Path]]" = {
    ".ply": write_line_set_ply,
    ".obj": write_line_set_obj,
    ".dxf": write_dxf,
    ".step": write_step,
}
