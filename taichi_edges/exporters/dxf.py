"""DXF for CAD programs: every edge as the entity that it is, arcs as arcs and splines as splines, in 3D.

A layer for each kind, and one for contours. What the images say about an edge, or of the round behind a contour, is
extended data of the application TAICHI_EDGES: pairs of a name and a value. Numbers are those of the input's frame,
which has no unit, and nor has the file.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.exporters.naming import edge_name, refuse_empty
from taichi_edges.exporters.nurbs import DEGREE, joined
from taichi_edges.files.artefacts import replacing
from taichi_edges.files.palette import CONTOUR_COLOUR, KIND_COLOURS

if TYPE_CHECKING:
    from ezdxf.document import Drawing
    from ezdxf.entities import DXFGraphic
    from ezdxf.layouts import Modelspace
    from ezdxf.math import Vec3

    from taichi_edges.geometry.shapes import EllipticArc, Line, Shape, Spline
    from taichi_edges.geometry.wireframe import Edge, Wireframe

VERSION = "R2010"  # the oldest that all programs of today read with true colours
APPLICATION = "TAICHI_EDGES"
TEXT, REAL, INTEGER = 1000, 1040, 1071  # group codes of extended data
VIEW_HEIGHT = 1.2  # of the longest side of the edges' box: what is in sight when the file is opened


def write_dxf(
    path: Path | str, wireframe: "Wireframe", contours: "Sequence[tuple[Shape, Mapping[str, float]]]" = ()
) -> Path:
    """Write the edges of a Wireframe, in the frame the file shall have, as a DXF.

    contours: shapes in the same frame, and {name: value} of each.
    """
    refuse_empty(path, wireframe)
    with _fixed_dates() as ezdxf, replacing(path) as unfinished:
        document = ezdxf.new(VERSION, units=0)
        document.appids.add(APPLICATION)
        for kind in sorted({shape.kind for shape in wireframe.shapes}):
            document.layers.add(layer_of(kind), true_color=ezdxf.rgb2int(KIND_COLOURS[kind]))
        for number, edge in enumerate(wireframe.edges):
            _add(document, edge.shape, edge.shape.kind, _extended_data(number, edge))
        if contours:
            document.layers.add(layer_of("contour"), true_color=ezdxf.rgb2int(CONTOUR_COLOUR))
        for number, (shape, told) in enumerate(contours):
            _add(document, shape, "contour", [(TEXT, "contour"), (INTEGER, number), *_reals(told)])
        _look_at(document, wireframe)
        _declare_classes(document)
        document.saveas(unfinished)
    return Path(path)


def layer_of(kind: str) -> str:
    """'ELLIPTIC_ARCS'."""
    return f"{kind.upper()}S"


def _add(document: "Drawing", shape: "Shape", kind: str, data: list[tuple[int, str | float]]) -> None:
    """A shape as an entity in the layer of a kind."""
    entity = ENTITIES[shape.kind](document.modelspace(), shape)
    entity.dxf.layer = layer_of(kind)
    entity.set_xdata(APPLICATION, data)


@contextlib.contextmanager
def _fixed_dates() -> Iterator[ModuleType]:
    """The module ezdxf, told to write no dates and no random identifiers: the same edges give the same bytes."""
    import ezdxf

    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield ezdxf
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def _declare_classes(document: "Drawing") -> None:
    """By the alphabet; ezdxf itself takes the order of a set, which differs from process to process."""
    for name in sorted(document.entitydb.dxf_types_in_use()):
        document.classes.add_class(name)


def _extended_data(number: int, edge: "Edge") -> list[tuple[int, str | float]]:
    """(group code, value) pairs."""
    pairs: list[tuple[int, str | float]] = [
        (TEXT, "edge"),
        (INTEGER, number),
        (TEXT, "name"),
        (TEXT, edge_name(number, edge)),
    ]
    if edge.evidence:
        names = ("confidence", "residual_px", "supported_length")
        pairs += _reals({name: getattr(edge.evidence, name) for name in names})
        pairs += [(TEXT, "views"), (INTEGER, int(edge.evidence.views))]
    return pairs


def _reals(values: "Mapping[str, float]") -> list[tuple[int, str | float]]:
    """(group code, value) pairs: each name and its number."""
    return [pair for name, value in values.items() for pair in ((TEXT, name), (REAL, float(value)))]


def _look_at(document: "Drawing", wireframe: "Wireframe") -> None:
    """Programs open the file with the edges in sight."""
    points = np.concatenate([shape.cubics().reshape(-1, 3) for shape in wireframe.shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    document.set_modelspace_vport(VIEW_HEIGHT * (high - low).max(), tuple((0.5 * (low + high))[:2].tolist()))


def _add_line(space: "Modelspace", line: "Line") -> "DXFGraphic":
    return space.add_line(*line.points.tolist())


def _add_circle(space: "Modelspace", circle: "EllipticArc") -> "DXFGraphic":
    centre, _ = _in_plane(circle)
    return space.add_circle(centre, circle.radii.mean(), {"extrusion": circle.normal})


def _add_arc(space: "Modelspace", arc: "EllipticArc") -> "DXFGraphic":
    """Counter-clockwise about its normal, as our angles are."""
    centre, start = _in_plane(arc)
    low, high = (start + np.degrees([0.0, arc.high - arc.low])) % 360.0
    return space.add_arc(centre, arc.radii.mean(), low, high, dxfattribs={"extrusion": arc.normal})


def _in_plane(arc: "EllipticArc") -> tuple["Vec3", float]:
    """Its centre in the coordinate system that DXF derives from the normal, and where it starts there, degrees."""
    from ezdxf.math import OCS

    system = OCS(arc.normal)
    towards = system.from_wcs(arc.ends[0] - arc.centre)
    return system.from_wcs(arc.centre), np.degrees(np.arctan2(towards.y, towards.x))


def _add_ellipse(space: "Modelspace", arc: "EllipticArc") -> "DXFGraphic":
    low, high = (0.0, 2 * np.pi) if arc.closed else (arc.low, arc.high)
    ratio = arc.radii[1] / arc.radii[0]
    return space.add_ellipse(arc.centre, arc.axes[0], ratio, low, high, {"extrusion": arc.normal})


def _add_spline(space: "Modelspace", spline: "Spline") -> "DXFGraphic":
    """Without the flag of closed splines: some programs then make up knots of their own."""
    same = joined(spline.curves)
    return space.add_open_spline(same.control_points, DEGREE, same.all_knots.tolist())


ENTITIES: dict[str, Callable[..., "DXFGraphic"]] = {
    "line": _add_line,
    "circle": _add_circle,
    "arc": _add_arc,
    "ellipse": _add_ellipse,
    "elliptic_arc": _add_ellipse,
    "spline": _add_spline,
}
