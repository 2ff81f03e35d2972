"""A small sheet that snaps in a shrinking sphere, its solver and its run."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxcrumple.material.material import Material
from jaxcrumple.scenes.radial import radial
from jaxcrumple.simulation import frame_times, simulate
from jaxcrumple.solvers.loop import EXPLICIT_COST, IMPLICIT_COST
from jaxcrumple.solvers.scheme import integrator
from jaxcrumple.state import initial_state

NODES = 60
# The start is over at 3 ms; the wall makes the sheet snap at 9 ms, and it is calm again at 19 ms.
SNAP_END = 0.02
SHEET = Material(drag_rate=1500.0)


def solver(rtol=1e-4, scheme="alternating", **options):
    """The integrator that has all stages, with the linear solver that needs no extra."""
    return integrator(rtol, scheme=scheme, linear="block-cg", **options)


@functools.cache
def setup():
    return radial(NODES, sweeps=5, contact=None, material=SHEET)


def with_speed(scene, speed):
    """The scene whose sphere shrinks at `speed` (weakly typed like the scene's own)."""
    return eqx.tree_at(lambda s: s.walls[0].shape.radius.rate, scene, jnp.asarray(-speed))


def start():
    return initial_state(setup().scene, setup().x)


@functools.cache
def snap():
    return simulate(setup().scene, start(), frame_times(SNAP_END, 3), solver=solver())


def cost(state):
    """Units of cost of a state's steps."""
    quasistatic, implicit, explicit = state.counters.steps.tolist()
    return IMPLICIT_COST * (quasistatic + implicit) + EXPLICIT_COST * explicit


def equal(a, b):
    """Whether two pytrees are equal bit for bit."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)
