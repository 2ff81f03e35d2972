"""The tangent's sparsity pattern and the maps that assemble it, built once on the host."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple.model.stencil import upper_pairs


class Pattern(eqx.Module):
    """Upper triangle (diagonal included) of a symmetric matrix in compressed sparse rows.

    Degrees of freedom are numbered 3 * node + component. Arrays are data, not constants of the
    program: another mesh of the same size runs the same executable.

    - `indptr` (3n+1,), `indices` (nnz,), `rows` (nnz,): int32.
    - `diagonal` (3n,): entry of each diagonal element.
    - `node_entries` (n, 3, 3): entry of each element of the nodes' own blocks.
    - `element_entries`: one (pairs * 9 * m,) map per stencil, `nnz` where an element falls below the
      diagonal and is dropped.
    """

    indptr: Array
    indices: Array
    rows: Array
    diagonal: Array
    node_entries: Array
    element_entries: tuple[Array, ...]

    @property
    def nnz(self) -> int:
        """Stored entries."""
        return self.indices.shape[0]

    def assemble(self, element_blocks: Sequence[Array], node_blocks: Array) -> Array:
        """Values (nnz,) from element blocks (pairs, 3, 3, m), one per stencil, and node blocks (n, 3, 3)."""
        values = jnp.zeros(self.nnz, node_blocks.dtype)
        values = values.at[self.node_entries].add(node_blocks, mode="drop")
        for entries, blocks in zip(self.element_entries, element_blocks, strict=True):
            values = values.at[entries].add(blocks.reshape(-1), mode="drop")
        return values

    def product(self, values: Array, x: Array) -> Array:
        """Symmetric matrix times vector (3n,)."""
        upper = jnp.zeros_like(x).at[self.rows].add(values * x[self.indices], indices_are_sorted=True)
        strict = jnp.where(self.rows == self.indices, 0.0, values)
        return upper.at[self.indices].add(strict * x[self.rows])


def build_pattern(n: int, stencils: Sequence[np.ndarray]) -> Pattern:
    """Pattern of a tangent whose elements couple the nodes of each row of `stencils` (m, k)."""
    pairs = [_global_pairs(stencil) for stencil in stencils]
    own = np.stack([np.arange(n)] * 2, axis=1)
    rows, cols = np.concatenate([own, *(p.reshape(-1, 2) for p in pairs)]).T
    keys = np.unique(np.minimum(rows, cols).astype(np.int64) * n + np.maximum(rows, cols))
    block_row, block_col = keys // n, keys % n
    entries, counts = _scalar_entries(n, block_row, block_col)
    indptr = np.concatenate([[0], np.cumsum(counts)])
    order = np.repeat(np.arange(3 * n), counts)
    indices = _column_indices(entries, block_col, indptr[-1])

    def locate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Entries (..., 3, 3) of block (a, b); what lies below the diagonal maps to nnz."""
        block = np.searchsorted(keys, np.minimum(a, b).astype(np.int64) * n + np.maximum(a, b))
        found = entries[block]
        return np.where((a > b)[..., None, None], np.swapaxes(found, -1, -2), found)

    node = np.arange(n)
    node_entries = locate(node, node)
    maps = [_element_map(locate, p) for p in pairs]
    diagonal = node_entries[:, np.arange(3), np.arange(3)].reshape(-1)

    def device(a: np.ndarray) -> Array:
        return jnp.asarray(a.astype(np.int32))

    return Pattern(
        device(indptr), device(indices), device(order), device(diagonal), device(node_entries),
        tuple(device(m) for m in maps),
    )  # fmt: skip


def _global_pairs(stencil: np.ndarray) -> np.ndarray:
    """Node pairs (pairs, m, 2) of every element."""
    stencil = np.asarray(stencil)
    return np.stack([stencil[:, list(pair)] for pair in upper_pairs(stencil.shape[1])])


def _scalar_entries(n: int, block_row: np.ndarray, block_col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def _element_map(locate, pairs: np.ndarray) -> np.ndarray:
    """Flat map for blocks (pairs, 3, 3, m); a pair of two local nodes adds to one triangle only."""
    entries = locate(pairs[..., 0], pairs[..., 1])
    return np.moveaxis(entries, 1, -1).reshape(-1)
