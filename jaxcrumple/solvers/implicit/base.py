"""What the implicit steps share: a tried step, what forbids it, and the contract of a step formula."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.schedule import passes, sharpest
from jaxcrumple.solvers.implicit.newton import NewtonSolution
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.state import CAUSES, IMPLICIT, Linearization, State

# Largest growth of the step after a step of order 1 ... 5: below what variable-step BDF tolerates
# without losing zero-stability (1.62 and 1.28 at orders 3 and 4).
GROWTH = (2.0, 2.0, 1.5, 1.25, 1.12)
# Share of the tolerance that one step's local error may use. Buckling amplifies what a step leaves
# behind up to a hundredfold; with this share the measured error of a run stays below rtol.
LOCAL_SHARE = 0.01
# Aim of the step control, and the smallest growth worth a change of step: with 0.7 one step in ten is
# rejected on `radial`, with 0.8 one in six, for the same number of Newton iterations.
SAFETY, WORTHWHILE = 0.7, 1.1
# A step that failed for another reason than its error is cut by this.
CUT = 0.4


class Attempt(NamedTuple):
    """A tried step: new `x`, `v`, `acceleration` (n, 3) and `p`, its `error` in units of the tolerance,
    the `order` it had, the step and order to take next, and what it took.
    `factor` and `kept`: the last tangent, and where it was taken. Where `restored`, that is all there is.

    `cause` indexes `CAUSES`, or is -1 when the step is accepted.
    """

    x: Array
    v: Array
    p: Array | None
    acceleration: Array
    error: Array
    cause: Array
    order: Array
    next_h: Array
    next_order: Array
    factor: Factor
    kept: Linearization
    newton: Array
    linear: Array
    factors: Array
    restored: Array

    @property
    def accepted(self) -> Array:
        """Whether the step stands."""
        return self.cause < 0


class AbstractImplicit(eqx.Module):
    """A formula for the implicit stages."""

    rtol: eqx.AbstractVar[Array]
    linear: eqx.AbstractVar[AbstractLinearSolver]

    @abc.abstractmethod
    def predict(self, scene: Scene, state: State, h: Array) -> Array:
        """Positions (n, 3) after a step of size `h` s as the history tells."""

    @abc.abstractmethod
    def differs(self, scene: Scene, state: State, h: Array) -> Array:
        """How far in m a node may be from `predict` after a step whose error is tolerated; 0: not known."""

    @abc.abstractmethod
    def attempt(self, scene: Scene, state: State, h: Array, factor: Factor, held: Array) -> Attempt:
        """Try a step of size `h` s in the state's stage; `held`: whether `factor` is of `state.kept`."""


def aligns(state: State) -> Array:
    """Whether the next step only makes the velocity balance the forces: a quasistatic start."""
    return (state.history.count == 0) & (state.stage != IMPLICIT)


def judge(scene: Scene, state: State, solution: NewtonSolution, x: Array, t: Array, error: Array) -> Array:
    """Index into `CAUSES` of what forbids the step to `x` at time `t`, or -1."""
    before = scene.bending.hinges(state.x).theta
    after = scene.bending.hinges(x).theta
    finite = jnp.all(jnp.isfinite(x)) & jnp.isfinite(error)
    # An angle that passes 180 degrees reappears with the other sign: it jumps by more than pi.
    flipped = jnp.max(jnp.abs(after - before)) > jnp.pi
    checks = {
        "nonfinite": ~finite,
        "newton": ~solution.converged,
        "fold": flipped,
        "error": error > 1.0,
        "contact": passes(scene, state, x, t, sharpest(scene, x)),
    }
    cause = jnp.asarray(-1)
    for name in reversed(checks):
        cause = jnp.where(checks[name], CAUSES.index(name), cause)
    # An indefinite matrix explains a failed iteration better than the failure itself.
    return jnp.where(finite & solution.indefinite, CAUSES.index("unstable"), cause)


def resized(h: Array, order: Array, error: Array, cause: Array, judged: Array | None = None) -> Array:
    """Step size after an attempt: from the error if it was judged by it, else a fixed cut.

    `order` is the next step's, `judged` that of the solution whose error is known (the same if None).
    """
    judged = order if judged is None else judged
    by_error = SAFETY * jnp.maximum(error, 1e-10) ** (-1.0 / (judged + 1))
    accepted = jnp.clip(by_error, 0.2, jnp.asarray(GROWTH)[order - 1])
    accepted = jnp.where((accepted > 1.0) & (accepted < WORTHWHILE), 1.0, accepted)
    rejected = jnp.where(cause == CAUSES.index("error"), jnp.clip(by_error, 0.1, 0.8), CUT)
    return h * jnp.where(cause < 0, accepted, rejected)
