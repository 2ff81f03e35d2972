"""The lattice of sites on every triangle (Fig. 2), and for how much a site counts."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcrumple.mesh import Mesh


class Sites(NamedTuple):
    """The lattice of sites on every triangle: barycentric `weights` (s, 3), `share` (s,) of its area, and
    `place` (s,): 0 inside, 1 + k on the side opposite to corner k, 4 + k at that corner."""

    weights: np.ndarray
    share: np.ndarray
    place: np.ndarray


def build_sites(level: int) -> Sites:
    """Sites of a refinement `level`: as many on an edge between its ends (Fig. 2), corners included."""
    parts = level + 1
    i, j = np.array([(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]).T
    corners = np.stack([i, j, parts - i - j], axis=1)
    # A third of each of the small triangles around a site, of which a corner has 1, a side 3, the inside 6.
    zeros = np.sum(corners == 0, axis=1)
    share = np.array([6, 3, 1])[zeros] / (3.0 * parts**2)
    side, corner = 1 + np.argmin(corners, axis=1), 4 + np.argmax(corners, axis=1)
    return Sites(corners / parts, share, np.choose(zeros, [0 * side, side, corner]))


def site_density(mesh: Mesh, sigma: Any) -> Any:
    """Areas (f, 7) over $a_0$ by which a triangle's sites count, by their `place`: its own, and at the free
    edge of the sheet so much more that sites there count in full, as in the paper. By their area alone two
    edges that meet would push with a quarter of the force, and press through one another."""
    factor = np.ones((len(mesh.faces), 7))
    free, sides = mesh.edges[mesh.boundary_edges], mesh.faces[:, [[1, 2], [2, 0], [0, 1]]]
    keys = [np.sort(pairs, axis=-1).astype(np.int64) @ [mesh.n_nodes, 1] for pairs in (sides, free)]
    factor[:, 1:4] += np.isin(keys[0], keys[1])
    valence = np.bincount(mesh.faces.reshape(-1), minlength=mesh.n_nodes)
    ends = np.isin(mesh.faces, mesh.boundary_nodes)
    factor[:, 4:] = np.where(ends, 6.0 / valence[mesh.faces], 1.0)
    return jnp.asarray(factor * (mesh.face_area / (np.sqrt(3.0) / 2.0))[:, None] / sigma**2)
