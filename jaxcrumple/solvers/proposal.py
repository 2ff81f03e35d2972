"""The step that comes next: its length, and how much of it the end of a call leaves."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxcrumple._jax.arrays import Flag, Scalar, ScalarLike

# Relative rounding error of a step that ends at the end of a call.
ROUNDING = 1e-9


class ProposedStep(NamedTuple):
    """Describe a step to try.

    `wanted`: length in s that error control, stability and contact permit; `h`: length in s, cut at the end
    of the call; `t`: time in s at its end; `lands`: whether it ends the call; `bounded`: whether contact
    limited its length.
    """

    wanted: Scalar
    h: Scalar
    t: ScalarLike
    lands: Flag
    bounded: Flag


def propose(t: Scalar, wanted: Scalar, t_stop: ScalarLike, bounded: Flag | bool = False) -> ProposedStep:
    """Propose a step of `wanted` s from time `t` that ends at `t_stop` or leaves half of the way there."""
    left = t_stop - t
    lands = wanted >= left * (1.0 - ROUNDING)
    h = jnp.where(lands, left, jnp.where(wanted > 0.5 * left, 0.5 * left, wanted))
    return ProposedStep(wanted, h, jnp.where(lands, t_stop, t + h), lands, jnp.asarray(bounded))
