"""Elements and their nodes: gather positions, scatter forces, order the pairs of a block Hessian."""

import jax.numpy as jnp
from jax.ops import segment_sum
from jaxtyping import Array, Int

from jaxcrumple._jax.arrays import NodeVectors
from jaxcrumple.geometry.hinge import Vec


def upper_pairs(size: int) -> tuple[tuple[int, int], ...]:
    """Local node pairs (a, b), a <= b, in the order in which block Hessians list them."""
    return tuple((a, b) for a in range(size) for b in range(a, size))


def scatter(nodes: Int[Array, "elements corners"], vectors: tuple[Vec, ...], n: int) -> NodeVectors:
    """Sum element vectors at their nodes.

    **Arguments:** `nodes` (m, k) node numbers; `vectors` k vectors with components (m,); `n` nodes.

    **Returns:** (n, 3).
    """
    index = jnp.concatenate([nodes[:, k] for k in range(nodes.shape[1])])
    components = [
        segment_sum(jnp.concatenate([vector[i] for vector in vectors]), index, num_segments=n)
        for i in range(3)
    ]
    return jnp.stack(components, axis=1)
