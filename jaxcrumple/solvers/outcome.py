"""Counters and the named result of a run, after each attempt."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, Scalar
from jaxcrumple.state import CAUSES, RESULTS, Counters, State

# Smallest step relative to the time: rounding removes shorter ones.
SMALLEST_STEP = 1e-13


def counted(
    counters: Counters,
    stage: Count | int,
    accepted: Flag,
    cause: Count,
    newton: Count | int = 0,
    linear: Count | int = 0,
    factors: Count | int = 0,
) -> Counters:
    """Return the counters after an attempt of a stage, and its Newton and linear iterations and factors."""
    accepted = jnp.asarray(accepted, int)
    return Counters(
        counters.steps.at[stage].add(accepted),
        counters.rejected.at[jnp.maximum(cause, 0)].add(1 - accepted),
        counters.newton + newton,
        counters.linear + linear,
        counters.factors + factors,
        counters.switches,
    )


def is_tiny(h: Scalar, t: Scalar) -> Flag:
    """Return whether a step of `h` s is so short that rounding removes it."""
    return h < SMALLEST_STEP * jnp.maximum(t, 1.0)


def given_up(state: State, lost: Flag, cause: Count) -> State:
    """Set the result of a run that is `lost`: no step succeeds, and the last one failed for `cause`."""
    state = with_result(state, lost, RESULTS.collapsed)
    for name, result in (("contact", RESULTS.blocked), ("nonfinite", RESULTS.nonfinite)):
        state = with_result(state, lost & (cause == CAUSES.index(name)), result)
    return state


def with_result(state: State, failed: Flag, result: Any) -> State:
    """Return the state with the `result` if it `failed`."""
    return eqx.tree_at(lambda s: s.result, state, RESULTS.where(failed, result, state.result))
