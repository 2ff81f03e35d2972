"""Fields that hold physical numbers, and trees of them."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def as_float(value: ArrayLike) -> Array:
    """Float array of a number or an array: a leaf to differentiate by, whatever it was given as.

    The explicit type makes numbers of Python and of NumPy compile to the same program.
    """
    return jnp.asarray(value, float)


def is_known(*values: Any) -> bool:
    """Whether all numbers in `values` can be looked at: none is traced by a transformation of JAX."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def select(keep: Array, new: Any, old: Any) -> Any:
    """The leaves of the tree `new` where `keep`, else those of `old`."""
    return jax.tree.map(lambda a, b: jnp.where(keep, a, b), new, old)
