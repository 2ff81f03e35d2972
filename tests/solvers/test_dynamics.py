"""The explicit stage through `integrate`, and rigid and prescribed motion in every stage."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from lattice import (
    SPACING,
    advance,
    constants,
    elastic,
    held,
    lattice,
    run,
    solver,
    strip_scene,
    total_energy,
    with_terms,
)

import jaxcrumple as jc
from jaxcrumple.model.loads import ElementEnergy
from jaxcrumple.scene import sheet
from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.scheme import integrator
from jaxcrumple.state import EXPLICIT, IMPLICIT, QUASISTATIC, initial_state
from jaxcrumple.system import tangent

strip = functools.cache(strip_scene)
STAGE = {"explicit": EXPLICIT, "dynamic": IMPLICIT, "quasistatic": QUASISTATIC, "paper": QUASISTATIC}


def explicit(rtol, max_step=np.inf):
    return solver(rtol, "explicit", max_step=max_step)


@functools.cache
def modes():
    """Frequencies (3n,) and unit modes (3n, 3n) of the flat strip; nodes have equal mass."""
    mesh, scene = strip()
    stiffness = tangent(scene, initial_state(scene, mesh.vertices)).toarray()
    squared, shapes = np.linalg.eigh(stiffness / constants(scene)[2])
    return np.sqrt(np.maximum(squared, 0.0)), shapes


def membrane_mode(target):
    """Frequency and shape (n, 3) of the in-plane mode whose frequency is nearest to `target`."""
    omega, shapes = modes()
    flat = np.sum(shapes.reshape(-1, 3, len(omega))[:, 2] ** 2, axis=0) < 1e-12
    pick = np.flatnonzero(flat)[np.argmin(np.abs(omega[flat] - target))]
    return omega[pick], shapes[:, pick].reshape(-1, 3)


# --- Energy --------------------------------------------------------------------------------------


def test_energy_of_an_undamped_mode_falls_as_predicted():
    mesh, scene = strip()
    omega, shape = membrane_mode(1.4e6)
    z, steps = 0.9, 200
    h = z / omega
    state = initial_state(scene, mesh.vertices + 1e-9 * shape)
    end = advance(scene, state, steps * h, explicit(1e-3, h))
    assert int(end.counters.steps[EXPLICIT]) == steps
    # |R(iz)|^2 at z = omega h
    expected = (1 - z**6 / 72 + z**8 / 576) ** steps
    assert total_energy(scene, end) / total_energy(scene, state) == pytest.approx(expected, rel=1e-3)


def test_energy_of_a_shaken_sheet_never_grows():
    mesh, scene = strip()
    rng = np.random.default_rng(0)
    x = mesh.vertices + 0.05 * SPACING * rng.normal(size=mesh.vertices.shape)
    state = initial_state(scene, x)
    limit = float(integrator(scheme="explicit").stability_limit(scene, state.x, 0.0))
    options = explicit(1e-3)
    energy = [total_energy(scene, state)]
    for t in np.arange(1, 6) * 40 * limit:
        state = advance(scene, state, t, options)
        energy.append(total_energy(scene, state))
    assert np.all(np.diff(energy) < 0)


def test_energy_drift_falls_with_the_fifth_power_of_the_step():
    """A mode loses energy at the rate omega^6 h^5/72; the stiffest modes dominate the loss."""
    mesh, scene = strip()
    rng = np.random.default_rng(0)
    x = mesh.vertices + 0.05 * SPACING * rng.normal(size=mesh.vertices.shape)
    state = initial_state(scene, x)
    limit = float(integrator(scheme="explicit").stability_limit(scene, state.x, 0.0))
    first = total_energy(scene, state)
    loss = [
        1 - total_energy(scene, advance(scene, state, 32 * limit, explicit(0.09, share * limit))) / first
        for share in (0.25, 0.125)
    ]
    assert np.log2(loss[0] / loss[1]) == pytest.approx(5.0, abs=0.3)


# --- Damping -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("drag", "internal"), [(2e4, 0.0), (0.0, 5e-8), (1e4, 5e-8)])
def test_damping_ratio_of_a_mode(drag, internal):
    mesh, scene = strip()
    scene = with_terms(scene, drag=drag, internal=internal)
    omega, shape = membrane_mode(5e5)
    state = initial_state(scene, mesh.vertices + 1e-9 * shape)
    zeta = internal * omega / 2 + drag / (2 * omega)
    damped = omega * np.sqrt(1 - zeta**2)

    def amplitude(state):
        q = np.sum(shape * (np.asarray(state.x) - mesh.vertices))
        dq = np.sum(shape * np.asarray(state.v))
        return np.hypot(q, (dq + zeta * omega * q) / damped)

    duration = 40 / omega
    end = advance(scene, state, duration, explicit(1e-3, 0.1 / omega))
    measured = np.log(amplitude(state) / amplitude(end)) / (omega * duration)
    assert measured == pytest.approx(zeta, rel=1e-3)


# --- Rigid motion --------------------------------------------------------------------------------


@pytest.mark.parametrize("drag", [0.0, 50.0])
def test_free_fall(drag):
    mesh, scene = strip()
    g = np.array([1.0, -2.0, -9.81])
    scene = with_terms(scene, drag=drag, internal=2e-7, gravity=g)
    v0 = np.array([0.3, 0.0, 0.1])
    state = initial_state(scene, mesh.vertices, np.broadcast_to(v0, mesh.vertices.shape))
    t = 2e-3
    end = advance(scene, state, t, explicit(1e-6))
    if drag:
        limit, decay = g / drag, np.exp(-drag * t)
        v = limit + (v0 - limit) * decay
        shift = limit * t + (v0 - limit) * (1 - decay) / drag
    else:
        v, shift = v0 + g * t, v0 * t + g * t**2 / 2
    np.testing.assert_allclose(end.v, np.broadcast_to(v, mesh.vertices.shape), atol=1e-10)
    np.testing.assert_allclose(end.x - mesh.vertices, np.broadcast_to(shift, end.x.shape), atol=1e-12)


@pytest.mark.parametrize("rtol", [1e-3, 1e-4])
def test_steps_get_long_again_where_the_motion_is_smooth(rtol):
    """A flat sheet that drag slows down: z = -(1 - exp(-d t)) v/d.

    The first implicit step is too long, and the run begins with explicit steps. After one spell of them the
    implicit steps begin at order 2, go on to the end, and take hardly more than without explicit steps."""
    mesh = jc.rectangle(0.1, 0.1, 30, seed=0, sweeps=3)
    scene, v, decay, t = sheet(mesh, jc.Material(drag_rate=20.0)), np.zeros((mesh.n_nodes, 3)), 20.0, 0.3
    v[:, 2] = -1.0
    state = initial_state(scene, mesh.vertices, v)
    ends = {s: simulate(scene, state, t, solver=integrator(rtol, scheme=s)) for s in ("hybrid", "dynamic")}
    shift = (np.exp(-decay * t) - 1.0) / decay
    for end in ends.values():
        assert np.max(np.abs(end.x[-1] - mesh.vertices - [0.0, 0.0, shift])) < 0.1 * rtol
    counters = ends["hybrid"].state.counters
    assert counters.steps[EXPLICIT] <= 400 and counters.switches == 2
    assert counters.steps[IMPLICIT] <= 1.1 * ends["dynamic"].state.counters.steps[IMPLICIT]
    rows = ends["hybrid"].history
    steps = rows[(rows["kind"] == 0) & (rows["stage"] == "implicit")]
    assert steps["order"].min() == 2


def spring(x, parameters, t):
    """A spring from a node to its anchor."""
    stiffness, anchor = parameters
    return 0.5 * stiffness * jnp.sum((x[0] - anchor) ** 2)


@pytest.mark.parametrize("drag", [pytest.param(5.0, marks=pytest.mark.slow), 100.0])
def test_errors_of_a_damped_oscillation_add_up_to_less_than_rtol(drag):
    """However many steps the oscillation remembers: some 100 with the larger drag, 4000 with the smaller."""
    omega, rtol = 400.0, 1e-2
    mesh = lattice(4, 3)
    mass = sheet(mesh, elastic()).mass
    anchors = (omega**2 * mass, jnp.asarray(mesh.vertices))
    springs = ElementEnergy(jnp.arange(mesh.n_nodes)[:, None], spring, anchors)
    scene = sheet(mesh, elastic(drag_rate=drag), extra=[springs])
    shift = 0.3 * float(scene.length_scale) * np.array([0.6, 0.0, 0.8])
    t = np.linspace(0.0, 0.4, 11)[1:]
    state = initial_state(scene, mesh.vertices + shift)
    solver = integrator(rtol, scheme="dynamic", linear="block-cg")
    run = simulate(scene, state, t, solver=solver, throw=True)
    decay = drag / 2
    damped = np.sqrt(omega**2 - decay**2)
    expected = np.exp(-decay * t) * (np.cos(damped * t) + decay / damped * np.sin(damped * t))
    found = run.x - mesh.vertices
    error = np.abs(found - expected[:, None, None] * shift).max() / float(scene.length_scale)
    assert error < rtol


def momenta(scene, state):
    """Linear and angular momentum about the origin."""
    p = np.asarray(scene.mass)[:, None] * np.asarray(state.v)
    return p.sum(axis=0), np.cross(np.asarray(state.x), p).sum(axis=0)


def test_a_flying_and_spinning_sheet_keeps_its_momenta():
    mesh, scene = strip()
    scene = with_terms(scene, internal=2e-7)
    spin, flight = np.array([300.0, -200.0, 500.0]), np.array([0.5, 0.2, -0.1])
    v = np.cross(spin, mesh.vertices) + flight
    state = initial_state(scene, mesh.vertices, v)
    end = advance(scene, state, 1.6e-3, explicit(1e-6))
    linear, angular = momenta(scene, state)
    linear_end, angular_end = momenta(scene, end)
    row, turned = mesh.vertices[8] - mesh.vertices[0], np.asarray(end.x)[8] - np.asarray(end.x)[0]
    assert row @ turned < 0.8 * (row @ row)
    np.testing.assert_allclose(linear_end, linear, atol=1e-10 * np.linalg.norm(linear))
    np.testing.assert_allclose(angular_end, angular, atol=1e-10 * np.linalg.norm(angular))


# --- Prescribed motion ---------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["explicit", "dynamic", "quasistatic", "paper"])
def test_prescribed_nodes_follow_their_motion_exactly(scheme):
    mesh, scene = strip()
    scene = with_terms(scene, drag=1e3, internal=2e-7)
    velocity = np.array([0.02, 0.01, -0.03])
    mask = np.zeros((mesh.n_nodes, 3), bool)
    mask[mesh.vertices[:, 0] < -3.4 * SPACING] = True
    mask[-1, 2] = True
    scene = eqx.tree_at(lambda s: s.prescribed, scene, held(mask, mesh.vertices, velocity))
    state = initial_state(scene, mesh.vertices, np.where(mask, velocity, 0.0))
    t = 3e-4
    # Loose: the quasistatic stage starts at rest, with a jump of the velocity it must not stop at.
    end = advance(scene, state, t, solver(1e-3, scheme))
    expected = mesh.vertices + velocity * t
    np.testing.assert_allclose(np.asarray(end.x)[mask], expected[mask], rtol=1e-15, atol=1e-18)
    np.testing.assert_allclose(
        np.asarray(end.v)[mask], np.broadcast_to(velocity, mask.shape)[mask], rtol=1e-9
    )
    assert int(end.stage) == STAGE[scheme]
    moved = np.asarray(end.x) - mesh.vertices
    assert 0 < np.abs(moved[~mask]).max() < 1.5 * np.abs(velocity).max() * t


def test_an_explicit_run_with_moving_supports_goes_on_to_the_same_bits_wherever_it_is_cut():
    mesh, scene = strip()
    mask = np.zeros((mesh.n_nodes, 3), bool)
    mask[:4] = True
    support = held(mask, mesh.vertices, (0.3, -0.7, 1.1))
    scene = eqx.tree_at(lambda s: s.prescribed, scene, support)
    state = initial_state(scene, mesh.vertices)
    whole = advance(scene, state, 1e-4, explicit(1e-3))
    assert int(whole.counters.steps[EXPLICIT]) > 30
    cut = state
    while float(cut.t) < 1e-4:
        cut, _ = run(scene, cut, jnp.asarray(1e-4), explicit(1e-3), 7.0)
    for name in ("x", "v", "h_explicit"):
        assert np.asarray(getattr(cut, name)).tobytes() == np.asarray(getattr(whole, name)).tobytes(), name


@pytest.mark.parametrize("scheme", ["dynamic", "explicit"])
def test_a_support_that_lets_go_lets_fall(scheme):
    """Held until 1 ms, then free fall for 2 ms: z = -g (t - t0)^2 / 2, in a sheet without drag."""
    mesh = jc.hexagonal(3, 3, 1e-2)
    material = jc.Material(drag_rate=0.0, internal_damping_time=0.0, yield_curvature=None)
    motion = jc.LinearMotion(mesh.vertices, (0.0, 0.0, 0.0))
    held = jc.Prescribed(jnp.ones((mesh.n_nodes, 3), bool), motion, until=1e-3)
    scene = jc.sheet(mesh, material, gravity=(0.0, 0.0, -9.81), prescribed=held)
    state = jc.initial_state(scene, mesh.vertices)
    solution = jc.simulate(scene, state, [1e-3, 3e-3], solver=jc.integrator(1e-4, scheme=scheme))
    assert solution.result == "success"
    np.testing.assert_array_equal(solution.x[0], mesh.vertices)
    np.testing.assert_allclose(solution.x[1, :, 2], -0.5 * 9.81 * 4e-6, rtol=5e-3)
    np.testing.assert_allclose(solution.v[1, :, 2], -9.81 * 2e-3, rtol=5e-3)
