"""Hard parts with faces of their own: a bent pipe, a chamfered nut, a twisted blade."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.synthetic.profiles import PIECE_FACETS, Path, Profile, Segment, arc, circle, rectangle
from taichi_edges.synthetic.solids import Part, assemble
from taichi_edges.synthetic.surfaces import Surface, cap, grid_triangles, lift, wall

BEND_FACETS = 48  # of a quarter turn: a chord leaves a bend of radius 0.4 by 5e-5, the profiles' CHORD_ERROR
BLADE_ROWS = 64  # mesh facets from root to tip
SECTION_FACETS = 128  # on each side of a section: they turn by 5 degrees where the leading edge is roundest
BLADE_SECTIONS = (  # turn in degrees, chord, shift in x and y of the four rows of control points, from root to tip
    (-24.0, 0.5, (0.0, 0.0)),
    (-2.0, 0.5, (0.08, 0.07)),
    (24.0, 0.44, (0.08, -0.06)),
    (48.0, 0.36, (-0.04, 0.0)),
)
HYPERBOLA_PIECES = 4  # the cubics leave the hyperbola by less than 4e-9 drawn units

Place = tuple[np.ndarray, np.ndarray]  # axes (3, 3) and origin (3,), as `Surface.placed` takes them


def pipe() -> Part:
    """A pipe bent by a right angle between straight ends, walls of 4 pixels: its only edges are the 4 circles there."""
    outer, inner, bend = 0.11, 0.09, 0.4
    places = pipe_frames(0.49, bend, 0.3)
    outside, inside = circle((0.0, 0.0), outer), circle((0.0, 0.0), inner).reversed()
    surfaces = [swept(path, places) for path in (outside, inside)]
    end = Profile(outside, (inside,))
    surfaces += [cap(end, 0.0, upward=False).placed(*places[0]), cap(end, 0.0, upward=True).placed(*places[-1])]
    return assemble("pipe", surfaces)


def pipe_frames(before: float, bend: float, after: float) -> list[Place]:
    """Places (axes, origin) along the middle of a pipe, z ahead.

    It goes straight up over `before`, a quarter turn of radius `bend` towards x, and straight over `after`.
    """
    angles = np.linspace(0.0, np.pi / 2.0, BEND_FACETS + 1)
    places = []
    for angle in angles:
        sine, cosine = np.sin(angle), np.cos(angle)
        axes = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
        places.append((axes, np.array([bend * (1.0 - cosine), 0.0, before + bend * sine])))
    (first, low), (last, high) = places[0], places[-1]
    return [(first, low - before * first[2]), *places, (last, high + after * last[2])]


def swept(path: Path, places: Sequence[Place]) -> Surface:
    """The face that a smooth closed path sweeps from place to place; it has sharp edges at both ends, none along it."""
    ring = lift(np.vstack([path.polygon, path.polygon[:1]]), 0.0)
    rings = np.stack([ring @ axes + origin for axes, origin in places])
    ends = [lift(s.points, 0.0) @ axes + origin for s in path.segments for axes, origin in (places[0], places[-1])]
    return Surface(grid_triangles(rings), tuple(ends))


def nut() -> Part:
    """A hexagonal nut, both ends chamfered by a cone: 6 lines, 12 hyperbolic arcs, 4 circles.

    The cone's rim is as wide as the nut across its flats, so each side meets the cone in an arc that touches the rim.
    """
    apothem, bore, height = np.sqrt(3.0) / 4.0, 0.24, 0.4
    side = nut_side(apothem, height)
    turns = np.radians(60.0 * np.arange(6))
    axes = [[(np.cos(t), np.sin(t), 0.0), (-np.sin(t), np.cos(t), 0.0), (0.0, 0.0, 1.0)] for t in turns]
    # Pieces of 30 degrees, so that the mesh has vertices at the nut's corners and where the arcs touch the rim.
    rim = Segment(
        np.concatenate([arc((0, 0), apothem, start, 60.0).points for start in range(-30, 330, 60)]), PIECE_FACETS
    )
    end = Profile(Path((rim,)), (circle((0.0, 0.0), bore),))
    surfaces = [side.placed(rotation) for rotation in axes]
    surfaces += [replace(cap(end, z, upward=z > 0), edges=(lift(rim.points, z),)) for z in (0.0, height)]
    return assemble("nut", [*surfaces, wall(end.holes[0], 0.0, height)])


def nut_side(apothem: float, height: float, slope: float = np.tan(np.radians(30.0))) -> Surface:
    """The side x = apothem of a nut, with its share of both chamfers; of its two vertical edges the right-hand one.

    slope: by how much the chamfers fall for each unit outwards.
    """
    rim = arc((0.0, 0.0), apothem, -30.0, 60.0).polyline()
    border = rim * (apothem / rim[:, :1])
    drop = slope * (np.linalg.norm(border, axis=1) - apothem)
    low, high = np.column_stack([border, drop]), np.column_stack([border, height - drop])
    rows = np.stack([lift(rim, 0.0), low, high, lift(rim, height)])
    arcs = hyperbola_cubics(np.arcsinh(np.tan(np.radians(30.0))))
    across, fall = apothem * arcs[..., 0], slope * apothem * (arcs[..., 1] - 1.0)
    low_arc, high_arc = (np.stack([np.full_like(across, apothem), across, z], -1) for z in (fall, height - fall))
    return Surface(grid_triangles(rows), (low_arc, high_arc, np.stack([low[-1], high[-1]])))


def hyperbola_cubics(reach: float) -> np.ndarray:
    """Cubics (HYPERBOLA_PIECES, 4, 2) of the hyperbola (sinh u, cosh u), u from -reach to reach.

    Each has the end points, the tangents and the shoulder of its piece, as `arc` has of the circle; so both are the
    same approximation of a conic, of sixth order (Floater 1997, "An O(h^2n) Hermite approximation for conic sections").
    """
    steps = np.linspace(-reach, reach, HYPERBOLA_PIECES + 1)
    ends = np.stack([np.sinh(steps), np.cosh(steps)], axis=1)
    middles, weight = (steps[1:] + steps[:-1]) / 2.0, np.cosh(reach / HYPERBOLA_PIECES)
    corners = np.stack([np.sinh(middles), np.cosh(middles)], axis=1) / weight  # where the end tangents meet
    share = 4.0 * weight / (3.0 * (1.0 + weight))
    starts, stops = ends[:-1], ends[1:]
    return np.stack([starts, starts + share * (corners - starts), stops + share * (corners - stops), stops], axis=1)


def blade() -> Part:
    """A twisted blade on a block: 12 lines, its outlines at root and tip, and the trailing edge, a space curve.

    The leading edge is round, 3 to 5 pixels in radius: a contour and no edge. Both sides are bicubic Bezier patches,
    whose borders are exact cubics.
    """
    foot, top, size = 0.12, 1.0, np.array([0.6, 0.42])
    patches = blade_patches(foot, top, size / 2.0)
    along_u, along_v = np.linspace(0.0, 1.0, SECTION_FACETS + 1), np.linspace(0.0, 1.0, BLADE_ROWS + 1)
    rows = evaluate_bezier(np.moveaxis(evaluate_bezier(patches, along_u), 1, 2), along_v)  # (side, u, v, 3)
    root, tip = (Path((Segment(patches[:, row, :, :2], SECTION_FACETS),)) for row in (0, -1))
    trailing_edge = patches[:1, :, 0]
    sides = [grid_triangles(np.swapaxes(side, 0, 1)) for side in rows]
    borders = (patches[:, 0], patches[:, -1], trailing_edge)
    block = Profile(rectangle((0, 0), size), ())
    surfaces = [Surface(np.concatenate(sides), borders), cap(Profile(tip), top, upward=True)]
    surfaces += [cap(block, 0.0, upward=False), cap(Profile(block.outer, (root,)), foot, upward=True)]
    return assemble("blade", [*surfaces, wall(block.outer, 0.0, foot)])


def blade_patches(bottom: float, top: float, middle: np.ndarray) -> np.ndarray:
    """Control points (2, 4, 4, 3) of the two sides: sections from `bottom` to `top`, each from the trailing edge round.

    middle: (2,) where the blade stands.
    """
    suction = [(1.0, 0.0), (0.62, 0.2), (0.0, 0.16), (0.0, 0.02)]
    pressure = [(0.0, 0.02), (0.0, -0.1), (0.5, 0.03), (1.0, 0.0)]  # leaves the leading edge along the same tangent
    section = np.array([suction, pressure]) - (0.45, 0.04)
    patches = np.empty((2, 4, 4, 3))
    for row, (turn, chord, shift) in enumerate(BLADE_SECTIONS):
        sine, cosine = np.sin(np.radians(turn)), np.cos(np.radians(turn))
        turned = section @ np.array([[cosine, sine], [-sine, cosine]])
        patches[:, row] = lift(chord * turned + middle + shift, bottom + (top - bottom) * row / 3.0)
    return patches
