"""Check in tests, at each call, what annotations say about the shapes and kinds of arrays.

Checked are annotations such as `Float[Array, "nodes 3"]`. Those of several types, such as `Scalar | float` or
with `ArrayLike`, are not: users pass them, and the function checks them itself, and its error says more.
Names of axes hold within one call, or one object.
"""

from collections.abc import Callable
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

from beartype import beartype
from jaxtyping import AbstractArray, install_import_hook


def install() -> None:
    """Check all functions and classes of the package, which must not have been imported yet."""
    install_import_hook("jaxcrumple", "array_types.checked")


def checked(function):
    """Return a function that checks its arrays, and the same function if no annotation tells of arrays."""
    hints = {name: hint if _tells(hint) else Any for name, hint in function.__annotations__.items()}
    if all(hint is Any for hint in hints.values()):
        return function
    function.__annotations__ = hints
    return beartype(function)


def _tells(hint) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    if get_origin(hint) is Callable:
        return False
    parts = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        arrays = {getattr(part, "array_type", None) for part in parts if part is not NoneType}
        return len(arrays) == 1 and any(map(_tells, parts))
    return any(map(_tells, parts))
