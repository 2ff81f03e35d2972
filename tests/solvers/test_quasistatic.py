"""The quasistatic stage: plastic flow of one hinge, Newton's tangent, and relaxation under drag."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from lattice import SPACING, advance, constants, held, lattice, solver, strip_scene, with_terms
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxcrumple.history import HISTORY, History, implicit_step
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.model.loads import AbstractMotion, Prescribed
from jaxcrumple.model.walls import Ramp, Sphere
from jaxcrumple.scene import sheet
from jaxcrumple.solvers.implicit.bdf import coefficients
from jaxcrumple.state import QUASISTATIC, initial_state
from jaxcrumple.system import linearize, residual, tangent

C0, GAMMA = 0.3, 1.0

# --- One hinge whose curvature is prescribed -----------------------------------------------------


class Fold(AbstractMotion):
    """Hinge held at the curvature c = `start` + `rate` (t - `since`); `flat` (4, 3), node 3 turns."""

    flat: Array
    start: Array
    rate: Array
    since: Array

    def __call__(self, t):
        theta = 2 * jnp.arcsin((self.start + self.rate * (t - self.since)) / 2)
        arm = jnp.stack([jnp.zeros(()), -jnp.cos(theta), -jnp.sin(theta)])
        apex = self.flat[3] * jnp.array([1.0, 0.0, 0.0]) + jnp.abs(self.flat[3, 1]) * arm
        return jnp.concatenate([self.flat[:3], apex[None]])


def hinge_mesh():
    """Two equilateral triangles with nodes numbered as x0 ... x3 of the hinge."""
    mesh = lattice(2, 1)
    x = mesh.vertices[mesh.hinges[0]]
    along = (x[1] - x[0]) / SPACING
    across = np.cross([0.0, 0.0, 1.0], along)
    local = np.stack([(x - x[0]) @ along, (x - x[0]) @ across, np.zeros(4)], axis=1)
    return mesh.from_arrays(local, [[0, 1, 2], [1, 0, 3]], reorder=False)


@functools.cache
def hinge_scene():
    mesh = hinge_mesh()
    assert mesh.hinges[0].tolist() == [0, 1, 2, 3]
    motion = Fold(jnp.asarray(mesh.vertices), *jnp.zeros(3))
    material = Material(yield_c0=C0, gamma=GAMMA, plastic_time=1.0)
    return sheet(mesh, material, prescribed=Prescribed(jnp.ones((4, 3), bool), motion))


def folding(curvature, rate=0.0, since=0.0):
    """The hinge's scene with c = `curvature` + `rate` (t - `since`)."""
    scene = hinge_scene()
    motion = Fold(scene.prescribed.motion.flat, *(jnp.asarray(float(a)) for a in (curvature, rate, since)))
    return eqx.tree_at(lambda s: s.prescribed.motion, scene, motion)


def hinge_start(scene):
    return initial_state(scene, scene.prescribed.motion(jnp.asarray(0.0)))


def flow(c, p):
    """dp/dt of (34)-(36) with T = 1 s, written out."""
    u = np.clip((abs(c - p) - C0) / (2 - C0), 0.0, 1.0)
    return np.sign(c - p) * (6 * u**5 - 15 * u**4 + 10 * u**3) / (1 + GAMMA)


HELD = {1: 0.337495915, 5: 0.790048489, 20: 1.017490305, 50: 1.090856147}


def held_primitive(u):
    """G(u) of the closed form: the integral of 1/(6 u^5 - 15 u^4 + 10 u^3)."""
    root = np.sqrt(15.0)
    logs = (
        11 * np.log(u) - 5.5 * np.log(u**2 - 2.5 * u + 5 / 3) + 3 * root * np.arctan((4 * u - 5) * root / 5)
    )
    return 3 / 200 * logs - 3 / (20 * u) - 1 / (20 * u**2)


def held_curvature(t, c=1.5):
    """p(t) of an edge held at `c` since t = 0."""
    span = 2 - C0
    first = (c - C0) / span
    goal = held_primitive(first) - t / ((1 + GAMMA) * span)
    return c - C0 - span * brentq(lambda u: held_primitive(u) - goal, 1e-6, first, xtol=1e-15)


def test_closed_form_of_a_held_edge():
    for t, p in HELD.items():
        assert held_curvature(t) == pytest.approx(p, abs=1e-9)


@functools.cache
def held_errors(rtol):
    """Errors of p over 2, the unit of the tolerance, at the tabulated times."""
    scene = folding(1.5)
    state, errors = hinge_start(scene), []
    assert float(scene.bending.hinges(state.x).theta[0]) == pytest.approx(2 * np.arcsin(0.75), rel=1e-14)
    for t, p in HELD.items():
        state = advance(scene, state, t, solver(rtol))
        errors.append(abs(float(state.p[0]) - p) / 2)
    assert int(state.stage) == QUASISTATIC
    return np.array(errors)


@pytest.mark.parametrize("rtol", [1e-3, 1e-4, 1e-5, 1e-6])
def test_plastic_flow_of_a_held_edge(rtol):
    assert np.max(held_errors(rtol)) < rtol


def test_error_of_plastic_flow_falls_with_the_tolerance():
    worst = [np.max(held_errors(rtol)) for rtol in (1e-3, 1e-4, 1e-5, 1e-6)]
    assert np.all(np.diff(worst) < 0)
    assert worst[-1] < 1e-2 * worst[0]


def test_ramp_reaches_its_steady_lag():
    speed, c = 0.1, -1.9
    scene = folding(c, speed)
    state = hinge_start(scene)
    # From flat to flat the ramp would be too short: it starts far on the other side, at rest.
    past = (state.p + c, state.history.p + c)
    state = eqx.tree_at(lambda s: (s.p, s.history.p), state, past)
    state = advance(scene, state, 38.0, solver(1e-5))
    lag = c + speed * 38.0 - float(state.p[0])
    # Rate v needs S(u) = v (1 + gamma).
    u = brentq(lambda u: 6 * u**5 - 15 * u**4 + 10 * u**3 - speed * (1 + GAMMA), 0, 1, xtol=1e-15)
    steady = C0 + (2 - C0) * u
    assert steady == pytest.approx(0.855217, abs=1e-6)
    assert lag == pytest.approx(steady, abs=2e-5)


@functools.cache
def unloaded(hold, rtol=1e-5):
    """p after `hold` seconds at c = 1.5 and one second of unloading to 0, p 30 s later, and by reference."""
    scene, options = folding(1.5), solver(rtol)
    state = advance(scene, hinge_start(scene), hold, options)
    state = advance(folding(1.5, -1.5, hold), state, hold + 1.0, options)
    end = advance(folding(0.0), state, hold + 31.0, options)
    exact = held_curvature(hold)
    for c in (lambda t: 1.5 - 1.5 * t, lambda t: 0.0):
        duration = 1.0 if c(1.0) != c(0.5) else 30.0
        run = solve_ivp(lambda t, p, c=c: [flow(c(t), p[0])], (0, duration), [exact], rtol=1e-10, atol=1e-12)
        exact = run.y[0, -1]
    return float(state.p[0]), float(end.p[0]), exact


def test_unloading_yields_again_beyond_the_yield_curvature():
    p, later, exact = unloaded(20.0)
    assert p > C0
    assert C0 < later < p - 0.05
    assert later == pytest.approx(exact, abs=4e-5)


def test_unloading_after_little_flow_stays_elastic():
    p, later, exact = unloaded(0.5)
    assert 0 < p < C0
    # The flow has stopped; what remains is the memory of the formula, far below the tolerance.
    assert later == pytest.approx(p, abs=1e-7)
    assert later == pytest.approx(exact, abs=4e-5)


# --- Newton's tangent ----------------------------------------------------------------------------


@functools.cache
def crumpled_step(damping):
    """Scene, implicit step and positions with every term active; rates are as large as stiffnesses."""
    mesh = rectangle(0.02, 0.015, 40, seed=5, sweeps=5)
    rng = np.random.default_rng(6)
    x = mesh.vertices + 4e-4 * rng.normal(size=mesh.vertices.shape)
    mask = rng.random(mesh.vertices.shape) < 0.1
    wall = Sphere(jnp.zeros(3), Ramp(jnp.asarray(0.0105), jnp.asarray(-0.01)))
    material = Material(yield_c0=0.2, plastic_time=1e-4, drag_rate=1e5, internal_damping_time=1e-5)
    scene = sheet(mesh, material, walls=[wall], prescribed=held(mask, x), damping=damping)
    past = x + 1e-4 * rng.normal(size=(HISTORY, *x.shape))
    p = 0.5 * rng.normal(size=len(mesh.hinges)) + 0.01 * rng.normal(size=(HISTORY, len(mesh.hinges)))
    steps = jnp.array([2e-5, 1.5e-5, 3e-5, 1e-5, 2e-5, 1e-5])
    velocities, order = rng.normal(size=(2, *x.shape)), jnp.asarray(3)
    velocities = jnp.asarray(np.pad(velocities, ((0, HISTORY - 2), (0, 0), (0, 0))))
    history = History(jnp.asarray(past), velocities, jnp.asarray(p), steps, jnp.asarray(4), order)
    alpha, beta_h = coefficients(jnp.asarray(1.8e-5), steps, order)
    return scene, implicit_step(scene, history, alpha, beta_h, jnp.asarray(0.01)), jnp.asarray(x)


def force_terms(scene, step, x):
    """Largest nodal force of each term of the residual."""
    v = step.velocity(x)
    return {
        "wall": scene.walls[0].force(x, step.t),
        "drag": scene.drag.force(v),
        "damping": scene.damping.step_force(x, v, step.damping_memory, step.beta_h),
        "membrane": scene.membrane.force(x),
    }


@pytest.mark.parametrize("damping", ["central", "paper"])
def test_tangent_is_the_derivative_of_the_residual(damping):
    scene, step, x = crumpled_step(damping)
    for name, term in force_terms(scene, step, x).items():
        assert float(jnp.abs(term).max()) > 1e-3, name
    value, values = eqx.filter_jit(linearize)(scene, step, x)
    function = eqx.filter_jit(residual)
    first, p = function(scene, step, x)
    np.testing.assert_allclose(value, first, rtol=1e-12, atol=1e-12 * np.abs(first).max())
    assert np.mean(np.abs(p + step.p_memory) > 1e-3) > 0.2
    free = ~np.asarray(scene.prescribed.mask)
    assert np.all(np.asarray(value)[~free] == 0)
    eps = 1e-5 * SPACING
    for seed in range(5):
        d = jnp.asarray(np.random.default_rng(seed).normal(size=x.shape) * free)
        difference = (function(scene, step, x + eps * d)[0] - function(scene, step, x - eps * d)[0]) / (
            2 * eps
        )
        product = np.asarray(scene.sparsity.product(values, d.reshape(-1))).reshape(x.shape)
        error = np.abs(product - difference)[free].max() / np.abs(difference).max()
        assert error < 1e-6


@pytest.mark.parametrize("damping", ["central", "paper"])
def test_tangent_decouples_prescribed_components(damping):
    scene, step, x = crumpled_step(damping)
    _, values = eqx.filter_jit(linearize)(scene, step, x)
    mask = np.asarray(scene.prescribed.mask)
    d = np.random.default_rng(9).normal(size=x.shape) * mask
    product = np.asarray(scene.sparsity.product(values, jnp.asarray(d).reshape(-1))).reshape(x.shape)
    np.testing.assert_allclose(product, d * constants(scene)[0], rtol=1e-12)


# --- Relaxation ----------------------------------------------------------------------------------


def test_bent_strip_relaxes_at_the_rate_of_its_slowest_mode():
    mesh, scene = strip_scene()
    drag = 3e6
    scene = with_terms(scene, drag=drag)
    stiffness = tangent(scene, initial_state(scene, mesh.vertices)).toarray()
    squared, shapes = np.linalg.eigh(stiffness / constants(scene)[2])
    assert np.all(np.abs(squared[:6]) < 1e-6 * squared[6])
    # No mass: b_iso dx/dt = -K x.
    rate, shape = squared[6] / drag, shapes[:, 6].reshape(-1, 3)
    assert np.sum(shape[:, 2] ** 2) == pytest.approx(1.0)
    # So little bending that the strip does not stretch: that would relax at once, within a first step.
    bend = 1e-4 * SPACING / np.abs(shape).max() * shape
    state = initial_state(scene, mesh.vertices + bend, -rate * bend)
    for t in (0.5 / rate, 2.0 / rate):
        state = advance(scene, state, t, solver(1e-8))
        left = np.sum(shape * (np.asarray(state.x) - mesh.vertices)) / np.sum(shape * bend)
        assert int(state.stage) == QUASISTATIC
        assert -np.log(left) == pytest.approx(rate * t, rel=1e-3)
