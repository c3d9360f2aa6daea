"""Presets and scales: the values that a scene starts from, where they are not the defaults of `settings`."""

from typing import Any

from taichi_edges.scene.settings import SceneConfig

# The schedule of the paper and its supplement, 500 epochs: 30 are a share of 0.06, 300 of 0.6.
PAPER: dict[str, dict[str, Any]] = {
    "train": {
        "enabled": True,
        "epochs": 500,
        "steps": 0,
        "settled": 0.0,
        "gaussians": 10_000,
        "seeds": "auto",
        "initial_scale": 0.004,
        "initial_opacity": 0.08,
        "loss": "balanced",
        "strength_weight": 0.0,
        "flanks_from": 1.0,
        "established_support": 0.0,
        "only_means": 0.06,
        "learning_rates": {"means": 1e-3, "scales": 2e-4, "opacities": 3e-2, "quaternions": 1e-3},
        "means_decay": 0.75,
        "means_decay_every": 0.02,
        "means_decays": 5,
        "regularize_from": 0.6,
        "regularize_every": 10,
        "orient_weight": 0.1,
        "shape_weight": 0.1,
        "neighbors": 4,
        "density": {  # the paper leaves the intervals open
            "duplicate_at": [n / 50 for n in range(4, 17)],
            "duplicate_gradient": 0.5,
            "duplicate_copies": 2,
            "duplicate_distance": 0.01,
            "max_gaussians": 50_000,
            "cull_opacity_at": [0.25, 0.62, 0.9],
            "min_opacity": 0.05,
            "cull_support_at": [0.2, 0.3, 0.4, 0.5, 0.7, 0.9],
            "min_support": 0.05,
            "reset_opacity": True,
        },
    },
    "calibration": {"shift": "off", "silhouette": "off"},
    "filter": {"refine": False, "min_opacity": 0.2},
    "refine": {"enabled": False},
}


def _at_keys_of(pattern: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """What the nested dict `values` holds at the keys of `pattern`."""
    return {
        key: _at_keys_of(below, values[key]) if isinstance(below, dict) else values[key]
        for key, below in pattern.items()
    }


# Both name the same keys, so that one on the command line leaves nothing of the other; what they do not name is kept.
PRESETS = {"paper": PAPER, "fast": _at_keys_of(PAPER, SceneConfig.model_construct().model_dump())}
# What a preset says otherwise for scenes of other sizes, on top of it and below the scene file: SCALES[scale][preset].
LARGE_IN_THE_PAPER: dict[
    str, dict[str, Any]
] = {  # supplement: "for large scenes" lambda_1 = lambda_2 = 0.01, k = 4 as ever, seeded by SfM points
    "train": {"seeds": "auto", "orient_weight": 0.01, "shape_weight": 0.01},
}
# Photographs of what surrounds the camera: much texture, poses from structure from motion, few views of every place.
PHOTOGRAPHED: dict[str, dict[str, Any]] = {
    "source": {"min_chain": 12, "tolerance_px": 0.7},
    "train": {
        "enabled": False,
        "seeds": "pair",
        "gaussians": 60_000,
        "steps": 200,  # of those that are trained, from points or because the scene wants it
        "density": {"cull_opacity_at": [0.7], "cull_support_at": [0.5, 0.75]},
    },
    "filter": {
        "min_opacity": 0.2,
        "min_support": 0.15,
        "min_views": 2.2,
    },
    "cluster": {"min_points": 5, "max_gap": 0.015},
    "refine": {"min_support": 0.15, "min_views": 2.0, "min_steadiness": 0.3, "verdict": False},
}
# Photographers walk along facades, so that the depth of horizontal edges is for others to tell.
SURROUNDING: dict[str, dict[str, Any]] = {
    **PHOTOGRAPHED,
    "refine": {**PHOTOGRAPHED["refine"], "anchor": True},
}
SCALES: dict[str, dict[str, dict[str, Any]]] = {
    "part": {"paper": {}, "fast": {}},
    "object": {"paper": {}, "fast": PHOTOGRAPHED},
    "building": {"paper": LARGE_IN_THE_PAPER, "fast": SURROUNDING},
    "room": {"paper": LARGE_IN_THE_PAPER, "fast": SURROUNDING},
}
# What a scene is taken for that does not say: photographs are read by these readers.
SCALES_OF_READERS = {"idr": "object", "colmap": "building", "images": "building", "nerfstudio": "building"}
