"""Static equilibrium by damped Newton iteration (pseudo-transient continuation)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.scene import Scene
from jaxcrumple.solvers.choice import choose_linear_solver
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor
from jaxcrumple.state import State, check_state, restart_history
from jaxcrumple.system import elastic_tangent, force, potential_energy

# The shift is a pseudo inertia: m * shift is added to the stiffness. It starts at SHIFT_START times
# the largest spring frequency squared, shrinks after a success and grows after a failure.
SHIFT_START, SHIFT_FLOOR = 1e-4, 1e-16
SHRINK, GROW = 0.2, 6.0
# Relative residual of the linear systems.
FORCING = 1e-6
# Shift at which the eigenvalues of the stiffness are counted, in the same units.
PROBE_SHIFT = 1e-12


class Relaxed(NamedTuple):
    """Outcome of `relax`.

    `state` at rest (v = 0); `converged`; `iterations`; `max_force` left on a free node in N;
    `negative` eigenvalues of the last stiffness: above 0 the equilibrium is unstable, -1 unknown.
    """

    state: State
    converged: Array
    iterations: Array
    max_force: Array
    negative: Array


class _Carry(NamedTuple):
    x: Array
    force: Array
    energy: Array
    shift: Array
    factor: Factor
    iterations: Array


def relax(
    scene: Scene,
    state: State,
    *,
    force_tolerance: float,
    linear: str | AbstractLinearSolver = "auto",
    max_iterations: int = 500,
) -> Relaxed:
    """Minimise the potential energy at the state's time, with its rest curvature p held fixed.

    **Arguments:** `force_tolerance`: largest net force in N on any free node at the end.

    **Raises:** ValueError for a tolerance that is not positive, or a state of another scene.
    """
    if not force_tolerance > 0:
        raise ValueError(f"force_tolerance = {force_tolerance!r} N must be positive.")
    check_state(scene, state)
    solver = choose_linear_solver(linear)
    return _relax(scene, state, jnp.asarray(float(force_tolerance)), solver, max_iterations)


def _free_force(scene: Scene, state: State, x: Array) -> Array:
    net = force(scene, x, jnp.zeros_like(x), state.p, state.t)
    return net if scene.prescribed is None else scene.prescribed.free(net)


@eqx.filter_jit
def _relax(scene: Scene, state: State, tolerance: Array, linear, max_iterations: int) -> Relaxed:
    top = jnp.max(scene.membrane.stiffness) / jnp.min(scene.mass)
    floor = SHIFT_FLOOR * top

    def size(f: Array) -> Array:
        return jnp.sqrt(jnp.max(jnp.sum(f * f, axis=1)))

    def energy(x: Array) -> Array:
        return potential_energy(scene, x, state.p, state.t)

    def body(carry: _Carry) -> _Carry:
        values = elastic_tangent(scene, carry.x, state.p, state.t, carry.shift)
        factor = linear.factor(scene.pattern, values, carry.factor)
        solution = linear.solve(scene.pattern, factor, values, carry.force.reshape(-1), FORCING)
        x = carry.x + solution.x.reshape(carry.x.shape)
        new_force, new_energy = _free_force(scene, state, x), energy(x)
        lower = new_energy < carry.energy
        # Near the minimum the energy no longer changes in float64, but the force still falls.
        calmer = size(new_force) < size(carry.force)
        same = new_energy <= carry.energy + 1e-10 * jnp.abs(carry.energy)
        keep = ~solution.indefinite & (lower | (calmer & same)) & jnp.all(jnp.isfinite(new_force))
        shift = jnp.where(keep, jnp.maximum(SHRINK * carry.shift, floor), GROW * carry.shift)
        return _Carry(
            jnp.where(keep, x, carry.x),
            jnp.where(keep, new_force, carry.force),
            jnp.where(keep, new_energy, carry.energy),
            shift,
            factor,
            carry.iterations + 1,
        )

    def unfinished(carry: _Carry) -> Array:
        return (size(carry.force) > tolerance) & (carry.iterations < max_iterations)

    x = state.x if scene.prescribed is None else scene.prescribed.position(state.x, state.t)
    start = _Carry(
        x, _free_force(scene, state, x), energy(x), SHIFT_START * top,
        linear.start(scene.pattern), jnp.asarray(0),
    )  # fmt: skip
    end = jax.lax.while_loop(unfinished, body, start)
    rested = eqx.tree_at(
        lambda s: (s.x, s.v, s.history),
        state,
        (end.x, jnp.zeros_like(end.x), restart_history(end.x, jnp.zeros_like(end.x), state.p)),
    )
    left = size(end.force)
    # The iteration's own matrices are shifted until they are definite: judge the bare one. A trace
    # of the shift stays, above rounding, so that rigid motions of a free sheet do not count.
    bare = elastic_tangent(scene, end.x, state.p, state.t, PROBE_SHIFT * top)
    last = linear.factor(scene.pattern, bare, end.factor)
    linear.release(last, last.negative)
    return Relaxed(rested, left <= tolerance, end.iterations, left, last.negative)
