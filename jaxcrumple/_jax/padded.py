"""Lists that are mostly empty: what their entries add up to and which to keep, a chunk at a time, so that
room costs nothing."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple._jax.door import own_modes

# Length of the parts in which a long running count is made.
SIDE = 32


def accumulate(
    add: Callable[[Any, Any, Array, Array], Any],
    start: Any,
    arguments: Any,
    count: Array,
    room: int,
    chunk: int,
) -> Any:
    """`start` with what the first `count` entries of a list with `room` add to it.

    `add(total, arguments, places, held)` adds those at `places` (chunk,) that are `held` (chunk,), and
    nothing where one is not; it closes over no number that is differentiated. The loop ends with the list;
    derivatives, of any order and mode, come from one that has as many rounds as the list has room, and skips
    those beyond, many at a time.
    """
    return _accumulate(start, arguments, count, add=add, room=room, chunk=min(chunk, room))


@eqx.filter_custom_jvp
def _accumulate(start: Any, arguments: Any, count: Array, *, add, room: int, chunk: int) -> Any:
    def body(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        first, total = carry
        return first + chunk, add(total, arguments, *_places(first, count, room, chunk))

    return jax.lax.while_loop(lambda carry: carry[0] < count, body, (jnp.zeros_like(count), start))[1]


@_accumulate.def_jvp
@own_modes()
def _derivative(primals, tangents, *, add, room: int, chunk: int):
    start, arguments, count = primals
    moved, changed, _ = tangents

    rounds = -(-room // chunk)
    group = math.isqrt(rounds - 1) + 1

    def whole(start: Any, arguments: Any) -> Any:
        def one(total: Any, first: Array) -> Any:
            return add(total, arguments, *_places(first, count, room, chunk))

        def several(total: Any, first: Array) -> Any:
            return _each(one, total, first + chunk * jnp.arange(group), count)

        return _each(several, start, chunk * group * jnp.arange(-(-rounds // group)), count)

    return eqx.filter_jvp(whole, (start, arguments), (moved, changed))


def _each(function: Callable[[Any, Array], Any], start: Any, numbers: Array, count: Array) -> Any:
    """`start` with what a `function` of `numbers` (m,) adds for those below `count`. Reverse mode keeps
    nothing of them: there may be many, and few below."""

    @jax.checkpoint
    def body(total: Any, number: Array) -> tuple[Any, None]:
        return jax.lax.cond(number < count, lambda: function(total, number), lambda: total), None

    return jax.lax.scan(body, start, numbers)[0]


def _places(first: Array, count: Array, room: int, chunk: int) -> tuple[Array, Array]:
    """Places (chunk,) from `first` on, none beyond the `room`, and which are among the first `count`."""
    at = first + jnp.arange(chunk)
    return jnp.minimum(at, room - 1), at < count


def compacted(
    test: Callable[[Array], Array],
    count: Array,
    width: int,
    size: int,
    rows: int,
    entries: Callable[[Array], Array] = lambda places: places,
) -> tuple[Array, Array]:
    """Places row * width + column where `test` holds, in order, 0 beyond, and how many there are; or the
    `entries` of a list at these places.

    `test` takes row numbers (k,) and returns (k, `width`) of a table whose first `count` rows count. It is
    called for `rows` at a time, as often as there are such. Nothing of this is differentiated.
    """

    def body(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        chunk, kept, total = carry
        at = chunk * rows + jnp.arange(rows, dtype=jnp.int32)
        inside = jnp.minimum(at, count - 1)
        flat = (test(inside) & (at < count)[:, None]).reshape(-1)
        order = total + counted(flat)
        # Where a row has one place, what `test` and `entries` have in common is computed once.
        places = inside[:, None] * width + jnp.arange(width, dtype=jnp.int32)
        found = entries(places.reshape(-1))
        return chunk + 1, kept.at[jnp.where(flat, order - 1, size)].set(found, mode="drop"), order[-1]

    # Wider integers take four times as long.
    zero, count = jnp.zeros((), jnp.int32), jnp.asarray(count, jnp.int32)
    start = (zero, jnp.zeros(size, jax.eval_shape(entries, zero[None]).dtype), zero)
    _, kept, total = jax.lax.while_loop(lambda carry: carry[0] * rows < count, body, start)
    return kept, total.astype(int)


def enumerated(
    intervals: Callable[[Array], tuple[Array, Array]],
    count: Array,
    size: int,
    rows: int,
    entries: Callable[[Array, Array], Array],
) -> tuple[Array, Array]:
    """The whole numbers of intervals in order, 0 beyond, and how many there are, as what `entries` makes of
    them.

    `intervals` takes row numbers (k,) and returns the first number of (k, w) intervals and the one behind the
    last; `entries` takes row numbers (k,) and numbers (k, w). `rows` are looked at at a time, as in
    `compacted`.
    """

    def body(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        chunk, kept, total = carry
        at = chunk * rows + jnp.arange(rows, dtype=jnp.int32)
        inside = jnp.minimum(at, count - 1)
        first, behind = intervals(inside)
        length = jnp.where((at < count)[:, None], jnp.maximum(behind - first, 0), 0)
        ends = total + counted(length.reshape(-1)).reshape(length.shape)

        def add(carry: tuple[Array, Array]) -> tuple[Array, Array]:
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


def filled(value: Callable[[Array], Any], count: Array, size: int, chunk: int) -> Any:
    """Columns (size,) of a table with what `value` makes of places (chunk,), a tree of columns (chunk,), for
    the first `count`; the others are 0."""

    def body(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        first, columns = carry
        part = value(_places(first, count, size, chunk)[0])
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=first, axis=0)
        return first + chunk, jax.tree.map(put, columns, part)

    kinds = jax.eval_shape(value, jax.ShapeDtypeStruct((chunk,), int))
    start = jnp.asarray(0), jax.tree.map(lambda kind: jnp.zeros(size + chunk, kind.dtype), kinds)
    many = jnp.minimum(count, size)
    columns = jax.lax.while_loop(lambda carry: carry[0] < many, body, start)[1]
    return jax.tree.map(lambda column: column[:size], columns)


def counted(numbers: Array) -> Array:
    """Sum (m,) of small whole `numbers` (m,), or of flags, up to and including each: two short sums, the
    first by a product of matrices."""
    rows = jnp.pad(numbers, (0, -numbers.size % SIDE)).reshape(-1, SIDE).astype(jnp.float32)
    within = rows @ jnp.triu(jnp.ones((SIDE, SIDE), jnp.float32))
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    return (within + before[:, None]).reshape(-1)[: numbers.size].astype(jnp.int32)
