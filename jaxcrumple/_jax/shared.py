"""Share what is built from equal arguments for as long as somebody holds it."""

import functools
import weakref
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax

from jaxcrumple._jax.tree import is_known

Given = ParamSpec("Given")
Made = TypeVar("Made")


def shared(make: Callable[Given, Made]) -> Callable[Given, Made]:
    """Let a function return the same object for equal arguments, as long as it is in use elsewhere.

    Arguments must be hashable, and the object must not change.
    """
    made: weakref.WeakValueDictionary[Any, Any] = weakref.WeakValueDictionary()

    @functools.wraps(make)
    def one(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        key = (args, tuple(sorted(kwargs.items())))
        found = made.get(key)
        if found is None:
            found = made[key] = make(*args, **kwargs)
        return found

    return one


def kept_with_first(make: Callable[Given, Made]) -> Callable[Given, Made]:
    """Let a function return the same arrays of JAX for equal arguments, as long as its first one is in use.

    The other arguments must be hashable, and the result must not refer to the first one.
    """
    made: weakref.WeakKeyDictionary[Any, dict[Any, Any]] = weakref.WeakKeyDictionary()

    @functools.wraps(make)
    def one(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        first, *others = args
        kept = made.setdefault(first, {})
        key = (*others, *sorted(kwargs.items()), jax.config.jax_default_device)  # type: ignore[attr-defined]
        if key in kept:
            return kept[key]
        found = make(*args, **kwargs)
        # What is traced belongs to its trace.
        if is_known(found):
            kept[key] = found
        return found

    return one
