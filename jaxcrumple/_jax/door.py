"""What public functions share: double precision, and modes of JAX of their own."""

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
    """Compute in modes of JAX of our own, whatever the caller has set.

    `jax_numpy_dtype_promotion`, `jax_numpy_rank_promotion` and the transfer guard find slips in the caller's
    code. Here ranks and types are promoted on purpose, and arguments may be numbers of Python and of NumPy.
    Rules of derivatives and of batching run when their caller has returned, so they need this as well.
    Programs are the same as in the modes that JAX has by default.
    """
    with (
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        jax.transfer_guard("allow"),
    ):
        yield


def door(function: Callable[Given, Made]) -> Callable[Given, Made]:
    """A public function that computes: it refuses single precision, and computes in `own_modes`."""

    @functools.wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        require_x64()
        with own_modes():
            return function(*args, **kwargs)

    return checked


def require_x64() -> None:
    """Refuse to compute in single precision.

    **Raises:** ValueError with the setting to change.
    """
    if jnp.result_type(float) != np.float64:
        raise ValueError(
            "jaxcrumple needs float64: forces nearly cancel and float32 loses them. "
            'Call jax.config.update("jax_enable_x64", True) at the start of the program.'
        )
