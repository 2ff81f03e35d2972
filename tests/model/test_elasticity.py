"""Static elasticity of the lattice against closed forms: stretch, moduli, bending energies, buckling."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from lattice import CELL, ROW, SPACING, angle_rotation, constants, elastic, held, lattice
from scipy.optimize import brentq

from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.scene import sheet
from jaxcrumple.solvers.relax import relax
from jaxcrumple.state import initial_state
from jaxcrumple.system import tangent

ANGLES = np.radians([0.0, 7.0, 15.0, 22.0, 30.0])


@functools.cache
def patch(nx=13, ny=12):
    """Mesh and free elastic scene of a lattice patch."""
    mesh = lattice(nx, ny)
    return mesh, sheet(mesh, elastic())


# --- In the plane --------------------------------------------------------------------------------


def pulled_strip(nx, ny, strain):
    """Mesh, scene and relaxed positions of a strip whose end columns follow u_x = strain x.

    Both nodes of the zig-zag of a column move as in uniform strain, and only along x; the strip stays
    flat and free across. Then uniaxial stress is an exact equilibrium: diagonals keep their length.
    """
    mesh = lattice(nx, ny)
    column = np.arange(mesh.n_nodes) % nx
    mask = np.zeros((mesh.n_nodes, 3), bool)
    mask[:, 2] = True
    mask[(column == 0) | (column == nx - 1), 0] = True
    mask[0, 1] = True
    target = mesh.vertices * np.array([1 + strain, 1.0, 1.0])
    scene = sheet(mesh, elastic(), prescribed=held(mask, target))
    start = scene.prescribed.position(jnp.asarray(mesh.vertices), 0.0)
    rest = relax(scene, initial_state(scene, start), force_tolerance=1e-9)
    assert rest.converged
    return mesh, scene, np.asarray(rest.state.x)


@pytest.mark.parametrize("strain", [1e-3, -1e-3])
def test_stretch_force_and_contraction(strain):
    nx, ny = 12, 6
    mesh, scene, x = pulled_strip(nx, ny, strain)
    ks, _, _ = constants(scene)
    end = np.arange(mesh.n_nodes) % nx == nx - 1
    pull = -np.asarray(scene.membrane.force(jnp.asarray(x)))[end, 0].sum()
    young = 2 * ks / np.sqrt(3)
    assert pull == pytest.approx(young * strain * (ny + 1) * ROW, rel=1e-6)
    across = x[-nx:, 1].mean() - x[:nx, 1].mean()
    # The diagonals keep their length a: (1 + e)^2/4 + 3/4 (1 - c)^2 = 1, so c = e/3 + O(e^2).
    contraction = 1 - np.sqrt((1 - (1 + strain) ** 2 / 4) / 0.75)
    assert 1 - across / (ny * ROW) == pytest.approx(contraction, rel=1e-6)
    assert contraction == pytest.approx(strain / 3, rel=3 * abs(strain))


def stretch_density(strain):
    """Energy per area in units of ks of a uniform `strain` (2, 2) in an infinite lattice.

    A boundary edge belongs to one face only, so half of it counts.
    """
    mesh, scene = patch()
    x = mesh.vertices.copy()
    x[:, :2] = x[:, :2] @ (np.eye(2) + strain)
    energy = np.asarray(scene.membrane.element_energy(jnp.asarray(x)))
    share = np.ones(len(energy))
    share[mesh.boundary_edges] = 0.5
    return energy @ share / mesh.area / constants(scene)[0]


@pytest.mark.parametrize("size", [1e-3, 1e-5])
@pytest.mark.parametrize("angle", ANGLES)
def test_shear_and_bulk_moduli_are_isotropic(size, angle):
    turn = angle_rotation(angle)
    shear = turn @ np.array([[0.0, size], [size, 0.0]]) @ turn.T
    stretch = turn @ np.diag([size, 0.0]) @ turn.T
    mu = lam = np.sqrt(3) / 4
    # W = mu e:e + lambda/2 (tr e)^2
    assert stretch_density(shear) == pytest.approx(2 * mu * size**2, rel=2 * size)
    assert stretch_density(size * np.eye(2)) == pytest.approx((2 * mu + 2 * lam) * size**2, rel=1e-9)
    assert stretch_density(stretch) == pytest.approx((mu + lam / 2) * size**2, rel=2 * size)


# --- Out of the plane ----------------------------------------------------------------------------


def bending_density(x):
    """Bending energy per area in units of kappa at positions `x` of the patch, from interior hinges."""
    mesh, scene = patch()
    energy = np.asarray(scene.bending.element_energy(jnp.asarray(x), jnp.zeros(len(mesh.hinges))))
    # A cell has one hinge in each of the three directions.
    edges = np.diff(mesh.vertices[mesh.hinges[:, :2]], axis=1)[:, 0]
    direction = np.round(np.degrees(np.arctan2(edges[:, 1], edges[:, 0])) / 60).astype(int) % 3
    total = sum(energy[direction == k].mean() for k in range(3))
    return total / CELL / (np.sqrt(3) / 2 * constants(scene)[1])


def on_cylinder(radius, angle):
    """Patch wrapped isometrically on a cylinder whose axis makes `angle` with the lattice rows."""
    points = patch()[0].vertices[:, :2] @ angle_rotation(angle)
    arc = points[:, 1] / radius
    return np.column_stack([points[:, 0], radius * np.sin(arc), radius * np.cos(arc)])


def test_cylinder_energy_and_its_lattice_correction():
    radius = 40 * SPACING
    deficit = [
        (1 - 2 * radius**2 * bending_density(on_cylinder(radius, a))) * (radius / SPACING) ** 2
        for a in ANGLES
    ]
    # Axis along a row: the facets between rows are flat, and 1 - cos(h_r/R) gives 1/16.
    assert deficit[0] == pytest.approx(1 / 16, rel=1e-3)
    assert deficit[-1] == pytest.approx(0.0486, rel=1e-3)
    assert np.all(np.diff(deficit) < 0)


@pytest.mark.parametrize("principal", [(1.0, 1.0), (1.0, -1.0), (1.0, 0.0), (1.0, 0.4)])
@pytest.mark.parametrize("angle", ANGLES)
def test_bending_poisson_ratio_is_minus_one_third(principal, angle):
    scale = 1e-4 / SPACING
    one, two = scale * np.array(principal)
    mesh, _ = patch()
    points = mesh.vertices[:, :2] @ angle_rotation(angle)
    x = mesh.vertices.copy()
    x[:, 2] = 0.5 * (one * points[:, 0] ** 2 + two * points[:, 1] ** 2)
    expected = (one + two) ** 2 / 2 - 4 / 3 * one * two
    # kappa/2 (H^2 - 2 (1 - nu) K) with nu = -1/3
    assert bending_density(x) == pytest.approx(expected, rel=1e-5)


def icosphere(levels):
    """Unit sphere: an icosahedron whose faces are divided `levels` times."""
    golden = (1 + np.sqrt(5)) / 2
    x = [(s, t * golden, 0.0) for s in (-1, 1) for t in (-1, 1)]
    x = np.array([np.roll(p, k) for k in range(3) for p in x]) / np.sqrt(1 + golden**2)
    gap = np.linalg.norm(x[:, None] - x[None], axis=2)
    near = (gap > 0) & (gap < 1.1)
    f = np.array([(i, j, k) for i in range(12) for j in range(i) for k in range(j)
                  if near[i, j] and near[j, k] and near[i, k]])  # fmt: skip
    for _ in range(levels):
        mesh = Mesh.from_arrays(x, f, reorder=False)
        number = {tuple(e): len(x) + k for k, e in enumerate(mesh.edges.tolist())}
        middle = x[mesh.edges].sum(axis=1)
        x = np.vstack([x, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        halves = np.sort(np.stack([f, np.roll(f, -1, axis=1)], axis=2), axis=2)
        m = np.array([[number[tuple(e)] for e in face] for face in halves.tolist()])
        f = np.vstack([np.column_stack([f[:, k], m[:, k], m[:, k - 1]]) for k in range(3)] + [m])
    return Mesh.from_arrays(x, f, reorder=True)


def test_closed_sphere():
    mesh = icosphere(3)
    scene = sheet(mesh, elastic())
    total = float(scene.bending.energy(jnp.asarray(mesh.vertices), jnp.zeros(len(mesh.hinges))))
    # Triangles of unequal shape cost 1.5 %, at any refinement.
    assert total == pytest.approx(4 * np.pi * elastic().bending_constant / np.sqrt(3), rel=0.02)


def bending_matrix(nx, ny):
    """Hessian (n, n) by the heights of a flat strip: bending alone, springs are unstrained."""
    mesh = lattice(nx, ny)
    scene = sheet(mesh, elastic())
    return mesh, tangent(scene, initial_state(scene, mesh.vertices))[2::3, 2::3]


def curved_strip_energy(nx, ny):
    """Quadratic form of z = curvature x^2/2 + (height of each row): the energy's parts."""
    mesh, stiffness = bending_matrix(nx, ny)
    rows = np.kron(np.eye(ny + 1), np.ones((nx, 1)))
    basis = np.column_stack([mesh.vertices[:, 0] ** 2 / 2, rows])
    return basis.T @ (stiffness @ basis)


def strip_stiffness(ny):
    """Bending stiffness (J m) of a strip with free edges, rows relaxed, per length."""
    # The difference of two lengths leaves the ends out.
    form = (curved_strip_energy(11, ny) - curved_strip_energy(9, ny)) / (2 * SPACING)
    relaxed, *_ = np.linalg.lstsq(form[1:, 1:], form[1:, 0])
    return form[0, 0] - form[0, 1:] @ relaxed


def test_narrow_strip_with_free_edges_is_softer():
    ny = 3
    kappa = np.sqrt(3) / 2 * elastic().bending_constant
    assert strip_stiffness(ny) == pytest.approx(8 / 9 * kappa * ny * ROW, rel=1e-9)


# --- Buckling ------------------------------------------------------------------------------------


def row_stiffness(mesh, scene, strain, nx, ny):
    """Lowest eigenvalue of the tangent for rigid rows that move in z, ends pinned, under `strain` in y."""
    x = mesh.vertices * np.array([1.0, 1 + strain, 1.0])
    stiffness = tangent(scene, initial_state(scene, x))[2::3, 2::3]
    rows = np.kron(np.eye(ny + 1), np.ones((nx, 1)))[:, 1:-1]
    return np.linalg.eigvalsh(rows.T @ (stiffness @ rows))[0]


def test_euler_load_of_a_row_tied_strut():
    nx, ny = 5, 8
    mesh = lattice(nx, ny)
    scene = sheet(mesh, elastic())
    strain = brentq(lambda s: row_stiffness(mesh, scene, s, nx, ny), -0.01, 0.0, xtol=1e-13)
    x = mesh.vertices * np.array([1.0, 1 + strain, 1.0])
    load = np.asarray(scene.membrane.force(jnp.asarray(x)))[-nx:, 1].sum()
    kappa = np.sqrt(3) / 2 * elastic().bending_constant
    euler = 4 * kappa / ROW**2 * np.sin(np.pi / (2 * ny)) ** 2 * (nx - 1) * SPACING
    # Compression brings the rows closer, to (1 + strain) h_r.
    assert load == pytest.approx(euler / (1 + strain), rel=1e-7)
