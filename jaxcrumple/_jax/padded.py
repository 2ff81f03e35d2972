"""Padded lists of fixed capacity: sum, select and fill entries chunk by chunk.

The loops stop at the number of entries in use, so unused capacity costs no time.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxcrumple._jax.arrays import Count
from jaxcrumple._jax.device import on_accelerator
from jaxcrumple._jax.door import own_modes

# Row length of the cumulative sum in `counted`, and most rows that one matrix product sums: its matrix must
# fit in the processor's cache.
SIDE, MOST_ROWS = 32, 256
# Chunks of a sum that an accelerator adds at once: each round of a loop costs it some launches of kernels and
# a message to the host, while a small chunk leaves it idle.
AT_ONCE = 64


def accumulate(
    add: Callable[[Any, Any, Int[Array, " chunk"], Bool[Array, " chunk"]], Any],
    start: Any,
    arguments: Any,
    count: Count,
    room: int,
    chunk: int,
) -> Any:
    """Add the contributions of the first `count` entries of a list of capacity `room` to `start`, a `chunk`
    at a time on a CPU, and AT_ONCE as many on an accelerator.

    `add(total, arguments, places, held)` adds the entries at `places` (chunk,) where `held` (chunk,) is true,
    and ignores the others. Pass differentiated numbers in `arguments`; `add` must not close over them. The
    loop stops at `count`. Derivatives of any order and mode use a loop over the full capacity, which skips
    the rounds beyond `count` in groups.
    """
    chunk = min(AT_ONCE * chunk if on_accelerator() else chunk, room)
    return _accumulate(start, arguments, count, add=add, room=room, chunk=chunk)


@eqx.filter_custom_jvp
def _accumulate(
    start: Any, arguments: Any, count: Count, *, add: Callable[..., Any], room: int, chunk: int
) -> Any:
    def body(carry: tuple[Count, Any]) -> tuple[Count, Any]:
        first, total = carry
        return first + chunk, add(total, arguments, *_places(first, count, room, chunk))

    return jax.lax.while_loop(lambda carry: carry[0] < count, body, (jnp.zeros_like(count), start))[1]


@_accumulate.def_jvp
@own_modes()
def _derivative(
    primals: tuple[Any, Any, Count],
    tangents: tuple[Any, Any, Any],
    *,
    add: Callable[..., Any],
    room: int,
    chunk: int,
) -> tuple[Any, Any]:
    start, arguments, count = primals
    moved, changed, _ = tangents

    rounds = -(-room // chunk)
    group = math.isqrt(rounds - 1) + 1

    def whole(start: Any, arguments: Any) -> Any:
        def one(total: Any, first: Count) -> Any:
            return add(total, arguments, *_places(first, count, room, chunk))

        def several(total: Any, first: Count) -> Any:
            return _each(one, total, first + chunk * jnp.arange(group), count)

        return _each(several, start, chunk * group * jnp.arange(-(-rounds // group)), count)

    return eqx.filter_jvp(whole, (start, arguments), (moved, changed))


def _each(
    function: Callable[[Any, Count], Any], start: Any, numbers: Int[Array, " rounds"], count: Count
) -> Any:
    """Add the contributions of `function` for each of `numbers` (m,) below `count` to `start`.

    Reverse mode recomputes the rounds instead of storing them: there may be many, but few below `count`.
    """

    @jax.checkpoint
    def body(total: Any, number: Count) -> tuple[Any, None]:
        return jax.lax.cond(number < count, lambda: function(total, number), lambda: total), None

    return jax.lax.scan(body, start, numbers)[0]


def _places(
    first: Count, count: Count, room: int, chunk: int
) -> tuple[Int[Array, " chunk"], Bool[Array, " chunk"]]:
    """Return places (chunk,) from `first` on, clipped to the capacity `room`, and which are below `count`."""
    at = first + jnp.arange(chunk)
    return jnp.minimum(at, room - 1), at < count


def compacted(
    test: Callable[[Int[Array, " rows"]], Bool[Array, "rows width"]],
    count: Count,
    width: int,
    size: int,
    rows: int,
    entries: Callable[[Int[Array, " places"]], Int[Array, " places"]] = lambda places: places,
) -> tuple[Int[Array, " size"], Count]:
    """List the places row * width + column where `test` holds, in order, padded with 0.

    `test` takes row numbers (k,) and returns flags (k, `width`) of a table with `count` valid rows. The loop
    tests `rows` rows at a time. The result is not differentiable.

    **Returns:** `entries` of these places (size,), by default the places themselves, and how many there are.
    """

    def body(carry: tuple[Count, Int[Array, " size"], Count]) -> tuple[Count, Int[Array, " size"], Count]:
        chunk, kept, total = carry
        at = chunk * rows + jnp.arange(rows, dtype=jnp.int32)
        inside = jnp.minimum(at, count - 1)
        flat = (test(inside) & (at < count)[:, None]).reshape(-1)
        order = total + counted(flat)
        # With one place per row this form lets XLA share the common part of `test` and `entries`.
        places = inside[:, None] * width + jnp.arange(width, dtype=jnp.int32)
        found = entries(places.reshape(-1))
        return chunk + 1, kept.at[jnp.where(flat, order - 1, size)].set(found, mode="drop"), order[-1]

    # 64-bit integers take four times as long.
    zero, count = jnp.zeros((), jnp.int32), jnp.asarray(count, jnp.int32)
    start = (zero, jnp.zeros(size, jax.eval_shape(entries, zero[None]).dtype), zero)
    _, kept, total = jax.lax.while_loop(lambda carry: carry[0] * rows < count, body, start)
    return kept, total.astype(int)


def enumerated(
    intervals: Callable[
        [Int[Array, " rows"]], tuple[Int[Array, "rows intervals"], Int[Array, "rows intervals"]]
    ],
    count: Count,
    size: int,
    rows: int,
    entries: Callable[[Int[Array, " rows"], Int[Array, "rows intervals"]], Int[Array, "rows intervals"]],
) -> tuple[Int[Array, " size"], Count]:
    """List the integers in the intervals of each row, in order, mapped by `entries` and padded with 0.

    `intervals` takes row numbers (k,) and returns start and exclusive end of (k, w) intervals. `entries`
    takes row numbers (k,) and integers (k, w). The loop takes `rows` rows at a time, as in `compacted`.

    **Returns:** the mapped integers (size,), and how many there are.
    """

    def body(carry: tuple[Count, Int[Array, " size"], Count]) -> tuple[Count, Int[Array, " size"], Count]:
        chunk, kept, total = carry
        at = chunk * rows + jnp.arange(rows, dtype=jnp.int32)
        inside = jnp.minimum(at, count - 1)
        first, behind = intervals(inside)
        length = jnp.where((at < count)[:, None], jnp.maximum(behind - first, 0), 0)
        ends = total + counted(length.reshape(-1)).reshape(length.shape)

        def add(carry: tuple[Count, Int[Array, " size"]]) -> tuple[Count, Int[Array, " size"]]:
            number, kept = carry
            place = jnp.where(number < length, ends - length + number, size)
            found = entries(inside, first + number)
            return number + 1, kept.at[place.reshape(-1)].set(found.reshape(-1), mode="drop")

        longest = jnp.max(length)
        _, kept = jax.lax.while_loop(lambda carry: carry[0] < longest, add, (zero, kept))
        return chunk + 1, kept, ends[-1, -1]

    zero, count = jnp.zeros((), jnp.int32), jnp.asarray(count, jnp.int32)
    start = (zero, jnp.zeros(size, jax.eval_shape(entries, zero[None], zero[None, None]).dtype), zero)
    _, kept, total = jax.lax.while_loop(lambda carry: carry[0] * rows < count, body, start)
    return kept, total.astype(int)


def filled(value: Callable[[Int[Array, " chunk"]], Any], count: Count, size: int, chunk: int) -> Any:
    """Fill the columns (size,) of a table chunk by chunk for its first `count` entries.

    `value` takes places (chunk,) and returns a tree of columns (chunk,). Entries after the last chunk are 0.
    """
    chunk = min(chunk, size)

    def body(carry: tuple[Count, Any]) -> tuple[Count, Any]:
        first, columns = carry
        # The last chunk overlaps the one before it if it would reach beyond the end.
        here = jnp.minimum(first, size - chunk)
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=here, axis=0)
        return first + chunk, jax.tree.map(put, columns, value(here + jnp.arange(chunk)))

    kinds = jax.eval_shape(value, jax.ShapeDtypeStruct((chunk,), int))
    start = jnp.asarray(0), jax.tree.map(lambda kind: jnp.zeros(size, kind.dtype), kinds)
    many = jnp.minimum(count, size)
    return jax.lax.while_loop(lambda carry: carry[0] < many, body, start)[1]


def counted(numbers: Int[Array, " entries"] | Bool[Array, " entries"]) -> Int[Array, " entries"]:
    """Return the inclusive cumulative sum (m,) of small integers or flags `numbers` (m,).

    Matrix products sum within rows of SIDE numbers, and over the rows before; the sums of many rows are
    summed in the same way.
    """
    rows = jnp.pad(numbers, (0, -numbers.size % SIDE)).reshape(-1, SIDE).astype(jnp.float32)
    within = rows @ jnp.triu(jnp.ones((SIDE, SIDE), jnp.float32))
    sums = within[:, -1]
    if len(rows) > MOST_ROWS:
        before = counted(sums.astype(jnp.int32)).astype(jnp.float32) - sums
    else:
        before = jnp.tril(jnp.ones((len(rows), len(rows)), jnp.float32), -1) @ sums
    return (within + before[:, None]).reshape(-1)[: numbers.size].astype(jnp.int32)
