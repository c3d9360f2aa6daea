"""What each stage has found, in one line for the person who waits. `FINDINGS[stage](facts)` makes it."""

from collections.abc import Mapping
from typing import Any

from taichi_edges.errors import amount

WRONG_CAMERAS = "poses or intrinsics may not be those of these images (their order, axes or scale)"


# What each mark of `evidence/verdict.py` that speaks against an edge says about it: in the singular, and in the plural.
DOUBTS = {
    "steadiness": ("edge that moves with the viewpoint", "edges that move with the viewpoint"),
    "sharpness": ("contour of a rounded surface", "contours of rounded surfaces"),
    "outside": ("edge outside of the object's outline", "edges outside of the object's outline"),
    "blur": ("rounded or blurred edge", "rounded or blurred edges"),
    "spread": ("edge seen from too few sides", "edges seen from too few sides"),
}
CAUSES = {
    "steadiness": "they may be contours of rounded surfaces, which move with the viewpoint, or the poses are off",
    "sharpness": "they move with the viewpoint and are no edges",
    "outside": "they may be contours of rounds, or the transparency of the pictures is off",
    "blur": "the part may be rounded there, or the pictures out of focus",
    "spread": "take more pictures from other sides",
}
# Harmonic mean of the shares that are likely right and shown. Of the runs of `benchmarks/parts.py` all with an F5 below
# 80 % are below it, and three with more.
DOUBTFUL = 0.85


def left_out(*amounts: tuple[int, str] | tuple[int, str, str]) -> str:
    """'; left out: 3 outliers, 1 point': the (count, noun, plural) that are not zero, '' where all are."""
    named = [amount(*each) for each in amounts if each[0]]
    return f"; left out: {', '.join(named)}" if named else ""


def describe_prepare(facts: Mapping[str, Any]) -> str:
    """'9 views and 1 held out, 128 x 128 px, 9000 edgels, lines 2.4 px wide; maps shifted by (-0.55, -0.7) px: ...'."""
    part = f" of the synthetic part '{facts['part']}'" if "part" in facts else ""
    size = f"{facts['width_px']} x {facts['height_px']} px"
    lines = f"lines {facts['line_width_px']:.1f} px wide" if "line_width_px" in facts else "edges from the images"
    held_out = f" and {len(facts['held_out'])} held out" if facts["held_out"] else ""
    found = f"{amount(facts['views'], 'view')}{held_out}{part}, {size}, {amount(facts['edgels'], 'edgel')}, {lines}"
    return f"{found}{describe_calibration(facts.get('calibration'))}"


def describe_calibration(facts: Mapping[str, Any] | None) -> str:
    """'; maps shifted by (-0.55, -0.71) px: corrected; silhouettes 1.32 px outside: corrected', '' without facts."""
    if facts is None:
        return ""
    found = []
    if facts["shift_method"] != "none":
        right, down = facts["shift_px"]
        found.append((f"maps shifted by ({right:+.2f}, {down:+.2f}) px", facts["shift_applied"]))
    if facts["silhouette_method"] != "none":
        found.append((f"silhouettes {facts['silhouette_px']:+.2f} px outside", facts["silhouette_applied"]))
    reason = facts.get("reason") or "the views show too little"
    unknown = f"; not calibrated in full: {reason}" if len(found) < 2 else ""
    return "".join(f"; {what}: {'corrected' if applied else 'left as it is'}" for what, applied in found) + unknown


def describe_train(facts: Mapping[str, Any]) -> str:
    """'875 Gaussians after 720 view steps, final loss 0.1398'."""
    if not facts["view_steps"]:
        return f"{amount(facts['gaussians'], 'Gaussian')}, left where they start"
    loss = "" if facts["final_loss"] is None else f", final loss {facts['final_loss']:.4f}"
    return f"{amount(facts['gaussians'], 'Gaussian')} after {amount(facts['view_steps'], 'view step')}{loss}"


def describe_cluster(facts: Mapping[str, Any]) -> str:
    """'823 points on 40 edges, edgels 0.09 px off; left out: 40 Gaussians of low opacity, ..., 2 points on no edge'."""
    found = f"{amount(facts['points'] - facts['unclustered'], 'point')} on {amount(facts['clusters'], 'edge')}"
    noise = f", edgels {facts['edgel_noise_px']:.2f} px off" if "edgel_noise_px" in facts else ""
    return (
        found
        + noise
        + left_out(
            (facts["low_opacity"], "Gaussian of low opacity", "Gaussians of low opacity"),
            (facts["low_support"], "point of low support", "points of low support"),
            (facts["outliers"], "outlier"),
            (facts["unclustered"], "point on no edge", "points on no edge"),
        )
    )


def describe_fit(facts: Mapping[str, Any]) -> str:
    """'19 lines and 21 curves (2 of the edges closed); left out: 3 clusters that are too short'."""
    closed = facts["loop_clusters"]
    loops = f" ({closed} closed {'edge' if closed == 1 else 'edges'})" if closed else ""
    return f"{amount(facts['lines'], 'line')} and {amount(facts['curves'], 'curve')}{loops}" + left_out(
        (facts["short_clusters"], "cluster that is too short", "clusters that are too short"),
        (facts["degenerate_clusters"], "cluster without extent", "clusters without extent"),
    )


def describe_refine(facts: Mapping[str, Any]) -> str:
    """'33 edges, 20 vertices; 2 strokes joined to others; 71 parallel (refine.regularise: true makes them exact)'."""
    found = f"{amount(facts['edges'], 'edge')}, {amount(facts['vertices'], 'vertex', 'vertices')}"
    apart = f"; {amount(facts['contours'], 'contour')} in a file of their own" if "contours" in facts else ""
    done: list[tuple[int, str] | tuple[int, str, str]] = [
        (facts["joined"], "stroke joined to others", "strokes joined to others"),
        (facts["circles"], "circle completed", "circles completed"),
        (facts["anchored"], "line anchored to edges that it meets", "lines anchored to edges that they meet"),
        (facts["lines"], "line added", "lines added"),
    ]
    changed = ", ".join(amount(*each) for each in done if each[0])
    return (
        found
        + (f"; {changed}" if changed else "")
        + apart
        + left_out(
            (facts["duplicates"], "duplicate"),
            *((facts["doubted"][mark], *name) for mark, name in DOUBTS.items() if mark in facts["doubted"]),
            (facts["unsupported"], "edge without support in the images", "edges without support in the images"),
        )
        + describe_relations(facts["relations"])
    )


def doubt_of_refine(facts: Mapping[str, Any]) -> str:
    """What to say where the edges are not to be trusted, with the likely cause: one line; '' where they are."""
    if facts["likely_percent"] is None:
        return ""
    likely, shown = facts["likely_percent"] / 100, facts["shown_percent"] / 100
    if 2 * likely * shown >= DOUBTFUL * (likely + shown):
        return ""
    wrong = f"about {100 * (1 - likely):.0f} % of the edges' length is likely wrong"
    line = f"{wrong}, and {100 * (1 - shown):.0f} % of what the pictures show is on no edge"
    if not facts["doubted"]:
        return line
    mark = max(facts["doubted"], key=lambda mark: (facts["doubted"][mark], mark))
    return f"{line}; left out above all: {amount(facts['doubted'][mark], *DOUBTS[mark])}: {CAUSES[mark]}"


def describe_relations(relations: Mapping[str, tuple[int, int]]) -> str:
    """'; 71 parallel, 3 coaxial (refine.regularise: true makes them exact)', '' where there are none."""
    named = [f"{found} {kind.replace('_', ' ')}" for kind, (found, _) in relations.items() if found]
    if not named:
        return ""
    imposed = sum(count for _, count in relations.values())
    state = f"made exact by {imposed} of them" if imposed else "refine.regularise: true makes them exact"
    return f"; {', '.join(named)} ({state})"


def describe_evaluate(facts: Mapping[str, Any]) -> str:
    """'F-score 72.6 % at 5 mm, ..., 74.6 % at 20 mm; 7 of 8 corners closed; 3 views held out: ...'; '2 edges, ...'."""
    if facts["ground_truth"] is None:
        length, ends = f"{facts['predicted_length_units']:.2f} units long", amount(facts["free_ends"], "free end")
        return f"{amount(facts['edges'], 'edge')}, {length}, {ends}; there is no ground truth{describe_held_out(facts)}"
    shares = [f"{facts[f'f_score_{limit}mm_percent']:.1f} % at {limit} mm" for limit in (5, 10, 20)]
    corners = f"; {facts['corners_closed']} of {facts['corners']} corners closed" if facts.get("corners") else ""
    return f"F-score {', '.join(shares)}{corners}{describe_held_out(facts)}"


def describe_held_out(facts: Mapping[str, Any]) -> str:
    """'; 3 views held out: precision 93.1 %, recall 62.4 % of long edges', '' where none were."""
    precision, recall = (facts.get(f"held_out_{share}_percent") for share in ("precision", "recall_long"))
    shares = [f"precision {precision:.1f} %"] if precision is not None else []
    shares += [f"recall {recall:.1f} % of long edges"] if recall is not None else []
    return f"; {amount(facts['held_out_views'], 'view')} held out: {', '.join(shares)}" if shares else ""


def describe_export(facts: Mapping[str, Any]) -> str:
    """'edges.ply, edges.dxf, overlays.png and 4 pictures in overlays/'."""
    files = [name for name in facts["files"] if "/" not in name]
    return f"{', '.join(files)} and {amount(len(facts['files']) - len(files), 'picture')} in overlays/"


FINDINGS = {
    "prepare": describe_prepare,
    "train": describe_train,
    "cluster": describe_cluster,
    "fit": describe_fit,
    "refine": describe_refine,
    "evaluate": describe_evaluate,
    "export": describe_export,
}
