"""The part of the tangent that contact adds: 3x3 blocks between the nodes of two triangles that touch.

It comes and goes, so it is kept beside the sheet's own pattern, as a list of pairs of triangles. The blocks
of a triangle's own nodes have a place in the sheet's pattern already. A direct solver needs all in one
matrix, whose structure `Merger` makes on the host for a list of pairs.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
from jax import Array

from jaxcrumple._jax.padded import accumulate
from jaxcrumple.contact.lists import pair_key

# Numbers that a pair of triangles adds to the tangent's values: a block for each node of one and of the
# other.
SIZE = 81
# Pairs of triangles that are looked at together.
CHUNK = 128


class Merged(eqx.Module):
    """Sheet and contact in one matrix of compressed sparse rows.

    `indptr` (3n+1,), `indices` (room,), of which those beyond the last row are never read; `place` (nnz,) of
    the sheet's own entries; `keys` (c,) of pairs of triangles, sorted, and `cross` (c, 81): entries of their
    blocks, room where dropped.
    """

    indptr: Array
    indices: Array
    place: Array
    keys: Array
    cross: Array


class Cross(eqx.Module):
    """Blocks between touching triangles.

    - `face_blocks` (f, 6): the pattern's blocks of a triangle's own nodes, as `upper_pairs(3)`.
    - `triangles` (t, 2), `nodes` (t, 6), of which the first `count` are valid.
    - `merged`: the whole matrix, or None where no direct solver needs it.
    """

    face_blocks: Array
    triangles: Array
    nodes: Array
    count: Array
    merged: Merged | None

    @property
    def size(self) -> int:
        """Numbers of all blocks."""
        return SIZE * self.triangles.shape[0]

    def product(self, appended: Array, x: Array) -> Array:
        """Appended values (81 t + n,) times vector (3n,)."""

        def add(total: Array, arguments: tuple["Cross", Array, Array], at: Array, held: Array) -> Array:
            cross, blocks, points = arguments
            blocks, nodes = _kept(blocks[at], held), cross.nodes[at]
            one, two = nodes[:, :3], nodes[:, 3:]
            first = jnp.einsum("tijab,tjb->tia", blocks, points[two])
            second = jnp.einsum("tijab,tia->tjb", blocks, points[one])
            return total.at[one].add(first).at[two].add(second)

        points, room = x.reshape(-1, 3), self.triangles.shape[0]
        arguments = (self, self._blocks(appended), points)
        return accumulate(add, jnp.zeros_like(points), arguments, self.count, room, CHUNK).reshape(-1)

    def free(self, appended: Array, mask: Array) -> Array:
        """Appended values with rows and columns of components in `mask` (n, 3) set to zero."""
        one, two = mask[self.nodes[:, :3]], mask[self.nodes[:, 3:]]
        fixed = one[:, :, None, :, None] | two[:, None, :, None, :]
        blocks = jnp.where(fixed, 0.0, self._blocks(appended)).reshape(-1)
        return jnp.concatenate([blocks, self.lift(appended)])

    def lift(self, appended: Array) -> Array:
        """The diagonal (n,) that the sheet's own part needs where it stands without the blocks."""
        return appended[self.size :]

    def upper(self, appended: np.ndarray, size: int) -> sparse.csr_array:
        """Appended values as the upper triangle of a matrix (size, size)."""
        nodes = np.asarray(self.nodes)
        row = np.broadcast_to(
            3 * nodes[:, :3, None, None, None] + np.arange(3)[:, None], (len(nodes), 3, 3, 3, 3)
        ).reshape(-1)
        column = np.broadcast_to(
            3 * nodes[:, None, 3:, None, None] + np.arange(3), (len(nodes), 3, 3, 3, 3)
        ).reshape(-1)
        matrix = sparse.csr_array((appended[: self.size], (row, column)), shape=(size, size))
        return sparse.csr_array(sparse.triu(matrix + matrix.T))

    def merge(self, own: Array, appended: Array) -> Array:
        """Values of the merged matrix (room,)."""
        assert self.merged is not None
        merged = self.merged
        values = jnp.zeros(merged.indices.shape[0], own.dtype).at[merged.place].set(own)

        def add(total: Array, arguments: tuple["Cross", Merged, Array], at: Array, held: Array) -> Array:
            cross, merged, blocks = arguments
            nodes = cross.nodes[at]
            twice = nodes[:, :3, None] == nodes[:, None, 3:]
            # A node that both triangles have is met from both sides.
            factor = jnp.where(twice, 2.0, 1.0)[..., None, None]
            entries = merged.cross[cross._rows(merged, at)]
            return total.at[entries].add((_kept(blocks[at], held) * factor).reshape(-1, SIZE), mode="drop")

        arguments = (self, merged, self._blocks(appended))
        return accumulate(add, values, arguments, self.count, self.triangles.shape[0], CHUNK)

    def placed(self) -> Array:
        """Whether all pairs have a place in the merged matrix, where there is one."""
        if self.merged is None:
            return jnp.asarray(True)
        at = jnp.arange(self.triangles.shape[0])
        found = self.merged.keys[self._rows(self.merged, at)] == self._keys(at)
        return jnp.all(found | (at >= self.count))

    def _rows(self, merged: Merged, at: Array) -> Array:
        """Where pairs at places (c,) are in a merged matrix, if they are."""
        return jnp.minimum(jnp.searchsorted(merged.keys, self._keys(at)), merged.keys.shape[0] - 1)

    def _keys(self, at: Array) -> Array:
        return pair_key(self.triangles[at], self.face_blocks.shape[0])

    def _blocks(self, appended: Array) -> Array:
        """Blocks (t, 3, 3, 3, 3) of appended values: pair of triangles, node of the one, of the other,
        components."""
        return appended[: self.size].reshape(-1, 3, 3, 3, 3)


def _kept(blocks: Array, held: Array) -> Array:
    """Those of `blocks` (c, 3, 3, 3, 3) that are `held` (c,), zeros for the others."""
    return jnp.where(held[:, None, None, None, None], blocks, 0.0)
