"""Edge maps: what is done to a detector's output before it supervises anything."""
