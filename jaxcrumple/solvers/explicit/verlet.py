"""The velocity Verlet method: order 2 with one force a step."""

from typing import ClassVar

import jax.numpy as jnp

from jaxcrumple._jax.arrays import HingeValues, NodeVectors, Scalar
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.explicit.base import AbstractExplicit, Tried, slopes_at
from jaxcrumple.solvers.explicit.stability import Fastest
from jaxcrumple.state import Slopes, State
from jaxcrumple.system import force_at_rest


class Verlet(AbstractExplicit):
    """Integrate with order 2 and one force a step.

    Forces take nearly all of the time. At the stability limit the method is therefore 2.7 times as fast as
    `RungeKutta` (phantom sheet, n = 1000).

    Drag acts implicitly, at both ends of the step. Dashpots and plastic flow use predicted velocities and
    rest curvatures. The error estimate covers p and the positions, $\\frac{h^2}{6}(a_1 - a_0)$; errors of
    the velocities follow those of the positions, and stay small where forces are resolved.
    """

    order: ClassVar[int] = 2
    error_order: ClassVar[int] = 3

    @staticmethod
    def stable(motion: Fastest) -> Scalar:
        """Return the largest stable step in s.

        It is $\\frac{2}{\\omega}(\\sqrt{1 + \\zeta^2} - \\zeta)$, with damping ratio $\\zeta$ of the fastest
        mode."""
        ratio = 0.5 * motion.damping / motion.omega
        return 2.0 / (motion.omega * (jnp.sqrt(1.0 + ratio * ratio) + ratio))

    def step(self, scene: Scene, state: State, h: Scalar) -> Tried:
        """Make a step of `h` s from a state whose slopes are known."""
        x, v, p, slopes = verlet(scene, state.t, h, state.x, state.v, state.p, state.slopes)
        by_x = h * h / 6.0 * (slopes.acceleration - state.slopes.acceleration)
        by_p = None
        if slopes.flow is not None and state.slopes.flow is not None:
            by_p = 0.5 * h * (slopes.flow - state.slopes.flow)
        return Tried(x, v, p, (by_x, None, by_p), slopes)

    @staticmethod
    def advance(
        scene: Scene, t: Scalar, h: Scalar, x: NodeVectors, v: NodeVectors, p: HingeValues | None
    ) -> tuple[NodeVectors, NodeVectors, HingeValues | None]:
        """Return positions and velocities (n, 3) and p after a step of `h` s from time `t`."""
        x, v, p, _ = verlet(scene, t, h, x, v, p, slopes_at(scene, x, v, p, t))
        return x, v, p


def verlet(
    scene: Scene, t: Scalar, h: Scalar, x: NodeVectors, v: NodeVectors, p: HingeValues | None, slopes: Slopes
) -> tuple[NodeVectors, NodeVectors, HingeValues | None, Slopes]:
    """Return positions and velocities (n, 3), p and slopes after a step of `h` s.

    `slopes`: derivatives at the start of the step, time `t`."""
    end, a, supports, flows = t + h, slopes.acceleration, scene.prescribed, scene.plasticity
    x = x + h * (v + 0.5 * h * a)
    x = x if supports is None else supports.position(x, end)
    hinges = scene.bending.hinges(x)
    c, flow = hinges.curvature, None
    if p is not None and flows is not None and slopes.flow is not None:
        p = p + 0.5 * h * (slopes.flow + flows.rate(c, p + h * slopes.flow))
        flow = flows.rate(c, p)
    at_rest = force_at_rest(scene, hinges, x, p, end)

    def dashed(v: NodeVectors) -> NodeVectors:
        return at_rest if scene.damping is None else at_rest + scene.damping.force(x, v)

    mass = scene.mass[:, None]
    drag = jnp.zeros(()) if scene.drag is None else (scene.drag.coefficient / scene.mass)[:, None]
    v = (v + 0.5 * h * (a + dashed(v + h * a) / mass)) / (1.0 + 0.5 * h * drag)
    v = v if supports is None else supports.velocity(v, end)
    a = dashed(v) / mass - drag * v
    a = a if supports is None else supports.acceleration(a, end)
    return x, v, p, Slopes(a, flow, jnp.asarray(True))
