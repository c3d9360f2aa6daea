"""The parametric edges themselves: shapes, sets of edges, the wireframe."""
