"""Fields that hold physical numbers."""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def as_float(value: ArrayLike) -> Array:
    """Float array of a number or an array: a leaf to differentiate by, whatever it was given as.

    The explicit type makes numbers of Python and of NumPy compile to the same program.
    """
    return jnp.asarray(value, float)
