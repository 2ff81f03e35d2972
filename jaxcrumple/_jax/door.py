"""Guards of all public functions: double precision, and the default modes of JAX."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Given = ParamSpec("Given")
Made = TypeVar("Made")


@contextlib.contextmanager
def own_modes() -> Iterator[None]:
    """Compute in the default modes of JAX, whatever modes the caller has set.

    `jax_numpy_dtype_promotion`, `jax_numpy_rank_promotion` and the transfer guard detect mistakes in the
    caller's code. This package promotes ranks and types on purpose, and its arguments may be Python or NumPy
    numbers. JAX runs derivative and batching rules after their caller has returned, so these rules need this
    context as well. The compiled programs are the same as in JAX's default modes.
    """
    with (
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        jax.transfer_guard("allow"),
    ):
        yield


def door(function: Callable[Given, Made]) -> Callable[Given, Made]:
    """Decorate a public function: refuse single precision, and compute in `own_modes`."""

    @functools.wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        require_x64()
        with own_modes():
            return function(*args, **kwargs)

    return checked


def require_x64() -> None:
    """Refuse to compute in single precision.

    **Raises:** ValueError that names the setting to change.
    """
    if jnp.result_type(float) != np.float64:
        raise ValueError(
            "jaxcrumple needs float64: forces nearly cancel and float32 loses them. "
            'Call jax.config.update("jax_enable_x64", True) at the start of the program.'
        )
