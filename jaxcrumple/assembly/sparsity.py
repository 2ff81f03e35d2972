"""Sparsity pattern of the tangent and the maps of its assembly, built once on the host."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Flag
from jaxcrumple._jax.memory import require, require_indices
from jaxcrumple._jax.tree import as_array, as_indices
from jaxcrumple.assembly.coarse_space import CoarseSpace, build_coarse_space
from jaxcrumple.assembly.contact_blocks import ContactBlocks
from jaxcrumple.model.elements import upper_pairs

# Bytes for each entry of the tangent during the construction of the pattern.
ENTRY = 40.0
# The length of rows is rounded up to a multiple of ROUND: random meshes have rows of 14 to 18 blocks.
ROUND = 6
# Precision of products of matrices in float32, whose factors a GPU otherwise rounds to 11 bits.
FULL = jax.lax.Precision.HIGHEST


class Pattern(eqx.Module):
    """Hold the upper triangle (diagonal included) of a symmetric matrix in compressed sparse rows.

    Degrees of freedom have the numbers 3 * node + component. Arrays are data, not constants of the
    program, so that another mesh of the same size uses the same executable.

    - `indptr` (3n+1,), `indices` (nnz,), `rows` (nnz,): int32.
    - `diagonal` (3n,): index of each diagonal entry.
    - `entry_places` (nnz,): index of each entry in the 3x3 blocks (b, 9) on and above the diagonal.
    - `node_blocks` (n,): index of the diagonal block of each node.
    - `element_blocks`: for each stencil a map (pairs, m) to the blocks of the node pairs of an element;
      `element_flips` (pairs, m): whether the first node of a pair has the larger number.
    - `neighbors` (n, k): block columns of each node's row, both triangles, padded with numbers of any node.
    - `row_entries` (n, 3, 3k): index of each entry of these blocks, `nnz` for padding.
    - `coarse`: smooth coarse space over the nodes, for two-level solvers.
    - `face_blocks` (f, 6): blocks within each triangle, ordered as `upper_pairs(3)`; None without contact.
    - `contact`: blocks between the triangles in contact, or None without contact lists. Their values follow
      the `nnz` values of the sheet; a diagonal (n,) follows them, see `separate`.
    """

    indptr: Int[Array, " starts"]
    indices: Int[Array, " entries"]
    rows: Int[Array, " entries"]
    diagonal: Int[Array, " components"]
    entry_places: Int[Array, " entries"]
    node_blocks: Int[Array, " nodes"]
    element_blocks: tuple[Int[Array, "_pairs _elements"], ...]
    element_flips: tuple[Bool[Array, "_pairs _elements"], ...]
    neighbors: Int[Array, "nodes neighbors"]
    row_entries: Int[Array, "nodes 3 3*neighbors"]
    coarse: CoarseSpace
    face_blocks: Int[Array, "faces 6"] | None = None
    contact: ContactBlocks | None = None

    @property
    def nnz(self) -> int:
        """Return the number of stored entries of the sheet."""
        return self.indices.shape[0]

    @property
    def size(self) -> int:
        """Return the length of the vector of values: those of the sheet, then those of contact."""
        return self.nnz + (0 if self.contact is None else self.contact.size + len(self.node_blocks))

    @property
    def placed(self) -> Flag:
        """Return whether all listed pairs have entries in the matrix of a direct solver; True without one."""
        return jnp.asarray(True) if self.contact is None else self.contact.placed()

    def padded(self, entries: int, neighbors: int, coarse: CoarseSpace) -> "Pattern":
        """Return the pattern for more `entries` and `neighbors`, with a `coarse` space of another size.

        The entries are those of blocks without elements, in the corner below the diagonal, where they are 0.
        The starts of the rows, which only direct solvers read, stay as they are.
        """
        n, own, width = len(self.node_blocks), self.nnz, self.neighbors.shape[1]
        spare, more = np.arange(entries - own), neighbors - width
        row_entries = np.where(self.row_entries == own, entries, self.row_entries).reshape(n, 3, width, 3)
        wide = np.pad(row_entries, ((0, 0), (0, 0), (0, more), (0, 0)), constant_values=entries)
        return replace(
            self,
            indices=as_indices(np.append(self.indices, 0 * spare)),
            rows=as_indices(np.append(self.rows, 0 * spare + 3 * n - 1)),
            entry_places=as_indices(np.append(self.entry_places, own + 3 * n + spare)),
            neighbors=as_indices(np.pad(self.neighbors, ((0, 0), (0, more)), mode="edge")),
            row_entries=as_indices(wide.reshape(n, 3, -1)),
            coarse=coarse,
        )

    def for_factors(self) -> "Pattern":
        """Return the pattern for solvers that factor the matrix: without a coarse space, and with rows of
        a rounded length. Meshes of other seeds then have arrays of the same sizes, and use one program."""
        longest = -(-self.neighbors.shape[1] // ROUND) * ROUND
        return self.padded(self.nnz, longest, self.coarse.emptied())

    def assemble(
        self,
        element_blocks: Sequence[Float[Array, "_pairs 3 3 _elements"]],
        node_blocks: Float[Array, "nodes 3 3"],
    ) -> Float[Array, "blocks 9"]:
        """Sum the blocks of elements (pairs, 3, 3, m), one array per stencil, and of nodes (n, 3, 3).

        Returns the sheet's blocks (b, 9)."""
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

    def values(self, blocks: Float[Array, "blocks 9"]) -> Float[Array, " entries"]:
        """Return the entries (nnz,) of the sheet's blocks (b, 9)."""
        return blocks.reshape(-1)[self.entry_places]

    def product(
        self, values: Float[Array, " values"], x: Float[Array, " components"]
    ) -> Float[Array, " components"]:
        """Multiply the symmetric matrix by a vector (3n,)."""
        own = upper_product(self.rows, self.indices, values[: self.nnz], x)
        return own + self.contact_product(values, x)

    def separate(self, values: Float[Array, " values"]) -> Float[Array, " entries"]:
        """Return the sheet's entries (nnz,) without the negative stiffness of contact, for preconditioners.

        A compressed pair adds negative transverse stiffness. Without the contact blocks it would make the
        sheet's part indefinite; the appended diagonal cancels it."""
        own = values[: self.nnz]
        if self.contact is None:
            return own
        return own.at[self.diagonal].add(jnp.repeat(self.contact.lift(values[self.nnz :]), 3))

    def expand(self, values: Float[Array, " values"]) -> Float[Array, "nodes 3 columns"]:
        """Return the sheet's rows of 3x3 blocks (n, 3, 3k), both triangles, for repeated products."""
        return values[: self.nnz].at[self.row_entries].get(mode="fill", fill_value=0.0)

    def expanded_product(
        self, rows: Float[Array, "nodes 3 columns"], x: Float[Array, " 3*nodes"]
    ) -> Float[Array, " 3*nodes"]:
        """Multiply the sheet's matrix, in the form of `expand`, by a vector (3n,)."""
        gathered = x.reshape(-1, 3)[self.neighbors].reshape(rows.shape[0], -1)
        return jnp.einsum("nas,ns->na", rows, gathered, precision=FULL).reshape(-1)

    def contact_product(
        self, values: Float[Array, " values"], x: Float[Array, " components"]
    ) -> Float[Array, " components"] | float:
        """Multiply the blocks between triangles in contact by a vector (3n,); 0 without contact."""
        return 0.0 if self.contact is None else self.contact.product(values[self.nnz :], x)


def upper_product(
    rows: Int[Array, " entries"],
    columns: Int[Array, " entries"],
    values: Float[Array, " entries"],
    x: Float[Array, " components"],
) -> Float[Array, " components"]:
    """Multiply a symmetric matrix by a vector (3n,), given the entries of its upper triangle, row by row."""
    upper = jnp.zeros_like(x).at[rows].add(values * x[columns], indices_are_sorted=True)
    strict = jnp.where(rows == columns, 0.0, values)
    return upper.at[columns].add(strict * x[rows])


def build_pattern(
    rest: Float[np.ndarray, "nodes 3"],
    stencils: Sequence[Int[np.ndarray, "_elements _corners"]],
    faces: Int[np.ndarray, "faces 3"] | None = None,
) -> Pattern:
    """Build the pattern of a tangent whose elements couple the nodes of each row of `stencils` (m, k).

    `rest` (n, 3): rest positions in m, which define the coarse space. `faces` (f, 3): triangles that may
    touch, or None without contact; the stencils must contain their edges.

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

    def locate(pairs: Int[np.ndarray, "*axes 2"]) -> Int[np.ndarray, " *axes"]:
        """Return the block numbers (...) of node pairs (..., 2)."""
        return np.searchsorted(keys, pairs.min(axis=-1).astype(np.int64) * n + pairs.max(axis=-1))

    node_blocks = locate(own)
    diagonal = entries[node_blocks][:, np.arange(3), np.arange(3)].reshape(-1)
    kept = np.flatnonzero(entries.reshape(-1) < indptr[-1])
    places = np.empty(indptr[-1], np.int64)
    places[entries.reshape(-1)[kept]] = kept

    neighbors, row_entries = _rows(n, block_row, block_col, entries)

    return Pattern(
        as_indices(indptr), as_indices(indices), as_indices(order), as_indices(diagonal), as_indices(places),
        as_indices(node_blocks),
        tuple(as_indices(locate(p)) for p in pairs), tuple(as_array(p[..., 0] > p[..., 1]) for p in pairs),
        as_indices(neighbors), as_indices(row_entries),
        build_coarse_space(rest, np.stack([block_row, block_col], axis=1)),
        None if faces is None else as_indices(locate(np.asarray(faces)[:, np.array(upper_pairs(3))])),
    )  # fmt: skip


def _check_size(n: int, block_row: Int[np.ndarray, " blocks"], block_col: Int[np.ndarray, " blocks"]) -> None:
    """Reject a tangent that is too large, alone or because one node has too many neighbours.

    All rows are padded to the longest one."""
    neighbors = np.bincount(block_row, minlength=n) + np.bincount(block_col, minlength=n) - 1
    node, longest = int(np.argmax(neighbors)), float(neighbors.max())
    what, fewer = f"the tangent of {n} nodes", "give a mesh of fewer nodes"
    cure = f"{fewer}, or remesh around node {node}, which is coupled to {int(longest)} nodes"
    require_indices(9.0 * len(block_row), what, cure)
    require(ENTRY * 9.0 * len(block_row) + 16.0 * 9.0 * n * longest, what, cure)


def _global_pairs(stencil: Int[np.ndarray, "elements corners"]) -> Int[np.ndarray, "pairs elements 2"]:
    """Return the node pairs (pairs, m, 2) of every element."""
    stencil = np.asarray(stencil)
    return np.stack([stencil[:, list(pair)] for pair in upper_pairs(stencil.shape[1])])


def scalar_entries(
    n: int, block_row: Int[np.ndarray, " blocks"], block_col: Int[np.ndarray, " blocks"]
) -> tuple[Int[np.ndarray, "blocks 3 3"], Int[np.ndarray, " components"]]:
    """Number the scalar entries of the upper blocks; also return the number of entries of each scalar row.

    Entries below the diagonal get the total number of entries."""
    blocks_in_row = np.bincount(block_row, minlength=n)
    first_block = np.concatenate([[0], np.cumsum(blocks_in_row)])[:-1]
    component = np.arange(3)
    # A diagonal block has 3 - i entries in its row i; every other block has 3.
    counts = (3 * blocks_in_row[:, None] - component[None, :]).reshape(-1)
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1].reshape(n, 3)
    rank = np.arange(len(block_row)) - first_block[block_row]
    offset = 3 * rank[:, None, None] - component[None, :, None] + component[None, None, :]
    entries = starts[block_row][:, :, None] + offset
    below = (block_row == block_col)[:, None, None] & (component[:, None] > component[None, :])
    return np.where(below, counts.sum(), entries), counts


def _column_indices(
    entries: Int[np.ndarray, "blocks 3 3"], block_col: Int[np.ndarray, " blocks"], nnz: int
) -> Int[np.ndarray, " entries"]:
    columns = np.broadcast_to(3 * block_col[:, None, None] + np.arange(3), entries.shape)
    indices = np.empty(nnz + 1, dtype=np.int64)
    indices[entries.reshape(-1)] = columns.reshape(-1)
    return indices[:-1]


def _rows(
    n: int,
    block_row: Int[np.ndarray, " blocks"],
    block_col: Int[np.ndarray, " blocks"],
    entries: Int[np.ndarray, "blocks 3 3"],
) -> tuple[Int[np.ndarray, "nodes neighbors"], Int[np.ndarray, "nodes 3 3*neighbors"]]:
    """Compute `neighbors` and `row_entries` of a `Pattern` from its upper blocks."""
    off = block_row != block_col
    row = np.concatenate([block_row, block_col[off]])
    col = np.concatenate([block_col, block_row[off]])
    blocks = np.concatenate([entries, np.swapaxes(entries[off], 1, 2)])
    # The entries of a diagonal block below the diagonal equal those above it.
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
