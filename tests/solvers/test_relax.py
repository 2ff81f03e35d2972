"""`relax`: a heavy cantilever against the elastica, a tolerance that knows the forces, and why it stops."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattice import elastic, held, lattice
from linear_solvers import SOLVERS
from scipy.integrate import solve_bvp

import jaxcrumple as jc
from jaxcrumple.model.loads import AbstractMotion
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.snap import fixed
from jaxcrumple.solvers import relax as solver
from jaxcrumple.solvers.linear.direct import Direct
from jaxcrumple.solvers.linear.registry import direct_available
from jaxcrumple.solvers.relax import RELAXED, relax
from jaxcrumple.state import initial_state
from jaxcrumple.system import tangent

LENGTH, WIDTH, CLAMP, G = 0.1, 0.02, 0.006, 9.81


@functools.cache
def mesh():
    return jc.rectangle(LENGTH, WIDTH, 300, seed=1)


def cantilever(g=G, soft=1.0, **more):
    """A strip 0.1 mm thick, clamped at one end, under gravity; `soft` scales its stiffness and density."""
    x = mesh().vertices
    material = jc.Material(thickness=1e-4, young_modulus=1e9 * soft, density=1e3 * soft, yield_curvature=None)
    clamp = x[:, 0] < x[:, 0].min() + CLAMP
    return jc.sheet(mesh(), material, gravity=(0.0, 0.0, -g), prescribed=fixed(clamp, x), **more)


class Falling(AbstractMotion):
    """Free fall from rest."""

    start: jax.Array

    def __call__(self, t):
        return self.start + jnp.array([0.0, 0.0, -0.5 * G]) * t**2


def rested(scene, **options):
    return relax(scene, jc.initial_state(scene, mesh().vertices), **options)


def tip(rest):
    """Position (2,) of the free end's middle, along the strip and up."""
    x = mesh().vertices
    return np.asarray(rest.state.x)[x[:, 0] > x[:, 0].max() - 1e-9][:, [0, 2]].mean(axis=0)


def test_supports_carry_the_weight():
    scene = cantilever()
    state = rested(scene).state
    held = jc.reaction(scene, state.x, state.v, state.p, state.t)
    weight = float(scene.mass.sum()) * G
    np.testing.assert_allclose(held.sum(axis=0), [0, 0, weight], atol=1e-6 * weight)
    assert not np.any(held[~np.asarray(scene.prescribed.mask)])
    assert not np.any(jc.reaction(jc.sheet(mesh(), jc.Material()), state.x, state.v, None, 0.0))


def test_supports_accelerate_what_they_hold():
    """The reaction includes the inertia of a prescribed motion."""
    x = mesh().vertices
    motion = Falling(jnp.asarray(x))
    scene = jc.sheet(mesh(), jc.Material(), prescribed=jc.Prescribed(np.ones_like(x, bool), motion))
    held = jc.reaction(scene, motion(0.1), np.zeros_like(x), None, 0.1)
    np.testing.assert_allclose(
        held, np.outer(scene.mass, [0.0, 0.0, -G]), atol=1e-9 * float(scene.mass[0]) * G
    )


def test_supports_move_to_the_time_that_is_asked_for():
    """A clamp that rises by 1 cm/s lifts the sheet as it is, and the state is one of that time."""
    x = mesh().vertices
    rising = jc.LinearMotion(x, (0.0, 0.0, 0.01))
    still = cantilever()
    lifted = eqx.tree_at(lambda s: s.prescribed.motion, still, rising)
    state = rested(still).state
    rest = relax(lifted, state, t=0.5)
    assert rest.converged and rest.state.t == 0.5
    np.testing.assert_allclose(rest.state.x, state.x + np.array([0.0, 0.0, 0.005]), atol=1e-8)
    inside = eqx.filter_jit(lambda t: relax(lifted, state, t=t))(0.5)
    np.testing.assert_allclose(inside.state.x, rest.state.x, atol=1e-8)
    with pytest.raises(ValueError, match="from where its support holds it"):
        relax(lifted, eqx.tree_at(lambda s: s.t, state, jnp.asarray(0.5)))
    with pytest.raises(ValueError, match="t is nan"):
        relax(lifted, state, t=np.nan)
    with pytest.raises(ValueError, match="t has shape"):
        relax(lifted, state, t=[0.5, 1.0])


def elastica(load):
    """Tip (2,) of an inextensible beam of unit length and bending stiffness under its weight `load`."""
    s = np.linspace(0.0, 1.0, 101)

    def slopes(s, y):
        return [y[1], -load * (1.0 - s) * np.cos(y[0]), np.cos(y[0]), -np.sin(y[0])]

    def ends(a, b):
        return [a[0], b[1], a[2], a[3]]

    solution = solve_bvp(slopes, ends, s, np.array([s, 1.0 - s, s, -s]), tol=1e-8)
    assert solution.success
    return solution.y[2:, -1]


def test_a_heavy_cantilever_takes_tens_of_iterations_to_the_elastica():
    heavy = rested(cantilever())
    assert heavy.converged
    assert RELAXED[heavy.result].startswith("the net force on every free node")
    # Only a factor tells how many eigenvalues are negative.
    assert int(heavy.negative) == (0 if direct_available() else -1)
    assert int(heavy.iterations) <= 50
    # A strip this wide and thin bends as a plate, stiffer than a beam by 1/(1 - nu^2), and nu is 1/3.
    x = mesh().vertices[:, 0]
    root = x[x < x.min() + CLAMP].max()
    span = x.max() - root
    load = 12.0 * (1.0 - 1.0 / 9.0) * 1e3 * G * span**3 / (1e9 * 1e-4**2)
    expected = elastica(load) * span
    assert expected[1] < -0.6 * span
    np.testing.assert_allclose(tip(heavy) - [root, 0.0], expected, atol=0.01 * span)


def test_the_default_tolerance_is_relative():
    strong, soft = rested(cantilever()), rested(cantilever(soft=1e-6))
    assert strong.converged and soft.converged
    assert int(strong.iterations) == int(soft.iterations)
    assert float(soft.force_scale) == pytest.approx(1e-6 * float(strong.force_scale), rel=1e-6)
    assert float(soft.max_force) <= 1e-9 * float(soft.force_scale) or float(soft.max_force) < 1e-16
    np.testing.assert_allclose(soft.state.x, strong.state.x, atol=1e-7 * LENGTH)


def test_a_tolerance_above_all_forces_is_called_loose():
    scene = cantilever()
    rest = rested(scene, force_tolerance=1e-3)
    assert not rest.converged
    assert "force_tolerance is above all forces that act on any node" in RELAXED[rest.result]
    assert int(rest.iterations) == 0
    weight = G * float(scene.mass[0])
    assert float(rest.force_scale) == pytest.approx(weight, rel=1e-3)


def test_without_load_or_stress_there_is_nothing_to_do():
    rest = rested(cantilever(g=0.0))
    assert rest.converged and int(rest.iterations) == 0


def test_a_tolerance_below_rounding_is_called_stalled():
    rest = rested(cantilever(), force_tolerance=1e-18)
    assert not rest.converged
    assert "what is left is rounding" in RELAXED[rest.result]
    assert int(rest.iterations) < 100
    assert float(rest.max_force) < 1e-6 * G * float(cantilever().mass[0])


def test_iterations_used_up():
    rest = rested(cantilever(), max_iterations=3)
    assert not rest.converged and int(rest.iterations) == 3
    assert "max_iterations were used up; call relax again" in RELAXED[rest.result]


def test_negative_eigenvalues_are_named():
    scene = cantilever()
    squeezed = scene.prescribed.position(mesh().vertices * np.array([0.8, 1.0, 1.0]), jnp.zeros(()))
    rest = relax(scene, jc.initial_state(scene, squeezed), max_iterations=1)
    assert not rest.converged
    assert "the stiffness had negative eigenvalues" in RELAXED[rest.result]


def test_forces_that_are_not_finite_are_named():
    # A slope of sqrt at 0.
    last = mesh().n_nodes - 1
    spoilt = jc.ElementEnergy([[last]], lambda x, parameters, t: jnp.sqrt(x[0] @ jnp.array([0.0, 0.0, 1.0])))
    rest = rested(cantilever(extra=[spoilt]))
    assert not rest.converged
    assert "not finite" in RELAXED[rest.result]


def test_a_way_that_is_barred_is_named(monkeypatch):
    monkeypatch.setattr(solver, "passes", lambda *step: jnp.asarray(True))
    floor = jc.Plane(np.array([0.0, 0.0, 1.0]), -0.2)
    rest = rested(cantilever(walls=[floor]))
    assert not rest.converged
    assert "passes through a wall or the sheet itself" in RELAXED[rest.result]
    # Shorter and shorter steps end where positions do not change any more.
    assert int(rest.iterations) < 100
    assert np.array_equal(rest.state.x, mesh().vertices)


def test_inside_a_traced_function():
    scene = cantilever()
    state = jc.initial_state(scene, mesh().vertices)
    inside = eqx.filter_jit(lambda scene, state: relax(scene, state))(scene, state)
    assert inside.converged and bool(inside.result == RELAXED.converged)
    np.testing.assert_allclose(inside.state.x, rested(scene).state.x, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("linear", "rests", "error"),
    [("direct", False, 2e-5), ("direct", True, 2e-5), ("two-level", True, 1e-3)],
)
def test_the_derivative_of_an_equilibrium_is_that_of_finite_differences(linear, rests, error):
    """In both modes, whether the start is the equilibrium itself, which takes no iteration, or not.

    Conjugate gradients leave the soft strip farther from its equilibrium."""
    if linear == "direct" and not direct_available():
        pytest.skip("no direct solver here")
    x = mesh().vertices
    scene = eqx.tree_at(lambda s: s.prescribed.motion, cantilever(), jc.LinearMotion(x, (0.01, 0.0, 0.03)))
    state = jc.initial_state(scene, x)
    state = relax(scene, state, t=0.2).state if rests else state

    def place(soft, t):
        bent = eqx.tree_at(lambda s: s.bending.stiffness, scene, soft * scene.bending.stiffness)
        there = relax(bent, state, t=t, linear=linear, force_tolerance=1e-12).state.x
        return there[:, 0].mean() + there[:, 2].mean()

    at = (jnp.asarray(1.0), jnp.asarray(0.2))
    reverse = jax.grad(place, argnums=(0, 1))(*at)
    for k, step in enumerate((2e-3, 1e-2)):
        along = [jnp.zeros(()), jnp.zeros(())]
        along[k] = jnp.ones(())
        forward = float(jax.jvp(place, at, tuple(along))[1])
        moved = ([v + sign * step * d for v, d in zip(at, along, strict=True)] for sign in (1, -1))
        ends = [float(place(*values)) for values in moved]
        assert forward == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=error)
        assert float(reverse[k]) == pytest.approx(forward, rel=1e-6)
    # A clamp that moves takes the whole strip with it.
    assert float(reverse[1]) == pytest.approx(0.04, rel=1e-3)


def test_a_failing_step_does_not_loosen_the_tolerance():
    """A wrinkling strip on an elastic foundation: rejected steps reach far, and once raised the rounding
    error that the default tolerance allows for to 3e-5 of the forces."""
    strip = jc.hexagonal(101, 2, 1e-3, reorder=False)
    wavy = strip.vertices.copy()
    wavy[:, 2] = 1e-6 * np.random.default_rng(0).normal(size=len(wavy))
    base = jc.Mesh.from_arrays(wavy, strip.faces)
    material = jc.Material(young_modulus=1e9, thickness=0.2e-3, yield_curvature=None)
    stiffness = 8 / 9 * material.bending_rigidity
    bed = stiffness * (2 * np.pi / 16e-3) ** 4
    terms = jc.ElementEnergy(
        np.arange(base.n_nodes)[:, None],
        lambda x, weight, t: 0.5 * weight * x[0, 2] ** 2,
        jnp.asarray(bed * base.node_area),
    )
    critical = 2 * np.sqrt(stiffness * bed) / material.young_modulus_2d
    x = base.vertices
    ends = np.abs(x[:, 0]) > np.abs(x[:, 0]).max() - 0.75e-3
    motion = jc.LinearMotion(x, np.outer(np.where(ends, -x[:, 0], 0.0), [1.0, 0.0, 0.0]))
    grips = jc.Prescribed(np.repeat(ends[:, None], 3, axis=1), motion)
    scene = sheet(base, material, prescribed=grips, extra=[terms])
    state = initial_state(scene, x)
    for share in (0.6, 0.8):
        rest = relax(scene, state, t=share * critical)
        state = rest.state
        assert rest.converged and rest.max_force < 1.01e-9 * rest.force_scale


# --- Stability of equilibria ---------------------------------------------------------------------


def clamped(squeeze):
    """A strip with both ends clamped, its length multiplied by `squeeze`; scene and positions."""
    mesh = lattice(9, 4)
    x = mesh.vertices * [squeeze, 1.0, 1.0]
    along = mesh.vertices[:, 0]
    ends = (along < along.min() + 1.1e-3) | (along > along.max() - 1.1e-3)
    mask = np.broadcast_to(ends[:, None], x.shape)
    return sheet(mesh, elastic(), prescribed=held(mask, x)), x


def relaxed(squeeze, solver):
    """Outcome of `relax` and the eigenvalues of the stiffness there."""
    scene, x = clamped(squeeze)
    outcome = relax(scene, initial_state(scene, x), force_tolerance=1e-9, linear=solver)
    assert bool(outcome.converged)
    assert float(outcome.max_force) <= 1e-9
    return outcome, np.linalg.eigvalsh(tangent(scene, outcome.state).toarray())


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_stretched_strip_is_stable(solver):
    outcome, eigenvalues = relaxed(1.02, solver)
    assert eigenvalues[0] > 0
    assert int(outcome.negative) <= 0


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_flat_compressed_strip_is_reported_unstable(solver):
    outcome, eigenvalues = relaxed(0.97, solver)
    # By symmetry the strip stays flat, though any nudge would buckle it.
    assert np.all(np.asarray(outcome.state.x)[:, 2] == 0)
    assert np.sum(eigenvalues < 0) > 5
    known = np.sum(eigenvalues < 0) if isinstance(solver, Direct) else 1
    assert int(outcome.negative) == known


def test_relax_refuses_a_tolerance_it_cannot_meet():
    scene, x = clamped(1.0)
    for tolerance in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="must be positive"):
            relax(scene, initial_state(scene, x), force_tolerance=tolerance)
