"""NumPy that several rooms share."""
