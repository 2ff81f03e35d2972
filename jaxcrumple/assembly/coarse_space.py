"""A smooth coarse space on the reference sheet: tensor-product cubic B-splines over its nodes."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.tree import as_array, as_indices

# Number of functions along one direction that overlap a cell, and that overlap it or an adjacent cell.
SUPPORT, WINDOW = 4, 6
# Smallest cell width in node distances, and most cells per direction: this limits the size of the dense
# factor.
NODES_PER_CELL, MOST_CELLS = 4.5, 16


class CoarseSpace(eqx.Module):
    """Hold cubic B-splines on a grid of square cells over the two longest directions of the rest shape.

    Node i, in cell `cell[i]`, has SUPPORT weights along each direction. Neighbours in the mesh are at most
    one cell apart, so that a row of the tangent involves only WINDOW functions along each direction.

    - `cell` (n, 2): a node's cell in the grid; `weights` (n, 2, 4).
    - `members` (c, k): nodes of each occupied cell, padded with n; `place` (n,): a node's index in the
      flattened members.
    - `functions` (c, 16), `window` (c, 36): numbers of a cell's functions; `size` outside the grid.
    - `owners` (16, size): places in the flattened `functions` where each function stands, padded with 16 c.
    - `size`: number of functions.
    """

    cell: Int[Array, "nodes 2"]
    weights: Float[Array, "nodes 2 4"]
    members: Int[Array, "cells members"]
    place: Int[Array, " nodes"]
    functions: Int[Array, "cells 16"]
    window: Int[Array, "cells 36"]
    owners: Int[Array, "16 functions"]
    size: int = eqx.field(static=True)

    def emptied(self) -> "CoarseSpace":
        """Return a space of no functions, for solvers that use none."""
        none = np.zeros((0, 0), int)
        place = as_indices(np.zeros(len(self.place), int))
        functions, window = (as_indices(np.zeros((0, width**2), int)) for width in (SUPPORT, WINDOW))
        owners = as_indices(_owners(np.asarray(functions), 0))
        return CoarseSpace(self.cell, self.weights, as_indices(none), place, functions, window, owners, 0)

    def padded(self, cells: int, members: int, size: int) -> "CoarseSpace":
        """Return the space with more `cells`, `members` of a cell, and `size` functions, which stay empty."""
        occupied, most = self.members.shape
        more, place = ((0, cells - occupied), (0, 0)), np.asarray(self.place)
        functions, window = (
            np.pad(np.where(a == self.size, size, a), more, constant_values=size)
            for a in (self.functions, self.window)
        )
        wide = (more[0], (0, members - most))
        return CoarseSpace(
            self.cell,
            self.weights,
            as_indices(np.pad(self.members, wide, constant_values=len(place))),
            as_indices(place // most * members + place % most),
            as_indices(functions),
            as_indices(window),
            as_indices(_owners(functions, size)),
            size,
        )


def build_coarse_space(rest: Float[np.ndarray, "nodes 3"], pairs: Int[np.ndarray, "pairs 2"]) -> CoarseSpace:
    """Build the coarse space of nodes at `rest` (n, 3) m whose tangent couples the node `pairs` (m, 2).

    If a shell covers itself along its shortest direction, the functions couple its layers. The
    preconditioner is then still valid, but less effective.
    """
    points = _longest_directions(np.asarray(rest, float))
    reach = np.max(np.abs(points[pairs[:, 0]] - points[pairs[:, 1]])) if len(pairs) else 0.0
    extent = points.max(axis=0) - points.min(axis=0)
    target = np.sqrt(max(extent[0] * max(extent[1], 1e-3 * extent[0]), 1e-300) / len(points))
    width = max(NODES_PER_CELL * target, extent.max() / MOST_CELLS, reach, 1e-300) * (1.0 + 1e-9)
    grid = np.maximum(np.ceil(extent / width).astype(int), 1)
    scaled = (points - points.min(axis=0)) / width + 0.5 * (grid - extent / width)
    cell = np.clip(np.floor(scaled).astype(int), 0, grid - 1)
    weights = _cubic(scaled - cell)
    functions_per_side = grid + SUPPORT - 1
    occupied, owner = np.unique(cell[:, 0] * grid[1] + cell[:, 1], return_inverse=True)
    corner = np.stack([occupied // grid[1], occupied % grid[1]], axis=1)
    members, place = _members(owner.reshape(-1), len(occupied), len(points))
    functions, size = _numbers(corner, 0, SUPPORT, functions_per_side), int(np.prod(functions_per_side))

    return CoarseSpace(
        as_indices(cell),
        as_array(weights),
        as_indices(members),
        as_indices(place),
        as_indices(functions),
        as_indices(_numbers(corner, -1, WINDOW, functions_per_side)),
        as_indices(_owners(functions, size)),
        size,
    )


def _longest_directions(rest: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 2"]:
    """Return coordinates (n, 2) along the two principal directions of largest variance."""
    centred = rest - rest.mean(axis=0)
    _, directions = np.linalg.eigh(centred.T @ centred)
    return centred @ directions[:, :0:-1]


def _cubic(u: Float[np.ndarray, " *axes"]) -> Float[np.ndarray, "*axes 4"]:
    """Return the weights (..., 4) of the uniform cubic B-splines that overlap a cell, at `u` in [0, 1]."""
    return (
        np.stack(
            [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3],
            axis=-1,
        )
        / 6.0
    )


def _members(
    owner: Int[np.ndarray, " nodes"], cells: int, n: int
) -> tuple[Int[np.ndarray, "cells members"], Int[np.ndarray, " nodes"]]:
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=cells)
    rank = np.arange(n) - np.repeat(np.cumsum(counts) - counts, counts)
    members = np.full((cells, counts.max()), n)
    members[owner[order], rank] = order
    place = np.empty(n, dtype=int)
    place[order] = owner[order] * counts.max() + rank
    return members, place


def _numbers(
    corner: Int[np.ndarray, "cells 2"], first: int, count: int, sides: Int[np.ndarray, "2"]
) -> Int[np.ndarray, "cells functions"]:
    """Return the numbers (c, count^2) of functions from offset `first`; outside the grid, their total."""
    along = [corner[:, i, None] + first + np.arange(count) for i in range(2)]
    inside = [(a >= 0) & (a < side) for a, side in zip(along, sides, strict=True)]
    number = along[0][:, :, None] * sides[1] + along[1][:, None, :]
    known = inside[0][:, :, None] & inside[1][:, None, :]
    return np.where(known, number, np.prod(sides)).reshape(len(corner), -1)


def _owners(functions: Int[np.ndarray, "cells 16"], size: int) -> Int[np.ndarray, "16 functions"]:
    """Return the places (16, size) of each function in the flattened `functions`, padded with 16 c."""
    flat = functions.reshape(-1)
    order = np.argsort(flat, kind="stable")[: np.sum(flat < size)]
    numbers = flat[order]
    owners = np.full((SUPPORT**2, size), flat.size)
    owners[np.arange(len(order)) - np.searchsorted(numbers, numbers), numbers] = order
    return owners
