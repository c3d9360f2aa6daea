"""Which trained points to trust, and where they belong."""
