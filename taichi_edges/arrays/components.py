"""Connected components of a graph."""

import numpy as np


def components(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(count,) labels 0, 1, .. of the components of a graph with `count` nodes and edges from `first` to `second`.

    first, second: (k,) indices of nodes. Components are numbered in the order of their first nodes.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not count:
        return np.zeros(0, np.int32)
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)[1]
