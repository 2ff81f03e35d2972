"""The tangent's sparsity pattern and the maps that assemble it, built once on the host."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple._jax.memory import require, require_indices
from jaxcrumple.assembly.coarse_space import CoarseSpace, build_coarse_space
from jaxcrumple.assembly.contact_blocks import Cross
from jaxcrumple.model.elements import upper_pairs

# Bytes of an entry of the tangent while the pattern is built.
ENTRY = 40.0


class Pattern(eqx.Module):
    """Upper triangle (diagonal included) of a symmetric matrix in compressed sparse rows.

    Degrees of freedom are numbered 3 * node + component. Arrays are data, not constants of the
    program: another mesh of the same size runs the same executable.

    - `indptr` (3n+1,), `indices` (nnz,), `rows` (nnz,): int32.
    - `diagonal` (3n,): entry of each diagonal element.
    - `entry_places` (nnz,): where each entry lies among the 3x3 blocks on and above the diagonal (b, 9).
    - `node_blocks` (n,): the nodes' own among these.
    - `element_blocks`: one (pairs, m) map per stencil to the blocks of an element's node pairs, and
      `element_flips` (pairs, m): whether a pair's first node is the one with the larger number.
    - `neighbors` (n, k): block columns of each node's row, both triangles, padded with the node itself.
    - `row_entries` (n, 3, 3k): entry of each element of these blocks, `nnz` where there is none.
    - `coarse`: a smooth coarse space over the nodes, for two-level solvers.
    - `contact`: blocks between triangles that touch, whose values follow the `nnz` own ones, and after these
      a diagonal (n,), see `separate`; or None.
    """

    indptr: Array
    indices: Array
    rows: Array
    diagonal: Array
    entry_places: Array
    node_blocks: Array
    element_blocks: tuple[Array, ...]
    element_flips: tuple[Array, ...]
    neighbors: Array
    row_entries: Array
    coarse: CoarseSpace
    contact: Cross | None = None

    @property
    def nnz(self) -> int:
        """Stored entries of the sheet itself."""
        return self.indices.shape[0]

    @property
    def size(self) -> int:
        """Length of the vector of values: those of the sheet, then those of contact."""
        return self.nnz + (0 if self.contact is None else self.contact.size + len(self.node_blocks))

    def assemble(self, element_blocks: Sequence[Array], node_blocks: Array) -> Array:
        """Blocks (b, 9) from those of elements (pairs, 3, 3, m), one per stencil, and of nodes (n, 3, 3)."""
        n = self.node_blocks.shape[0]
        total = jnp.zeros(((self.nnz + 3 * n) // 9, 9), node_blocks.dtype)
        total = total.at[self.node_blocks].set(node_blocks.reshape(n, 9))
        for places, flips, blocks in zip(
            self.element_blocks, self.element_flips, element_blocks, strict=True
        ):
            turned = jnp.where(flips[:, None, None], jnp.swapaxes(blocks, 1, 2), blocks)
            windows = jnp.moveaxis(turned, 3, 1).reshape(-1, 9)
            total = total.at[places.reshape(-1)].add(windows)
        return total

    def values(self, blocks: Array) -> Array:
        """Entries (nnz,) of the sheet's own blocks (b, 9)."""
        return blocks.reshape(-1)[self.entry_places]

    def product(self, values: Array, x: Array) -> Array:
        """Symmetric matrix times vector (3n,)."""
        own = values[: self.nnz]
        upper = jnp.zeros_like(x).at[self.rows].add(own * x[self.indices], indices_are_sorted=True)
        strict = jnp.where(self.rows == self.indices, 0.0, own)
        product = upper.at[self.indices].add(strict * x[self.rows])
        return product + self.contact_product(values, x)

    def separate(self, values: Array) -> Array:
        """Own entries (nnz,) of a sheet whose parts do not know of one another: what contact takes from them
        because it gives it back by the blocks between them is left out. For preconditioners."""
        own = values[: self.nnz]
        if self.contact is None:
            return own
        return own.at[self.diagonal].add(jnp.repeat(self.contact.lift(values[self.nnz :]), 3))

    def expand(self, values: Array) -> Array:
        """Rows of 3x3 blocks (n, 3, 3k) of the sheet, both triangles: the form for repeated products."""
        return values[: self.nnz].at[self.row_entries].get(mode="fill", fill_value=0.0)

    def expanded_product(self, rows: Array, x: Array) -> Array:
        """The sheet's own matrix in the form of `expand` times vector (3n,)."""
        gathered = x.reshape(-1, 3)[self.neighbors].reshape(rows.shape[0], -1)
        return jnp.einsum("nas,ns->na", rows, gathered).reshape(-1)

    def contact_product(self, values: Array, x: Array) -> Array | float:
        """The blocks between touching triangles times vector (3n,); 0 without contact."""
        return 0.0 if self.contact is None else self.contact.product(values[self.nnz :], x)


def build_pattern(
    rest: np.ndarray, stencils: Sequence[np.ndarray], faces: np.ndarray | None = None
) -> Pattern:
    """Pattern of a tangent whose elements couple the nodes of each row of `stencils` (m, k).

    `rest` (n, 3): the nodes' rest positions in m, over which the coarse space is laid. `faces` (f, 3):
    triangles that may touch; their edges must be among the stencils.

    **Raises:** ValueError for more entries than memory or 32-bit indices hold.
    """
    n = len(rest)
    pairs = [_global_pairs(stencil) for stencil in stencils]
    own = np.stack([np.arange(n)] * 2, axis=1)
    rows, cols = np.concatenate([own, *(p.reshape(-1, 2) for p in pairs)]).T
    keys = np.unique(np.minimum(rows, cols).astype(np.int64) * n + np.maximum(rows, cols))
    block_row, block_col = keys // n, keys % n
    _check_size(n, block_row, block_col)
    entries, counts = scalar_entries(n, block_row, block_col)
    indptr = np.concatenate([[0], np.cumsum(counts)])
    order = np.repeat(np.arange(3 * n), counts)
    indices = _column_indices(entries, block_col, indptr[-1])

    def locate(pairs: np.ndarray) -> np.ndarray:
        """Blocks (...) of node pairs (..., 2)."""
        return np.searchsorted(keys, pairs.min(axis=-1).astype(np.int64) * n + pairs.max(axis=-1))

    node_blocks = locate(own)
    diagonal = entries[node_blocks][:, np.arange(3), np.arange(3)].reshape(-1)
    kept = np.flatnonzero(entries.reshape(-1) < indptr[-1])
    places = np.empty(indptr[-1], np.int64)
    places[entries.reshape(-1)[kept]] = kept

    neighbors, row_entries = _rows(n, block_row, block_col, entries)

    def device(a: np.ndarray) -> Array:
        return jnp.asarray(a.astype(np.int32))

    return Pattern(
        device(indptr), device(indices), device(order), device(diagonal), device(places), device(node_blocks),
        tuple(device(locate(p)) for p in pairs), tuple(jnp.asarray(p[..., 0] > p[..., 1]) for p in pairs),
        device(neighbors), device(row_entries),
        build_coarse_space(rest, np.stack([block_row, block_col], axis=1)),
        None if faces is None else _no_contact(locate, np.asarray(faces)),
    )  # fmt: skip


def _check_size(n: int, block_row: np.ndarray, block_col: np.ndarray) -> None:
    """Refuse a tangent that is too large, or rows that are as long as one node's with too many neighbours."""
    neighbors = np.bincount(block_row, minlength=n) + np.bincount(block_col, minlength=n) - 1
    node, longest = int(np.argmax(neighbors)), float(neighbors.max())
    what, fewer = f"the tangent of {n} nodes", "give a mesh of fewer nodes"
    cure = f"{fewer}, or remesh around node {node}, which is coupled to {int(longest)}"
    require_indices(9.0 * len(block_row), what, cure)
    require(ENTRY * 9.0 * len(block_row) + 16.0 * 9.0 * n * longest, what, cure)


def _no_contact(locate, faces: np.ndarray) -> Cross:
    """Contact of triangles none of which touches another."""
    blocks = locate(faces[:, np.array(upper_pairs(3))])
    two, six = jnp.zeros((1, 2), jnp.int32), jnp.zeros((1, 6), jnp.int32)
    return Cross(jnp.asarray(blocks.astype(np.int32)), two, six, jnp.asarray(0), None)


def _global_pairs(stencil: np.ndarray) -> np.ndarray:
    """Node pairs (pairs, m, 2) of every element."""
    stencil = np.asarray(stencil)
    return np.stack([stencil[:, list(pair)] for pair in upper_pairs(stencil.shape[1])])


def scalar_entries(n: int, block_row: np.ndarray, block_col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entry number of each scalar of each upper block, and the number of entries of each scalar row."""
    blocks_in_row = np.bincount(block_row, minlength=n)
    first_block = np.concatenate([[0], np.cumsum(blocks_in_row)])[:-1]
    component = np.arange(3)
    # A diagonal block keeps 3 - i entries of its row i; every other block keeps 3.
    counts = (3 * blocks_in_row[:, None] - component[None, :]).reshape(-1)
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1].reshape(n, 3)
    rank = np.arange(len(block_row)) - first_block[block_row]
    offset = 3 * rank[:, None, None] - component[None, :, None] + component[None, None, :]
    entries = starts[block_row][:, :, None] + offset
    below = (block_row == block_col)[:, None, None] & (component[:, None] > component[None, :])
    return np.where(below, counts.sum(), entries), counts


def _column_indices(entries: np.ndarray, block_col: np.ndarray, nnz: int) -> np.ndarray:
    columns = np.broadcast_to(3 * block_col[:, None, None] + np.arange(3), entries.shape)
    indices = np.empty(nnz + 1, dtype=np.int64)
    indices[entries.reshape(-1)] = columns.reshape(-1)
    return indices[:-1]


def _rows(
    n: int, block_row: np.ndarray, block_col: np.ndarray, entries: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`neighbors` and `row_entries` of a `Pattern` from its upper blocks."""
    off = block_row != block_col
    row = np.concatenate([block_row, block_col[off]])
    col = np.concatenate([block_col, block_row[off]])
    blocks = np.concatenate([entries, np.swapaxes(entries[off], 1, 2)])
    # Below the diagonal a diagonal block repeats what is above it.
    own = np.flatnonzero(~off)
    blocks[own] = np.minimum(blocks[own], np.swapaxes(blocks[own], 1, 2))
    order = np.lexsort((col, row))
    row, col, blocks = row[order], col[order], blocks[order]
    counts = np.bincount(row, minlength=n)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    neighbors = np.repeat(np.arange(n)[:, None], counts.max(), axis=1)
    neighbors[row, rank] = col
    row_entries = np.full((n, counts.max(), 3, 3), entries.max())
    row_entries[row, rank] = blocks
    return neighbors, np.moveaxis(row_entries, 2, 1).reshape(n, 3, -1)
