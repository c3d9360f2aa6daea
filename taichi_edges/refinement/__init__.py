"""From single edges to a wireframe: connected, minimal, in agreement with the images."""
