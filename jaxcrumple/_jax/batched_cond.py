"""Conditional computation that a batch skips if none of its lanes needs it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxcrumple._jax.arrays import Flag
from jaxcrumple._jax.door import own_modes
from jaxcrumple._jax.tree import select


def where_needed(needed: Flag, make: Callable[..., Any], old: Any, *args: Any) -> Any:
    """Return `make(*args)` where `needed`, else `old`, a tree of the same structure.

    Under `vmap`, `jax.lax.cond` computes both branches. This function computes `make` for all lanes if at
    least one lane needs it, else for none. Pass every value that differs between lanes in `args`. Forward
    mode takes one direction at a time (`jax.jvp`).
    """
    arrays, static = eqx.partition((old, args), eqx.is_array)

    def made(arrays: Any) -> Any:
        return eqx.filter(make(*eqx.combine(arrays, static)[1]), eqx.is_array)

    @jax.custom_batching.custom_vmap
    def chosen(needed: Flag, arrays: Any) -> Any:
        return jax.lax.cond(needed, made, lambda arrays: arrays[0], arrays)

    @chosen.def_vmap
    @own_modes()
    def lanes(
        size: int, in_batched: Any, needed: Flag | Bool[Array, " lanes"], arrays: Any
    ) -> tuple[Any, Any]:
        axes = jax.tree.map(lambda batched: 0 if batched else None, in_batched[1])
        new = jax.vmap(made, in_axes=(axes,), axis_size=size)
        kept = jax.vmap(lambda arrays: arrays[0], in_axes=(axes,), axis_size=size)
        mask = jnp.broadcast_to(needed, (size,))

        def some(arrays: Any) -> Any:
            return jax.vmap(select)(mask, new(arrays), kept(arrays))

        found = jax.lax.cond(jnp.any(mask), some, kept, arrays)
        return found, jax.tree.map(lambda _: True, found)

    return eqx.combine(chosen(needed, arrays), eqx.filter(old, eqx.is_array, inverse=True))


def once(needed: Flag, make: Callable[[Any], Any], old: Any) -> Any:
    """Return `make(old)` if `needed`, else `old`, a tree of arrays, which XLA then keeps in its place.

    `jax.lax.cond` copies it in each branch. Not for `vmap`, under which all lanes are computed."""
    return jax.lax.while_loop(
        lambda carry: carry[0], lambda carry: (jnp.zeros_like(needed), make(carry[1])), (needed, old)
    )[1]
