"""Files that people open: splats, oriented points, edges as line sets, overlays on the views, and a window.

The writers take world coordinates as they are: whoever calls them has brought them into the frame of the input.
Only the overlays take the unit cube, because that is the frame of `Views`.
"""

from taichi_edges.exporters.line_sets import write_line_set_obj, write_line_set_ply

EXPORTERS = {".ply": write_line_set_ply, ".obj": write_line_set_obj}  # suffix -> function(path, edges)
