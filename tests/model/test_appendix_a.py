"""Forces and Jacobian blocks as printed in Appendix A against the package's energies and autodiff."""

from functools import partial

import appendix_a as paper
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import (
    FOLD_STOP,
    HINGES,
    assert_close,
    curvature,
    disconnected,
    full_matrix,
    gradients,
    hessians,
    hinge_energy,
    hinge_sample,
    random_edges,
)

from jaxcrumple.geometry import hinge as geometry
from jaxcrumple.model import damping, membrane
from jaxcrumple.model.damping import PaperDashpot
from jaxcrumple.model.membrane import Membrane

hinge_data = pytest.fixture(hinge_sample, scope="module")


# --- A.1 and A.2: springs and dashpots -----------------------------------------------------------


def spring_energy(x, k, s):
    """Package's energy of one edge (2, 3)."""
    return membrane.spring_energy(*geometry.unpack(x), k, s)


def test_spring_force_is_a1():
    x, _, k, s = random_edges()
    f = paper.spring_force(x[:, 0] - x[:, 1], k, s)
    expected = np.stack([f, -f], axis=1)
    assert_close(-gradients(spring_energy)(x, k, s), expected)
    nodes_x, nodes = disconnected(x)
    assert_close(Membrane(nodes, jnp.asarray(k), jnp.asarray(s)).force(nodes_x).reshape(-1, 2, 3), expected)


def test_spring_hessian_is_a3():
    x, _, k, s = random_edges()
    b = paper.spring_block(x[:, 0] - x[:, 1], k, s)
    expected = np.stack([np.stack([b, -b], axis=2), np.stack([-b, b], axis=2)], axis=1)
    assert_close(hessians(spring_energy)(x, k, s), expected)
    nodes_x, nodes = disconnected(x)
    assert_close(full_matrix(Membrane(nodes, jnp.asarray(k), jnp.asarray(s)).blocks(nodes_x), 2), expected)


def paper_force(r, u, b, s):
    """Package's dashpot force on node i of one edge."""
    return jnp.stack(damping.paper_dashpot_force(tuple(r), tuple(u), b, s))


def test_paper_dashpot_is_a5_and_the_rate_of_the_spring_vector():
    x, v, b, s = random_edges()
    r, u = x[:, 0] - x[:, 1], v[:, 0] - v[:, 1]
    expected = paper.dashpot_force(r, u, b, s)
    assert_close(jax.vmap(paper_force)(r, u, b, s), expected)

    def spring_vector(r, s):
        return r - s * r / jnp.sqrt(r @ r)

    def rate(r, u, b, s):
        return -b * jax.jvp(partial(spring_vector, s=s), (r,), (u,))[1]

    assert_close(jax.jit(jax.vmap(rate))(r, u, b, s), expected)
    nodes_x, nodes = disconnected(x)
    force = PaperDashpot(nodes, jnp.asarray(b), jnp.asarray(s)).force(nodes_x, jnp.asarray(v.reshape(-1, 3)))
    assert_close(force.reshape(-1, 2, 3), np.stack([expected, -expected], axis=1))


@pytest.mark.parametrize("by", ["position", "velocity"])
def test_paper_dashpot_blocks_are_a6_a7(by):
    x, v, b, s = random_edges()
    r, u = x[:, 0] - x[:, 1], v[:, 0] - v[:, 1]
    if by == "position":
        expected, argument = paper.dashpot_block_x(r, u, b, s), 0
    else:
        expected, argument = paper.dashpot_block_v(r, b, s), 1
    assert_close(-jax.jit(jax.vmap(jax.jacfwd(paper_force, argument)))(r, u, b, s), expected)


# --- A.4: gradient and Hessian of nu -------------------------------------------------------------


def nu(x):
    """$\\hat n_1 \\cdot \\hat n_2$ through the package's curvature."""
    return 1.0 - 0.5 * curvature(x) ** 2


@pytest.fixture(scope="module")
def nu_hessian_autodiff(hinge_data):
    """Hessian of nu by autodiff, shape (m, 4, 3, 4, 3)."""
    return np.asarray(hessians(nu)(hinge_data[0]))


def test_population_covers_the_range(hinge_data):
    _, theta, terms, _, _ = hinge_data
    c = paper.curvature(terms)
    assert np.max(np.abs(c - 2.0 * np.sin(0.5 * theta))) < 1e-12
    assert HINGES >= 200
    assert np.abs(theta).min() < 2e-3
    assert np.sum(theta > FOLD_STOP) >= 4
    assert np.sum(theta < -FOLD_STOP) >= 4
    assert 0.4 < np.mean(theta > 0) < 0.6


def test_nu_gradient_is_a17_to_a20(hinge_data):
    x, _, terms, _, _ = hinge_data
    # Node by node: an error in a small gradient must not hide behind a large one.
    assert_close(gradients(nu)(x), paper.nu_gradient(terms), keep=2)


BLOCK_NUMBERS = [(i, j) for i in range(4) for j in range(4)]


@pytest.mark.parametrize(("i", "j"), BLOCK_NUMBERS, ids=[f"A.4.{4 * i + j + 1}" for i, j in BLOCK_NUMBERS])
def test_nu_hessian_block(i, j, hinge_data, nu_hessian_autodiff):
    expected = paper.NU_BLOCKS[i][j](hinge_data[2])
    assert_close(nu_hessian_autodiff[:, i, :, j, :], expected)


def test_nu_hessian_symmetry_and_row_sums(hinge_data):
    printed = paper.nu_hessian(hinge_data[2])
    # (A.43)-(A.52)
    assert_close(printed, printed.transpose(0, 3, 4, 1, 2), rtol=1e-12)
    size = np.max(np.abs(printed), axis=(1, 2, 3, 4))
    rows = np.max(np.abs(np.sum(printed, axis=3)), axis=(1, 2, 3))
    assert np.max(rows / size) < 1e-11


# --- Energy, force and Hessian of a hinge --------------------------------------------------------


def plastic_energy(x, p, stiffness):
    """Eq. (31), without the fold stop that the package adds."""
    return 0.5 * stiffness * (curvature(x) - p) ** 2


def test_elastic_energy_is_eq_29(hinge_data):
    x, theta, terms, K, _ = hinge_data
    energy = jax.jit(jax.vmap(hinge_energy))(x, np.zeros(HINGES), K)
    expected = 0.5 * K * np.sum((terms.h1 - terms.h2) ** 2, axis=1)
    below = np.abs(theta) < FOLD_STOP
    assert np.max(np.abs(energy / expected - 1.0)[below]) < 1e-10
    assert np.all(energy[~below] > expected[~below])


@pytest.mark.parametrize("plastic", [False, True])
def test_hinge_force_and_hessian_formulas(plastic, hinge_data):
    x, _, terms, K, p = hinge_data
    p = p if plastic else np.zeros_like(p)
    force = paper.plastic_force(terms, K, p) if plastic else paper.elastic_force(terms, K)
    hessian = paper.plastic_hessian(terms, K, p) if plastic else paper.elastic_hessian(terms, K)
    assert_close(-gradients(plastic_energy)(x, p, K), force)
    assert_close(hessians(plastic_energy)(x, p, K), hessian)
