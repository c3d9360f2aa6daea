"""Presets and scales: the values that a scene starts from."""

from taichi_edges.scene.settings import DensityConfig

# Key by key; what a preset does not name keeps the scene's value.
PRESETS = {
    # The schedule of the paper and its supplement, 500 epochs: 30 are a share of 0.06, 300 of 0.6.
    "paper": {
        "train": {
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
            "density": DensityConfig().model_dump(),  # the paper leaves the intervals open
        },
        "calibration": {"shift": "off", "silhouette": "off"},
        "filter": {"refine": False},
        "refine": {"enabled": False},
    },
    # Seeded where the views agree, so that a few passes are enough: faster rates, one smooth decay, no duplication.
    "fast": {
        "train": {
            "epochs": 0,
            "steps": 500,
            "settled": 0.01,
            "gaussians": 10_000,
            "seeds": "votes",
            "initial_opacity": 0.3,
            "loss": "balanced",
            "strength_weight": 0.5,
            "flanks_from": 1.0,
            "established_support": 0.1,
            "only_means": 0.15,
            "learning_rates": {"means": 2e-3, "scales": 5e-3, "opacities": 3e-2, "quaternions": 5e-3},
            "means_decay": 0.84,
            "means_decay_every": 0.05,
            "means_decays": 20,
            "regularize_from": 0.5,
            "density": {
                "duplicate_at": [],
                "cull_opacity_at": [0.7],
                "cull_support_at": [0.5, 0.75],
                "reset_opacity": False,
            },
        },
        "calibration": {"shift": "auto", "silhouette": "auto"},
        "filter": {"refine": True},
        "refine": {"enabled": True},
    },
}
# What a preset says otherwise for scenes of other sizes, on top of it and below the scene file: SCALES[scale][preset].
LARGE_IN_THE_PAPER = {  # supplement: "for large scenes" lambda_1 = lambda_2 = 0.01, k = 4 as ever, seeded by SfM points
    "train": {"seeds": "auto", "orient_weight": 0.01, "shape_weight": 0.01},
}
# Photographs of what surrounds the camera: much texture, poses from structure from motion, few views of every place.
PHOTOGRAPHED = {
    "source": {"min_chain": 12, "tolerance_px": 0.7},
    "train": {"seeds": "sweep", "gaussians": 60_000, "steps": 200, "learning_rates": {"means": 1e-4}},
    "filter": {
        "min_support": 0.15,
        "min_views": 2.2,
        "min_steadiness": 0.0,
        "min_evidence": 0.0,
        "min_angle": 0.0,
        "harvest": False,
        "grow": 0.0,
    },
    "cluster": {"min_points": 5, "max_gap": 0.015},
    "refine": {"min_support": 0.15, "min_views": 2.0, "min_steadiness": 0.3},
}
# Photographers walk along facades, so that the depth of horizontal edges is for others to tell.
SURROUNDING = {
    **PHOTOGRAPHED,
    "refine": {**PHOTOGRAPHED["refine"], "anchor": True},
}
SCALES = {
    "part": {"paper": {}, "fast": {}},
    "object": {"paper": {}, "fast": PHOTOGRAPHED},
    "building": {"paper": LARGE_IN_THE_PAPER, "fast": SURROUNDING},
    "room": {"paper": LARGE_IN_THE_PAPER, "fast": SURROUNDING},
}
# What a scene is taken for that does not say: photographs are read by these readers.
SCALES_OF_READERS = {"idr": "object", "colmap": "building", "images": "building", "nerfstudio": "building"}
