"""From oriented points to single edges. NumPy in, NumPy out; `contours` alone asks the images."""
