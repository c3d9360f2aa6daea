"""From oriented points to parametric edges. NumPy in, NumPy out: nothing here knows of Taichi."""
