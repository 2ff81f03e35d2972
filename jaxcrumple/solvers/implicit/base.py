"""Common parts of the implicit steps: a step attempt, its rejection, and the interface of a formula."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, NodeVectors, Scalar
from jaxcrumple.history import Linearization
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.crossings import passes, unlisted_turn
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.state import CAUSES, IMPLICIT, State

# Largest growth of the step after a step of order 1 ... 5, below the zero-stability limits of variable-step
# BDF (1.62 and 1.28 at orders 3 and 4).
GROWTH = (2.0, 2.0, 1.5, 1.25, 1.12)
# Share of the tolerance that the local error of one step may use. Buckling amplifies local errors up to a
# hundredfold; with this share the measured error of a run stays below rtol.
LOCAL_SHARE = 0.01
# Safety factor of the step control, and smallest growth for which the step changes. With 0.7 one step in ten
# is rejected in `radial`, with 0.8 one in six, for the same number of Newton iterations.
SAFETY, WORTHWHILE = 0.7, 1.1
# Factor on the step after a failure other than a too large error.
CUT = 0.4


class ImplicitAttempt(NamedTuple):
    """Hold a step attempt: new `x`, `v`, `acceleration` (n, 3) and `p` (h,).

    `error`: local error in units of the tolerance; `cause`: index into `CAUSES`, or -1 for an accepted step;
    `order`: order of the step; `next_h` in s and `next_order`: size and order of the next step; `factor` and
    `kept`: factor of the last tangent, and where that tangent was computed; `newton`, `linear`, `factors`:
    iterations and factorisations of the attempt.
    """

    x: NodeVectors
    v: NodeVectors
    p: HingeValues | None
    acceleration: NodeVectors
    error: Scalar
    cause: Count
    order: Count
    next_h: Scalar
    next_order: Count
    factor: Factor
    kept: Linearization
    newton: Count
    linear: Count
    factors: Count

    @property
    def accepted(self) -> Flag:
        """Return whether the step is accepted."""
        return self.cause < 0


class AbstractImplicit(eqx.Module):
    """Define a formula of the implicit stages.

    A step attempt has three parts, so that the contact lists can be rebuilt while the equations are solved:
    `begin` at a proposed step, `go_on` until the result `is_over`, and `end`."""

    rtol: eqx.AbstractVar[Scalar]
    linear: eqx.AbstractVar[AbstractLinearSolver]

    @abc.abstractmethod
    def predict(self, scene: Scene, state: State, h: Scalar) -> NodeVectors:
        """Predict the positions (n, 3) after a step of `h` s from the history."""

    @abc.abstractmethod
    def differs(self, scene: Scene, state: State, h: Scalar) -> Scalar:
        """Bound the distance in m of a node from `predict` after an accepted step; 0 if unknown."""

    @abc.abstractmethod
    def begin(self, scene: Scene, state: State, h: Scalar, held: Flag) -> Any:
        """Begin a step of `h` s in the state's stage, and return what `go_on` continues.

        `held`: whether the factor of the tangent `state.kept` is there."""

    @abc.abstractmethod
    def go_on(self, scene: Scene, state: State, h: Scalar, begun: Any, factor: Factor) -> tuple[Any, Factor]:
        """Solve the equations of the step until they are solved, or an iterate leaves the contact lists."""

    @abc.abstractmethod
    def is_over(self, begun: Any) -> Flag:
        """Return whether the equations are solved, or cannot be."""

    @abc.abstractmethod
    def restores(self, begun: Any) -> Flag:
        """Return whether `go_on` only recomputes the missing factor of the lagged tangent, so that the step
        must begin again."""

    @abc.abstractmethod
    def iterate(self, begun: Any) -> NodeVectors:
        """Return the positions (n, 3) that the contact lists must cover to go on."""

    @abc.abstractmethod
    def given_up(self, begun: Any, when: Flag) -> Any:
        """Let the equations count as impossible to solve if `when`."""

    @abc.abstractmethod
    def end(self, scene: Scene, state: State, h: Scalar, begun: Any, factor: Factor) -> ImplicitAttempt:
        """Judge the step."""


def aligns(state: State) -> Flag:
    """Return whether the next step is a quasistatic start, which only aligns the velocity with the forces."""
    return (state.history.count == 0) & (state.stage != IMPLICIT)


def judge(
    scene: Scene, state: State, converged: Flag, indefinite: Flag, x: NodeVectors, t: Scalar, error: Scalar
) -> Count:
    """Return the cause (index into `CAUSES`) to reject the step to `x` at time `t`, or -1 to accept it.

    `converged`: whether its equations are solved; `indefinite`: whether their tangent is indefinite."""
    before = scene.bending.hinges(state.x).half
    after = scene.bending.hinges(x).half
    finite = jnp.all(jnp.isfinite(x)) & jnp.isfinite(error)
    # An angle that passes 180 degrees reappears with the other sign: it jumps by more than pi.
    flipped = jnp.any(after.minus(before).cosine < 0)
    checks = {
        "nonfinite": ~finite,
        "newton": ~converged,
        "fold": flipped,
        "error": error > 1.0,
        "contact": passes(scene, state, x, t, unlisted_turn(scene, x)),
    }
    cause = jnp.asarray(-1)
    for name in reversed(checks):
        cause = jnp.where(checks[name], CAUSES.index(name), cause)
    # An indefinite matrix explains a failed iteration better than the failure itself.
    return jnp.where(finite & indefinite, CAUSES.index("unstable"), cause)


def resized(h: Scalar, order: Count, error: Scalar, cause: Count, judged: Count | None = None) -> Scalar:
    """Return the step size in s after an attempt: from its error, or reduced by CUT after another failure.

    `order`: order of the next step; `judged`: order of the solution that `error` belongs to (None: `order`).
    """
    judged = order if judged is None else judged
    by_error = SAFETY * jnp.maximum(error, 1e-10) ** (-1.0 / (judged + 1))
    accepted = jnp.clip(by_error, 0.2, jnp.asarray(GROWTH)[order - 1])
    accepted = jnp.where((accepted > 1.0) & (accepted < WORTHWHILE), 1.0, accepted)
    rejected = jnp.where(cause == CAUSES.index("error"), jnp.clip(by_error, 0.1, 0.8), CUT)
    return h * jnp.where(cause < 0, accepted, rejected)
