"""Where Gaussians begin: places that many views agree on."""
