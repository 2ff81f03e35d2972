"""Replays of runs: they repeat the run, and their derivatives are those of what they compute."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import bound
from folded import folded, strip

import jaxcrumple as jc
from jaxcrumple.geometry.hinge import curvature
from jaxcrumple.model.loads import dead_load
from jaxcrumple.replays.replay import replay
from jaxcrumple.replays.snaps import HIGH, MOST, snaps
from jaxcrumple.state import EXPLICIT, IMPLICIT, QUASISTATIC

COLUMNS, RANGE = (4, 4), 0.5e-3
LEAVES = {
    "stretching": lambda s: s.membrane.stiffness,
    "rest length": lambda s: s.membrane.rest_length,
    "bending": lambda s: s.bending.stiffness,
    "yield": lambda s: s.plasticity.yield_threshold,
    "plastic time": lambda s: s.plasticity.time,
    "mass": lambda s: s.mass,
    "drag": lambda s: s.drag.coefficient,
    "wall": lambda s: s.walls[0].stiffness,
    "wall's place": lambda s: s.walls[0].shape.offset.start,
    "wall's speed": lambda s: s.walls[0].shape.offset.rate,
    "support": lambda s: s.prescribed.motion.velocity,
    "load": lambda s: s.extra[0].parameters[0],
    "contact": lambda s: s.contact.stiffness,
    "range": lambda s: s.contact.range,
}
# Kinds of numbers that a difference changes together, and the negative exponents of its relative sizes: a
# sheet buckles where rest lengths change by a millionth.
TOGETHER = {
    ("stretching", "bending", "yield", "plastic time"): (3, 4, 5),
    ("rest length",): (6, 7, 8),
    ("mass", "drag", "load"): (3, 4, 5),
    ("wall", "wall's place", "wall's speed", "support"): (3, 4, 5),
    ("contact", "range"): (3, 4, 5),
}
RUNS = {
    "quasistatic": ("pressed", [1e-3, 4e-3], {QUASISTATIC}),
    "hybrid": ("confined", [0.1, 0.2], {IMPLICIT, EXPLICIT}),
}


def pressed():
    """A strip with a fold at rest, some nodes of which are held, that a wall presses together: scene and
    positions."""
    mesh = strip(0.9 * RANGE, COLUMNS, 3)
    x = folded(mesh, 0.9 * RANGE, COLUMNS)
    held = np.zeros((mesh.n_nodes, 3), bool)
    held[np.argsort(mesh.vertices[:, 0])[:3]] = True
    top = np.argsort(x[:, 2])[-2:]
    scene = jc.sheet(
        mesh,
        jc.Material(thickness=0.2e-3, yield_curvature=5.0),
        walls=[jc.Plane((0.0, 0.0, -1.0), jc.Ramp(-0.8 * RANGE, 0.05))],
        prescribed=jc.Prescribed(jnp.asarray(held), jc.LinearMotion(x, (0.0, 0.0, 0.01))),
        extra=[dead_load(top, np.tile([0.0, 2e-3, 0.0], (2, 1)), 1e-3)],
        contact=jc.SelfContact(range=RANGE),
    )
    bent = curvature(scene.bending.hinges(jnp.asarray(x)).theta)
    return eqx.tree_at(lambda s: s.bending.rest_curvature, scene, bent), x


def confined():
    """A phantom sheet in a shrinking sphere: scene and positions."""
    setup = jc.radial(40, seed=5, sweeps=5, contact=None)
    return setup.scene, setup.x


@pytest.fixture(scope="module", params=[pytest.param("quasistatic", marks=pytest.mark.slow), "hybrid"])
def run(request):
    """A scene, and a run of it that is recorded."""
    name, times, stages = RUNS[request.param]
    scene, x = {"pressed": pressed, "confined": confined}[name]()
    solver = jc.integrator(1e-2, scheme=request.param)
    solution = jc.simulate(scene, jc.initial_state(scene, x), times, solver=solver, record=True)
    assert solution.result == "success"
    assert set(solution.record.stages) == stages
    if scene.contact is not None:
        last = jnp.asarray(solution.x[-1])
        assert int(bound(jc.with_contacts(scene, last)).gaps(last)[1]) > 0
    return scene, solution


def test_a_record_tells_when_the_sheet_snaps():
    """Three bursts of acceleration in a steady motion, the last two of them one snap."""
    scene, x = confined()
    threshold = HIGH * float(scene.length_scale / scene.inertial_time**2)
    bursts, length = (0.1, 0.3, 0.305), 1e-3
    t = np.concatenate([np.linspace(0.0, 0.095, 20), np.arange(0.096, 0.4, 1e-4)])
    for factor, expected in ((1.5, [0.1, 0.3]), (0.5, [])):
        acceleration = np.zeros_like(t)
        for burst in bursts:
            acceleration[(t > burst) & (t <= burst + length)] = factor * threshold
        v = 0.02 + np.cumsum(acceleration * np.diff(t, prepend=0.0))
        height = np.cumsum(v * np.diff(t, prepend=0.0))
        moved = np.asarray(x) + height[:, None, None] * np.array([0.0, 0.0, 1.0])
        found = snaps(scene, moved, t)
        assert found.shape == (MOST,)
        np.testing.assert_allclose(found[np.isfinite(found)], expected, atol=3e-4)


def test_a_replay_repeats_the_run(run):
    """To Newton's error in the run; its own is that of rounding."""
    scene, solution = run
    again = eqx.filter_jit(replay)(scene, solution.record)
    size = float(scene.length_scale)
    assert float(again.error) < 1e-11
    np.testing.assert_array_equal(again.t, solution.t)
    np.testing.assert_allclose(again.x, solution.x, atol=1e-7 * size, rtol=0)
    np.testing.assert_allclose(again.p, solution.p, atol=1e-6, rtol=0)


def loss_of(solution, **options):
    """A measure with random weights of all frames, as a function of the scene."""
    rng = np.random.default_rng(1)
    weights = [jnp.asarray(rng.normal(size=a.shape)) for a in (solution.x, solution.v, solution.p)]

    def loss(scene):
        frames = replay(scene, solution.record, **options)
        x, v, p = (jnp.sum(w * a) for w, a in zip(weights, frames[1:4], strict=True))
        return x + 1e-3 * v + 1e-3 * p

    return loss


def gradient_of(scene, solution, **options):
    """Derivatives of the measure by everything in the scene, times a cotangent."""
    loss = loss_of(solution, **options)
    slopes = eqx.filter_jit(eqx.filter_grad(lambda scene, cotangent: cotangent * loss(scene)))
    return lambda cotangent: slopes(scene, jnp.asarray(cotangent))


@pytest.fixture(scope="module")
def slopes(run):
    return gradient_of(*run)


@pytest.fixture(scope="module")
def gradient(slopes):
    return slopes(1.0)


@pytest.mark.slow
def test_derivatives_of_the_recorded_steps_need_no_solution(run, gradient):
    """They differ by the error that the run's Newton iteration left: most by the stiffness of walls, which
    hardly matters."""
    scene, solution = run
    again = eqx.filter_jit(lambda scene: replay(scene, solution.record, solve=False))
    frames = again(scene)
    np.testing.assert_allclose(frames.x, solution.x, atol=1e-15, rtol=0)
    size = np.linalg.norm(solution.v)
    assert np.linalg.norm(frames.v - solution.v) < 1e-10 * size
    np.testing.assert_allclose(frames.p, solution.p, atol=1e-8, rtol=0)
    other = eqx.tree_at(lambda s: s.membrane.stiffness, scene, scene.membrane.stiffness * 1.001)
    assert np.all(np.isnan(again(other).x))
    taken = gradient_of(scene, solution, solve=False, checkpoint=True)(1.0)
    for name, leaf in LEAVES.items():
        if has(scene, leaf):
            expected = leaf(gradient)
            size = float(jnp.max(jnp.abs(expected)))
            np.testing.assert_allclose(leaf(taken), expected, atol=5e-4 * size, rtol=0, err_msg=name)


@pytest.mark.slow
def test_cotangents_may_be_tiny_or_nothing(slopes, gradient):
    """Also such whose squares are rounded to nothing."""
    numbers = [jax.tree.leaves(eqx.filter(slopes(scale), eqx.is_array)) for scale in (1e-200, 0.0)]
    for one, tiny, nothing in zip(jax.tree.leaves(eqx.filter(gradient, eqx.is_array)), *numbers, strict=True):
        assert np.all(np.isfinite(one))
        size = float(jnp.max(jnp.abs(one), initial=0.0))
        # The first factors of a process and later ones differ by rounding, which stiff contact amplifies.
        np.testing.assert_allclose(1e200 * tiny, one, atol=1e-6 * size, rtol=0)
        assert not np.any(nothing)


@pytest.mark.slow
def test_forward_mode_equals_reverse_mode(run, gradient):
    """With respect to every kind of number."""
    scene, solution = run
    rng = np.random.default_rng(0)
    loss = loss_of(solution)
    change = eqx.filter_jit(lambda by: eqx.filter_jvp(loss, (scene,), (by,))[1])
    still = jax.tree.map(lambda a: jnp.zeros_like(a) if eqx.is_inexact_array(a) else None, scene)
    for name, leaf in own_leaves(scene).items():
        way = leaf(scene) * jnp.asarray(rng.uniform(0.5, 1.5, leaf(scene).shape))
        terms = leaf(gradient) * way
        size = float(jnp.sum(jnp.abs(terms)))
        forward = float(change(eqx.tree_at(leaf, still, way)))
        assert forward == pytest.approx(float(jnp.sum(terms)), abs=1e-7 * size), name


def test_the_gradient_is_that_of_central_differences(run, gradient):
    scene, solution = run
    value, own = eqx.filter_jit(loss_of(solution)), own_leaves(scene)
    # By common factors: rest lengths that do not fit together bend a sheet.
    for names, exponents in TOGETHER.items():
        # Steps of a run without explicit ones are few, so that more sizes are tried.
        exponents = exponents if EXPLICIT in solution.record.stages else range(3, 8)
        leaves = [own[name] for name in names if name in own]
        if leaves:
            reverse = sum(float(jnp.sum(leaf(gradient) * leaf(scene))) for leaf in leaves)
            assert plateau(value, scene, leaves, exponents) == pytest.approx(reverse, rel=1e-4), names


def own_leaves(scene):
    """The numbers that the scene has, by their kind."""
    return {name: leaf for name, leaf in LEAVES.items() if has(scene, leaf)}


def has(scene, leaf):
    """Whether the scene has that number."""
    try:
        return leaf(scene) is not None
    except (AttributeError, IndexError):
        return False


def plateau(value, scene, leaves, exponents):
    """Central difference of fourth order by a common factor, of two steps the smaller one that agree best."""
    found = np.array([difference(value, scene, leaves, 10.0**-k) for k in exponents])
    with np.errstate(invalid="ignore"):
        return found[1 + np.nanargmin(np.abs(np.diff(found)))]


def difference(value, scene, leaves, step):
    def at(change):
        numbers = [leaf(scene) * (1.0 + change) for leaf in leaves]
        return float(value(eqx.tree_at(lambda s: [leaf(s) for leaf in leaves], scene, numbers)))

    one, two = (at(k * step) - at(-k * step) for k in (1, 2))
    return (8.0 * one - two) / (12.0 * step)
