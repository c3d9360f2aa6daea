"""What the images say about points and edges."""
