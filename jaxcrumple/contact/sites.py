"""The lattice of sites on every triangle (Fig. 2), for how much a site counts, and what sites take."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from jaxcrumple._jax.memory import require, require_indices, times_that_fit
from jaxcrumple.mesh.mesh import Mesh

# Bytes: of a site of one triangle while the lattice is built, of a pair of sites in the lists and their
# copies, and of a pair of triangles in the search for candidates.
SITE, PAIR, CANDIDATE = 200.0, 90.0, 100.0
# Pairs of sites in the lists for each site of the sheet: where it touches itself along a few folds, and in a
# dense crumple, with the room that lists keep (0.36 in a crumple to a third of its size, n = 1000).
PAIRS = (0.01, 0.5)
# Refinement from which on 32-bit numbers do not count the sites of a triangle.
MOST_LEVEL = 65_000


class Sites(NamedTuple):
    """The lattice of sites on every triangle: barycentric `weights` (s, 3), `share` (s,) of its area, and
    `place` (s,): 0 inside, 1 + k on the side opposite to corner k, 4 + k at that corner."""

    weights: np.ndarray
    share: np.ndarray
    place: np.ndarray


def build_sites(level: int) -> Sites:
    """Sites of a refinement `level`: as many on an edge between its ends (Fig. 2), corners included."""
    parts = level + 1
    i = np.repeat(np.arange(parts + 1), np.arange(parts + 1, 0, -1))
    j = np.concatenate([np.arange(parts + 1 - row) for row in range(parts + 1)])
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


def require_sites(faces: int, level: int, sigma: float, *, chosen: bool) -> None:
    """Refuse more sites than memory holds, before any is made; warn where a dense crumple may need too much.

    **Arguments:** `faces` of the sheet; refinement `level`, which was `chosen` or follows from the range
    `sigma` in m.

    **Raises:** ValueError with an estimate and the level or the range that fits.
    """
    own = (level + 2.0) * (level + 3.0) / 2.0
    least, most = (SITE * own + PAIR * share * own * faces for share in PAIRS)
    what = f"contact of range {sigma:.3g} m at level {level}, with {own * faces:.2g} sites on the sheet,"
    # Of that level or range a dense crumple fits too.
    fitting = np.sqrt(times_that_fit(most))
    if chosen:
        cure = f"choose a contact level of at most {max(int(fitting * (level + 2)) - 3, 0)}"
    else:
        fits = _rounded_up(sigma / fitting)
        cure = f"choose a contact range, by default the thickness, of at least {fits} m, or no contact"
    require(least, what, cure, most)
    require_indices(own, what, cure)


def require_candidates(mesh: Mesh, sigma: float) -> None:
    """Refuse a range `sigma` in m, or a mesh, by which more triangles are near one another than memory holds.

    **Raises:** ValueError with an estimate.
    """
    faces = len(mesh.faces)
    if times_that_fit(CANDIDATE * faces**2) > 1.0:
        return
    corners = mesh.vertices[mesh.faces]
    center = corners.mean(axis=1)
    widest = 2.0 * float(np.linalg.norm(corners - center[:, None], axis=2).max())
    tree = cKDTree(center)
    pairs = (float(tree.count_neighbors(tree, widest + sigma)) - faces) / 2.0
    cure = "give triangles of more equal size" if widest > sigma else "choose a smaller contact range"
    require(CANDIDATE * pairs, f"the search for {pairs:.2g} pairs of triangles that may meet", cure)


def _rounded_up(value: float) -> str:
    """Two digits, not below the value."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return f"{np.ceil(value / unit) * unit:.2g}"
