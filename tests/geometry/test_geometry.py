"""Geometry of hinges and sheets: the sign of the curvature, flat hinges, net forces and rigid motions."""

import appendix_a as paper
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import (
    HINGES,
    angle,
    assert_close,
    curvature,
    curvatures,
    disconnected,
    full_matrix,
    gradients,
    hessians,
    hinge_energy,
    hinge_sample,
    hinges_at,
    kernels,
    rotations,
)

from jaxcrumple.geometry import hinge as geometry
from jaxcrumple.model.bending import Bending
from jaxcrumple.model.damping import CentralDashpot
from jaxcrumple.model.membrane import Membrane

hinge_data = pytest.fixture(hinge_sample, scope="module")


def test_curvature_is_eq_33_with_its_sign(hinge_data):
    x, theta, terms, _, _ = hinge_data
    c = np.asarray(curvatures(x))
    sign = -terms.n2e1[:, 0, 0] / np.abs(terms.n2e1[:, 0, 0])
    assert np.array_equal(np.sign(c), sign)
    assert np.max(np.abs(c / (sign * np.linalg.norm(terms.h1 - terms.h2, axis=1)) - 1.0)) < 1e-11
    # Eqs. (30), (A.57): the sign is that of (n1 x n2).e0: positive if faces bend away from n1.
    assert np.array_equal(np.sign(c), np.sign(terms.t0[:, 0, 0]))
    assert np.array_equal(np.sign(c), np.sign(theta))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_curvature_and_slope_are_those_of_the_angle(sign):
    """From flat almost to the fold, where rounding of the normals' product grows as 1/cos(theta/2)^2."""
    theta = sign * np.concatenate([np.geomspace(1e-9, 0.1, 20), np.linspace(0.1, np.radians(179.9), 60)])
    hinge = geometry.hinge(*geometry.gather(*disconnected(hinges_at(np.random.default_rng(4), theta))))
    exact, loss = hinge.theta, 20.0 * np.finfo(float).eps / np.cos(theta / 2) ** 2
    assert np.all(np.abs(hinge.curvature / (2.0 * np.sin(exact / 2)) - 1.0) < loss)
    assert np.all(np.abs(hinge.slope / np.cos(exact / 2) - 1.0) < loss)
    assert np.all(np.abs(hinge.half.angle / exact - 1.0) < loss)


def test_half_of_a_difference_of_angles():
    """Also of more than 180 degrees, which its cosine tells."""
    one, two = np.random.default_rng(5).uniform(-np.pi, np.pi, (2, 1000))
    half = [geometry.HalfAngle(np.sin(0.5 * angle), np.cos(0.5 * angle)) for angle in (one, two)]
    change = half[0].minus(half[1])
    assert np.max(np.abs(change.angle - (one - two))) < 1e-14
    assert np.array_equal(change.cosine < 0, np.abs(one - two) > np.pi)
    assert 100 < np.sum(change.cosine < 0) < 900


# --- Flat hinges ---------------------------------------------------------------------------------


def flat_hinges(count=HINGES):
    """Exactly flat hinges: each lies in a coordinate plane, so that its theta is zero without rounding."""
    rng = np.random.default_rng(8)
    turn = rng.uniform(0.0, 2.0 * np.pi, count)
    attitude = np.zeros((count, 3, 3))
    attitude[:, 0, 0], attitude[:, 0, 1] = np.cos(turn), -np.sin(turn)
    attitude[:, 1, 0], attitude[:, 1, 1] = np.sin(turn), np.cos(turn)
    attitude[:, 2, 2] = 1.0
    attitude = np.stack([np.roll(a, k % 3, axis=0) for k, a in enumerate(attitude)])
    return hinges_at(rng, np.zeros(count), attitude)


def flat_curvature_derivatives(x):
    """Closed gradient (m, 4, 3) and Hessian (m, 4, 3, 4, 3) of c at flat hinges.

    There $c = \\sin\\theta + O(\\theta^3) = g D$ with $D = e_2 \\cdot (e_0 \\times e_1) = 0$ and
    $g = -|e_0|/(|n_1||n_2|)$, so that the Hessian is
    $\\nabla g \\nabla D + \\nabla D \\nabla g + g \\nabla^2 D$.
    """
    t = paper.hinge_terms(x)
    N1, N2, e00 = t.N1[..., 0], t.N2[..., 0], t.e00[..., 0]
    g = (-np.sqrt(e00) / (N1 * N2))[:, :, None]
    by_e0 = t.e0 / e00 - np.cross(t.e1, t.h1) / N1 - np.cross(t.h2, t.e2) / N2
    dg = g * np.stack([by_e0, -np.cross(t.h1, t.e0) / N1, -np.cross(t.e0, t.h2) / N2], axis=1)
    dD = np.stack([np.cross(t.e1, t.e2), np.cross(t.e2, t.e0), np.cross(t.e0, t.e1)], axis=1)
    # Entry (k, l) of d(a x b)/da is -cross(unit k, b)_l.
    cross0, cross1, cross2 = (np.cross(np.eye(3), e[:, None, :]) for e in (t.e0, t.e1, t.e2))
    zero = np.zeros_like(cross0)
    ddD = np.array([[zero, -cross2, cross1], [cross2, zero, -cross0], [-cross1, cross0, zero]])
    hessian = g[:, :, :, None, None] * np.moveaxis(ddD, (0, 1), (1, 3))
    hessian = hessian + dg[:, :, :, None, None] * dD[:, None, None]
    hessian = hessian + dD[:, :, :, None, None] * dg[:, None, None]
    nodes = np.array([[-1.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 1.0]])
    return (
        np.einsum("mak,ai->mik", g * dD, nodes),
        np.einsum("makbl,ai,bj->mikjl", hessian, nodes, nodes, optimize=True),
    )


def differences(function, x, step=4e-3):
    """Central differences of order 8 by the twelve coordinates, shape (m, ..., 4, 3)."""
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    columns = []
    for i in np.eye(12).reshape(12, 4, 3):
        parts = [w * (function(x + k * step * i) - function(x - k * step * i)) for k, w in weights.items()]
        columns.append(sum(parts) / step)
    stacked = np.stack(columns, axis=-1)
    return stacked.reshape(*stacked.shape[:-1], 4, 3)


def test_flat_hinge_has_exact_zero_curvature_and_finite_derivatives():
    x = flat_hinges()
    assert np.all(np.asarray(jax.vmap(angle)(x)) == 0.0)
    assert np.all(np.asarray(curvatures(x)) == 0.0)
    gradient, hessian = flat_curvature_derivatives(x)
    assert_close(gradients(curvature)(x), gradient, rtol=1e-12, keep=2)
    assert_close(hessians(curvature)(x), hessian, rtol=1e-12)
    # c = 0: the printed Hessian of nu = 1 - c^2/2, finite when flat, must be -grad c grad c^T.
    outer = gradient[:, :, :, None, None] * gradient[:, None, None]
    assert_close(paper.nu_hessian(paper.hinge_terms(x)), -outer, rtol=1e-12)


def test_flat_hinge_derivatives_against_differences():
    x = flat_hinges()
    gradient = gradients(curvature)
    assert_close(gradient(x), differences(lambda x: np.asarray(curvatures(x)), x))
    assert_close(hessians(curvature)(x), differences(lambda x: np.asarray(gradient(x)), x))


def test_flat_hinge_kernels():
    x = flat_hinges()
    m = len(x)
    rng = np.random.default_rng(9)
    K, p, loss = rng.uniform(0.5, 2.0, m), rng.uniform(-1.2, 1.2, m), rng.uniform(0.0, 1.0, m)
    gradient, hessian = flat_curvature_derivatives(x)
    outer = gradient[:, :, :, None, None] * gradient[:, None, None]
    K5, p5, loss5 = (a[:, None, None, None, None] for a in (K, p, loss))
    force, tangent = (K * p)[:, None, None] * gradient, K5 * ((1.0 - loss5) * outer - p5 * hessian)
    kernel_force, blocks = kernels(x, p, K, loss)
    assert_close(kernel_force, force, rtol=1e-12)
    assert_close(-gradients(hinge_energy)(x, p, K), force, rtol=1e-12)
    assert_close(full_matrix(blocks, 4), tangent, rtol=1e-12)
    assert_close(hessians(hinge_energy)(x, p, K), tangent + K5 * loss5 * outer, rtol=1e-12)


@pytest.mark.parametrize("theta", [1e-5, -1e-8, 1e-12, -1e-300])
def test_derivatives_are_continuous_through_flat(theta):
    bent = hinges_at(np.random.default_rng(10), np.full(HINGES, theta))
    gradient, _ = flat_curvature_derivatives(bent)
    # The flat formulas neglect terms in D = O(theta).
    assert_close(gradients(curvature)(bent), gradient, rtol=3.0 * abs(theta) + 1e-12)
    hessian = np.asarray(hessians(curvature)(bent))
    assert_close(hessian, flat_curvature_derivatives(bent)[1], rtol=30.0 * abs(theta) + 1e-12)


# --- Net force and torque, rigid motions ---------------------------------------------------------


@pytest.fixture(scope="module")
def sheet():
    """A small crumpled lattice: positions, velocities and the three element models."""
    rng = np.random.default_rng(13)
    columns, rows = 6, 5
    i, j = np.meshgrid(np.arange(columns), np.arange(rows))
    flat = np.stack([i + 0.5 * (j % 2), 0.5 * np.sqrt(3.0) * j, 0.0 * i], axis=-1).reshape(-1, 3)
    triangles = []
    for row in range(rows - 1):
        for k in range(row * columns, row * columns + columns - 1):
            up = k + columns
            corners = [(k, k + 1, up), (k + 1, up + 1, up)]
            triangles += corners if row % 2 == 0 else [(k, k + 1, up + 1), (k, up + 1, up)]
    # Directed edge -> opposite corner; an edge met in both directions is a hinge.
    apex = {(t[a], t[(a + 1) % 3]): t[(a + 2) % 3] for t in triangles for a in range(3)}
    hinges = np.array([(a, b, c, apex[b, a]) for (a, b), c in apex.items() if a < b and (b, a) in apex])
    edges = np.array(sorted({tuple(sorted(edge)) for edge in apex}))
    assert len(edges) == len(flat) + len(triangles) - 1  # Euler: a disc
    x = flat + 0.25 * rng.normal(size=flat.shape)
    v = rng.normal(size=flat.shape)
    k, b = rng.uniform(0.5, 2.0, (2, len(edges)))
    K = paper.hinge_stiffness(rng.uniform(0.5, 2.0, len(hinges)), flat[hinges])
    models = (
        Membrane(jnp.asarray(edges), jnp.asarray(k), jnp.asarray(rng.uniform(0.8, 1.2, len(edges)))),
        Bending(jnp.asarray(hinges), jnp.asarray(K), jnp.zeros(len(hinges))),
        CentralDashpot(jnp.asarray(edges), jnp.asarray(b)),
    )
    return jnp.asarray(x), jnp.asarray(v), models, jnp.asarray(rng.uniform(-1.0, 1.0, len(hinges)))


@jax.jit
def bending_force(model, x, p):
    """Nodal forces of all hinges."""
    return model.force(model.hinges(x), p, len(x))


def test_no_net_force_or_torque(sheet):
    x, v, (springs, hinges, dashpots), p = sheet

    @jax.jit
    def evaluate(x, v):
        return {
            "membrane": springs.force(x),
            "bending": hinges.force(hinges.hinges(x), p, len(x)),
            "dashpot": dashpots.force(x, v),
            "step": dashpots.step_force(x, v, -0.9 * jnp.ones(len(dashpots.nodes)), jnp.asarray(0.1)),
        }

    forces = evaluate(x, v)
    for name, force in forces.items():
        size = np.sum(np.linalg.norm(force, axis=1))
        arm = np.max(np.linalg.norm(x, axis=1))
        assert np.linalg.norm(np.sum(force, axis=0)) < 1e-12 * size, name
        assert np.linalg.norm(np.sum(np.cross(x, force), axis=0)) < 1e-12 * size * arm, name


def test_forces_of_the_sheet_are_gradients_of_its_energy(sheet):
    x, _, (springs, hinges, _), p = sheet
    assert_close(springs.force(x), -jax.jit(jax.grad(springs.energy))(x), keep=0)
    assert_close(bending_force(hinges, x, p), -jax.jit(jax.grad(hinges.energy))(x, p), keep=0)


def test_element_hessians_have_vanishing_row_sums(sheet):
    x, _, (springs, hinges, _), p = sheet
    blocks = jax.jit(lambda x: (springs.blocks(x), hinges.blocks(x, p, None)))(x)
    for part, size in zip(blocks, (2, 4), strict=True):
        full = full_matrix(part, size)
        assert np.max(np.abs(full.sum(axis=3))) < 1e-12 * np.max(np.abs(full))
        assert_close(full, full.transpose(0, 3, 4, 1, 2), rtol=1e-12)


def test_energies_ignore_rigid_motion(sheet):
    x, _, (springs, hinges, _), p = sheet
    rng = np.random.default_rng(14)
    energies = (jax.jit(lambda x: springs.energy(x)), jax.jit(lambda x: hinges.energy(x, p)))
    for rotation in rotations(rng, 5):
        moved = x @ rotation.T + 3.0 * rng.normal(size=3)
        for energy in energies:
            assert abs(energy(moved) / energy(x) - 1.0) < 1e-12


def test_central_dashpot_dissipates_and_lets_rigid_rotation_pass(sheet):
    x, v, (_, _, dashpots), _ = sheet
    assert np.sum(np.asarray(dashpots.force(x, v)) * v) < 0
    spin = jnp.cross(jnp.array([0.3, -1.2, 0.8]), x) + jnp.array([1.0, 2.0, 3.0])
    assert np.max(np.abs(dashpots.force(x, spin))) < 1e-13
