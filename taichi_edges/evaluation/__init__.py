"""How good the edges are: the ground truth in its several forms, and EMAP's metrics. NumPy in, NumPy out."""
