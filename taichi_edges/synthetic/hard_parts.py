"""Parts that break simple methods: thin bars, narrow steps, many edges, tangent contacts, contours beside few edges.

They are drawn in the units of `profiles`, one unit long. In a view of the default size, 400 pixels, such a part is
195 pixels long: a pixel spans 0.00461 of the unit cube (217 pixels a unit), which is PIXEL of the drawing.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from taichi_edges.synthetic.free_form import blade, nut, pipe
from taichi_edges.synthetic.profiles import Path, Points, Profile, circle, line, polygon, rectangle
from taichi_edges.synthetic.solids import Part, assemble, extrude, revolve
from taichi_edges.synthetic.surfaces import cap, revolved, wall

PIXEL = 0.00512  # drawn units


def frame() -> Part:
    """A space frame of square bars, 4.5 pixels wide: 72 lines, of which 24 are as short as the bars are wide."""
    size, bar = np.array([1.0, 0.72, 0.5]), 4.5 * PIXEL
    surfaces = []
    for axis in range(3):
        across = [(axis + 1) % 3, (axis + 2) % 3]
        width, depth = size[across], size[axis]
        side = Profile(rectangle((0, 0), width), (rectangle((bar, bar), width - bar),))
        window = side.holes[0]
        faces = [cap(side, 0.0, upward=False), cap(side, depth, upward=True)]
        faces += [wall(window, 0.0, bar), wall(window, depth - bar, depth)]
        # The outer faces come with the other two axes, their edges with the swept outline.
        faces.append(replace(wall(side.outer, 0.0, depth), triangles=np.zeros((0, 3, 3))))
        surfaces += [face.placed(np.eye(3)[[*across, axis]]) for face in faces]
    return assemble("frame", surfaces)


def shaft() -> Part:
    """A slim stepped shaft with a taper: 24 circles, 1.5 to 6 pixels apart at steps, grooves, chamfers and a collar."""
    shoulder = [(9, 0), (11, 2), (11, 38), (12.5, 38)]
    groove = [(12.5, 70), (10.5, 70), (10.5, 73), (12.5, 73)]
    collar = [(12.5, 100), (18, 100), (18, 104), (16, 104), (16, 107), (14, 107)]
    ring_groove = [(14, 140), (12.5, 140), (12.5, 141.5), (14, 141.5)]
    tip = [(14, 146), (8, 160), (8, 189), (6, 189), (6, 193.5), (4.5, 195)]
    return revolve("shaft", meridian([(0, 0), *shoulder, *groove, *collar, *ring_groove, *tip, (0, 195)]))


def meridian(points: Points) -> Path:
    """The path of straight lines through (r, z) `points`, in pixels."""
    points = PIXEL * np.asarray(points, dtype=np.float64)
    return Path(tuple(line(one, other) for one, other in pairwise(points)))


def fillet() -> Part:
    """An angle with one convex and one concave fillet of large radius, both tangent: 16 lines, 4 arcs."""
    outline = polygon(
        [(0, 0), (1, 0), (1, 0.16), (0.4, 0.16), (0.4, 0.66), (0, 0.66)],
        [0, 0, 0, 0.25, 0, 0.35],
    )
    lying = [(1, 0, 0), (0, 0, 1), (0, -1, 0)]  # swept sideways
    height, profile = 0.5, Profile(outline)
    surfaces = [cap(profile, 0.0, upward=False), cap(profile, height, upward=True), wall(profile.outer, 0.0, height)]
    return assemble("fillet", [surface.placed(lying) for surface in surfaces])


def rims() -> Part:
    """A terraced plate with a turned hub, whose rims are 0.5 to 2 pixels apart: 24 lines, 24 arcs, 14 circles.

    The plate's terraces are 2 and 1 pixels high. The hub has steps of 1.5 and 0.5 pixels, a groove 1 pixel wide and a
    ridge 2 pixels wide.
    """
    size, middle, corner = np.array([1.0, 0.7]), (0.5, 0.35), 0.16
    insets, tops = PIXEL * np.array([0.0, 6.0, 12.0]), PIXEL * np.array([10.0, 12.0, 13.0])
    outlines = [rectangle((inset, inset), size - inset, corner - inset) for inset in insets]
    inside = [*outlines[1:], circle(middle, 48 * PIXEL)]
    surfaces = [cap(Profile(outlines[0]), 0.0, upward=False)]
    for outline, inner, bottom, top in zip(outlines, inside, [0.0, *tops[:-1]], tops, strict=True):
        surfaces += [wall(outline, bottom, top), cap(Profile(outline, (inner,)), top, upward=True)]
    steps = [(48, 13), (48, 14.5), (40, 14.5), (40, 15)]
    groove, ridge = [(32, 15), (32, 13.5), (31, 13.5), (31, 15)], [(22, 15), (22, 17), (20, 17), (20, 15)]
    hub = meridian([*steps, *groove, *ridge, (12, 15), (12, 21), (0, 21)])
    return assemble("rims", [*surfaces, revolved(hub, middle)])


def grille() -> Part:
    """A thin plate with bowed rows of slanted and round openings, bars of 6 pixels between: 156 lines, 12 circles.

    No corners of openings lie in one line: the triangulation would leave the middle ones out.
    """
    columns, bar, tall, slant, bow = 6, 6 * PIXEL, 0.2, 0.03, 0.004
    wide = (1.0 - bar) / columns - bar
    lefts = bar + (wide + bar) * np.arange(columns)
    rises = bow * (np.arange(columns) - 2.0) ** 2
    opening = np.array([(0.0, 0.0), (wide, slant), (wide, tall + slant), (0.0, tall)])
    pitch = tall + 2 * bar + wide
    slots = [polygon(opening + corner) for low in (bar, bar + pitch) for corner in zip(lefts, low + rises, strict=True)]
    centres = np.column_stack([lefts + wide / 2, rises + tall + (slant + wide) / 2 + 2 * bar])
    holes = [circle(centre, wide / 2) for centre in centres]
    outline = rectangle((0.0, 0.0), (1.0, pitch + tall + slant + rises.max() + 2 * bar))
    return extrude("grille", Profile(outline, (*slots, *holes)), 10 * PIXEL)


HARD_PARTS: dict[str, Callable[[], Part]] = {
    "frame": frame,
    "shaft": shaft,
    "pipe": pipe,
    "fillet": fillet,
    "nut": nut,
    "rims": rims,
    "grille": grille,
    "blade": blade,
}
