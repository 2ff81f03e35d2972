"""Patch test: the stiffness of a triangulated sheet as a function of direction.

Springs and hinges have the constants of a lattice of equilateral triangles, (10), (14) and (23). On another
triangulation the same constants give a softer or stiffer sheet that is also anisotropic.
"""

from __future__ import annotations

import warnings
from dataclasses import astuple, dataclass

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxcrumple.mesh.files import MeshWarning
from jaxcrumple.mesh.mesh import Mesh, edge_numbers, half_edge_pairs

#: Deviation from the lattice, or between directions, above which a mesh does not represent its material.
TOLERANCE = 0.05

_PATCH = 1000  # nodes per patch, in sheets with more than 3 times as many
_PATCHES = 5
_FLAT = 1e-6  # largest distance of a flat sheet from its plane, relative to its size
_ANGLES = np.pi * np.arange(36) / 36
_YOUNG, _BENDING = 2 / np.sqrt(3), np.sqrt(3) / 2  # moduli of the lattice with ks = kb = 1


@dataclass(frozen=True)
class Stiffness:
    """Elasticity of a mesh relative to that of the lattice of equilateral triangles.

    `young` and `bending` are means over all directions of Young's modulus in tension and of the stiffness
    in cylindrical bending. An anisotropy is the largest deviation of any direction from the mean, divided by
    the mean. `poisson` is the mean in-plane Poisson ratio, 1/3 for the lattice.
    """

    young: float
    young_anisotropy: float
    poisson: float
    bending: float
    bending_anisotropy: float

    @property
    def worst(self) -> float:
        """The largest deviation from the lattice; loading a mesh warns above 5 %."""
        of_means = abs(self.young - 1), abs(self.bending - 1)
        return float(np.nanmax([*of_means, self.young_anisotropy, self.bending_anisotropy]))

    def __str__(self) -> str:
        return (
            f"Young's modulus {self.young:.1%} of the material's value (+-{self.young_anisotropy:.1%} with "
            f"the direction), bending stiffness {self.bending:.1%} (+-{self.bending_anisotropy:.1%})"
        )


def patch_test(mesh: Mesh) -> Stiffness:
    """Measure the stiffness of a mesh under a homogeneous strain and a homogeneous curvature.

    The boundary nodes, and for bending also their neighbours, follow the homogeneous deformation; all other
    nodes relax. The result is an upper bound, which approaches the stiffness of the sheet on finer meshes.
    Without relaxation it would be a few per cent higher on random meshes, whose nodes do not move affinely.
    Boundary springs, which belong to one triangle, count half.

    The test uses five patches for a flat sheet of more than 3000 nodes and for every curved sheet. It
    projects the patches of a curved sheet onto their best-fit planes. A curved sheet has no common frame, so
    its anisotropies are the means of the anisotropies of its patches.

    **Returns:** a `Stiffness`, relative to the lattice of equilateral triangles, whose moduli are those of
    sections 2.1 and 2.2 of the paper.

    >>> lattice = jc.patch_test(jc.hexagonal(8, 8, 1e-3))
    >>> round(lattice.young, 6), round(lattice.bending, 6), round(lattice.poisson, 6)
    (1.0, 1.0, 0.333333)
    >>> random = jc.patch_test(jc.disc(0.05, 200))
    >>> bool(abs(random.young - 1) < 0.03), bool(random.young_anisotropy > 0.01)
    (True, True)
    """
    plane = flattened(mesh)
    if plane is not None:
        parts = _patches(mesh, _PATCH) if mesh.n_nodes > 3 * _PATCH else [mesh.faces]
        return _stiffness(*np.mean([_tensors(plane, faces) for faces in parts], axis=0))
    found = []
    for faces in _patches(mesh, min(_PATCH, max(mesh.n_nodes // 10, 30))):
        x = mesh.vertices - mesh.vertices[np.unique(faces)].mean(axis=0)
        axes = np.linalg.svd(x[np.unique(faces)], full_matrices=False)[2]
        found.append(astuple(_stiffness(*_tensors(x @ axes[:2].T, faces))))
    return Stiffness(*np.mean(found, axis=0))


def warn_of_anisotropy(mesh: Mesh, path: str) -> None:
    """Warn if the sheet of a mesh file would not have the stiffness of its material."""
    found = patch_test(mesh)
    if found.worst > TOLERANCE:
        cure = "set remesh = true" if flattened(mesh) is not None else "remesh it"
        warnings.warn(
            f"the mesh of {path!r} makes a sheet that is not isotropic: {found}; {cure} for triangles that "
            "are nearly equilateral.",
            MeshWarning,
            stacklevel=4,
        )


def flattened(mesh: Mesh) -> Float[np.ndarray, "nodes 2"] | None:
    """Return positions (n, 2) in the plane of the sheet, or None for a curved sheet."""
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    size = np.linalg.norm(np.ptp(centred, axis=0))
    return centred @ axes[:2].T if np.ptp(centred @ axes[2]) <= _FLAT * size else None


def _patches(mesh: Mesh, size: int) -> list[Int[np.ndarray, "_ 3"]]:
    """Return the faces of patches of `size` nodes around centres that are spread over the sheet."""
    n = mesh.n_nodes
    graph = scipy.sparse.coo_array((np.ones(len(mesh.edges)), tuple(mesh.edges.T)), shape=(n, n)).tocsr()
    patches = []
    # Node numbers usually follow a Hilbert curve, so equal steps spread the centres.
    for centre in np.linspace(0, n - 1, _PATCHES + 2).astype(int)[1:-1]:
        near = scipy.sparse.csgraph.breadth_first_order(graph, centre, directed=False)[0][:size]
        patches.append(mesh.faces[np.isin(mesh.faces, near).all(axis=1)])
    return patches


def _tensors(
    x: Float[np.ndarray, "nodes 2"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Stiffness (3, 3) against strains (xx, yy, 2 xy) and against curvatures (xx, yy, 2 xy), ks = kb = 1."""
    used, faces = np.unique(faces, return_inverse=True)
    x, faces = x[used], faces.reshape(-1, 3)
    edges, number = edge_numbers(faces)
    one, two = half_edge_pairs(number)
    boundary = np.zeros(len(x), bool)
    boundary[edges[np.bincount(number) == 1]] = True
    near = boundary.copy()
    near[edges[boundary[edges].any(axis=1)]] = True
    apex = np.roll(faces, -2, axis=1).ravel()
    hinges = np.column_stack([edges[number[one]], apex[one], apex[two]])
    weight = np.bincount(number) / 2
    inner = (weight[number].reshape(-1, 3) == 1).all(axis=1)  # triangles with three hinges
    u, v = x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2
    membrane = _membrane(x, edges, weight, ~boundary) / area
    return membrane, _plate(x, hinges, (inner[one // 3], inner[two // 3]), ~near)


def _membrane(
    x: Float[np.ndarray, "nodes 2"],
    edges: Int[np.ndarray, "edges 2"],
    weight: Float[np.ndarray, " edges"],
    free: Bool[np.ndarray, " nodes"],
) -> Float[np.ndarray, "3 3"]:
    d = x[edges[:, 1]] - x[edges[:, 0]]
    length = np.linalg.norm(d, axis=1, keepdims=True)
    n = d / length
    affine = length * np.column_stack([n**2, n[:, :1] * n[:, 1:]])
    columns = np.column_stack([2 * edges, 2 * edges + 1])[:, [0, 2, 1, 3]]
    stretch = _rows(columns, np.column_stack([-n, n]), 2 * len(x))
    return _relaxed(stretch[:, np.repeat(free, 2)], affine, weight)


def _plate(
    x: Float[np.ndarray, "nodes 2"],
    hinges: Int[np.ndarray, "hinges 4"],
    inner: tuple[Bool[np.ndarray, " hinges"], Bool[np.ndarray, " hinges"]],
    free: Bool[np.ndarray, " nodes"],
) -> Float[np.ndarray, "3 3"]:
    """Plate stiffness. Only the `inner` triangles of each hinge count; the others lie among fixed nodes."""
    if len(hinges) == 0:
        return np.full((3, 3), np.nan)
    if not inner[0].any() and not inner[1].any():
        inner = (np.ones(len(hinges), bool),) * 2
    a, b, c, d = (x[hinges[:, k]] for k in range(4))
    along = b - a
    squared = (along**2).sum(axis=1)
    length = np.sqrt(squared)
    slopes, heights = [], []
    for apex in (c, d):
        foot = ((apex - a) * along).sum(axis=1) / squared
        height = np.linalg.norm(apex - a - foot[:, None] * along, axis=1)
        slopes.append(np.column_stack([(foot - 1) / height, -foot / height, 1 / height]))
        heights.append(height)
    angle = np.column_stack([slopes[0][:, :2] + slopes[1][:, :2], slopes[0][:, 2], slopes[1][:, 2]])
    area = length * (heights[0] + heights[1]) / 2
    share = (inner[0].astype(float) + inner[1]) / 2
    counted = length * (inner[0] * heights[0] + inner[1] * heights[1]) / 2
    height_of = np.column_stack([x**2, x[:, 0] * x[:, 1]]) / 2
    turn = _rows(hinges, angle, len(x))
    affine = turn @ height_of
    # A triangle has three hinges, so each hinge gets a third of its area.
    weight = share * np.sqrt(3) * squared / (2 * area)
    return _relaxed(turn[:, free], affine, weight) / (counted.sum() / 3)


def _rows(
    columns: Int[np.ndarray, "rows entries"], values: Float[np.ndarray, "rows entries"], width: int
) -> scipy.sparse.csc_array:
    row = np.repeat(np.arange(len(columns)), columns.shape[1])
    entries = values.ravel(), (row, columns.ravel())
    return scipy.sparse.csc_array(entries, shape=(len(columns), width))


def _relaxed(
    change: scipy.sparse.csc_array, affine: Float[np.ndarray, "rows 3"], weight: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, "3 3"]:
    """Energy (3, 3) of affine elongations (m, 3), minimised over displacements u that add `change` @ u."""
    weighted = weight[:, None] * affine
    energy = affine.T @ weighted
    if change.shape[1]:
        force = change.T @ weighted
        tangent = change.T @ (scipy.sparse.diags_array(weight) @ change)
        # A node that a degenerate mesh leaves without stiffness must not make the matrix singular.
        least = np.full(tangent.shape[0], 1e-12 * tangent.diagonal().max())
        tangent = (tangent + scipy.sparse.diags_array(least)).tocsc()
        energy = energy - force.T @ scipy.sparse.linalg.spsolve(tangent, force, permc_spec="MMD_AT_PLUS_A")
    return energy


def _stiffness(membrane: Float[np.ndarray, "3 3"], plate: Float[np.ndarray, "3 3"]) -> Stiffness:
    c, s = np.cos(_ANGLES), np.sin(_ANGLES)
    stress = np.stack([c**2, s**2, c * s])
    strain = np.linalg.solve(membrane, stress)
    young = 1 / (stress * strain).sum(axis=0)
    poisson = -(np.stack([s**2, c**2, -c * s]) * strain).sum(axis=0) * young
    curvature = np.stack([c**2, s**2, 2 * c * s])
    bending = (curvature * (plate @ curvature)).sum(axis=0)
    return Stiffness(
        float(young.mean() / _YOUNG),
        float(np.abs(young / young.mean() - 1).max()),
        float(poisson.mean()),
        float(bending.mean() / _BENDING),
        float(np.abs(bending / bending.mean() - 1).max()),
    )
