"""A folded sheet whose layers push one another apart, at rest or flying."""

import equinox as eqx
import jax.numpy as jnp
from folded import folded, strip

import jaxcrumple as jc
from jaxcrumple.geometry.hinge import curvature

SIGMA, COLUMNS = 0.5e-3, (5, 5)


def pressed_layers():
    """An elastic sheet with two creases that it has at rest, and its start, at which its layers push one
    another apart."""
    mesh = strip(0.95 * SIGMA, columns=COLUMNS, rows=4)
    x = folded(mesh, 0.95 * SIGMA, COLUMNS)
    material = jc.Material(thickness=0.3e-3, yield_curvature=None)
    scene = jc.sheet(mesh, material, contact=jc.SelfContact(range=SIGMA, level=3))
    creased = curvature(scene.bending.hinges(jnp.asarray(x)).theta)
    return eqx.tree_at(lambda s: s.bending.rest_curvature, scene, creased), jc.initial_state(scene, x)


def moving_layers(speed):
    """The same, but its upper layer flies up at so many m/s that it needs several searches."""
    scene, state = pressed_layers()
    upper = state.x[:, 2] > jnp.mean(state.x[:, 2])
    velocity = jnp.where(upper[:, None], jnp.asarray([0.0, 0.0, speed]), 0.0)
    return scene, jc.initial_state(scene, state.x, velocity)
