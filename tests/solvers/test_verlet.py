"""Verlet's method against closed forms, the other method, and its own linear theory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattice import constants, elastic, lattice, patch, strip_scene, total_energy, with_terms

import jaxcrumple as jc
from jaxcrumple.model.walls import Plane, Wall
from jaxcrumple.solvers.explicit.base import slopes_at
from jaxcrumple.solvers.explicit.runge_kutta import RungeKutta
from jaxcrumple.solvers.explicit.stability import Fastest, fastest
from jaxcrumple.solvers.explicit.verlet import Verlet, verlet
from jaxcrumple.state import CAUSES, initial_state
from jaxcrumple.system import energies


def shaken(plastic_time=1e-5, **terms):
    """A small plastic sheet far from flat with a velocity, all dissipation on: scene, x, v and p."""
    mesh = lattice(6, 4)
    material = jc.Material(yield_curvature=100.0, plastic_time=plastic_time, internal_damping_time=1e-6)
    scene = jc.sheet(mesh, material, gravity=(0.0, 0.0, -1e3), **terms)
    rng = np.random.default_rng(0)
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    height = 2e-3 * np.sin(600.0 * x) * np.cos(500.0 * y)
    v = 0.5 * rng.normal(size=mesh.vertices.shape)
    return (
        scene,
        jnp.asarray(mesh.vertices).at[:, 2].set(height),
        jnp.asarray(v),
        scene.bending.rest_curvature,
    )


@eqx.filter_jit
def end_of(method, scene, x, v, p, end, steps):
    h = jnp.asarray(end / steps)

    def body(k, y):
        return method.advance(scene, k * h, h, *y)

    return jax.lax.fori_loop(0, steps, body, (x, v, p))


def test_errors_of_positions_velocities_and_rest_curvatures_fall_with_the_square_of_the_step():
    scene, x, v, p = shaken()
    end, counts = 40 * float(Verlet.stable(fastest(scene, x))), np.array([160, 320, 640])
    exact = end_of(RungeKutta, scene, x, v, p, end, 5120)
    assert float(jnp.max(jnp.abs(exact[2] - p))) > 0.01
    found = [end_of(Verlet, scene, x, v, p, end, int(count)) for count in counts]
    for part in range(3):
        errors = [float(jnp.max(jnp.abs(at[part] - exact[part]))) for at in found]
        slope = np.polyfit(np.log(1.0 / counts), np.log(errors), 1)[0]
        assert slope == pytest.approx(2.0, abs=0.15), part


def test_a_step_hands_on_the_derivatives_at_its_end():
    scene, x, v, p = shaken()
    h = 0.5 * Verlet.stable(fastest(scene, x))
    x, v, p, slopes = verlet(scene, jnp.zeros(()), h, x, v, p, slopes_at(scene, x, v, p, jnp.zeros(())))
    again = slopes_at(scene, x, v, p, h)
    size = float(jnp.max(jnp.abs(again.acceleration)))
    np.testing.assert_allclose(slopes.acceleration, again.acceleration, atol=1e-12 * size)
    np.testing.assert_allclose(slopes.flow, again.flow, atol=1e-12 * float(jnp.max(jnp.abs(again.flow))))


def test_the_estimated_error_of_positions_is_the_error():
    scene, x, v, p = shaken()
    state = initial_state(scene, x, v)
    for share in (0.05, 0.025):
        h = share * Verlet.stable(fastest(scene, x))
        slopes = slopes_at(scene, state.x, state.v, state.p, state.t)
        state = eqx.tree_at(lambda s: s.slopes, state, slopes)
        tried = Verlet(jnp.asarray(1e-3)).step(scene, state, h)
        exact = end_of(RungeKutta, scene, x, v, p, h, 16)
        error = np.asarray(exact[0] - tried.x)
        assert np.max(np.abs(error - tried.error[0])) < 0.15 * np.max(np.abs(error))


def growth(omega, ratio, h):
    """Largest growth a step of a mode of that frequency and damping ratio, by the formulas of the method."""

    def step(x, v):
        a = -(omega**2) * x - 2 * ratio * omega * v
        new = x + h * v + 0.5 * h * h * a
        return new, v + 0.5 * h * (a - omega**2 * new - 2 * ratio * omega * (v + h * a))

    matrix = np.array([step(1.0, 0.0), step(0.0, 1.0)]).T
    return np.max(np.abs(np.linalg.eigvals(matrix)))


@pytest.mark.parametrize("ratio", [0.0, 0.05, 0.25, 1.0, 4.0])
def test_no_damped_mode_grows_at_the_limit(ratio):
    # Dashpots damp in proportion to the frequency.
    limit = float(Verlet.stable(Fastest(1.0, 2.0 * ratio, 1e3)))
    shares = np.linspace(0.01, 1.0, 200)
    assert max(growth(share, ratio * share, limit) for share in shares) <= 1 + 1e-12
    if ratio == 0:
        assert limit == 2.0
        assert growth(1.0, 0.0, 1.001 * limit) > 1.01


def test_the_limit_on_the_lattice():
    _, scene, _ = patch()
    ks, _, mass = constants(scene)
    scene = eqx.tree_at(lambda s: (s.drag, s.damping), scene, (None, None), is_leaf=lambda x: x is None)
    limit = float(Verlet.stable(fastest(scene, jnp.asarray(patch()[0].vertices))))
    assert 0.87 < limit / (2.0 / np.sqrt(6 * ks / mass)) <= 1.0


def test_drag_is_no_limit_and_stops_a_sheet():
    mesh, scene = strip_scene()
    scene = with_terms(scene, drag=1e8)
    h = Verlet.stable(fastest(scene, jnp.asarray(mesh.vertices)))
    assert float(h) == pytest.approx(
        float(Verlet.stable(fastest(strip_scene()[1], jnp.asarray(mesh.vertices))))
    )
    v = jnp.ones_like(jnp.asarray(mesh.vertices))
    _, v, _ = end_of(Verlet, scene, jnp.asarray(mesh.vertices), v, None, 50.0 * h, 50)
    # The trapezoidal rule: a factor (1 - d h/2)/(1 + d h/2) a step.
    factor = (1 - 0.5e8 * float(h)) / (1 + 0.5e8 * float(h))
    np.testing.assert_allclose(v, factor**50, rtol=1e-6)


def test_the_energy_of_an_undamped_sheet_stays():
    """The method keeps an energy near the true one: a swing, of the step squared, but no drift."""
    mesh = lattice(6, 4)
    scene = jc.sheet(mesh, elastic(drag_rate=0.0, internal_damping_time=0.0))
    rng = np.random.default_rng(2)
    x = jnp.asarray(mesh.vertices + 2e-5 * rng.normal(size=mesh.vertices.shape))
    v, limit = jnp.zeros_like(x), float(Verlet.stable(fastest(scene, x)))
    first = float(sum(energies(scene, x, v, None, 0.0)))
    swings = []
    for share in (0.4, 0.2):
        ends = [
            end_of(Verlet, scene, x, v, None, periods * limit, int(periods / share)) for periods in (400, 800)
        ]
        swings.append([float(sum(energies(scene, *end, 0.0))) / first - 1 for end in ends])
    assert np.max(np.abs(swings[0])) < 0.08
    assert np.max(np.abs(swings[1])) < 0.4 * np.max(np.abs(swings[0])) + 1e-6


@pytest.mark.parametrize(("speed", "share"), [(1.0, 1e-4), (10.0, 5e-3), (50.0, 0.1)])
def test_a_sheet_thrown_at_a_wall_comes_back_with_its_energy(speed, share):
    """At the highest speed a step that is stable without the wall goes as far as the wall reaches."""
    mesh, still = lattice(6, 4), elastic(drag_rate=0.0, internal_damping_time=0.0)
    alone, reach, height = jc.sheet(mesh, still), 3e-5, 5e-4
    wall = Wall(Plane((0.0, 0.0, 1.0), 0.0), 0.1 * np.full(mesh.n_nodes, constants(alone)[0]), reach)
    scene = jc.sheet(mesh, still, walls=(wall,))
    x = jnp.asarray(mesh.vertices).at[:, 2].set(height)
    start = initial_state(scene, x, jnp.zeros_like(x).at[:, 2].set(-speed))
    solver = jc.integrator(scheme="explicit")
    solver = eqx.tree_at(lambda s: s.explicit, solver, Verlet(jnp.asarray(1e-2)))
    end = jc.simulate(scene, start, 2.2 * height / speed, solver=solver, throw=True).state
    assert total_energy(scene, end) / total_energy(scene, start) == pytest.approx(1.0, abs=share)
    assert float(jnp.mean(end.v[:, 2])) > 0.95 * speed
    rejected = dict(zip(CAUSES, map(int, end.counters.rejected), strict=True))
    assert rejected == dict.fromkeys(CAUSES, 0) | {"error": 9 if speed > 10.0 else 0}
