"""Waves: dispersion from the assembled tangent, sound speeds, and the limit of the explicit step."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattice import CELL, SPACING, constants, elastic, patch
from scipy.sparse.linalg import eigsh

from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.scene import sheet
from jaxcrumple.solvers.explicit.runge_kutta import STABILITY, RungeKutta
from jaxcrumple.solvers.explicit.stability import fastest, largest_eigenvalue
from jaxcrumple.state import initial_state
from jaxcrumple.system import mass_matrix, tangent

# RK4 is stable on the imaginary axis up to 2 sqrt 2.
RK4_LIMIT = np.sqrt(8.0)
BONDS = np.array([[1.0, 0.0], [0.5, np.sqrt(3) / 2], [-0.5, np.sqrt(3) / 2]])
# Normals to the bonds, as long as the height of a triangle.
NORMALS = np.sqrt(3) / 2 * np.column_stack([-BONDS[:, 1], BONDS[:, 0]])
RNG = np.random.default_rng(0)
WAVES = [*RNG.uniform(-np.pi, np.pi, (4, 2)), np.array([0.0, 2 * np.pi / np.sqrt(3)])]


@functools.cache
def interior(mesh, layers):
    """Nodes at least `layers` bonds away from the boundary."""
    inside = np.ones(mesh.n_nodes, bool)
    inside[mesh.boundary_nodes] = False
    for _ in range(layers - 1):
        i, j = mesh.edges.T
        outside = ~inside
        inside[i[outside[j]]] = False
        inside[j[outside[i]]] = False
    return np.flatnonzero(inside)


def response(q, polarisation, layers):
    """Stiffness times a plane wave of wave number `q` (units 1/a), and the wave, at interior nodes."""
    mesh, _, stiffness = patch()
    phase = np.exp(1j * mesh.vertices[:, :2] @ q / SPACING)
    wave = phase[:, None] * polarisation
    inside = interior(mesh, layers)
    return (stiffness @ wave.ravel()).reshape(-1, 3)[inside], phase[inside]


def dynamical_matrix(q):
    """2 ks sum (1 - cos q.a) n n^T in units of ks."""
    return sum(2 * (1 - np.cos(q @ n)) * np.outer(n, n) for n in BONDS)


def flexural_stiffness(q):
    """m omega^2 of a flexural wave in units of kb/a^2: one hinge per bond n, its apexes at +-h from it."""
    return sum((2 * (np.cos(q @ h) - np.cos(q @ n / 2)) / (np.sqrt(3) / 2)) ** 2
               for n, h in zip(BONDS, NORMALS, strict=True))  # fmt: skip


# --- Dispersion ----------------------------------------------------------------------------------


@pytest.mark.parametrize("q", WAVES)
def test_dispersion_in_the_plane(q):
    ks, _, _ = constants(patch()[1])
    squared, modes = np.linalg.eigh(dynamical_matrix(q))
    for value, mode in zip(squared, modes.T, strict=True):
        polarisation = np.array([*mode, 0.0])
        force, phase = response(q, polarisation, layers=1)
        np.testing.assert_allclose(force, ks * value * phase[:, None] * polarisation, atol=1e-10 * 6 * ks)


@pytest.mark.parametrize("q", WAVES)
def test_dispersion_of_flexural_waves(q):
    _, kb, _ = constants(patch()[1])
    force, phase = response(q, np.array([0.0, 0.0, 1.0]), layers=2)
    expected = kb / SPACING**2 * flexural_stiffness(q) * phase
    np.testing.assert_allclose(force[:, 2], expected, atol=1e-10 * 36 * kb / SPACING**2)


def test_largest_frequencies():
    grid = np.stack(np.meshgrid(*[np.linspace(-2, 2, 81) * np.pi] * 2), axis=-1).reshape(-1, 2)
    assert max(np.linalg.eigvalsh(dynamical_matrix(q))[-1] for q in grid) <= 6 + 1e-12
    assert max(flexural_stiffness(q) for q in grid) <= 36 + 1e-12
    # The edge of the Brillouin zone, half a wave per row.
    top = np.linalg.eigvalsh(dynamical_matrix(WAVES[-1]))[-1]
    assert top == pytest.approx(6.0, rel=1e-12)
    assert flexural_stiffness(np.array([4 * np.pi / 3, 0.0])) == pytest.approx(36.0, rel=1e-12)


@pytest.mark.parametrize("direction", np.radians([0.0, 11.0, 30.0]))
def test_long_waves(direction):
    """Sound speeds and the plate's bending wave, from the tangent: errors are of order q^2."""
    _, scene, _ = patch()
    ks, kb, mass = constants(scene)
    q = 0.01
    along = np.array([np.cos(direction), np.sin(direction), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    for polarisation, speed in [(along, np.sqrt(9 / 8)), (across, np.sqrt(3 / 8))]:
        force, phase = response(q * along[:2], polarisation, layers=1)
        stiffness = (force @ polarisation / phase).real.mean()
        assert np.sqrt(stiffness / ks) / q == pytest.approx(speed, rel=q**2)
    force, phase = response(q * along[:2], np.array([0.0, 0.0, 1.0]), layers=2)
    omega_squared = (force[:, 2] / phase).real.mean() / mass
    kappa = np.sqrt(3) / 2 * kb
    density = mass / CELL
    assert omega_squared == pytest.approx(kappa / density * (q / SPACING) ** 4, rel=q**2)


# --- Explicit step -------------------------------------------------------------------------------


@functools.cache
def random_sheet():
    mesh = rectangle(0.02, 0.015, 150, seed=3, sweeps=10)
    return mesh, sheet(mesh, elastic(drag_rate=0.0, internal_damping_time=0.0))


def shapes():
    """A random mesh flat, stretched and shaken, rolled up, and folded sharply."""
    x = random_sheet()[0].vertices
    rng = np.random.default_rng(1)
    shaken = 1.02 * x + 2e-4 * rng.normal(size=x.shape)
    radius = 0.003
    rolled = np.column_stack([radius * np.sin(x[:, 0] / radius), x[:, 1], radius * np.cos(x[:, 0] / radius)])
    crumpled = shaken + 6e-4 * rng.normal(size=x.shape) * np.array([0.1, 0.1, 1.0])
    return {"flat": x, "shaken": shaken, "rolled": rolled, "crumpled": crumpled}


@pytest.mark.parametrize("shape", ["flat", "shaken", "rolled", "crumpled"])
def test_stability_limit_bounds_the_largest_frequency_tightly(shape):
    _, scene = random_sheet()
    state = initial_state(scene, shapes()[shape])
    omega = np.sqrt(
        eigsh(
            tangent(scene, state), k=1, M=mass_matrix(scene).tocsc(), which="LA", return_eigenvectors=False
        )[0]
    )
    limit = float(RungeKutta.stable(fastest(scene, state.x)))
    assert 0.85 < limit * omega / RK4_LIMIT < 1.0


def spectra():
    """Eigenvalues of matrices: spread, all but one equal, one far above, none positive, few, none."""
    rng = np.random.default_rng(0)
    spread = rng.uniform(-0.5, 2.0, 300)
    return {
        "spread": spread, "double": np.repeat([1.0, 3.0], 100), "apart": np.append(spread, 50.0),
        "negative": -np.linspace(1.0, 2.0, 50), "few": np.array([1.0, 2.0, 4.0]), "zero": np.zeros(20),
    }  # fmt: skip


@pytest.mark.parametrize("kind", spectra())
@pytest.mark.parametrize("scale", [1e-12, 1e13])
def test_largest_eigenvalue_is_bounded_tightly(kind, scale):
    values = scale * spectra()[kind]
    q = np.linalg.qr(np.random.default_rng(1).normal(size=(len(values), len(values))))[0]
    matrix = jnp.asarray((q * values) @ q.T)
    bound = float(jax.jit(lambda a: largest_eigenvalue(lambda u: a @ u, len(a)))(matrix))
    exact = max(values.max(), 0.0)
    assert exact * (1 - 1e-12) <= bound <= 1.25 * exact + 0.15 * np.abs(values).max()


def test_largest_eigenvalue_that_is_at_home_in_one_place():
    """One pair of sites that presses shows nowhere else."""
    values = np.full(3000, 1.0)
    values[1234] = 1.5
    bound = float(largest_eigenvalue(lambda u: jnp.asarray(values) * u, len(values)))
    assert 1.5 * (1 - 1e-12) <= bound < 1.6


def test_stability_limit_on_the_lattice():
    _, scene, _ = patch()
    ks, _, mass = constants(scene)
    scene = eqx.tree_at(lambda s: (s.drag, s.damping), scene, (None, None), is_leaf=lambda x: x is None)
    limit = float(RungeKutta.stable(fastest(scene, jnp.asarray(patch()[0].vertices))))
    assert 0.87 < limit / (STABILITY / np.sqrt(6 * ks / mass)) <= 1.0


def amplification(z):
    """Growth of an RK4 step for y' = lambda y, z = lambda h."""
    return np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)


@pytest.mark.parametrize(("drag_rate", "damping_time"), [(0.0, 0.0), (1e3, 2e-7), (1e3, 2e-6), (3e6, 0.0)])
def test_no_damped_mode_grows_at_the_stability_limit(drag_rate, damping_time):
    mesh, _, stiffness = patch()
    material = elastic(drag_rate=drag_rate, internal_damping_time=damping_time)
    scene = sheet(mesh, material)
    limit = float(RungeKutta.stable(fastest(scene, jnp.asarray(mesh.vertices))))
    squared = np.linalg.eigvalsh(stiffness.toarray()) / constants(scene)[2]
    squared = np.maximum(squared, 0.0)
    # In the plane damping follows stiffness; flexural modes have drag alone.
    for internal in (damping_time, 0.0):
        decay = internal * squared + drag_rate
        root = np.sqrt(decay**2 / 4 - squared + 0j)
        factors = amplification(limit * np.array([-decay / 2 + root, -decay / 2 - root]))
        assert factors.max() <= 1 + 1e-12
