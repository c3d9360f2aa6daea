"""Which trained points to trust, and those that continue them."""
