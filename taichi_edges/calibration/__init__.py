"""What removes the biases of a detector's maps: shifts, silhouettes that lie outside."""
