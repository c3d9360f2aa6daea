"""Connected components of a graph."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def components(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(count,) labels 0, 1, .. of the components of a graph with `count` nodes and edges from `first` to `second`.

    first, second: (k,) indices of nodes. Components are numbered in the order of their first nodes.
    """
    from scipy.sparse import coo_matrix

    if not count:
        return np.zeros(0, np.int32)
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(count, count))
    return components_of(graph)


def components_of(graph: "csr_array") -> np.ndarray:
    """(n,) labels as `components` gives them, of a sparse (n, n) graph whose entries are edges both ways."""
    from scipy.sparse.csgraph import connected_components

    return connected_components(graph, directed=False)[1]
