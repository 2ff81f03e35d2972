"""No derivative is NaN: flat hinges, no plastic curvature, contact that begins, cotangents of any size."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folded import folded, strip

import jaxcrumple as jc
from jaxcrumple.geometry.hinge import curvature
from jaxcrumple.history import HISTORY, implicit_step
from jaxcrumple.replays.step import Point
from jaxcrumple.system import residual, updated_rest_curvature

RANGE, COLUMNS, DRAWS = 0.5e-3, (4, 4), 250
# Distances of the layers in ranges: where contact begins, exactly and nearly, inside and outside.
GAPS = (1.0, 1.0 - 1e-12, 0.6, 1.2)
LEAVES = (
    lambda s: s.membrane.stiffness,
    lambda s: s.membrane.rest_length,
    lambda s: s.bending.stiffness,
    lambda s: s.bending.rest_curvature,
    lambda s: s.plasticity.yield_threshold,
    lambda s: s.plasticity.time,
    lambda s: s.mass,
    lambda s: s.drag.coefficient,
    lambda s: s.damping.coefficient,
    lambda s: s.walls[0].stiffness,
    lambda s: s.walls[0].shape.offset.start,
    lambda s: s.walls[0].shape.offset.rate,
    lambda s: s.contact.stiffness,
    lambda s: s.contact.range,
)


def scene_at(gap):
    """Two flat layers, that far apart, below a wall that touches the upper one: scene and positions."""
    mesh = strip(gap * RANGE, COLUMNS, 3)
    x = folded(mesh, gap * RANGE, COLUMNS)
    scene = jc.sheet(
        mesh,
        jc.Material(thickness=0.2e-3, yield_curvature=5.0),
        walls=[jc.Plane((0.0, 0.0, -1.0), jc.Ramp(-x[:, 2].max(), 0.05))],
        contact=jc.SelfContact(range=RANGE),
    )
    return jc.with_contacts(scene, x), jnp.asarray(x)


def drawn(key, scene, x):
    """A step from a state: positions, past ones, rest curvatures, its size, and cotangents.

    Each of these is zero, untouched or at rest in a part of the draws, and of any size in the others.
    """
    keys = iter(jax.random.split(key, 12))

    def size(low, high):
        power = 10.0 ** jax.random.uniform(next(keys), minval=low, maxval=high)
        return jnp.where(jax.random.bernoulli(next(keys), 0.3), 0.0, power)

    moved = x + size(-18.0, -5.0) * jax.random.normal(next(keys), x.shape)
    bent = curvature(scene.bending.hinges(x).theta)
    p = size(-12.0, 0.0) * bent * jax.random.uniform(next(keys), bent.shape)
    h = 10.0 ** jax.random.uniform(next(keys), minval=-9.0, maxval=-1.0)
    scale = size(-300.0, 2.0)
    pulls = scale * jax.random.normal(next(keys), x.shape), scale * jax.random.normal(next(keys), p.shape)
    return moved, p, h, pulls


def slopes(key, scene, x):
    """Derivatives of a step's residual and rest curvatures, times cotangents, by all there is; and the
    largest of the cotangents."""
    moved, p, h, (pull, turn) = drawn(key, scene, x)

    def weighed(numbers, x, past, p):
        here = eqx.tree_at(lambda s: [leaf(s) for leaf in LEAVES], scene, numbers)
        points = Point(*(jnp.broadcast_to(a, (HISTORY, *a.shape)) for a in (past, 0.0 * past, p)))
        alpha = jnp.zeros(HISTORY).at[0].set(-1.0)
        step = implicit_step(here, points, alpha, h, jnp.zeros(()), jnp.ones(()))
        return jnp.sum(pull * residual(here, step, x)[0]) + jnp.sum(
            turn * updated_rest_curvature(here, step, x)
        )

    numbers = [leaf(scene) for leaf in LEAVES]
    return jax.grad(weighed, argnums=(0, 1, 2, 3))(numbers, moved, x, p), jnp.max(jnp.abs(pull))


@eqx.filter_jit
def all_slopes(keys, scene, x):
    return jax.lax.map(lambda key: slopes(key, scene, x), keys)


@pytest.mark.parametrize("gap", GAPS)
def test_no_derivative_is_nan(gap):
    """Not in one of 1000 draws; and none is anything where the cotangents are nothing."""
    scene, x = scene_at(gap)
    keys = jax.random.split(jax.random.key(int(1e3 * gap)), DRAWS)
    found, pull = all_slopes(keys, scene, x)
    pull = np.asarray(pull)
    assert 0 < np.sum(pull == 0) < DRAWS and np.any((pull > 0) & (pull < 1e-200))
    for leaf in jax.tree.leaves(found):
        rows = np.asarray(leaf).reshape(DRAWS, -1)
        assert np.all(np.isfinite(rows))
        assert not np.any(rows[pull == 0])
    reached = np.any(np.asarray(found[0][-2]).reshape(DRAWS, -1) != 0, axis=1)
    assert np.any(reached) == (gap <= 1.0)
