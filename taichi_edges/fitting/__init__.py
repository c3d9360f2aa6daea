"""Which shape is it? Lines, arcs, ellipses, chains of cubics through points. NumPy in, NumPy out."""
