"""Lists that are mostly empty: programs for a few lengths, of which the shortest that suffices is run."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

# Shares of a list's room for which a program is compiled.
SHARES = (64, 8, 1)


def by_size(
    count: Array, room: int, function: Callable[[int], Any], nothing: Any, shares: Sequence[int] = SHARES
) -> Any:
    """`function(length)` for the shortest of a few lengths that holds `count` entries of a list with `room`.

    `shares`: what parts of the room these lengths are; each is compiled. Where there are none it is
    `nothing`, which must have the same structure. Unlike a loop it can be differentiated in both modes.
    """
    sizes = sorted({max(room // share, 1) for share in shares})
    index = jnp.sum(count > jnp.asarray([0, *sizes[:-1]]))

    def head(size: int) -> Callable[[], Any]:
        return lambda: function(size)

    return jax.lax.switch(index, [lambda: nothing, *map(head, sizes)])
