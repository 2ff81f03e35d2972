"""Reject steps that pass through the sheet or a wall."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxcrumple._jax.arrays import Flag, NodeVectors, Scalar
from jaxcrumple.contact.adjacency import MOST_TURN
from jaxcrumple.contact.ccd import crosses
from jaxcrumple.contact.coverage import covers, largest_unlisted_turn
from jaxcrumple.model.walls import Wall
from jaxcrumple.scene import Scene
from jaxcrumple.state import State


def passes(scene: Scene, state: State, x: NodeVectors, t: Scalar, turn: Scalar) -> Flag:
    """Return whether to reject a step to positions `x` (n, 3) at time `t` in s.

    It is rejected if it would pass through a wall or the sheet itself, or leaves the motions that the lists
    cover. `turn`: `unlisted_turn` in rad at `x`.
    """
    through = jnp.asarray(False)
    for wall in scene.walls:
        through = through | _comes_through(wall, state, wall.gap(x, t) < 0)
    contact = scene.contact
    if contact is None:
        return through
    lists = scene.own_lists
    return through | ~covers(lists, x) | (turn > MOST_TURN) | crosses(contact, lists, state.x, x)


def _comes_through(wall: Wall, state: State, beyond: Bool[Array, " nodes"]) -> Flag:
    """Return whether some of the nodes `beyond` (n,) a wall after a step were on its near side before."""

    def before() -> Flag:
        return jnp.any(beyond & (wall.gap(state.x, state.t) >= 0))

    return jax.lax.cond(jnp.any(beyond), before, lambda: jnp.asarray(False))


def unlisted_turn(scene: Scene, x: NodeVectors) -> Scalar:
    """Return the largest turn in rad of the ways at nodes that the lists leave out, at positions `x` (n, 3).

    If an upper bound is below `DUE_TURN`, the result is that bound; without contact it is 0.
    """
    if scene.contact is None:
        return jnp.zeros(())
    half = scene.bending.hinges(x).half
    return largest_unlisted_turn(scene.contact, scene.own_lists.candidates, half)
