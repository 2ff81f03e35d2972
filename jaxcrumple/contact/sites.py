"""The lattice of sites on every triangle (Fig. 2), the weights of sites, and the memory they need."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import Scalar
from jaxcrumple._jax.memory import require, require_indices, times_that_fit
from jaxcrumple._jax.tree import as_array
from jaxcrumple.mesh.mesh import Mesh

# Bytes per site of one triangle while the lattice is built, per site pair in the lists with their copies, and
# per candidate pair of triangles in the broad phase.
SITE, PAIR, CANDIDATE = 200.0, 90.0, 100.0
# Site pairs in the lists per site of the sheet, with spare capacity: for contact along a few folds, and for a
# dense crumple (0.36 in a crumple to a third of its size, n = 1000).
PAIRS = (0.01, 0.5)
# Largest refinement level: 32-bit integers cannot number the sites of a triangle much beyond it.
MOST_LEVEL = 65_000


class Sites(NamedTuple):
    """Hold the lattice of sites on a triangle.

    `weights` (s, 3): barycentric coordinates; `share` (s,): share of the triangle's area; `place` (s,): 0
    inside, 1 + k on the side opposite to corner k, 4 + k at corner k.
    """

    weights: Float[np.ndarray, "sites 3"]
    share: Float[np.ndarray, " sites"]
    place: Int[np.ndarray, " sites"]


def build_sites(level: int) -> Sites:
    """Build the sites of a refinement `level`: the corners, `level` sites on each edge between them, and the
    inner sites (Fig. 2)."""
    parts = level + 1
    i = np.repeat(np.arange(parts + 1), np.arange(parts + 1, 0, -1))
    j = np.concatenate([np.arange(parts + 1 - row) for row in range(parts + 1)])
    corners = np.stack([i, j, parts - i - j], axis=1)
    # A site gets a third of each small triangle around it: one at a corner, three on a side, six inside.
    zeros = np.sum(corners == 0, axis=1)
    share = np.array([6, 3, 1])[zeros] / (3.0 * parts**2)
    side, corner = 1 + np.argmin(corners, axis=1), 4 + np.argmax(corners, axis=1)
    return Sites(corners / parts, share, np.choose(zeros, [0 * side, side, corner]))


def site_density(mesh: Mesh, sigma: Scalar | float) -> Float[Array, "faces 7"]:
    """Return the area (f, 7) of each triangle over $a_0$, by `place` of its sites, to multiply their `share`.

    At the free edge of the sheet it is larger, so that sites there count in full, as in the paper. With the
    area alone, two edges in contact would repel with a quarter of the force and pass through each other.
    """
    factor = np.ones((len(mesh.faces), 7))
    free, sides = mesh.edges[mesh.boundary_edges], mesh.faces[:, [[1, 2], [2, 0], [0, 1]]]
    keys = [np.sort(pairs, axis=-1).astype(np.int64) @ [mesh.n_nodes, 1] for pairs in (sides, free)]
    factor[:, 1:4] += np.isin(keys[0], keys[1])
    valence = np.bincount(mesh.faces.reshape(-1), minlength=mesh.n_nodes)
    ends = np.isin(mesh.faces, mesh.boundary_nodes)
    factor[:, 4:] = np.where(ends, 6.0 / valence[mesh.faces], 1.0)
    return as_array(factor * (mesh.face_area / (np.sqrt(3.0) / 2.0))[:, None] / sigma**2)


def require_sites(faces: int, level: int, sigma: float, *, chosen: bool) -> None:
    """Refuse sites that exceed the memory, before they are built; warn if a dense crumple may exceed it.

    **Arguments:** `faces`: number of triangles; `level`: refinement level; `sigma`: contact range in m;
    `chosen`: whether the user chose the level, which otherwise follows from the range.

    **Raises:** ValueError with an estimate, and a level or a range that fits.
    """
    own = (level + 2.0) * (level + 3.0) / 2.0
    least, most = (SITE * own + PAIR * share * own * faces for share in PAIRS)
    what = f"contact of range {sigma:.3g} m at level {level}, with {own * faces:.2g} sites on the sheet,"
    # The suggested level or range leaves memory for a dense crumple as well.
    fitting = np.sqrt(times_that_fit(most))
    if chosen:
        cure = f"choose a contact level of at most {max(int(fitting * (level + 2)) - 3, 0)}"
    else:
        fits = _rounded_up(sigma / fitting)
        cure = f"choose a contact range, by default the thickness, of at least {fits} m, or no contact"
    require(least, what, cure, most)
    require_indices(own, what, cure)


def require_candidates(mesh: Mesh, sigma: float) -> None:
    """Refuse a contact range `sigma` in m, or a mesh, whose candidate pairs of triangles exceed the memory.

    **Raises:** ValueError with an estimate.
    """
    faces = len(mesh.faces)
    if times_that_fit(CANDIDATE * faces**2) > 1.0:
        return
    corners = mesh.vertices[mesh.faces]
    center = corners.mean(axis=1)
    widest = 2.0 * float(np.linalg.norm(corners - center[:, None], axis=2).max())
    tree = scipy.spatial.cKDTree(center)
    pairs = (float(tree.count_neighbors(tree, widest + sigma)) - faces) / 2.0
    cure = "give triangles of more equal size" if widest > sigma else "choose a smaller contact range"
    require(CANDIDATE * pairs, f"the broad phase with {pairs:.2g} candidate pairs of triangles", cure)


def _rounded_up(value: float) -> str:
    """Format a value with two digits, rounded up."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return f"{np.ceil(value / unit) * unit:.2g}"
