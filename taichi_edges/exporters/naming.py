"""What every exported file says about an edge, in the same words."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from taichi_edges.errors import UserError, amount

if TYPE_CHECKING:
    from taichi_edges.geometry.wireframe import Edge, Wireframe


def edge_name(number: int, edge: "Edge") -> str:
    """'line_3', 'elliptic_arc_12': the kind and the index in `edges.json`. edge: Edge."""
    return f"{edge.shape.kind}_{number}"


def confidence_of(edge: "Edge") -> float:
    """0 to 1; NaN where nobody has looked at the images for this edge."""
    return edge.evidence.confidence if edge.evidence else math.nan


def evidence_words(edge: "Edge") -> str:
    """'confidence 0.93, 41 views, residual 0.21 px', '' without evidence."""
    if edge.evidence is None:
        return ""
    confidence, views, residual = edge.evidence.confidence, edge.evidence.views, edge.evidence.residual_px
    return f"confidence {confidence:.2f}, {amount(views, 'view')}, residual {residual:.2f} px"


def refuse_empty(path: Path | str, wireframe: "Wireframe") -> None:
    """Hardly a program that opens these files takes one without a single edge."""
    if len(wireframe) == 0:
        raise UserError(f"{path}: there are no edges to write; look at the clusters and loosen the fit's thresholds")
