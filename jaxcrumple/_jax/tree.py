"""Conversion and checks of numeric fields, and selection between trees of them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Float, Int, Integer, Real, Shaped

from jaxcrumple._jax.arrays import Flag

# Most characters of a wrong value that a message quotes.
QUOTED = 80


def as_array(value: Shaped[ArrayLike, " *axes"], dtype: DTypeLike | None = None) -> Shaped[Array, " *axes"]:
    """Convert numbers to an array of JAX, without compiling.

    `jnp.asarray` compiles a program for every shape of a NumPy array.
    """
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        return jax.device_put(np.asarray(value, dtype), may_alias=False)
    return jnp.asarray(value, dtype)


def as_indices(value: Int[ArrayLike, " *axes"]) -> Int[Array, " *axes"]:
    """Convert indices to an array of JAX of 32 bits."""
    return as_array(value, np.int32)


def as_float(value: Real[ArrayLike, " *axes"]) -> Float[Array, " *axes"]:
    """Convert a number or an array to a float array, so that the field is a differentiable leaf.

    The explicit type makes Python and NumPy numbers compile to the same program.

    **Raises:** ValueError for a value that is not numeric.
    """
    with jax.transfer_guard("allow"):
        try:
            return as_array(np.float64(value) if isinstance(value, int | float) else value, float)
        except (TypeError, ValueError) as error:
            if not is_known(value):
                raise
            raise ValueError(f"{value!r} is neither a number nor an array of numbers.") from error


def as_numbers(what: str, value: Integer[ArrayLike, " *axes"]) -> Integer[Array, " *axes"]:
    """Convert node numbers to an integer array.

    **Raises:** ValueError unless all are whole numbers from 0 on.
    """
    given = value if isinstance(value, Array) else np.asarray(value)
    if given.dtype.kind not in "iu":
        raise ValueError(f"{what} = {value!r} must be whole numbers; use numpy.flatnonzero(mask) for a mask.")
    if is_known(given) and np.any(np.asarray(given) < 0):
        raise ValueError(f"{what} holds {np.min(np.asarray(given))}; nodes are numbered from 0 on.")
    with jax.transfer_guard("allow"):
        return as_array(given)


def is_known(*values: Any) -> bool:
    """Return whether all numbers in `values` are concrete: no transformation of JAX traces one of them."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def require_finite(what: str, value: Any) -> None:
    """Refuse a number or an array with an entry that is not finite; skip traced values.

    **Raises:** ValueError that names the first such entry.
    """
    if not is_known(value):
        return
    array = np.asarray(value)
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        place = f"[{', '.join(map(str, bad[0]))}]" if array.ndim else ""
        raise ValueError(f"{what}{place} is {array[tuple(bad[0])]}; it must be finite.")


def require_numbers(what: str, value: Any, *, positive: bool = False) -> None:
    """Refuse numbers that are not finite or are negative, with `positive` also zero; skip traced values.

    **Raises:** ValueError that names the first one.
    """
    require_finite(what, value)
    if not is_known(value):
        return
    array = np.asarray(value)
    bad = np.argwhere(array <= 0 if positive else array < 0)
    if len(bad):
        place = f"[{', '.join(map(str, bad[0]))}]" if array.ndim else ""
        wanted = "positive" if positive else "zero or positive"
        raise ValueError(f"{what}{place} is {array[tuple(bad[0])]}; it must be {wanted}.")


def require_shape(what: str, value: Any, *shapes: tuple[int, ...]) -> None:
    """Refuse an array whose shape is not among `shapes`.

    **Raises:** ValueError with its shape and the permitted shapes.
    """
    if np.shape(value) not in shapes:
        raise ValueError(f"{what} has shape {np.shape(value)}; it must be {' or '.join(map(str, shapes))}.")


def require_limit(name: str, value: Any) -> None:
    """Refuse a limit that is neither None nor a number >= 0.

    **Raises:** ValueError that names it.
    """
    if value is not None and not (is_number(value) and value >= 0):
        raise ValueError(f"{name} = {shown(value)} must be zero or more; leave it out for no limit.")


def is_number(value: Any) -> bool:
    """Return whether a value is one real number of Python, NumPy or JAX, concrete or traced."""
    kind = getattr(np.asarray(value) if is_known(value) else value, "dtype", np.dtype(object)).kind
    return kind in "iuf" and np.shape(value) == ()


def shown(value: Any) -> str:
    """Quote a value for a message of one line: its repr, or its type if the repr is long."""
    text = repr(value)
    return text if len(text) <= QUOTED and "\n" not in text else f"a {type(value).__name__}"


def select(keep: Flag, new: Any, old: Any) -> Any:
    """Select the leaves of the tree `new` where `keep`, else those of `old`."""
    return jax.tree.map(lambda a, b: jnp.where(keep, a, b), new, old)


def size_difference(one: Any, other: Any) -> str:
    """Describe the first array whose size differs between two dictionaries of trees; "" if none does."""
    sizes = [
        {path: np.shape(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
        for tree in (one, other)
    ]
    for path in [*sizes[0], *sizes[1]]:
        first, second = (these.get(path) for these in sizes)
        if first != second:
            name = f"{path[0].key}{jax.tree_util.keystr(path[1:])}"
            return f"{name} has sizes {first} and {second}"
    return ""
