"""The parts themselves. `PARTS[name]()` makes one."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from taichi_edges.synthetic.hard_parts import HARD_PARTS
from taichi_edges.synthetic.profiles import (
    Path,
    Point,
    Profile,
    circle,
    corner_arc,
    curve,
    join,
    line,
    polygon,
    rectangle,
    slot,
)
from taichi_edges.synthetic.solids import Part, assemble, extrude, revolve
from taichi_edges.synthetic.surfaces import Surface, cap, pierced, wall

__all__ = ["PARTS", "Part", "extrude", "revolve"]


def block() -> Part:
    """A plain box: 12 lines."""
    return extrude("block", Profile(rectangle((0, 0), (0.9, 0.7))), 0.5)


def bracket() -> Part:
    """An angle with a rounded bend and a round hole in each leg: 16 lines, 8 arcs and circles."""
    thick, width, long, tall = 0.13, 0.55, 0.9, 0.7
    outline = polygon(
        [(0, 0), (long, 0), (long, thick), (thick, thick), (thick, tall), (0, tall)],
        [0.2, 0.0, 0.0, 0.07, 0.0, 0.0],
    )
    profile = Profile(outline)
    surfaces = [cap(profile, 0.0, upward=False), cap(profile, width, upward=True)]
    bores = [((0.62, 0.0), (0.62, thick)), ((0.0, 0.47), (thick, 0.47))]
    for near, far in bores:
        surfaces += bored(outline, near, far, width, radius=0.12)
    surfaces.append(wall(outline, 0.0, width, skip=[side_at(outline, point) for bore in bores for point in bore]))
    lying = [(1, 0, 0), (0, 0, 1), (0, -1, 0)]  # swept sideways: the long leg lies on the ground
    return assemble("bracket", [surface.placed(lying) for surface in surfaces])


def side_at(path: Path, point: Point) -> int:
    """Index of the straight segment of a path that passes through `point`."""
    for index, segment in enumerate(path.segments):
        start, end = segment.flat[0], segment.flat[-1]
        detour = np.linalg.norm(point - start) + np.linalg.norm(point - end) - np.linalg.norm(end - start)
        if segment.straight and detour < 1e-9:
            return index
    raise ValueError(f"no straight side passes through {point}")


def bored(path: Path, near: Point, far: Point, width: float, radius: float) -> list[Surface]:
    """Two parallel flat sides of an extruded path and the round hole from one to the other, at half the width.

    near, far: (2,) points in which the hole's axis meets the two sides.
    """
    surfaces = []
    for point in (near, far):
        index = side_at(path, np.asarray(point))
        start, end = path.segments[index].points
        along = (end - start) / np.linalg.norm(end - start)
        hole = circle(((point - start) @ along, width / 2.0), radius)
        face, frame = pierced(path, index, 0.0, width, [hole])
        surfaces.append(face)
    depth = float(np.linalg.norm(np.subtract(near, far)))
    return surfaces + [wall(hole.reversed(), -depth, 0.0).placed(*frame)]


def wave() -> Part:
    """A block whose back is one free-form cubic: 10 lines, 2 curves."""
    back = curve([(0.9, 0.35), (0.6, 0.95), (0.35, 0.05), (0.0, 0.55)])
    return extrude("wave", Profile(join([line((0, 0), (0.9, 0)), back])), 0.35)


def knob() -> Part:
    """A turned knob with a free-form grip: 5 circles, and wide smooth surfaces that have contours but no edges."""
    grip = curve([(0.24, 0.14), (0.10, 0.34), (0.16, 0.52), (0.38, 0.56)])
    points = [(0, 0), (0.42, 0), (0.42, 0.14), (0.24, 0.14)]
    top = curve([(0.38, 0.62), (0.30, 0.72), (0.15, 0.74), (0.0, 0.74)])
    lines = [line(one, other) for one, other in pairwise(points)]
    return revolve("knob", Path((*lines, grip, line((0.38, 0.56), (0.38, 0.62)), top)))


def demo() -> Part:
    """A cam plate: free-form side, fillets, a chamfered hub, a slot, a hole, a leaf-shaped rib: 35 edges."""
    foot, rib_top, hub_top = 0.14, 0.24, 0.36
    outline = demo_outline()
    hub, bore, chamfer, middle = 0.165, 0.085, 0.03, (0.29, 0.33)
    rib = Path(
        (
            curve([(0.52, 0.46), (0.60, 0.62), (0.76, 0.40), (0.90, 0.50)]),
            curve([(0.90, 0.50), (0.80, 0.28), (0.62, 0.36), (0.52, 0.46)]),
        )
    ).reversed()
    through = [slot((0.58, 0.17), (0.78, 0.17), 0.055), circle((0.09, 0.62), 0.045)]
    floor = Profile(outline, (*through, circle(middle, bore)))
    step = Profile(outline, (*through, circle(middle, hub), rib))
    hub_side, bore_side = circle(middle, hub), circle(middle, bore).reversed()
    surfaces = [cap(floor, 0.0, upward=False), cap(step, foot, upward=True), cap(Profile(rib), rib_top, upward=True)]
    surfaces += [wall(path, 0.0, foot) for path in Profile(outline, tuple(through)).paths]
    surfaces += [wall(Profile(rib).outer, foot, rib_top), wall(bore_side, 0.0, hub_top)]
    surfaces.append(wall(hub_side, foot, hub_top - chamfer))
    surfaces.append(wall(hub_side, hub_top - chamfer, hub_top, top_path=circle(middle, hub - chamfer)))
    surfaces.append(cap(Profile(circle(middle, hub - chamfer), (circle(middle, bore),)), hub_top, upward=True))
    return assemble("demo", surfaces)


def demo_outline() -> Path:
    """The outline of the demo's plate: two fillets, two sharp corners, one free-form side."""
    left, right = (0.0, 0.0), (1.0, 0.0)
    high_right, high_left = (1.0, 0.55), (0.0, 0.72)
    side = curve([high_right, (0.72, 0.86), (0.50, 0.48), high_left])
    return join(
        [
            corner_arc(high_left, left, right, 0.14),
            corner_arc(left, right, high_right, 0.10),
            side,
        ]
    )


PARTS: dict[str, Callable[[], Part]] = {
    "block": block,
    "bracket": bracket,
    "wave": wave,
    "knob": knob,
    "demo": demo,
    **HARD_PARTS,
}
