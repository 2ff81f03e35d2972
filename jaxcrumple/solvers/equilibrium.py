"""The derivative of an equilibrium, by the implicit function theorem."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, HingeValues, NodeVectors, Scalar
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.linear.base import AbstractLinearSolver
from jaxcrumple.solvers.linear.solve import solve_once
from jaxcrumple.system import elastic_tangent, force_terms

# Relative residual of the linear system.
RTOL = 1e-12


class Conditions(NamedTuple):
    """Hold what determines an equilibrium: scene, rest curvature `p` (h,), time `t` in s, and a `shift` in
    1/s2 of the stiffness, so that rigid motions of a free sheet do not make it singular.

    `negative`: number of negative eigenvalues from the last factor, -1 if unknown; the derivative waits for
    it."""

    scene: Scene
    p: HingeValues | None
    t: Scalar
    shift: Scalar
    negative: Count


@eqx.filter_custom_jvp
def with_derivative(conditions: Conditions, x: NodeVectors, linear: AbstractLinearSolver) -> NodeVectors:
    """Return the equilibrium `x` (n, 3) in m. Its derivative with respect to `conditions` is implicit.

    At fixed net force F(x, conditions) = 0 of the free components, K dx = dF with the stiffness K; supports
    carry the components that they hold. A start from which an iteration found `x` does not matter.
    """
    return x


@with_derivative.def_jvp
def _implicit(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[NodeVectors, NodeVectors]:
    conditions, x, linear = primals

    def net_force(given: Conditions) -> tuple[NodeVectors, NodeVectors]:
        """Return the positions that supports give, and the net force (n, 3) in N there."""
        scene, p, t, *_ = given
        y = x if scene.prescribed is None else scene.prescribed.position(x, t)
        f = sum(force_terms(scene, y, p, t), jnp.zeros_like(y))
        return y, f if scene.prescribed is None else scene.prescribed.free(f, t)

    _, changes = eqx.filter_jvp(net_force, (conditions,), (tangents[0],))
    # Without a dependence there is no tangent.
    moved, pushed = (jnp.zeros_like(x) if change is None else change for change in changes)
    scene, p, t, shift, negative = conditions
    # This data dependence factors one matrix after the other. Two simultaneous batches of LAPACK calls would
    # hang a machine of two threads, see `solvers/explicit/stability.py`.
    values = jnp.where(negative >= -1, elastic_tangent(scene, x, p, t, shift), jnp.nan)
    start = linear.start(scene.sparsity)
    answer = solve_once(linear, scene.sparsity, start, values, pushed.reshape(-1), RTOL)
    return x, moved + answer.reshape(x.shape)
