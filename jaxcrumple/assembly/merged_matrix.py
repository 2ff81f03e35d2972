"""The merged matrix: the structure of sheet and contact in one matrix, built on the host."""

import numpy as np
from jaxtyping import Int

from jaxcrumple._jax.memory import require, require_indices
from jaxcrumple._jax.tree import as_array
from jaxcrumple.assembly.contact_blocks import SIZE
from jaxcrumple.assembly.sparsity import Pattern, scalar_entries
from jaxcrumple.contact.lists import NONE, SOON, MatrixPairs, doubled, pair_key

# Bytes of an entry of a pair of triangles.
BYTES = 8.0
# Capacity in new entries per pair, of its 81: most blocks of a pair also belong to other pairs.
ENTRIES = 10


class Merger:
    """Merge pairs of triangles into the pattern of a sheet."""

    def __init__(self, pattern: Pattern, faces: Int[np.ndarray, "faces 3"]) -> None:
        self.n = len(pattern.diagonal) // 3
        self.nnz = pattern.nnz
        self.faces = np.asarray(faces, np.int64)
        row, column = np.asarray(pattern.rows, np.int64) // 3, np.asarray(pattern.indices, np.int64) // 3
        self.keys = np.unique(row * self.n + column)
        entries, _ = scalar_entries(self.n, self.keys // self.n, self.keys % self.n)
        self.upper = entries.reshape(-1) < self.nnz
        # Entries are numbered by scalar rows, so that the entries of a block are not adjacent.
        self.order = entries.reshape(-1)[self.upper]

    def merge(self, triangles: Int[np.ndarray, "pairs 2"], capacity: int, spare: float = 1.0) -> MatrixPairs:
        """Build the structure for the sorted pairs `triangles` (c, 2), with room for `capacity` pairs.

        If `spare` times the pairs, or the entries that they add, exceed the capacity, it is doubled until it
        holds `SOON` times as many.

        **Raises:** ValueError for a matrix that exceeds memory or 32-bit indices."""
        n = self.n
        nodes = self.faces[triangles]
        a, b = np.broadcast_arrays(nodes[:, 0, :, None], nodes[:, 1, None, :])
        wanted = np.minimum(a, b) * n + np.maximum(a, b)
        keys = np.union1d(self.keys, wanted)
        row, column = keys // n, keys % n
        entries, counts = scalar_entries(n, row, column)
        nnz = int(counts.sum())
        needed = max(len(triangles), (nnz - self.nnz) / ENTRIES)
        if spare * needed > capacity:
            capacity = doubled(capacity, int(SOON * needed))
        room = self.nnz + ENTRIES * capacity
        what = f"the matrix of a direct solver, with room for {capacity} pairs of triangles in contact,"
        cure = "choose linear = 'two-level', or resume with a coarser mesh"
        require_indices(room, what, cure)
        require(BYTES * SIZE * capacity, what, cure)
        entries[entries == nnz] = room
        place = np.empty(self.nnz, np.int32)
        place[self.order] = entries[np.searchsorted(keys, self.keys)].reshape(-1)[self.upper]
        indices = np.zeros(room + 1, np.int32)
        indices[entries] = 3 * column[:, None, None] + np.arange(3)
        found = entries[np.searchsorted(keys, wanted)]
        found = np.where((a > b)[..., None, None], np.swapaxes(found, -1, -2), found)
        cross = np.full((capacity, SIZE), room, np.int32)
        cross[: len(nodes)] = found.reshape(-1, SIZE)
        indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        pairs = np.full(capacity, NONE)
        # NumPy, because JAX would compile this for every number of pairs.
        pairs[: len(triangles)] = pair_key(triangles, len(self.faces))
        arrays = (indptr, indices[:-1], place, pairs, cross)
        return MatrixPairs(*map(as_array, arrays))
