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

from jaxcrumple._jax.arrays import Count, Scalar
from jaxcrumple._jax.tree import as_array
from jaxcrumple.scene import Scene, with_lists
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.log import Log
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
    """Stack trees of arrays along a new leading axis, on the host: `jnp.stack` compiles for each shape."""
    return jax.tree.map(lambda *leaves: as_array(np.stack(leaves)), *trees)


def lane_of(tree: Any, index: int) -> Any:
    """Return one lane of stacked arrays."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def differing(inputs: Sequence[Inputs], known: Inputs | None = None) -> Inputs:
    """Return a tree of booleans: whether lanes of one kind differ in an array, or differed as `known`."""
    arrays = [eqx.filter(pair, eqx.is_array) for pair in inputs]
    mask = jax.tree.map(lambda first, *rest: any(not _same(first, one) for one in rest), *arrays)
    if known is None:
        return mask
    leaves, tree = jax.tree.flatten(mask)
    # The size of the coarse space, which may have grown, is part of the structure.
    both = [now or before for now, before in zip(leaves, jax.tree.leaves(known), strict=True)]
    return jax.tree.unflatten(tree, both)


def _same(one: Any, other: Any) -> bool:
    return one is other or np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True)


def lanes_of(inputs: Sequence[Inputs], mask: Inputs, devices: DeviceMesh) -> Lanes:
    """Distribute scenes and solvers as lanes on devices; `mask` marks the arrays that differ by lane.

    Every lane has contact lists of its own.
    """
    own = [own_of(pair, mask) for pair in inputs]
    arrays, static = eqx.partition(inputs[0], eqx.is_array)
    everywhere = NamedSharding(devices, PartitionSpec())
    common = eqx.filter(arrays, _with_lists(mask, inputs[0]), inverse=True)
    shared = jax.device_put(common, everywhere)
    return Lanes(spread(stacked(own), devices), eqx.combine(shared, static))


def spread(tree: Any, devices: DeviceMesh) -> Any:
    """Distribute stacked arrays, with a part of the lanes on each device."""
    return jax.device_put(tree, NamedSharding(devices, PartitionSpec(AXIS)))


def best_side_by_side(device: jax.Device) -> bool:
    """Return whether vectorised lanes are faster than sequential ones; on a CPU core they are not."""
    return device.platform != "cpu"


@eqx.filter_jit(donate="all-except-first")
def _placed(one: Any, lanes: Any, index: Count) -> Any:
    return jax.tree.map(lambda all_, own: all_.at[index].set(own), lanes, one)


def placed(tree: Any, index: int, one: Any, devices: DeviceMesh) -> Any:
    """Return stacked arrays with those of `one` in the lane `index`."""
    return spread(_placed(one, tree, jnp.asarray(index)), devices)


def own_of(pair: Inputs, mask: Inputs) -> Inputs:
    """Return the arrays of a lane that `mask` marks, and its contact lists."""
    return eqx.filter(eqx.filter(pair, eqx.is_array), _with_lists(mask, pair))


def _with_lists(mask: Inputs, pair: Inputs) -> Inputs:
    """Return the mask with the contact lists of a lane, of which every lane has its own."""
    lists = jax.tree.map(lambda _: True, eqx.filter(pair[0].lists, eqx.is_array))
    return with_lists(mask[0], lists), mask[1]


@eqx.filter_jit
def advance(
    lanes: Lanes, moving: Moving, devices: DeviceMesh, side_by_side: bool, trail: int
) -> tuple[State, Log]:
    """Call `integrate` once for each lane.

    **Arguments:** `moving`: states, stop times (lanes,) in s, and remaining attempts (lanes,); `devices`:
    each advances its part of the lanes independently of the others; `side_by_side`: whether a device
    vectorises its lanes or advances them one after another; `trail`: as of `integrate`.
    """
    shared, static = eqx.partition(lanes.shared, eqx.is_array)

    def part(own: Any, moving: Moving, shared: Any) -> tuple[State, Log]:
        def one(lane: tuple[Any, State, Scalar, Real[Array, ""]]) -> tuple[State, Log]:
            own, state, stop, left = lane
            scene, solver = eqx.combine(own, shared, static)
            return integrate(scene, state, stop, solver, left, trail)

        lanes = (own, *moving)
        return jax.vmap(one)(lanes) if side_by_side else jax.lax.map(one, lanes)

    many, whole = PartitionSpec(AXIS), PartitionSpec()
    specs = (many, many, whole)
    mapped = jax.shard_map(part, mesh=devices, in_specs=specs, out_specs=many, check_vma=False)
    return mapped(lanes.own, moving, shared)
