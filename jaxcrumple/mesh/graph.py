"""Connected components of a graph."""

import numpy as np
import scipy
from jaxtyping import Int


def components(
    size: int, a: Int[np.ndarray, " links"], b: Int[np.ndarray, " links"]
) -> tuple[int, Int[np.ndarray, " members"]]:
    """Return the number of components of a graph of `size` members, and the component of each member.

    Links connect the members `a` and `b`.
    """
    graph = scipy.sparse.coo_array((np.ones(len(a)), (a, b)), shape=(size, size))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)
