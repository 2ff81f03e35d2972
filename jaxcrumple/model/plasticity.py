"""Plastic flow of the rest curvature (eqs. 34-36)."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, Scalar
from jaxcrumple._jax.tree import as_float, is_known, require_numbers

# Every iteration halves the bracket or the step, so this many iterations always suffice in float64.
MAX_ITERATIONS = 120
# Root, ends of the bracket, last step and number of iterations.
Bracket = tuple[HingeValues, HingeValues, HingeValues, HingeValues, Count | int]


class AbstractFlowRule(eqx.Module):
    """A yield law: dp/dt as a function of the curvature c and the rest curvature p, for each hinge.

    Subclass it with one method, `rate`. `rate` must have the sign of c - p (or vanish) and must not decrease
    with c - p. It may depend on per-hinge parameters stored as array fields. The solvers require nothing else
    of a user-defined law.
    """

    @abc.abstractmethod
    def rate(self, c: HingeValues, p: HingeValues) -> HingeValues:
        """dp/dt in 1/s for curvatures `c` and rest curvatures `p`, both (h,)."""


class SmoothstepFlow(AbstractFlowRule):
    """The paper's law (eqs. 34-36) with an explicit time scale.

    dp/dt = sign(c - p) S((abs(c - p) - c0) / (2 - c0)) / (T (1 + gamma)), with the smoothstep S(u) = 6 u^5 -
    15 u^4 + 10 u^3 between 0 and 1. The paper has no T (its rate has no unit). Only the product T (1 + gamma)
    enters.

    **Arguments:** `yield_threshold`: c0 < 2, dimensionless; `time`: T in s; `gamma` >= 0, dimensionless; each
    is one number or (h,).

    **Raises:** ValueError for a negative number, a time of 0, or a threshold of 2 or more.

    >>> law = jc.SmoothstepFlow(yield_threshold=0.3, time=1e-3, gamma=0.0)
    >>> c, p = jnp.array([0.2, 1.15, 2.0]), jnp.zeros(3)
    >>> print(law.rate(c, p))  # 1/s: below the threshold, halfway to c = 2, and at c = 2
    [   0.  500. 1000.]
    """

    yield_threshold: Scalar | HingeValues = eqx.field(converter=as_float)
    time: Scalar | HingeValues = eqx.field(converter=as_float)
    gamma: Scalar | HingeValues = eqx.field(converter=as_float)

    def __check_init__(self) -> None:
        require_numbers("yield_threshold of SmoothstepFlow", self.yield_threshold)
        require_numbers("time of SmoothstepFlow", self.time, positive=True)
        require_numbers("gamma of SmoothstepFlow", self.gamma)
        if is_known(self.yield_threshold) and np.any(np.asarray(self.yield_threshold) >= 2.0):
            raise ValueError(
                f"yield_threshold of SmoothstepFlow reaches {np.max(self.yield_threshold):g}; it must be "
                "below 2, the largest curvature of a hinge."
            )

    def rate(self, c: HingeValues, p: HingeValues) -> HingeValues:
        """dp/dt in 1/s for curvatures `c` and rest curvatures `p`, both (h,) (eqs. 34-36)."""
        elastic = c - p
        excess = (jnp.abs(elastic) - self.yield_threshold) / (2.0 - self.yield_threshold)
        return jnp.sign(elastic) * smoothstep(excess) / (self.time * (1.0 + self.gamma))


def smoothstep(u: Float[Array, " *axes"]) -> Float[Array, " *axes"]:
    """$6u^5 - 15u^4 + 10u^3$, clamped to [0, 1] (eq. 36)."""
    u = jnp.clip(u, 0.0, 1.0)
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


def implicit_update(
    rule: AbstractFlowRule, c: HingeValues, memory: HingeValues, beta_h: Scalar
) -> tuple[HingeValues, HingeValues]:
    """Compute the rest curvature of an implicit step and its slope dp/dc.

    Solves $p - p_* - \\beta h\\, \\dot p(c, p) = 0$ hinge by hinge (eq. 48), with `memory` $= -p_* =
    \\sum_j \\alpha_j p_j$. The left side increases with p, and the root lies between $p_*$ and c. So Newton's
    method with bisection as a safeguard always converges.

    **Returns:** `p` (h,) and `dp/dc` (h,) in [0, 1).
    """
    start = -memory

    def mismatch(p: HingeValues, c: HingeValues) -> HingeValues:
        return p - start - beta_h * rule.rate(c, p)

    def slopes(p: HingeValues, c: HingeValues) -> tuple[HingeValues, HingeValues, HingeValues]:
        by_p = jax.jvp(lambda p: rule.rate(c, p), (p,), (jnp.ones_like(p),))[1]
        by_c = jax.jvp(lambda c: rule.rate(c, p), (c,), (jnp.ones_like(c),))[1]
        return mismatch(p, c), 1.0 - beta_h * by_p, beta_h * by_c

    frozen_c = jax.lax.stop_gradient(c)
    root = jax.lax.stop_gradient(_bracketed_root(lambda p: slopes(p, frozen_c)[:2], start, frozen_c))
    value, by_p, by_c = slopes(root, c)
    # One last Newton step costs nothing and gives the root its derivatives.
    return root - value / by_p, by_c / by_p


def _bracketed_root(
    function: Callable[[HingeValues], tuple[HingeValues, HingeValues]], start: HingeValues, end: HingeValues
) -> HingeValues:
    """Find the root of an increasing function between `start` and `end`, elementwise."""

    def body(carry: Bracket) -> Bracket:
        p, low, high, step, count = carry
        value, slope = function(p)
        low, high = jnp.where(value < 0, p, low), jnp.where(value > 0, p, high)
        newton = p - value / slope
        # The law is flat below yield, where Newton would jump between the ends of the bracket. So accept a
        # Newton step only if it stays in the bracket and is at most half the last step. The bracket
        # includes its ends: bisection is slow towards a root within rounding of an end.
        good = (newton >= low) & (newton <= high) & (jnp.abs(newton - p) <= 0.5 * jnp.abs(step))
        new = jnp.where(good, newton, 0.5 * (low + high))
        new = jnp.where(value == 0, p, new)
        return new, low, high, new - p, count + 1

    def unfinished(carry: Bracket) -> Flag:
        return (jnp.max(jnp.abs(carry[3])) > 1e-15) & (carry[4] < MAX_ITERATIONS)

    low, high = jnp.minimum(start, end), jnp.maximum(start, end)
    init: Bracket = (start, low, high, high - low + 1.0, 0)
    return jax.lax.while_loop(unfinished, body, init)[0]
