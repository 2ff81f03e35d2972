"""The package's closed forms against autodiff and Appendix A: dashpots, hinges and the fold stop."""

import appendix_a as paper
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import (
    FOLD_STOP,
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
    kernels,
    random_edges,
    random_hinges,
    rotations,
    update,
)

from jaxcrumple.geometry import hinge as geometry
from jaxcrumple.geometry.hinge import HalfAngle
from jaxcrumple.model import bending
from jaxcrumple.model.bending import Bending
from jaxcrumple.model.damping import CentralDashpot, PaperDashpot
from jaxcrumple.model.plasticity import SmoothstepFlow, implicit_update

hinge_data = pytest.fixture(hinge_sample, scope="module")


@pytest.fixture(scope="module")
def energy_hessian_autodiff(hinge_data):
    """Hessian of the package's hinge energy by autodiff."""
    x, _, _, K, p = hinge_data
    return np.asarray(hessians(hinge_energy)(x, p, K))


# --- Dashpots ------------------------------------------------------------------------------------


def step_edges():
    """Edges of an implicit step: x, past, history weights, beta h; velocities follow from (47)."""
    x, _, b, s = random_edges()
    rng = np.random.default_rng(3)
    past = x + 0.1 * rng.normal(size=(3, *x.shape))
    return x, past, np.array([-1.8, 1.1, -0.3]), jnp.asarray(0.37), b, s


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
    force = CentralDashpot(nodes, jnp.asarray(b)).force(nodes_x, jnp.asarray(v.reshape(-1, 3)))
    assert_close(force.reshape(-1, 2, 3), np.stack([f, -f], axis=1))


def test_central_dashpot_step_force_ignores_rigid_motion_of_any_size():
    x, _, alpha, beta_h, b, _ = step_edges()
    alpha = alpha / -alpha.sum()  # a consistent method: constants have zero rate
    rng = np.random.default_rng(4)
    nodes_x, nodes = disconnected(x)
    moved = np.einsum("sij,nj->sni", rotations(rng, 3), nodes_x) + rng.normal(size=(3, 1, 3))
    dashpot = CentralDashpot(nodes, jnp.asarray(b))
    memory = dashpot.memory(jnp.asarray(moved), jnp.asarray(alpha))
    force = dashpot.step_force(nodes_x, jnp.zeros_like(nodes_x), memory, beta_h)
    assert np.max(np.abs(force)) < 1e-13


# --- Forces and Hessians of hinges ---------------------------------------------------------------


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
        one = jnp.ones(len(x))
        return gradient, geometry.hinge_hessian(hinge, one, 0.0 * one)

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


def softened_hinges():
    """Hinges with stiffness K, rest curvature p and a slope dp/dc of the plastic update."""
    x, theta = random_hinges(seed=6)
    rng = np.random.default_rng(7)
    return x, theta, *(rng.uniform(a, b, HINGES) for a, b in ((0.5, 2.0), (-1.2, 1.2), (0.0, 1.0)))


def test_bending_hessian_with_softening():
    x, theta, K, p, loss = softened_hinges()
    blocks = kernels(x, p, K, loss)[1]
    assert blocks.shape == (10, 3, 3, HINGES)
    full, below = full_matrix(blocks, 4), np.abs(theta) < FOLD_STOP
    assert_close(full[below], paper.plastic_hessian(paper.hinge_terms(x), K, p, loss)[below])


def test_forces_and_hessians_of_a_batch_are_those_of_its_members():
    x, _, K, p, loss = softened_hinges()
    split = [np.asarray(a).reshape(4, HINGES // 4, *a.shape[1:]) for a in (x, p, K, loss)]
    force, blocks = jax.jit(jax.vmap(kernels))(*split)
    whole_force, whole = kernels(x, p, K, loss)
    assert_close(force.reshape(-1, 4, 3), whole_force, rtol=1e-12)
    together = np.moveaxis(np.asarray(blocks), 0, -2).reshape(10, 3, 3, HINGES)
    assert_close(full_matrix(together, 4), full_matrix(whole, 4), rtol=1e-12)


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
        p, _ = implicit_update(rule, c[None], memory[None], jnp.asarray(beta_h))
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
    half = HalfAngle(jnp.sin(0.5 * theta), jnp.cos(0.5 * theta))
    stop = [bending.fold_stop(jnp.asarray(theta)), *bending.stop_derivatives(half)]
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
    assert bending.fold_stop(jnp.asarray(np.pi - 1e-6)) > 1e5


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
