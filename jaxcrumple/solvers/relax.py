"""Static equilibrium by damped Newton iteration (pseudo-transient continuation)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.memory import require_run
from jaxcrumple.model.door import door
from jaxcrumple.model.fields import as_float, is_known, is_number, require_limit
from jaxcrumple.model.near import motion
from jaxcrumple.model.scene import Scene
from jaxcrumple.renewal import Renewal
from jaxcrumple.solvers.choice import choose_linear_solver
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor
from jaxcrumple.solvers.lists import passes, sharpest, without_places
from jaxcrumple.start import check_gap, check_start
from jaxcrumple.state import State, check_state, restarted
from jaxcrumple.system import elastic_tangent, force, potential_energy

# The shift is a pseudo inertia: m * shift is added to the stiffness. It starts at SHIFT_START times
# the largest spring frequency squared, shrinks after a success and grows after a failure.
SHIFT_START, SHIFT_FLOOR = 1e-4, 1e-16
SHRINK, GROW = 0.2, 6.0
# Relative residual of the linear systems.
FORCING = 1e-6
# Shift at which the eigenvalues of the stiffness are counted, in the same units.
PROBE_SHIFT = 1e-12
# Share of the reach of the lists of contact that a step may take.
STRIDE = 0.99


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
    """`moved`: whether a step was made with these lists of contact; `held_up`: whether one more after that
    would leave them, or pass through something."""

    x: Array
    force: Array
    energy: Array
    shift: Array
    factor: Factor
    iterations: Array
    moved: Array
    held_up: Array


@door
def relax(
    scene: Scene,
    state: State,
    *,
    force_tolerance: float,
    linear: str | AbstractLinearSolver = "auto",
    max_iterations: int = 500,
) -> Relaxed:
    """Minimise the potential energy at the state's time, with its rest curvature p held fixed.

    No step passes through a wall or through the sheet itself. The lists of contact are made anew on the host;
    inside a function that JAX traces, those of the scene are all there is.

    **Arguments:** `force_tolerance`: largest net force in N on any free node at the end; `linear`: a linear
    solver or its name; `max_iterations`: linear solves.

    **Raises:** ValueError for a tolerance that is not positive, a state of another scene, or a start from
    which no run can proceed: behind a wall, with a hinge at 180 degrees or, in a scene with contact, passing
    through itself.
    """
    if not (is_number(force_tolerance) and force_tolerance > 0):
        raise ValueError(f"force_tolerance = {force_tolerance!r} N must be positive.")
    require_limit("max_iterations", max_iterations)
    check_state(scene, state)
    solver = choose_linear_solver(linear)
    x = state.x if scene.prescribed is None else scene.prescribed.position(state.x, state.t)
    state = restarted(scene, state, x, jnp.zeros_like(x))
    tolerance, left = as_float(force_tolerance), jnp.asarray(max_iterations)
    known = is_known(x, scene.mass)
    if known:
        require_run(scene.n_nodes, 0, scene.contact is not None)
        check_start(scene, state)
    if known and scene.contact is not None:
        return _relax_apart(scene, state, tolerance, solver, left)
    return _relax(scene, state, tolerance, solver, left, _first_shift(scene))[0]


def _relax_apart(scene: Scene, state: State, tolerance: Array, solver, left: Array) -> Relaxed:
    """`_relax` again and again, with new lists of contact between."""
    renewal, shift, most = Renewal(scene, solver.one_matrix), _first_shift(scene), left
    scene = renewal.first(scene, state)
    check_gap(scene, state)
    while True:
        outcome, shift, held_up = _relax(scene, state, tolerance, solver, left, shift)
        left, state = left - outcome.iterations, outcome.state
        if outcome.converged or not held_up or left <= 0:
            return outcome._replace(iterations=most - left)
        scene = renewal.first(scene, state)


def _first_shift(scene: Scene) -> Array:
    return SHIFT_START * _largest(scene)


def _largest(scene: Scene) -> Array:
    """Largest spring frequency squared in 1/s2."""
    return jnp.max(scene.membrane.stiffness) / jnp.min(scene.mass)


def _free_force(scene: Scene, state: State, x: Array) -> Array:
    net = force(scene, x, jnp.zeros_like(x), state.p, state.t)
    return net if scene.prescribed is None else scene.prescribed.free(net, state.t)


def _within_reach(scene: Scene, x: Array, step: Array) -> Array:
    """The step (n, 3) from `x`, shortened to what lists of contact that were made there allow for."""
    if scene.contact is None:
        return step
    reach = STRIDE * jnp.min(scene.contact.near.around.reach)
    return step * jnp.minimum(1.0, reach / jnp.maximum(jnp.max(motion(x, x + step)), 1e-300))


@eqx.filter_jit
def _relax(
    scene: Scene, state: State, tolerance: Array, linear, max_iterations: Array, shift: Array
) -> tuple[Relaxed, Array, Array]:
    """The outcome, the last shift, and whether other lists of contact are needed to go on."""
    scene = scene if linear.one_matrix else without_places(scene)
    top = _largest(scene)

    def size(f: Array) -> Array:
        return jnp.sqrt(jnp.max(jnp.sum(f * f, axis=1)))

    def energy(x: Array) -> Array:
        return potential_energy(scene, x, state.p, state.t)

    def body(carry: _Carry) -> _Carry:
        values = elastic_tangent(scene, carry.x, state.p, state.t, carry.shift)
        factor = linear.factor(scene.pattern, values, carry.factor)
        solution = linear.solve(scene.pattern, factor, values, carry.force.reshape(-1), FORCING)
        x = carry.x + _within_reach(scene, carry.x, solution.x.reshape(carry.x.shape))
        new_force, new_energy = _free_force(scene, state, x), energy(x)
        lower = new_energy < carry.energy
        # Near the minimum the energy no longer changes in float64, but the force still falls.
        calmer = size(new_force) < size(carry.force)
        same = new_energy <= carry.energy + 1e-10 * jnp.abs(carry.energy)
        here = eqx.tree_at(lambda s: s.x, state, carry.x)
        through = passes(scene, here, x, state.t, sharpest(scene, x))
        sound = ~solution.indefinite & ~through & jnp.all(jnp.isfinite(new_force))
        keep = sound & (lower | (calmer & same))
        held_up = (scene.contact is not None) & through & carry.moved
        grown = jnp.where(held_up, carry.shift, GROW * carry.shift)
        return _Carry(
            jnp.where(keep, x, carry.x),
            jnp.where(keep, new_force, carry.force),
            jnp.where(keep, new_energy, carry.energy),
            jnp.where(keep, jnp.maximum(SHRINK * carry.shift, SHIFT_FLOOR * top), grown),
            factor,
            carry.iterations + 1,
            carry.moved | keep,
            held_up,
        )

    def unfinished(carry: _Carry) -> Array:
        going = (carry.iterations < max_iterations) & ~carry.held_up
        return (size(carry.force) > tolerance) & going

    no = jnp.asarray(False)
    start = _Carry(
        state.x, _free_force(scene, state, state.x), energy(state.x), shift,
        linear.start(scene.pattern), jnp.asarray(0), no, no,
    )  # fmt: skip
    end = jax.lax.while_loop(unfinished, body, start)
    left = size(end.force)
    # The iteration's own matrices are shifted until they are definite: judge the bare one. A trace
    # of the shift stays, above rounding, so that rigid motions of a free sheet do not count.
    bare = elastic_tangent(scene, end.x, state.p, state.t, PROBE_SHIFT * top)
    last = linear.factor(scene.pattern, bare, end.factor)
    linear.release(last, last.negative)
    rested = restarted(scene, state, end.x, jnp.zeros_like(end.x))
    outcome = Relaxed(rested, left <= tolerance, end.iterations, left, last.negative)
    return outcome, end.shift, end.held_up
