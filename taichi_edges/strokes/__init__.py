"""From oriented points to single edges. NumPy in, NumPy out; the images are not asked."""
