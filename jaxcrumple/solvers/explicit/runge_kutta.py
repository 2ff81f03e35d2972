"""Kutta's 3/8 rule with an embedded third-order method: the paper's explicit stage."""

from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, HingeValues, NodeVectors, Scalar
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.explicit.base import AbstractExplicit, Tried
from jaxcrumple.solvers.explicit.stability import Fastest
from jaxcrumple.state import Slopes, State
from jaxcrumple.system import rates

# Stability limit of the method, below those on the imaginary axis (2.83) and the negative real axis (2.79).
STABILITY = 2.75


class RK43(diffrax.AbstractERK):
    """Implement Kutta's 3/8 rule (order 4) with an embedded third-order method on an extra, reused stage."""

    tableau = diffrax.ButcherTableau(
        c=np.array([1 / 3, 2 / 3, 1.0, 1.0]),
        a_lower=(
            np.array([1 / 3]),
            np.array([-1 / 3, 1.0]),
            np.array([1.0, -1.0, 1.0]),
            np.array([1 / 8, 3 / 8, 3 / 8, 1 / 8]),
        ),
        b_sol=np.array([1 / 8, 3 / 8, 3 / 8, 1 / 8, 0.0]),
        b_error=np.array([1 / 8 - 1 / 12, 3 / 8 - 1 / 2, 3 / 8 - 1 / 4, 1 / 8, -1 / 6]),
    )
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: Any) -> int:
        """Return the order of the solution."""
        return 4


# Positions, velocities and rest curvatures, or their time derivatives.
_Unknowns = tuple[NodeVectors, NodeVectors, HingeValues | None]

# Times and tableau rows of the stages that the solution needs (without the stage of the error estimate).
_TIMES = np.append(0.0, RK43.tableau.c[:-1])
_STAGES = np.zeros((len(_TIMES), len(_TIMES)))
for _number, _row in enumerate(RK43.tableau.a_lower[:-1], 1):
    _STAGES[_number, : len(_row)] = _row


def _field(t: Any, y: _Unknowns, scene: Scene) -> _Unknowns:
    x, v, p = y
    return rates(scene, x, v, p, t)


_TERM = diffrax.ODETerm(_field)
_SOLVER = RK43()


class RungeKutta(AbstractExplicit):
    """Integrate with order 4 and four forces a step, for errors far below those at the stability limit."""

    order: ClassVar[int] = 4
    error_order: ClassVar[int] = 4

    @staticmethod
    def stable(motion: Fastest) -> Scalar:
        """Return the largest stable step in s."""
        return STABILITY / jnp.maximum(motion.omega, motion.damping + motion.drag)

    def step(self, scene: Scene, state: State, h: Scalar) -> Tried:
        """Make a step of `h` s from a state whose slopes are known."""
        y0, t1 = (state.x, state.v, state.p), state.t + h
        # With supports the last stage of the previous step cannot be reused: it precedes their correction.
        anew = jnp.asarray(scene.prescribed is not None)
        stage = jnp.asarray(False), (state.v, state.slopes.acceleration, state.slopes.flow)
        y1, error, _, stages, _ = _SOLVER.step(_TERM, state.t, t1, y0, scene, stage, anew)
        assert error is not None and stages is not None
        (x, v, p), (_, (_, acceleration, flow)) = y1, stages
        if scene.prescribed is not None:
            x, v = scene.prescribed.position(x, t1), scene.prescribed.velocity(v, t1)
        return Tried(x, v, p, error, Slopes(acceleration, flow, jnp.asarray(True)))

    @staticmethod
    def advance(
        scene: Scene, t: Scalar, h: Scalar, x: NodeVectors, v: NodeVectors, p: HingeValues | None
    ) -> tuple[NodeVectors, NodeVectors, HingeValues | None]:
        """Return positions and velocities (n, 3) and p after a step of `h` s from time `t`."""
        y = (x, v, p)

        def moved(slopes: Any, weights: Float[Array, " stages"]) -> _Unknowns:
            return jax.tree.map(lambda y, k: y + h * jnp.tensordot(weights, k, 1), y, slopes)

        def stage(slopes: Any, row: tuple[Count, Scalar, Float[Array, " stages"]]) -> tuple[Any, None]:
            number, c, weights = row
            x, v, p = moved(slopes, weights)
            slope = rates(scene, x, v, p, t + c * h)
            return jax.tree.map(lambda all, k: all.at[number].set(k), slopes, slope), None

        # A scan compiles and differentiates one stage instead of four.
        slopes = jax.tree.map(lambda y: jnp.zeros((len(_STAGES), *y.shape)), y)
        rows = jnp.arange(len(_STAGES)), jnp.asarray(_TIMES), jnp.asarray(_STAGES)
        slopes, _ = jax.lax.scan(stage, slopes, rows)
        x, v, p = moved(slopes, jnp.asarray(RK43.tableau.b_sol[:-1]))
        if scene.prescribed is None:
            return x, v, p
        return scene.prescribed.position(x, t + h), scene.prescribed.velocity(v, t + h), p
