"""Variable-step backward differentiation formulas, coefficients from the step history."""

import jax.numpy as jnp
from jax import Array

from jaxcrumple.system import HISTORY, History


def _lags(h: Array, steps: Array) -> Array:
    """Distance (4,) from the new time back to each point of the history."""
    return h + jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps[:-1])])


def extrapolation(h: Array, steps: Array, points: Array) -> Array:
    """Weights (4,) of the Lagrange predictor through the newest `points` points, at the new time."""
    lags = _lags(h, steps)
    used = jnp.arange(HISTORY) < points
    ratio = lags[None, :] / jnp.where(jnp.eye(HISTORY, dtype=bool), 1.0, lags[None, :] - lags[:, None])
    other = used[None, :] & ~jnp.eye(HISTORY, dtype=bool)
    return jnp.where(used, jnp.prod(jnp.where(other, ratio, 1.0), axis=1), 0.0)


def coefficients(h: Array, steps: Array, order: Array) -> tuple[Array, Array]:
    """BDF coefficients of eq. (39): the derivative at the new time of the interpolant.

    **Arguments:** `h` new step in s; `steps` (4,) past steps; `order` 1 ... 4 (may be traced).

    **Returns:** `alpha` (4,), zero beyond the order, and `beta * h`, such that
    $\\dot y_{new} = (y_{new} + \\sum_j \\alpha_j y_j)/(\\beta h)$.
    """
    lags = _lags(h, steps)
    used = jnp.arange(HISTORY) < order
    beta_h = 1.0 / jnp.sum(jnp.where(used, 1.0 / lags, 0.0))
    return -extrapolation(h, steps, order) / lags * beta_h, beta_h


def push(history: History, h: Array, x: Array, p: Array | None) -> History:
    """History with a new accepted point in front."""

    def shift(past: Array, new: Array) -> Array:
        return jnp.concatenate([new[None], past[:-1]])

    past = None if history.p is None or p is None else shift(history.p, p)
    count = jnp.minimum(history.count + 1, HISTORY)
    return History(shift(history.x, x), past, shift(history.steps, h), count)
