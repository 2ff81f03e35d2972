"""Contact blocks of the tangent: 3x3 blocks between the nodes of two triangles in contact.

The pairs in contact change, so that their blocks are stored separately from the sheet's pattern, as a list of
pairs of triangles. The blocks between nodes of the same triangle are part of the sheet's pattern. A direct
solver needs all blocks in one matrix; `Merger` builds its structure on the host (`MatrixPairs`).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Count, Flag, NodeValues, NodeVectors
from jaxcrumple._jax.device import on_accelerator
from jaxcrumple._jax.padded import accumulate
from jaxcrumple.contact.lists import MatrixPairs, SitePairs, pair_key

# Values of a pair of triangles in the tangent: a 3x3 block for each node of the first and of the second.
SIZE = 81
# Pairs of triangles that are processed together.
CHUNK = 128


class ContactBlocks(eqx.Module):
    """Describe the blocks between the triangles in contact.

    - `triangles` (t, 2), `nodes` (t, 6): pairs of triangles and their nodes; the first `count` are valid.
    - `n_faces`: number of triangles of the sheet.
    - `matrix`: structure of the matrix of sheet and contact, or None if the linear solver does not need it.
    """

    triangles: Int[Array, "triangles 2"]
    nodes: Int[Array, "triangles 6"]
    count: Count
    matrix: MatrixPairs | None
    n_faces: int = eqx.field(static=True)

    @classmethod
    def of(
        cls, pairs: SitePairs, faces: Int[Array, "faces 3"], matrix: MatrixPairs | None
    ) -> "ContactBlocks":
        """Return the blocks of the listed `pairs` of the triangles `faces` (f, 3)."""
        nodes = faces[pairs.triangles].reshape(-1, 6)
        return cls(pairs.triangles, nodes, pairs.triangle_count, matrix, faces.shape[0])

    @property
    def size(self) -> int:
        """Return the number of values of all blocks."""
        return SIZE * self.triangles.shape[0]

    def product(
        self, appended: Float[Array, " appended"], x: Float[Array, " components"]
    ) -> Float[Array, " components"]:
        """Multiply the blocks in the appended values (81 t + n,) by a vector (3n,)."""

        def add(
            total: NodeVectors,
            arguments: tuple["ContactBlocks", Float[Array, "triangles 3 3 3 3"], NodeVectors],
            at: Int[Array, " chunk"],
            held: Bool[Array, " chunk"],
        ) -> NodeVectors:
            contact, blocks, points = arguments
            blocks, nodes = _kept(blocks[at], held), contact.nodes[at]
            first = jnp.einsum("tijab,tjb->tia", blocks, points[nodes[:, 3:]])
            second = jnp.einsum("tijab,tia->tjb", blocks, points[nodes[:, :3]])
            return total.at[nodes].add(jnp.concatenate([first, second], axis=1))

        points, room = x.reshape(-1, 3), self.triangles.shape[0]
        arguments = (self, self._blocks(appended), points)
        if on_accelerator():
            every = jnp.arange(room)
            return add(jnp.zeros_like(points), arguments, every, every < self.count).reshape(-1)
        return accumulate(add, jnp.zeros_like(points), arguments, self.count, room, CHUNK).reshape(-1)

    def free(
        self, appended: Float[Array, " appended"], mask: Bool[Array, "nodes 3"]
    ) -> Float[Array, " appended"]:
        """Set rows and columns of components in `mask` (n, 3) to zero in the appended values."""
        one, two = mask[self.nodes[:, :3]], mask[self.nodes[:, 3:]]
        fixed = one[:, :, None, :, None] | two[:, None, :, None, :]
        blocks = jnp.where(fixed, 0.0, self._blocks(appended)).reshape(-1)
        return jnp.concatenate([blocks, self.lift(appended)])

    def lift(self, appended: Float[Array, " appended"]) -> NodeValues:
        """Return the diagonal correction (n,) for uses of the sheet's part without the contact blocks."""
        return appended[self.size :]

    def upper(self, appended: Float[np.ndarray, " appended"], size: int) -> "scipy.sparse.csr_array":
        """Convert the appended values to the upper triangle of a matrix (size, size)."""
        nodes = np.asarray(self.nodes)
        row = np.broadcast_to(
            3 * nodes[:, :3, None, None, None] + np.arange(3)[:, None], (len(nodes), 3, 3, 3, 3)
        ).reshape(-1)
        column = np.broadcast_to(
            3 * nodes[:, None, 3:, None, None] + np.arange(3), (len(nodes), 3, 3, 3, 3)
        ).reshape(-1)
        matrix = scipy.sparse.csr_array((appended[: self.size], (row, column)), shape=(size, size))
        return scipy.sparse.csr_array(scipy.sparse.triu(matrix + matrix.T))

    def merge(
        self, own: Float[Array, " entries"], appended: Float[Array, " appended"]
    ) -> Float[Array, " merged"]:
        """Compute the values (e,) of the matrix of sheet and contact, without pairs that lack entries."""
        assert self.matrix is not None
        matrix = self.matrix
        values = jnp.zeros(matrix.indices.shape[0], own.dtype).at[matrix.place].set(own)

        def add(
            total: Float[Array, " merged"],
            arguments: tuple["ContactBlocks", MatrixPairs, Float[Array, "triangles 3 3 3 3"]],
            at: Int[Array, " chunk"],
            held: Bool[Array, " chunk"],
        ) -> Float[Array, " merged"]:
            contact, matrix, blocks = arguments
            nodes = contact.nodes[at]
            twice = nodes[:, :3, None] == nodes[:, None, 3:]
            # At a shared node both a block and its transpose fall on the same diagonal block.
            factor = jnp.where(twice, 2.0, 1.0)[..., None, None]
            rows = contact._rows(matrix, at)
            entries = matrix.entries[rows]
            # Pairs without entries are left out.
            held = held & (matrix.keys[rows] == contact._keys(at))
            return total.at[entries].add((_kept(blocks[at], held) * factor).reshape(-1, SIZE), mode="drop")

        arguments = (self, matrix, self._blocks(appended))
        return accumulate(add, values, arguments, self.count, self.triangles.shape[0], CHUNK)

    def entries(self, own: Int[Array, " some"]) -> Int[Array, " some"]:
        """Return the places in that matrix of the entries `own` of the sheet's pattern."""
        assert self.matrix is not None
        return self.matrix.place[own]

    def placed(self) -> Flag:
        """Return whether all pairs have entries in that matrix; True without such a matrix."""
        if self.matrix is None:
            return jnp.asarray(True)
        at = jnp.arange(self.triangles.shape[0])
        found = self.matrix.keys[self._rows(self.matrix, at)] == self._keys(at)
        return jnp.all(found | (at >= self.count))

    def _rows(self, matrix: MatrixPairs, at: Int[Array, " chunk"]) -> Int[Array, " chunk"]:
        """Return the rows in `matrix.keys` of the pairs `at` (c,); meaningless for pairs without entries."""
        return jnp.minimum(jnp.searchsorted(matrix.keys, self._keys(at)), matrix.keys.shape[0] - 1)

    def _keys(self, at: Int[Array, " chunk"]) -> Int[Array, " chunk"]:
        return pair_key(self.triangles[at], self.n_faces)

    def _blocks(self, appended: Float[Array, " appended"]) -> Float[Array, "triangles 3 3 3 3"]:
        """Reshape appended values to blocks (t, 3, 3, 3, 3): pair, node of the first and of the second
        triangle, components."""
        return appended[: self.size].reshape(-1, 3, 3, 3, 3)


def _kept(
    blocks: Float[Array, "chunk 3 3 3 3"], held: Bool[Array, " chunk"]
) -> Float[Array, "chunk 3 3 3 3"]:
    """Set those of `blocks` (c, 3, 3, 3, 3) to zero that are not `held` (c,)."""
    return jnp.where(held[:, None, None, None, None], blocks, 0.0)
