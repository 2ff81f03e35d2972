"""Strict modes of JAX, which find slips in the caller's code, change nothing in ours."""

import contextlib
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.model.loads import dead_load

MESH = jc.hexagonal(3, 3, 1e-2)
X = MESH.vertices
V = np.random.default_rng(0).normal(size=X.shape)
# A self-avoiding sheet has every term of a phantom one.
CONTACTS = [
    pytest.param(None, id="phantom", marks=pytest.mark.slow),
    # A range that suits the coarse mesh: relaxing takes steps of a share of it.
    pytest.param(jc.SelfContact(range=3e-3), id="self-avoiding"),
]


@contextlib.contextmanager
def strict():
    """All three modes at once: what fails in one of them fails here."""
    with (
        jax.numpy_dtype_promotion("strict"),
        jax.numpy_rank_promotion("raise"),
        jax.transfer_guard("disallow"),
    ):
        yield


def made(contact):
    """A scene with every term and its start, from plain numbers."""
    origin, up = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    walls = [
        jc.Sphere(origin, jc.Ramp(0.1, -0.01)),
        jc.Cylinder(origin, up, 0.1),
        jc.Plane(up, jc.PiecewiseLinear([0, 1], [-0.1, -0.09])),
        jc.Cone(origin, up, 0.7, -0.2),
        jc.Ball((0, 0, -1), up, 0.1, 0.0),
        jc.HoledPlate((0, 0, -0.2), up, 0.01, 0.01),
    ]
    mask = np.repeat((X[:, 0] < X[:, 0].min() + 1e-3)[:, None], 3, axis=1)
    scene = jc.sheet(
        MESH,
        jc.Material(),
        walls=walls,
        gravity=(0, 0, -9.81),
        prescribed=jc.Prescribed(mask, jc.LinearMotion(X, (0, 0, 0.1)), until=1),
        extra=[dead_load([4], [[0, 0, 1e-4]], 1e-3)],
        contact=contact,
    )
    return jc.with_contacts(scene, X), jc.initial_state(scene, X, ledger=True)


@functools.cache
def plain(contact):
    return made(contact)


def assert_same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(*(jax.tree.leaves(eqx.filter(tree, eqx.is_array)) for tree in (one, other)), strict=True):
        assert a.dtype == b.dtype and getattr(a, "weak_type", False) == getattr(b, "weak_type", False)
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("contact", CONTACTS)
def test_scenes_energies_and_forces_are_the_same_in_strict_modes(contact):
    scene, state = plain(contact)
    results = []
    for mode in (contextlib.nullcontext, strict):
        with mode():
            results.append(
                (
                    jc.energies(scene, X, V, None, 0.0),
                    jc.force(scene, X, V, None, 0.0),
                    jc.mass_matrix(scene).data,
                    (scene.sparsity, scene.length_scale, scene.inertial_time),
                )
            )
    assert_same(*results)
    assert float(results[0][0].kinetic) > 0
    with strict():
        again = made(contact)
    assert_same((scene, state), again)


@pytest.mark.parametrize("contact", CONTACTS)
def test_gradients_are_the_same_in_strict_modes(contact):
    scene, state = plain(contact)

    def energy(x):
        return jc.potential_energy(scene, x, state.p, state.t)

    expected = jax.jit(jax.grad(energy))(state.x)
    with strict():
        np.testing.assert_array_equal(jax.jit(jax.grad(energy))(state.x), expected)
    # Here rules of derivatives run when the function has returned.
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        found = jax.grad(jax.jit(energy))(state.x)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-18)
    force = jc.force(scene, state.x, jnp.zeros_like(state.x), state.p, state.t)
    np.testing.assert_allclose(found, -force, atol=1e-12 * float(jnp.max(jnp.abs(force))))


@pytest.mark.parametrize(
    "scheme", ["hybrid", pytest.param("alternating", marks=pytest.mark.slow), "explicit", "paper"]
)
def test_a_phantom_step_is_traced_in_strict_modes(scheme):
    scene, state = plain(None)
    with strict():
        solver = jc.integrator(scheme=scheme, linear="block-cg" if scheme == "paper" else "two-level")
        end, _ = eqx.filter_eval_shape(jc.integrate, scene, state, state.t, solver)
    assert end.x.shape == X.shape and end.x.dtype == np.float64


@pytest.mark.slow
@pytest.mark.parametrize("contact", CONTACTS)
def test_runs_are_the_same_bits_in_strict_modes(contact):
    scene, state = plain(contact)
    found = []
    for mode in (contextlib.nullcontext, strict):
        with mode():
            solver = jc.integrator(1e-2, linear="two-level")
            solution = jc.simulate(scene, state, [1e-4, 2e-4], solver=solver, record=True)
            again = jc.replay(scene, solution.record)
            rest = jc.relax(scene, state, force_tolerance=1e-9, linear="two-level")
            gradient = eqx.filter_jit(
                eqx.filter_grad(lambda s, record=solution.record: jnp.sum(jc.replay(s, record).x ** 2))
            )(scene)
            values = jc.elastic_tangent(scene, X, None, 0.0, 1e6)
            x = jc.linear_solve("two-level", scene.sparsity, values, X.ravel())
        found.append(
            (solution.x, again.x, rest.state.x, gradient.bending.stiffness, jc.tangent(scene, state).data, x)
        )
        assert solution.result == "success" and bool(rest.converged)
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
        assert np.all(np.isfinite(one))
