"""Lanes of a batch: trees of the same structure as one, and the one program that advances them all."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh as DeviceMesh
from jax.sharding import NamedSharding, PartitionSpec

from jaxcrumple.scene import Scene
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State

AXIS = "lanes"
# A scene and its solver: what lanes may differ by.
Inputs = tuple[Scene, Integrator]


class Lanes(NamedTuple):
    """Scenes and solvers of all lanes: `own` numbers, by which lanes differ, have a leading axis (lanes,);
    the others are `shared`."""

    own: Any
    shared: Any


def stacked(trees: Sequence[Any]) -> Any:
    """Trees of arrays as one with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def lane(tree: Any, index: int) -> Any:
    """One lane of stacked arrays."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def differing(inputs: Sequence[Inputs]) -> Inputs:
    """Which numbers lanes differ by, or will once they move: a tree of booleans.

    **Raises:** ValueError for lanes that have not the same structure and sizes.
    """
    arrays, static = zip(*(eqx.partition(pair, eqx.is_array) for pair in inputs), strict=True)
    for other, rest in zip(arrays, static, strict=True):
        difference = _difference(arrays[0], other)
        if difference or not eqx.tree_equal(rest, static[0]):
            raise ValueError(
                "the members of a batch must be of one mesh and one kind, with the same nodes, seed, scheme "
                f"and contact_level{difference}; give what differs a sweep of its own, or take "
                "backend='processes'."
            )
    mask = jax.tree.map(lambda first, *rest: any(not _same(first, one) for one in rest), *arrays)
    if inputs[0][0].contact is not None:
        mask = eqx.tree_at(
            lambda pair: (pair[0].contact.near, pair[0].contact.candidates),
            mask,
            replace_fn=lambda lists: jax.tree.map(lambda _: True, lists),
        )
    return mask


def _difference(one: Inputs, other: Inputs) -> str:
    """The first array of another size, in words."""
    sizes = [
        {jax.tree_util.keystr(path): leaf.shape for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
        for tree in (one, other)
    ]
    for name in [*sizes[0], *sizes[1]]:
        first, second = (these.get(name) for these in sizes)
        if first != second:
            return f" (scene{name.removeprefix('[0]')} has sizes {first} and {second})"
    return ""


def _same(one: Any, other: Any) -> bool:
    return one is other or np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True)


def lanes_of(inputs: Sequence[Inputs], mask: Inputs, devices: DeviceMesh) -> Lanes:
    """Scenes and solvers as lanes on devices; `mask`: which of their numbers are each lane's own."""
    own = [eqx.filter(eqx.filter(pair, eqx.is_array), mask) for pair in inputs]
    arrays, static = eqx.partition(inputs[0], eqx.is_array)
    everywhere = NamedSharding(devices, PartitionSpec())
    shared = jax.device_put(eqx.filter(arrays, mask, inverse=True), everywhere)
    return Lanes(spread(stacked(own), devices), eqx.combine(shared, static))


def spread(tree: Any, devices: DeviceMesh) -> Any:
    """Stacked arrays with a part of the lanes on each device."""
    return jax.device_put(tree, NamedSharding(devices, PartitionSpec(AXIS)))


def best_side_by_side(device: jax.Device) -> bool:
    """Whether lanes go faster side by side than in turn: a core has nothing to share out."""
    return device.platform != "cpu"


@eqx.filter_jit
def advance(
    lanes: Lanes, moving: tuple[State, Array, Array], devices: DeviceMesh, side_by_side: bool
) -> State:
    """One call of `integrate` for each lane: `moving` are states, times to stop at (lanes,) in s, and
    attempts (lanes,) that are left. Each of the `devices` has a part of the lanes, and waits for no other; it
    advances them `side_by_side`, or in turn."""
    shared, static = eqx.partition(lanes.shared, eqx.is_array)

    def part(own: Any, moving: tuple[State, Array, Array], shared: Any) -> State:
        def one(lane: tuple[Any, State, Array, Array]) -> State:
            own, state, stop, left = lane
            scene, solver = eqx.combine(own, shared, static)
            return integrate(scene, state, stop, solver, left)[0]

        lanes = (own, *moving)
        return jax.vmap(one)(lanes) if side_by_side else jax.lax.map(one, lanes)

    many, whole = PartitionSpec(AXIS), PartitionSpec()
    specs = (many, many, whole)
    mapped = jax.shard_map(part, mesh=devices, in_specs=specs, out_specs=many, check_vma=False)
    return mapped(lanes.own, moving, shared)
