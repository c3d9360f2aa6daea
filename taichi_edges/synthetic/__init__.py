"""CAD-like parts with exact edges and ray-cast views of them: the embedded demo and the tests' truth."""
