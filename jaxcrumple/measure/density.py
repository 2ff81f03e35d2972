"""Energy density on the faces, from the energy of edges and hinges."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int, Real

from jaxcrumple._jax.arrays import HingeValuesLike, NodeVectorsLike, ScalarLike
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import require_shape
from jaxcrumple.measure.creases import hinge_angles, plastic_curvature
from jaxcrumple.measure.strain import edge_length
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.bending import hinge_energy


@door
def face_stretch_density(
    mesh: Mesh, x: NodeVectorsLike, ks: Real[ArrayLike, " edges"] | ScalarLike
) -> Float[np.ndarray, " faces"]:
    """Return the stretching energy per rest area (f,) in J/m2 at positions `x` (n, 3) in m.

    `ks`: spring constants (e,), or one for all edges, in N/m. The faces of an edge share its energy (eq. 11)
    equally, so that density times `mesh.face_area` sums to the energy of the sheet.

    **Raises:** ValueError for a wrong shape of `x` or `ks`.
    """
    require_shape("ks", ks, (), (len(mesh.edges),))
    energy = 0.5 * np.asarray(ks) * (edge_length(mesh, x) - mesh.edge_length) ** 2
    of_face = face_edges(mesh)
    owners = np.bincount(of_face.ravel(), minlength=len(mesh.edges))
    return (energy / owners)[of_face].sum(axis=1) / mesh.face_area


@door
def face_bending_density(
    mesh: Mesh, x: NodeVectorsLike, p: HingeValuesLike, stiffness: HingeValuesLike
) -> Float[np.ndarray, " faces"]:
    """Return the stored bending energy per rest area (f,) in J/m2 at positions `x` (n, 3) in m.

    `p`: rest curvature (h,); `stiffness`: kb times `Mesh.hinge_weight` (h,) in J, which is
    `scene.bending.stiffness`. Each face of a hinge receives half of the hinge energy (eq. 31, with the stop
    that keeps faces apart), so that density times `mesh.face_area` sums to the energy of the sheet.

    **Raises:** ValueError for a wrong shape of `x`, `p` or `stiffness`.
    """
    for name, values in (("p", p), ("stiffness", stiffness)):
        require_shape(name, values, (len(mesh.hinges),))
    theta = hinge_angles(mesh, x)
    energy = hinge_energy(jnp.asarray(theta), jnp.asarray(p), jnp.asarray(stiffness))
    return _to_faces(mesh, 0.5 * np.asarray(energy)) / mesh.face_area


def face_plastic_curvature(mesh: Mesh, p: HingeValuesLike) -> Float[np.ndarray, " faces"]:
    """Return the mean damage (f,) of the hinges of each face, dimensionless, or 0 for a face without hinges.

    The damage of a hinge is abs(p - p0), with its rest curvature `p` (h,) and that of the mesh, p0.

    **Raises:** ValueError for a wrong shape of `p`.
    """
    count = _to_faces(mesh, np.ones(len(mesh.hinges)))
    return _to_faces(mesh, np.abs(plastic_curvature(mesh, p))) / np.maximum(count, 1.0)


def face_edges(mesh: Mesh) -> Int[np.ndarray, "faces 3"]:
    """Return the rows (f, 3) of `mesh.edges` that bound each face."""
    pairs = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].astype(np.int64), axis=2)
    keys = mesh.edges[:, 0].astype(np.int64) * mesh.n_nodes + mesh.edges[:, 1]  # ascending, see Mesh
    return np.searchsorted(keys, pairs[..., 0] * mesh.n_nodes + pairs[..., 1])


def _to_faces(mesh: Mesh, values: Float[np.ndarray, " hinges"]) -> Float[np.ndarray, " faces"]:
    """Add hinge `values` (h,) to both faces of each hinge: sums (f,) on the faces."""
    return np.bincount(
        mesh.hinge_faces.ravel(), weights=np.repeat(values, 2), minlength=len(mesh.faces)
    ).astype(float)
