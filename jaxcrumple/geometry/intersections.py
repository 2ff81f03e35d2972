"""Self-intersections of a sheet: edges that pierce triangles, found with a k-d tree on the host."""

import numpy as np
import scipy
from jaxtyping import ArrayLike, Bool, Float, Int, Integer

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple._jax.memory import require, times_that_fit

# Bytes per candidate pair of a segment and a triangle.
PAIR = 60.0

Points = Float[np.ndarray, "pairs 3"]


def intersections(
    x: NodeVectorsLike, faces: Integer[ArrayLike, "faces 3"], edges: Integer[ArrayLike, "edges 2"]
) -> Int[np.ndarray, "pairs 2"]:
    """Find the edges that pierce a triangle with which they share no node.

    Where two triangles intersect, an edge of one pierces the other. An edge that only touches a plane from
    one side does not count.

    **Arguments:** `x` (n, 3) positions in m; `faces` (f, 3), `edges` (e, 2) node numbers.

    **Returns:** (k, 2) rows of `edges` and of `faces`.
    """
    x, faces, edges = np.asarray(x, float), np.asarray(faces), np.asarray(edges)
    pairs = close_pairs(x[edges], x[faces])
    ends, corners = edges[pairs[:, 0]], faces[pairs[:, 1]]
    apart = ~np.any(ends[:, :, None] == corners[:, None], axis=(1, 2))
    pairs, ends, corners = pairs[apart], ends[apart], corners[apart]
    return pairs[pierces(x[ends], x[corners])]


def close_pairs(
    ends: Float[np.ndarray, "segments 2 3"], corners: Float[np.ndarray, "triangles 3 3"]
) -> Int[np.ndarray, "pairs 2"]:
    """Find the pairs of a segment and a triangle whose bounding boxes overlap.

    **Arguments:** positions in m: `ends` (k, 2, 3) of the segments, `corners` (f, 3, 3) of the triangles.

    **Returns:** (m, 2) rows of `ends` and of `corners`.
    """
    low, high = corners.min(axis=1), corners.max(axis=1)
    first, last = ends.min(axis=1), ends.max(axis=1)
    center, middle = 0.5 * (low + high), 0.5 * (first + last)
    reach = 0.5 * (np.linalg.norm(high - low, axis=1).max() + np.linalg.norm(last - first, axis=1).max())
    segments, triangles = scipy.spatial.cKDTree(middle), scipy.spatial.cKDTree(center)
    if len(ends) and times_that_fit(PAIR * len(ends) * len(corners)) < 1.0:
        pairs = float(segments.count_neighbors(triangles, reach))
        what = f"the search among {pairs:.2g} pairs of segments and triangles, up to {reach:.3g} m apart,"
        require(PAIR * pairs, what, "give triangles of more equal size, or shorter chords")
    near = segments.sparse_distance_matrix(triangles, reach, output_type="ndarray")
    edge, face = near["i"], near["j"]
    overlap = np.all((low[face] <= last[edge]) & (first[edge] <= high[face]), axis=1)
    return np.stack([edge[overlap], face[overlap]], axis=1)


def pierces(
    ends: Float[np.ndarray, "pairs 2 3"], corners: Float[np.ndarray, "pairs 3 3"]
) -> Bool[np.ndarray, " pairs"]:
    """Whether segments (m, 2, 3) pass through triangles (m, 3, 3), from the signs of five volumes."""
    start, end = ends[:, 0], ends[:, 1]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]

    def volume(p: Points, q: Points, r: Points, s: Points) -> Float[np.ndarray, " pairs"]:
        return np.einsum("ij,ij->i", np.cross(q - p, r - p), s - p)

    sides = volume(a, b, c, start) * volume(a, b, c, end) < 0
    around = np.stack([volume(start, end, a, b), volume(start, end, b, c), volume(start, end, c, a)])
    return sides & (np.all(around >= 0, axis=0) | np.all(around <= 0, axis=0))
