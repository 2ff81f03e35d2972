"""Energies, forces and Hessians against Appendix A, against autodiff and against closed forms."""

from functools import cache, partial

import appendix_a as paper
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxcrumple.model import bending, contact, damping, geometry, membrane
from jaxcrumple.model.bending import Bending
from jaxcrumple.model.damping import CentralDashpot, PaperDashpot
from jaxcrumple.model.membrane import Membrane
from jaxcrumple.model.plasticity import AbstractFlowRule, SmoothstepFlow, implicit_update
from jaxcrumple.model.stencil import upper_pairs

HINGES, EDGES = 400, 300  # all hinge tests but one use this many: one compilation serves them all
RTOL = 1e-9
FOLD_STOP = np.pi * 170.0 / 180.0


# --- Random elements and comparisons -------------------------------------------------------------


def rotations(rng, count):
    """Random rotation matrices (count, 3, 3)."""
    q, r = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None, :]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def hinges_at(rng, theta, attitude=None):
    """Hinges (m, 4, 3) of random shape, size and place that are bent by `theta` (m,)."""
    m = len(theta)
    attitude = rotations(rng, m) if attitude is None else attitude
    length = rng.uniform(0.5, 2.0, m)
    foot1, foot2 = rng.uniform(-0.5, 1.5, (2, m)) * length
    height1, height2 = rng.uniform(0.3, 2.0, (2, m)) * length
    x = np.zeros((m, 4, 3))
    x[:, 1, 0] = length
    x[:, 2] = np.stack([foot1, height1, np.zeros(m)], axis=1)
    x[:, 3] = np.stack([foot2, -height2 * np.cos(theta), -height2 * np.sin(theta)], axis=1)
    return np.einsum("mij,mkj->mki", attitude, x) + rng.normal(size=(m, 1, 3))


def random_hinges(seed=0, count=HINGES, low=1e-3, high=3.0):
    """Hinges with |theta| log-uniform in [low, high], both signs, some at the end; returns (x, theta)."""
    rng = np.random.default_rng(seed)
    theta = np.exp(rng.uniform(np.log(low), np.log(high), count)) * rng.choice([-1.0, 1.0], count)
    # A third is spread evenly, so that large angles, where curvature is strong, are well covered.
    even = np.arange(0, count, 3)
    theta[even] = rng.uniform(low, high, even.size) * np.sign(theta[even])
    theta[:8] = np.linspace(0.99, 1.0, 8) * high * np.array([1.0, -1.0] * 4)
    return hinges_at(rng, theta), theta


def random_edges(seed=1, count=EDGES):
    """Edges (m, 2, 3), velocities (m, 2, 3), coefficients and rest lengths (m,)."""
    rng = np.random.default_rng(seed)
    x, v = rng.normal(size=(2, count, 2, 3))
    length = np.linalg.norm(x[:, 0] - x[:, 1], axis=1)
    return x, v, rng.uniform(0.5, 2.0, count), length * rng.uniform(0.6, 1.5, count)


def assert_close(actual, expected, rtol=RTOL, keep=1):
    """Compare element by element, relative to the largest entry of each element's array."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    assert np.all(np.isfinite(actual))
    axes = tuple(range(keep, expected.ndim))
    scale = np.max(np.abs(expected), axis=axes)
    error = np.max(np.abs(actual - expected), axis=axes) / scale
    assert np.max(error) < rtol, f"relative error {np.max(error):.2e} at element {np.argmax(error)}"


def disconnected(x):
    """Nodes (m k, 3) and element numbering (m, k) of elements (m, k, 3) that share no node."""
    m, k = x.shape[:2]
    return jnp.asarray(x.reshape(m * k, 3)), jnp.arange(m * k).reshape(m, k)


def full_matrix(blocks, size):
    """Element Hessians (m, size, 3, size, 3) from the package's upper-triangular blocks."""
    full = np.zeros((blocks.shape[-1], size, 3, size, 3))
    for block, (a, b) in zip(np.moveaxis(np.asarray(blocks), -1, 1), upper_pairs(size), strict=True):
        full[:, b, :, a, :] = np.swapaxes(block, 1, 2)
        full[:, a, :, b, :] = block
    return full


def angle(x):
    """Signed angle of one hinge (4, 3)."""
    return geometry.hinge_angle(*geometry.unpack(x))


def curvature(x):
    """Package's c of one hinge."""
    return geometry.curvature(angle(x))


curvatures = jax.jit(jax.vmap(curvature))


def nu(x):
    """$\\hat n_1 \\cdot \\hat n_2$ through the package's curvature."""
    return 1.0 - 0.5 * curvature(x) ** 2


def hinge_energy(x, p, stiffness):
    """Package's energy of one hinge, fold stop included."""
    return bending.hinge_energy(angle(x), p, stiffness)


def plastic_energy(x, p, stiffness):
    """Eq. (31), without the fold stop that the package adds."""
    return 0.5 * stiffness * (curvature(x) - p) ** 2


@cache
def gradients(function):
    """Vectorised gradient by the first argument."""
    return jax.jit(jax.vmap(jax.grad(function)))


@cache
def hessians(function):
    """Vectorised Hessian by the first argument."""
    return jax.jit(jax.vmap(jax.hessian(function)))


@jax.jit
def kernels(x, p, stiffness, loss):
    """Bending's closed-form forces (m, 4, 3) and blocks (10, 3, 3, m) of hinges (m, 4, 3)."""
    nodes = jnp.arange(4 * len(x)).reshape(-1, 4)
    nodes_x = x.reshape(-1, 3)
    model = Bending(nodes, stiffness, jnp.zeros(len(x)))
    force = model.force(model.hinges(nodes_x), p, 4 * len(x)).reshape(-1, 4, 3)
    return force, model.blocks(nodes_x, p, loss)


@pytest.fixture(scope="module")
def hinge_data():
    """Random hinges with the oracle's terms, stiffness K and rest curvatures p."""
    x, theta = random_hinges()
    rng = np.random.default_rng(2)
    K = paper.hinge_stiffness(rng.uniform(0.5, 2.0, HINGES), hinges_at(rng, np.zeros(HINGES)))
    return x, theta, paper.hinge_terms(x), K, rng.uniform(-1.2, 1.2, HINGES)


@pytest.fixture(scope="module")
def nu_hessian_autodiff(hinge_data):
    """Hessian of nu by autodiff, shape (m, 4, 3, 4, 3)."""
    return np.asarray(hessians(nu)(hinge_data[0]))


@pytest.fixture(scope="module")
def energy_hessian_autodiff(hinge_data):
    """Hessian of the package's hinge energy by autodiff."""
    x, _, _, K, p = hinge_data
    return np.asarray(hessians(hinge_energy)(x, p, K))


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
    assert_close(Membrane(nodes, k, s).force(nodes_x).reshape(-1, 2, 3), expected)


def test_spring_hessian_is_a3():
    x, _, k, s = random_edges()
    b = paper.spring_block(x[:, 0] - x[:, 1], k, s)
    expected = np.stack([np.stack([b, -b], axis=2), np.stack([-b, b], axis=2)], axis=1)
    assert_close(hessians(spring_energy)(x, k, s), expected)
    nodes_x, nodes = disconnected(x)
    assert_close(full_matrix(Membrane(nodes, k, s).blocks(nodes_x), 2), expected)


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
    force = PaperDashpot(nodes, b, s).force(nodes_x, jnp.asarray(v.reshape(-1, 3)))
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


def step_edges():
    """Edges of an implicit step: x, past, history weights, beta h; velocities follow from (47)."""
    x, _, b, s = random_edges()
    rng = np.random.default_rng(3)
    past = x + 0.1 * rng.normal(size=(3, *x.shape))
    return x, past, np.array([-1.8, 1.1, -0.3]), 0.37, b, s


@pytest.mark.parametrize("model", [PaperDashpot, CentralDashpot])
def test_dashpot_step_blocks_are_the_jacobian_of_step_force(model):
    x, past, alpha, beta_h, b, s = step_edges()
    nodes = jnp.array([[0, 1]])

    def build(b, s):
        arguments = (b[None], s[None]) if model is PaperDashpot else (b[None],)
        return model(nodes, *arguments)

    def force(x, past, b, s):
        dashpot = build(b, s)
        v = (x + jnp.tensordot(jnp.asarray(alpha), past, 1)) / beta_h
        return dashpot.step_force(x, v, dashpot.memory(past, jnp.asarray(alpha)), beta_h)

    def blocks(x, past, b, s):
        dashpot = build(b, s)
        v = (x + jnp.tensordot(jnp.asarray(alpha), past, 1)) / beta_h
        return dashpot.step_blocks(x, v, dashpot.memory(past, jnp.asarray(alpha)), beta_h)[..., 0]

    arguments = (x, np.moveaxis(past, 0, 1), b, s)
    full = full_matrix(np.moveaxis(jax.jit(jax.vmap(blocks))(*arguments), 0, -1), 2)
    assert_close(full, -jax.jit(jax.vmap(jax.jacfwd(force)))(*arguments))
    if model is PaperDashpot:
        v = (x + np.tensordot(alpha, past, 1)) / beta_h
        r, u = x[:, 0] - x[:, 1], v[:, 0] - v[:, 1]
        oracle = paper.dashpot_block_x(r, u, b, s) + paper.dashpot_block_v(r, b, s) / beta_h
        assert_close(full[:, 0, :, 0], oracle)


def test_central_dashpot_force_is_minus_b_jtj_v():
    x, v, b, _ = random_edges()
    r, u = x[:, 0] - x[:, 1], v[:, 0] - v[:, 1]
    direction = r / np.linalg.norm(r, axis=1)[:, None]
    f = -b[:, None] * np.sum(direction * u, axis=1)[:, None] * direction
    nodes_x, nodes = disconnected(x)
    force = CentralDashpot(nodes, b).force(nodes_x, jnp.asarray(v.reshape(-1, 3)))
    assert_close(force.reshape(-1, 2, 3), np.stack([f, -f], axis=1))


def test_central_dashpot_step_force_ignores_rigid_motion_of_any_size():
    x, _, alpha, beta_h, b, _ = step_edges()
    alpha = alpha / -alpha.sum()  # a consistent method: constants have zero rate
    rng = np.random.default_rng(4)
    nodes_x, nodes = disconnected(x)
    moved = np.einsum("sij,nj->sni", rotations(rng, 3), nodes_x) + rng.normal(size=(3, 1, 3))
    dashpot = CentralDashpot(nodes, b)
    memory = dashpot.memory(jnp.asarray(moved), jnp.asarray(alpha))
    force = dashpot.step_force(nodes_x, jnp.zeros_like(nodes_x), memory, beta_h)
    assert np.max(np.abs(force)) < 1e-13


# --- A.3: self-contact ---------------------------------------------------------------------------


def contact_data(count=200):
    """Six nodes per pair of sites (m, 6, 3), weights (m, 6), and r/sigma from 0.03 to 0.97."""
    rng = np.random.default_rng(5)
    ks, sigma = 1.7, 0.3
    weights = rng.dirichlet(np.ones(3), (count, 2))
    x = rng.normal(size=(count, 2, 3, 3))
    gap = np.linspace(0.03, 0.97, count)[:, None] * sigma * rotations(rng, count)[:, 0]
    sites = np.einsum("msk,mskj->msj", weights, x)
    x[:, 0] += (gap - sites[:, 0] + sites[:, 1])[:, None]
    return x.reshape(count, 6, 3), weights.reshape(count, 6), ks, sigma


def site_vector(x, w):
    """$r_{12}$ of (A.9) from six nodes."""
    return w[:3] @ x[:3] - w[3:] @ x[3:]


def contact_energy(x, w, ks, sigma):
    """Package's contact energy of six nodes."""
    r = site_vector(x, w)
    return contact.pair_energy(jnp.sqrt(r @ r), ks, sigma)


def test_contact_force_is_a8_a9():
    x, w, ks, sigma = contact_data()
    r12 = np.einsum("mk,mkj->mj", w[:, :3], x[:, :3]) - np.einsum("mk,mkj->mj", w[:, 3:], x[:, 3:])
    signed = w * np.array([1, 1, 1, -1, -1, -1])
    expected = signed[:, :, None] * paper.contact_force(r12, ks, sigma)[:, None]
    force = -gradients(lambda x, w: contact_energy(x, w, ks, sigma))(x, w)
    assert_close(force, expected)


def test_contact_hessian_is_a10_with_corrected_sign():
    x, w, ks, sigma = contact_data()
    r12 = np.einsum("mk,mkj->mj", w[:, :3], x[:, :3]) - np.einsum("mk,mkj->mj", w[:, 3:], x[:, 3:])
    block = paper.contact_block(r12, ks, sigma)
    # (A.10) is the block of nodes on different sites; on the same site it changes sign.
    signed = w * np.array([1, 1, 1, -1, -1, -1])
    expected = -np.einsum("mi,mj,mkl->mikjl", signed, signed, block)
    hessian = hessians(lambda x, w: contact_energy(x, w, ks, sigma))(x, w)
    assert_close(hessian, expected)
    size = np.max(np.abs(expected), axis=(1, 2, 3, 4))
    rows = np.max(np.abs(np.sum(expected, axis=3)), axis=(1, 2, 3))
    assert np.max(rows / size) < 1e-12


PAIR_GAPS = {1e-3: 0.9156, 0.01: 0.8889, 0.05: 0.8538, 0.1: 0.8284, 0.2: 0.7876, 0.4: 0.6979, 0.5: 0.6180}


@pytest.mark.parametrize("load", PAIR_GAPS)
def test_contact_gap_under_load(load):
    force = jax.jit(lambda r: -jax.grad(contact.pair_energy)(r, 1.0, 1.0))
    gap = brentq(lambda r: float(force(r)) - load, 0.5, 0.99, xtol=1e-12)
    assert abs(gap - PAIR_GAPS[load]) < 5.1e-5


def test_contact_is_finite_at_zero_and_softens_inside_half_the_range():
    ks, sigma = 1.7, 0.3
    r = np.linspace(1e-6, 0.999, 1999) * sigma
    energy, slope = jax.jit(jax.vmap(jax.value_and_grad(lambda r: contact.pair_energy(r, ks, sigma))))(r)
    assert abs(contact.pair_energy(0.0, ks, sigma) / (ks * sigma**2) - np.exp(-1.0)) < 1e-14
    assert np.all(np.diff(energy) < 0)
    force = -np.asarray(slope) / (ks * sigma)
    peak = np.argmax(force)
    assert abs(r[peak] / sigma - 0.5) < 6e-4
    assert abs(-jax.grad(contact.pair_energy)(0.5, 1.0, 1.0) - 4.0 * np.exp(-2.0)) < 1e-13
    assert abs(force[peak] - 0.5413) < 5e-5


def test_contact_ends_smoothly_at_its_range():
    sigma = 0.3
    r = np.array([sigma * (1 - 1e-3), np.nextafter(sigma, 0.0), sigma, 1.5 * sigma])
    energy = jax.grad(jax.grad(lambda r: contact.pair_energy(r, 1.7, sigma)))
    derivatives = [jax.vmap(lambda r: contact.pair_energy(r, 1.7, sigma))(r), jax.vmap(energy)(r)]
    assert np.all(np.asarray(derivatives) == 0.0)


# --- A.4: gradient and Hessian of nu -------------------------------------------------------------


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


def test_curvature_is_eq_33_with_its_sign(hinge_data):
    x, theta, terms, _, _ = hinge_data
    c = np.asarray(curvatures(x))
    sign = -terms.n2e1[:, 0, 0] / np.abs(terms.n2e1[:, 0, 0])
    assert np.array_equal(np.sign(c), sign)
    assert np.max(np.abs(c / (sign * np.linalg.norm(terms.h1 - terms.h2, axis=1)) - 1.0)) < 1e-11
    # Eqs. (30), (A.57): the sign is that of (n1 x n2).e0: positive if faces bend away from n1.
    assert np.array_equal(np.sign(c), np.sign(terms.t0[:, 0, 0]))
    assert np.array_equal(np.sign(c), np.sign(theta))


def test_elastic_energy_is_eq_29(hinge_data):
    x, theta, terms, K, _ = hinge_data
    energy = jax.jit(jax.vmap(hinge_energy))(x, np.zeros(HINGES), K)
    expected = 0.5 * K * np.sum((terms.h1 - terms.h2) ** 2, axis=1)
    below = np.abs(theta) < FOLD_STOP
    assert np.max(np.abs(energy / expected - 1.0)[below]) < 1e-10
    assert np.all(energy[~below] > expected[~below])


# --- Forces and Hessians of hinges ---------------------------------------------------------------


@pytest.mark.parametrize("plastic", [False, True])
def test_hinge_force_and_hessian_formulas(plastic, hinge_data):
    x, _, terms, K, p = hinge_data
    p = p if plastic else np.zeros_like(p)
    force = paper.plastic_force(terms, K, p) if plastic else paper.elastic_force(terms, K)
    hessian = paper.plastic_hessian(terms, K, p) if plastic else paper.elastic_hessian(terms, K)
    assert_close(-gradients(plastic_energy)(x, p, K), force)
    assert_close(hessians(plastic_energy)(x, p, K), hessian)


def test_hinge_energy_derivatives_are_the_papers_below_the_fold_stop(hinge_data, energy_hessian_autodiff):
    x, theta, terms, K, p = hinge_data
    below = np.abs(theta) < FOLD_STOP
    force = -np.asarray(gradients(hinge_energy)(x, p, K))
    assert_close(force[below], paper.plastic_force(terms, K, p)[below])
    assert_close(energy_hessian_autodiff[below], paper.plastic_hessian(terms, K, p)[below])


def test_bending_force_kernel(hinge_data):
    x, theta, terms, K, p = hinge_data
    force = np.asarray(kernels(x, p, K, None)[0])
    assert_close(force, -gradients(hinge_energy)(x, p, K))
    below = np.abs(theta) < FOLD_STOP
    assert_close(force[below], paper.plastic_force(terms, K, p)[below])


def test_bending_hessian_kernel(hinge_data, energy_hessian_autodiff):
    x, theta, terms, K, p = hinge_data
    full = full_matrix(kernels(x, p, K, None)[1], 4)
    assert_close(full, energy_hessian_autodiff)
    below = np.abs(theta) < FOLD_STOP
    assert_close(full[below], paper.plastic_hessian(terms, K, p)[below])


def test_angle_gradient_and_hessian_kernels(hinge_data):
    x = hinge_data[0]

    @jax.jit
    def closed(x):
        hinge = geometry.hinge(*(tuple(x[:, k, i] for i in range(3)) for k in range(4)))
        gradient = geometry.hinge_gradient(hinge)
        return gradient, jnp.stack(geometry.hinge_hessian(hinge, gradient))

    gradient, blocks = closed(x)
    stacked = np.stack([np.stack(g, axis=1) for g in gradient[:4]], axis=1)
    assert_close(stacked, gradients(angle)(x), keep=2)
    full = full_matrix(blocks, 4)
    assert_close(full, hessians(angle)(x))
    # With (A.17)-(A.20): nu = cos(theta).
    theta = hinge_data[1]
    assert_close(-np.sin(theta)[:, None, None] * stacked, paper.nu_gradient(hinge_data[2]))
    outer = stacked[:, :, :, None, None] * stacked[:, None, None]
    sine, cosine = (f(theta)[:, None, None, None, None] for f in (np.sin, np.cos))
    assert_close(-cosine * outer - sine * full, paper.nu_hessian(hinge_data[2]))


def test_bending_hessian_in_chunks():
    count = bending.CHUNK + 37
    x, theta = random_hinges(seed=6, count=count)
    rng = np.random.default_rng(7)
    K, p, loss = rng.uniform(0.5, 2.0, count), rng.uniform(-1.2, 1.2, count), rng.uniform(0.0, 1.0, count)
    blocks = kernels(x, p, K, loss)[1]
    assert blocks.shape == (10, 3, 3, count)
    full, below = full_matrix(blocks, 4), np.abs(theta) < FOLD_STOP
    expected = paper.plastic_hessian(paper.hinge_terms(x), K, p, loss)
    assert_close(full[below], expected[below])
    # The number of hinges per pass must not show, at any place in the sequence.
    for first in (0, bending.CHUNK - 5, count - HINGES):
        part = slice(first, first + HINGES)
        alone = kernels(x[part], p[part], K[part], loss[part])[1]
        assert_close(full[part], full_matrix(alone, 4), rtol=1e-12)


def yielding_hinges(hinge_data):
    """Memory and law with which the hinges yield (or not) in one implicit step."""
    c0, time, gamma, beta_h = 0.3, 0.5, 1.0, 2.0
    rule = SmoothstepFlow(jnp.asarray(c0), jnp.asarray(time), jnp.asarray(gamma))
    return rule, -hinge_data[4], beta_h, c0, time * (1.0 + gamma)


def test_condensed_tangent_is_the_jacobian_of_the_condensed_force(hinge_data):
    x, theta, terms, K, _ = hinge_data
    rule, memory, beta_h, c0, scale = yielding_hinges(hinge_data)

    def force(x, memory, stiffness):
        c = curvature(x)
        p, _ = implicit_update(rule, c[None], memory[None], beta_h)
        model = Bending(jnp.arange(4)[None], stiffness[None], jnp.zeros(1))
        return model.force(model.hinges(x), p, 4)

    jacobian = -np.asarray(jax.jit(jax.vmap(jax.jacfwd(force)))(x, memory, K))
    p, slope = update(rule, curvatures(x), jnp.asarray(memory), beta_h)
    full = full_matrix(kernels(x, p, K, slope)[1], 4)
    assert_close(full, jacobian)
    expected = paper.softening(paper.curvature(terms) - p, c0, scale, beta_h)
    assert 0.1 < np.mean(expected > 0) < 0.9
    assert expected.max() > 0.5
    assert np.max(np.abs(slope - expected)) < 1e-10
    below = np.abs(theta) < FOLD_STOP
    assert_close(full[below], paper.plastic_hessian(terms, K, np.asarray(p), expected)[below], rtol=1e-8)
    # The matrix of (51) with plasticity is symmetric: CG is not ruled out by it.
    assert_close(jacobian, jacobian.transpose(0, 3, 4, 1, 2))


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


# --- The fold stop -------------------------------------------------------------------------------


def stop_formulas(theta):
    """$u^3/(1-u) = 1/(1-u) - 1 - u - u^2$ and its first two derivatives by theta."""
    reach = np.pi - FOLD_STOP
    u = np.maximum(np.abs(theta) - FOLD_STOP, 0.0) / reach
    first = (1.0 / (1.0 - u) ** 2 - 1.0 - 2.0 * u) / reach
    return u**3 / (1.0 - u), np.sign(theta) * first, (2.0 / (1.0 - u) ** 3 - 2.0) / reach**2


def test_fold_stop_and_its_closed_derivatives():
    theta = np.concatenate([np.linspace(-3.14, 3.14, 2001), [0.0, FOLD_STOP, -FOLD_STOP]])
    value, first, second = stop_formulas(theta)
    stop = [bending.fold_stop(jnp.asarray(theta)), *bending.stop_derivatives(jnp.asarray(theta))]
    for actual, expected in zip(stop, (value, first, second), strict=True):
        assert np.max(np.abs(actual - expected) / (1.0 + np.abs(expected))) < 1e-9
    slope = jax.grad(bending.fold_stop)
    for actual, auto in zip(stop[1:], (slope, jax.grad(slope)), strict=True):
        auto = jax.jit(jax.vmap(auto))(theta)
        assert np.max(np.abs(actual - auto) / (1.0 + np.abs(auto))) < 1e-11
    below = np.abs(theta) <= FOLD_STOP
    assert all(np.all(np.asarray(a)[below] == 0.0) for a in stop)
    assert np.all(np.asarray(stop[0])[~below] > 0.0)
    # A barrier: it grows without bound before the faces touch.
    assert bending.fold_stop(np.pi - 1e-6) > 1e5


def test_fold_stop_is_twice_continuously_differentiable_at_its_onset():
    reach = np.pi - FOLD_STOP
    slope = jax.grad(bending.fold_stop)
    functions = [jax.jit(f) for f in (bending.fold_stop, slope, jax.grad(slope))]
    for u in (1e-3, 1e-5):
        theta = FOLD_STOP + u * reach
        derivatives = [f(theta) for f in functions]
        # u^3, 3 u^2, 6 u to leading order: all three vanish as u does.
        leading = [u**3, 3.0 * u**2 / reach, 6.0 * u / reach**2]
        assert np.allclose(derivatives, leading, rtol=3.0 * u + 1e-9, atol=0.0)


def test_kernels_beyond_the_fold_stop():
    x, theta = random_hinges(seed=11, low=FOLD_STOP + 1e-3, high=3.12)
    rng = np.random.default_rng(12)
    K, p = rng.uniform(0.5, 2.0, HINGES), rng.uniform(-1.2, 1.2, HINGES)
    force, blocks = kernels(x, p, K, None)
    full = full_matrix(blocks, 4)
    assert_close(force, -gradients(hinge_energy)(x, p, K))
    assert_close(full, hessians(hinge_energy)(x, p, K))
    # And from the printed blocks: theta = arccos(nu) away from flat.
    terms = paper.hinge_terms(x)
    _, first, second = stop_formulas(theta)
    g, sine = -paper.nu_gradient(terms) / np.sin(theta)[:, None, None], np.sin(theta)
    outer = g[:, :, :, None, None] * g[:, None, None]
    K5, first5, second5, sine5, cosine5 = (
        a[:, None, None, None, None] for a in (K, first, second, sine, np.cos(theta))
    )
    angle_hessian = (-paper.nu_hessian(terms) - cosine5 * outer) / sine5
    expected = paper.plastic_hessian(terms, K, p) + K5 * (second5 * outer + first5 * angle_hessian)
    assert_close(full, expected, rtol=1e-8)
    assert_close(force, paper.plastic_force(terms, K, p) - (K * first)[:, None, None] * g, rtol=1e-8)


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
            "step": dashpots.step_force(x, v, -0.9 * jnp.ones(len(dashpots.nodes)), 0.1),
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


# --- Plasticity ----------------------------------------------------------------------------------


def law(c0=0.3, time=1.0, gamma=1.0):
    """The paper's law."""
    return SmoothstepFlow(jnp.asarray(c0), jnp.asarray(time), jnp.asarray(gamma))


def smoothstep_gap(u):
    """G(u) with $G' = 1/S$: the time that the excess u takes to decay, in units of $T$."""
    log = 11.0 * np.log(u) - 5.5 * np.log(u * u - 2.5 * u + 5.0 / 3.0)
    arc = 3.0 * np.sqrt(15.0) * np.arctan((4.0 * u - 5.0) * np.sqrt(15.0) / 5.0)
    return 3.0 / 200.0 * (log + arc) - 3.0 / (20.0 * u) - 1.0 / (20.0 * u * u)


def integrate(rate, start, times):
    """Tight integration of a scalar equation; values at `times`."""
    solution = solve_ivp(
        lambda t, y: [float(rate(t, y[0]))],
        (0.0, times[-1]),
        [start],
        "DOP853",
        times,
        rtol=1e-12,
        atol=1e-13,
    )
    assert solution.success
    return solution.y[0]


def test_flow_rate_is_eqs_34_to_36():
    rng = np.random.default_rng(15)
    c, p = rng.uniform(-2.0, 2.0, (2, 5000))
    c0, time, gamma = 0.3, 0.7, 1.6
    u = np.clip((np.abs(c - p) - c0) / (2.0 - c0), 0.0, 1.0)
    expected = np.sign(c - p) * (6.0 * u**5 - 15.0 * u**4 + 10.0 * u**3) / (time * (1.0 + gamma))
    rate = np.asarray(law(c0, time, gamma).rate(jnp.asarray(c), jnp.asarray(p)))
    assert np.max(np.abs(rate - expected)) < 1e-14
    elastic = np.abs(c - p) <= c0
    assert np.all(rate[elastic] == 0.0)
    assert np.all(rate[~elastic] != 0.0)
    beyond = np.abs(c - p) > 2.0
    assert np.sum(beyond) > 0
    assert np.max(np.abs(np.abs(rate[beyond]) * time * (1.0 + gamma) - 1.0)) < 1e-14


def test_plastic_edge_under_held_curvature():
    C, c0, gamma = 1.5, 0.3, 1.0
    rate = jax.jit(lambda p: law(c0, 1.0, gamma).rate(C, p))
    times = np.array([1.0, 5.0, 20.0, 50.0])
    p = integrate(lambda t, p: rate(p), 0.0, times)
    assert np.max(np.abs(p - [0.337495915, 0.790048489, 1.017490305, 1.090856147])) < 6e-10
    u = (C - p - c0) / (2.0 - c0)
    elapsed = (smoothstep_gap((C - c0) / (2.0 - c0)) - smoothstep_gap(u)) * (1.0 + gamma) * (2.0 - c0)
    assert np.max(np.abs(elapsed / times - 1.0)) < 1e-9


def test_plastic_edge_on_a_ramp():
    rate = jax.jit(lambda c, p: law().rate(c, p))
    p = integrate(lambda t, p: rate(0.1 * t, p), 0.0, np.array([60.0, 70.0]))
    elastic = 0.1 * np.array([60.0, 70.0]) - p
    assert np.max(np.abs(elastic - 0.855217)) < 6e-7


def test_unloading_yields_again_only_beyond_c0():
    p = np.array([0.1, 0.2999, 0.3, 0.3001, 0.8])
    rate = np.asarray(law().rate(jnp.zeros(5), jnp.asarray(p)))
    assert np.all(rate[:3] == 0.0)
    assert np.all(rate[3:] < 0.0)


class Bingham(AbstractFlowRule):
    """A user's law: flow proportional to the excess over a per-hinge yield curvature."""

    yield_curvature: jax.Array
    time: jax.Array

    def rate(self, c, p):
        """dp/dt in 1/s."""
        elastic = c - p
        return jnp.sign(elastic) * jnp.maximum(jnp.abs(elastic) - self.yield_curvature, 0.0) / self.time


update = jax.jit(implicit_update)


def implicit_data(count=2000, seed=16):
    """Random states of an implicit plastic step."""
    rng = np.random.default_rng(seed)
    c, start = rng.uniform(-2.0, 2.0, (2, count))
    return jnp.asarray(c), jnp.asarray(start)


@pytest.mark.parametrize("beta_h", [1e-12, 1e-3, 0.3, 10.0, 1e3, 1e6, 1e12])
@pytest.mark.parametrize("c0", [0.05, 0.3, 1.2])
def test_implicit_update_finds_the_root(beta_h, c0):
    c, start = implicit_data()
    p, slope = (np.asarray(a) for a in update(law(c0), c, -start, beta_h))
    c, start = np.asarray(c), np.asarray(start)
    assert np.all(np.isfinite(p))
    assert np.all((slope >= 0.0) & (slope < 1.0))

    # Bisection of eq. (48) in plain NumPy.
    def mismatch(p):
        u = np.clip((np.abs(c - p) - c0) / (2.0 - c0), 0.0, 1.0)
        return p - start - beta_h * np.sign(c - p) * (6.0 * u**5 - 15.0 * u**4 + 10.0 * u**3) / 2.0

    low, high = np.minimum(start, c), np.maximum(start, c)
    for _ in range(70):
        middle = 0.5 * (low + high)
        positive = mismatch(middle) > 0.0
        low, high = np.where(positive, low, middle), np.where(positive, middle, high)
    elastic = np.abs(c - start) <= c0
    assert np.max(np.abs(p - 0.5 * (low + high))[~elastic]) < 1e-13
    assert np.array_equal(p[elastic], start[elastic])
    assert 0.01 < np.mean(elastic) < 0.9
    expected = paper.softening(c - p, c0, 2.0, beta_h)
    assert np.max(np.abs(slope - expected)) < 1e-9


@pytest.mark.parametrize("beta_h", [0.3, 10.0])
def test_implicit_update_slope(beta_h):
    c, start = implicit_data()
    # Away from the onset of yield, where the law is only twice differentiable.
    keep = np.abs(np.abs(c - start) - 0.3) > 1e-3
    c, start = c[keep], start[keep]
    slope = update(law(), c, -start, beta_h)[1]

    @jax.jit
    def derivative(c):
        return jax.jvp(lambda c: implicit_update(law(), c, -start, beta_h)[0], (c,), (jnp.ones_like(c),))[1]

    tangent = derivative(c)
    assert np.max(np.abs(tangent - slope)) < 1e-12
    step = 1e-5
    plus, minus = (update(law(), c + s, -start, beta_h)[0] for s in (step, -step))
    difference = (plus - minus) / (2.0 * step)
    assert np.max(np.abs(difference - slope)) < 1e-7
    assert np.max(slope) > 0.1


def test_implicit_update_can_be_differentiated_in_reverse():
    c, start = implicit_data(200)
    beta_h, c0 = 3.0, jnp.full(200, 0.3)

    @jax.jit
    def total(c, memory, beta_h, c0):
        return jnp.sum(
            implicit_update(SmoothstepFlow(c0, jnp.asarray(1.0), jnp.asarray(1.0)), c, memory, beta_h)[0]
        )

    by_c, by_memory, by_step, by_c0 = jax.grad(total, (0, 1, 2, 3))(c, -start, beta_h, c0)
    p, slope = update(law(), c, -start, beta_h)
    assert np.max(np.abs(by_c - slope)) < 1e-12
    # (48) differentiated: (1 + beta h f') dp = dp* + g d(beta h) + beta h f' dc.
    assert np.max(np.abs(by_memory + (1.0 - slope))) < 1e-12
    assert abs(by_step - np.sum((1.0 - slope) * law().rate(c, p))) < 1e-10
    step = 1e-6
    difference = (total(c, -start, beta_h, c0 + step) - total(c, -start, beta_h, c0 - step)) / (2.0 * step)
    assert abs(np.sum(by_c0) - difference) < 1e-6


@pytest.mark.parametrize("beta_h", [1e-6, 0.5, 1e8])
def test_implicit_update_with_a_law_of_ones_own(beta_h):
    c, start = implicit_data(500)
    c0 = jnp.linspace(0.1, 1.0, 500)
    p, slope = update(Bingham(c0, jnp.asarray(0.5)), c, -start, beta_h)
    ratio = beta_h / 0.5
    yielding = np.abs(c - start) > c0
    flow = np.sign(c - start) * (np.abs(c - start) - c0) * ratio / (1.0 + ratio)
    assert np.max(np.abs(p - np.where(yielding, start + flow, start))) < 1e-13
    assert np.max(np.abs(slope - np.where(yielding, ratio / (1.0 + ratio), 0.0))) < 1e-9
    assert np.array_equal(p[~yielding], start[~yielding])
