"""In-plane strain: relative change of length of the edges."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple.mesh.mesh import Mesh


def positions(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, "nodes 3"]:
    """Return `x` as float64 (n, 3) in m.

    **Raises:** ValueError unless it has one row of three finite coordinates for each node of `mesh`.
    """
    x = np.asarray(x, dtype=np.float64)
    if x.shape != (mesh.n_nodes, 3):
        raise ValueError(f"x has shape {x.shape}; give positions ({mesh.n_nodes}, 3) of this mesh in metres")
    check_finite("x", x)
    return x


def check_finite(name: str, values: Float[np.ndarray, " ..."]) -> None:
    """Check that all values are finite.

    **Raises:** ValueError that names the first row that is not finite.
    """
    bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
    if bad.size:
        raise ValueError(f"{name}[{bad[0]}] is {values[bad[0]]}; it must be finite")


def edge_length(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, " edges"]:
    """Return the length (e,) of the edges in m at positions `x` (n, 3)."""
    x = positions(mesh, x)
    return np.linalg.norm(x[mesh.edges[:, 1]] - x[mesh.edges[:, 0]], axis=1)


def edge_strain(mesh: Mesh, x: NodeVectorsLike) -> Float[np.ndarray, " edges"]:
    """Return the engineering strain (e,) of the edges, length / rest length - 1, at `x` (n, 3) in m.

    **Raises:** ValueError for a wrong shape of `x`.

    >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> longer = square.vertices * [1.01, 1.0, 1.0]  # 1 % in x
    >>> measure.edge_strain(square, longer).round(4)  # of square.edges
    array([0.01 , 0.005, 0.   , 0.   , 0.01 ])
    """
    return edge_length(mesh, x) / mesh.edge_length - 1.0


def rms_strain(mesh: Mesh, x: NodeVectorsLike) -> float:
    """Return the root mean square of `edge_strain`, unweighted, at `x` (n, 3) in m.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    return float(np.sqrt(np.mean(edge_strain(mesh, x) ** 2)))


def max_strain(mesh: Mesh, x: NodeVectorsLike) -> float:
    """Return the largest absolute value of `edge_strain` at `x` (n, 3) in m.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    return float(np.max(np.abs(edge_strain(mesh, x))))
