"""Stack the lanes of a batch: trees of equal structure as one tree, advanced by a single program."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh as DeviceMesh
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Real

from jaxcrumple._jax.arrays import Scalar
from jaxcrumple.scene import Scene, with_lists
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State

AXIS = "lanes"
# A scene and its solver, in which lanes may differ.
Inputs = tuple[Scene, Integrator]
# States, stop times in s, and remaining attempts.
Moving = tuple[State, Float[Array, " lanes"], Real[Array, " lanes"]]


class Lanes(NamedTuple):
    """Scenes and solvers of all lanes: arrays in which lanes differ are `own`, with a leading axis (lanes,);
    the others are `shared`."""

    own: Any
    shared: Any


def stacked(trees: Sequence[Any]) -> Any:
    """Stack trees of arrays along a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def lane(tree: Any, index: int) -> Any:
    """Return one lane of stacked arrays."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def differing(inputs: Sequence[Inputs]) -> Inputs:
    """Return a tree of booleans: whether lanes differ in an array.

    **Raises:** ValueError if lanes differ in structure or array sizes.
    """
    arrays, static = zip(*(eqx.partition(pair, eqx.is_array) for pair in inputs), strict=True)
    for other, rest in zip(arrays, static, strict=True):
        difference = _difference(arrays[0], other)
        if difference or not eqx.tree_equal(rest, static[0]):
            raise ValueError(
                "the members of a batch must be of one kind, with the same numbers of nodes, edges and "
                f"hinges, scheme and contact_level{difference}; split the sweep, or choose "
                "backend='processes'."
            )
    return jax.tree.map(lambda first, *rest: any(not _same(first, one) for one in rest), *arrays)


def _difference(one: Inputs, other: Inputs) -> str:
    """Describe the first array whose size differs."""
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
    """Distribute scenes and solvers as lanes on devices; `mask` marks the arrays that differ by lane.

    Every lane has contact lists of its own.
    """
    lists = jax.tree.map(lambda _: True, eqx.filter(inputs[0][0].lists, eqx.is_array))
    mask = with_lists(mask[0], lists), mask[1]
    own = [eqx.filter(eqx.filter(pair, eqx.is_array), mask) for pair in inputs]
    arrays, static = eqx.partition(inputs[0], eqx.is_array)
    everywhere = NamedSharding(devices, PartitionSpec())
    shared = jax.device_put(eqx.filter(arrays, mask, inverse=True), everywhere)
    return Lanes(spread(stacked(own), devices), eqx.combine(shared, static))


def spread(tree: Any, devices: DeviceMesh) -> Any:
    """Distribute stacked arrays, with a part of the lanes on each device."""
    return jax.device_put(tree, NamedSharding(devices, PartitionSpec(AXIS)))


def best_side_by_side(device: jax.Device) -> bool:
    """Return whether vectorised lanes are faster than sequential ones; on a CPU core they are not."""
    return device.platform != "cpu"


@eqx.filter_jit
def advance(lanes: Lanes, moving: Moving, devices: DeviceMesh, side_by_side: bool) -> State:
    """Call `integrate` once for each lane.

    **Arguments:** `moving`: states, stop times (lanes,) in s, and remaining attempts (lanes,); `devices`:
    each advances its part of the lanes independently of the others; `side_by_side`: whether a device
    vectorises its lanes or advances them one after another.
    """
    shared, static = eqx.partition(lanes.shared, eqx.is_array)

    def part(own: Any, moving: Moving, shared: Any) -> State:
        def one(lane: tuple[Any, State, Scalar, Real[Array, ""]]) -> State:
            own, state, stop, left = lane
            scene, solver = eqx.combine(own, shared, static)
            return integrate(scene, state, stop, solver, left)[0]

        lanes = (own, *moving)
        return jax.vmap(one)(lanes) if side_by_side else jax.lax.map(one, lanes)

    many, whole = PartitionSpec(AXIS), PartitionSpec()
    specs = (many, many, whole)
    mapped = jax.shard_map(part, mesh=devices, in_specs=specs, out_specs=many, check_vma=False)
    return mapped(lanes.own, moving, shared)
