"""Order of points along a Hilbert curve, which keeps neighbours close."""

import numpy as np
from jaxtyping import Float, Int

# Resolution of the curve: cells along each side, as a power of two.
_HILBERT_BITS = 16


def hilbert_order(x: Float[np.ndarray, "nodes 3"]) -> Int[np.ndarray, " nodes"]:
    """Return the order of the nodes along a Hilbert curve in their best-fit plane.

    The first axis in the plane is a projected coordinate axis: the principal axes of a square depend on
    rounding.
    """
    centred = x - x.mean(axis=0)
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    normal *= np.sign(normal[np.argmax(np.abs(normal))])
    first = np.eye(3)[np.argmin(np.abs(normal).round(6))]
    first = first - normal * (first @ normal)
    plane = centred @ np.stack([first, np.cross(normal, first)], axis=1)
    cells = (plane - plane.min(axis=0)) / np.ptp(plane, axis=0).max() * (2**_HILBERT_BITS - 1)
    return np.argsort(hilbert_index(np.rint(cells).astype(np.int64), _HILBERT_BITS), kind="stable")


def hilbert_index(cells: Int[np.ndarray, "nodes 2"], bits: int) -> Int[np.ndarray, " nodes"]:
    """Index of integer cells (n, 2) in [0, 2^bits) along the Hilbert curve, one quadrant per bit."""
    x, y = cells.T
    index = np.zeros(len(cells), dtype=np.int64)
    for bit in reversed(range(bits)):
        right, up = (x >> bit) & 1, (y >> bit) & 1
        index = 4 * index + ((3 * right) ^ up)
        flip = (up == 0) & (right == 1)
        x, y = np.where(flip, 2**bits - 1 - x, x), np.where(flip, 2**bits - 1 - y, y)
        x, y = np.where(up == 0, y, x), np.where(up == 0, x, y)
    return index
