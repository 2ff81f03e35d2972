"""Variable-step multistep formulas: BDF, and a two-step family for steps with inertia."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, Scalar
from jaxcrumple.history import HISTORY, History, ImplicitStep, Points, implicit_step
from jaxcrumple.scene import Scene


def _lags(h: Scalar, steps: Float[Array, " points"]) -> Float[Array, " points"]:
    """Return the time (6,) in s from each point of the history to the new time."""
    return h + jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps[:-1])])


def extrapolation(h: Scalar, steps: Float[Array, " points"], points: Count) -> Float[Array, " points"]:
    """Return the weights (6,) at the new time of the Lagrange predictor through the newest `points`."""
    lags = _lags(h, steps)
    used = jnp.arange(HISTORY) < points
    ratio = lags[None, :] / jnp.where(jnp.eye(HISTORY, dtype=bool), 1.0, lags[None, :] - lags[:, None])
    other = used[None, :] & ~jnp.eye(HISTORY, dtype=bool)
    return jnp.where(used, jnp.prod(jnp.where(other, ratio, 1.0), axis=1), 0.0)


def coefficients(
    h: Scalar, steps: Float[Array, " points"], order: Count
) -> tuple[Float[Array, " points"], Scalar]:
    """Compute the BDF coefficients of eq. (39), the derivative of the interpolant at the new time.

    **Arguments:** `h`: new step in s; `steps` (6,): past steps in s; `order`: 1 ... 6 (may be traced).

    **Returns:** `alpha` (6,), zero beyond the order, and `beta * h`, such that
    $\\dot y_{new} = (y_{new} + \\sum_j \\alpha_j y_j)/(\\beta h)$.
    """
    lags = _lags(h, steps)
    used = jnp.arange(HISTORY) < order
    beta_h = 1.0 / jnp.sum(jnp.where(used, 1.0 / lags, 0.0))
    return -extrapolation(h, steps, order) / lags * beta_h, beta_h


def error_constant(h: Scalar, steps: Float[Array, " points"], order: Count) -> Scalar:
    """Return the local error of BDF `order` as a share of (solution - predictor through order + 1 points).

    Both are the divided difference of order + 2 points times a polynomial in the steps. Their ratio is
    therefore $\\beta h / (t_{new} - t_{order})$ for any step ratios.
    """
    _, beta_h = coefficients(h, steps, order)
    return beta_h / _lags(h, steps)[order]


# Extent of the instability region of BDF 3, 4 and 5 to the left of the imaginary axis, in 1/h.
REACH = (1.0 / 12.0, 2.0 / 3.0, 2.3272)
# Margin for variable steps.
REACH_MARGIN = 1.2


def damped_order(h: Scalar, decay: Scalar) -> Count:
    """Return the largest order of BDF, 2 to 5, that is stable with inertia at steps of `h` s.

    `decay` in 1/s: decay rate of the least damped vibration. With drag proportional to mass,
    $\\lambda^2 + (b/m) \\lambda + \\omega^2 = 0$, and every complex eigenvalue has the real part -b/2m at any
    frequency. Orders above 2 are unstable in a bounded region near the imaginary axis only. All modes lie
    outside it if h b/2m exceeds its extent.
    """
    return 2 + jnp.sum(h * decay > REACH_MARGIN * jnp.asarray(REACH))


class TwoStep(NamedTuple):
    """Hold the coefficients of the two-step family for the unknown $Y = \\theta y_{new} + (1 - \\theta) y_0$.

    $\\dot Y = (Y + \\sum_j \\alpha_j y_j)/(\\beta h)$ with `alpha` (6,) and `beta_h` in s; `error`: local
    error as a share of (solution - predictor). The predictor uses three points, or an Euler step at order 1.
    """

    alpha: Float[Array, " points"]
    beta_h: Scalar
    error: Scalar


def two_step(h: Scalar, steps: Float[Array, " points"], order: Count, theta: Scalar) -> TwoStep:
    """Compute a one-leg method of order 1 or 2 for stages with inertia, A-stable for theta in [1/2, 1].

    The derivative at $t_0 + \\theta h$ of the parabola through the new point and the last two points equals
    the right-hand side at $\\theta y_{new} + (1 - \\theta) y_0$. $\\theta = 1$ gives BDF2, 1/2 the implicit
    midpoint rule. A step multiplies a mode of infinite frequency by $\\rho_\\infty = (1 - \\theta)/\\theta$.
    On the imaginary axis the loss is proportional to $\\theta (\\theta - 1/2) (1 - \\cos\\varphi)^2 \\ge 0$.
    """
    first, last = steps[0], steps[1]
    s = theta * h
    second = order > 1
    new = jnp.where(second, (2.0 * s + first) / (h * (h + first)), 1.0 / h)
    now = jnp.where(second, (h - first - 2.0 * s) / (h * first), -1.0 / h)
    before = jnp.where(second, (2.0 * s - h) / (first * (first + h)), 0.0)
    beta_h = theta / new
    alpha = jnp.zeros(HISTORY).at[0].set(beta_h * now - (1.0 - theta)).at[1].set(beta_h * before)
    # Third divided difference times the defects of the parabola's derivative and of the mean value.
    slope = 3.0 * s * s + 2.0 * s * (first - h) - h * first
    defect = slope + 3.0 * theta * (1.0 - theta) * h * h
    error = jnp.abs(defect) / (new * h * (h + first) * (h + first + last))
    return TwoStep(alpha, beta_h, jnp.where(second, error, h / (h + first)))


class Formula(NamedTuple):
    """Hold a step's formula: $\\dot Y = (Y + \\sum_j \\alpha_j y_j)/(\\beta h)$ for the unknown
    $Y = \\theta y_{new} + (1 - \\theta) y_0$.

    `alpha` (6,); `beta_h` in s; `inertia`: 0 or 1, or None if no stage has inertia; `share`: local error as a
    share of corrector - predictor.
    """

    alpha: Float[Array, " points"]
    beta_h: Scalar
    theta: Scalar
    inertia: Scalar | None
    share: Scalar

    def equations(self, scene: Scene, history: Points, t: Scalar, h: Scalar) -> ImplicitStep:
        """Return the equations of a step of `h` s from time `t`."""
        when = t + self.theta * h
        return implicit_step(scene, history, self.alpha, self.beta_h, when, self.inertia)


def step_formula(
    h: Scalar, steps: Float[Array, " points"], order: Count, moves: Flag | None, rho_infinity: Scalar
) -> Formula:
    """Return the formula of a step of `h` s and of `order`, after past `steps` (6,) in s.

    It is the two-step family for steps of order 1 or 2 with inertia (`moves`), and BDF for others. `moves`
    is None if no stage has inertia."""
    alpha, beta_h = coefficients(h, steps, order)
    share = error_constant(h, steps, order)
    if moves is None:
        return Formula(alpha, beta_h, jnp.ones(()), None, share)
    theta = jnp.where(moves, 1.0 / (1.0 + rho_infinity), 1.0)
    two = two_step(h, steps, order, theta)
    pair = moves & (order <= 2)
    alpha, beta_h = jnp.where(pair, two.alpha, alpha), jnp.where(pair, two.beta_h, beta_h)
    share = jnp.where(pair, two.error, share)
    return Formula(alpha, beta_h, theta, jnp.where(moves, 1.0, 0.0), share)


def push(
    history: History,
    h: Scalar,
    x: Float[Array, " *axes"],
    v: Float[Array, " *axes"],
    p: HingeValues | None,
    order: Count,
    points: int = HISTORY,
) -> History:
    """Insert a new accepted point at the front of the history, and keep `points` of them."""

    def shift(
        past: Float[Array, " points *axes"], new: Float[Array, " *axes"]
    ) -> Float[Array, " points *axes"]:
        return jnp.concatenate([new[None], past[: points - 1], past[points:]])

    past = None if history.p is None or p is None else shift(history.p, p)
    count = jnp.minimum(history.count + 1, points)
    return History(
        shift(history.x, x), shift(history.v, v), past, shift(history.steps, h), count, order
    )  # fmt: skip
