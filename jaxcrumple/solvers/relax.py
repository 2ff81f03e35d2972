"""Static equilibrium by damped Newton iteration (pseudo-transient continuation)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, NodeValues, NodeVectors, Scalar, ScalarLike
from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require_run
from jaxcrumple._jax.program_cache import make_room
from jaxcrumple._jax.tree import (
    as_float,
    is_known,
    is_number,
    require_finite,
    require_limit,
    require_shape,
)
from jaxcrumple.contact.lists import motion
from jaxcrumple.model.loads import check_motion
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.crossings import passes, unlisted_turn
from jaxcrumple.solvers.contact.reallocate import Reallocation
from jaxcrumple.solvers.contact.schedule import without_matrix
from jaxcrumple.solvers.equilibrium import Conditions, with_derivative
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.solvers.linear.registry import choose_linear_solver
from jaxcrumple.solvers.start import check_gap, check_start
from jaxcrumple.state import State, check_fits, check_state, restarted
from jaxcrumple.system import elastic_tangent, energies, force_terms

# The shift is a pseudo inertia: m * shift is added to the stiffness. It starts at SHIFT_START times the
# largest spring frequency squared. A success reduces it by the factor SHRINK at most, and less when edges
# already turn by up to AIM rad. A failure multiplies it by GROW; a turn of more than TURN rad is a failure.
SHIFT_START, SHIFT_FLOOR = 1e-4, 1e-16
SHRINK, GROW = 0.1, 6.0
AIM, TURN = 0.3, 1.0
# A straight step lengthens the edges that it turns. Up to CORRECTIONS further solves with the same factor
# correct this, until the turning forces change by less than SETTLED of the forces that drive the step.
CORRECTIONS, SETTLED = 5, 0.1
# Relative residual of the linear systems.
FORCING = 1e-6
# Shift for the count of negative eigenvalues, in units of the largest spring frequency squared.
PROBE_SHIFT = 1e-12
# A step may use this share of the skin of the contact lists.
STRIDE = 0.99
# Default tolerance: the share RELATIVE of the force scale, but at least ROUNDINGS times the rounding error.
RELATIVE, ROUNDINGS = 1e-9, 8.0
# Energies count as equal below this difference, relative to the sum of the magnitudes of their terms.
SAME = 1e-10
# Edges at a node of a regular mesh; their stiffnesses add up.
VALENCE = 6.0


class RELAXED(eqx.Enumeration):
    """Name why `relax` stopped."""

    converged = "the net force on every free node is within the tolerance"
    budget = "max_iterations were used up; call relax again with the state to continue"
    loose = (
        "force_tolerance is above all forces that act on any node, so that every position would count as "
        "equilibrium; no node was moved. Leave it out, or give a value below the load of one node"
    )
    stalled = (
        "no step lowers energy or force any more: what is left is rounding error, and force_tolerance is "
        "smaller. Leave it out, or give a larger one"
    )
    blocked = "every step that lowers the energy further passes through a wall or the sheet itself"
    unstable = "max_iterations were used up while the stiffness had negative eigenvalues, as near a snap"
    reach = (
        "the next step leaves the reach of the contact lists; call relax outside of jit, grad and vmap, "
        "where it rebuilds them"
    )
    nonfinite = (
        "energies or forces are not finite at the last positions or after the next step. Look for edges of "
        "length zero, layers within the core of a barrier, or a parameter that is NaN"
    )


# The same enumeration without a type, because type checkers take its members for strings.
_WHY: Any = RELAXED


class Relaxed(NamedTuple):
    """Hold the outcome of `relax`.

    `state` at rest (v = 0); `converged`; `iterations`: number of factorisations; `max_force`: largest
    remaining force in N on a free node; `negative`: number of negative eigenvalues of the last stiffness
    (above 0: unstable equilibrium, -1: unknown); `result`: why `relax` stopped, a member of `RELAXED`;
    `force_scale` in N: largest sum over nodes of the magnitudes of all forces on a node, the unit of the
    default tolerance.
    """

    state: State
    converged: Flag
    iterations: Count
    max_force: Scalar
    negative: Count
    result: RELAXED
    force_scale: Scalar

    @property
    def reason(self) -> str:
        """Return why `relax` stopped, in words."""
        return _WHY[self.result]


class _Point(NamedTuple):
    """Hold positions, net `force` on free nodes, force `scale`, energy, and `magnitude` of its terms."""

    x: NodeVectors
    force: NodeVectors
    scale: Scalar
    energy: Scalar
    magnitude: Scalar


class _Carry(NamedTuple):
    """Hold the loop variables.

    `taut`: whether the next tangent omits the negative stiffness of compressed edges; `moved`: whether a step
    succeeded with these contact lists; `held_up`: whether a later step with them was rejected because it
    would leave them or pass through something; `over`: whether rounding would remove a further step; `why`:
    what rejected the last step."""

    point: _Point
    shift: Scalar
    taut: Flag
    factor: Factor
    iterations: Count
    rounding: Scalar
    moved: Flag
    held_up: Flag
    over: Flag
    why: RELAXED


# Positions, number of solves, turning forces in N and their last change, and whether the tangent is
# indefinite.
_Correction = tuple[NodeVectors, Count, NodeVectors, Scalar, Flag]


@door
def relax(
    scene: Scene,
    state: State,
    *,
    t: ScalarLike | None = None,
    force_tolerance: float | None = None,
    linear: str | AbstractLinearSolver = "auto",
    max_iterations: int = 500,
) -> Relaxed:
    """Minimise the potential energy at one time, with the rest curvature p of the state held fixed.

    Newton's method with a pseudo inertia that vanishes as the forces balance (pseudo-transient continuation;
    Kelley & Keyes, SIAM J. Numer. Anal. 35 (1998) 508).

    No step passes through a wall or through the sheet itself. The host rebuilds the contact lists as the
    sheet moves. Inside a function that JAX traces, `relax` has only the lists of the scene.

    Derivatives, forward and reverse, follow from the implicit function theorem: those of the equilibrium with
    respect to scene, time and rest curvature. The start has none. Near a buckling point they grow without
    bound; they are NaN where the stiffness is singular.

    **Arguments:** `t`: time in s of walls, loads and supports, by default that of the state. Supports move
    their nodes to where they hold them then: for a curve of equilibria, call `relax` for one time after the
    other, each time with the last state. `force_tolerance`: largest net force in N on any free node at the
    end; by default 1e-9 of the largest sum of the magnitudes of all forces on a node, loads and reactions
    included, but at least the rounding error; `linear`: a linear solver or its name; `max_iterations`:
    largest number of factorisations.

    **Returns:** a `Relaxed`, whose `result` states why the iteration stopped.

    **Raises:** ValueError for a tolerance that is not positive, a state of another scene, or a start that no
    run can leave: behind a wall, with a hinge at 180 degrees or, in a scene with contact, passing through
    itself.

    >>> mesh = jc.hexagonal(13, 4, 2e-3)  # a strip of 25 mm, clamped at its left end, under its weight
    >>> left = mesh.vertices[:, 0] < mesh.vertices[:, 0].min() + 2.5e-3
    >>> held = np.repeat(left[:, None], 3, axis=1)
    >>> clamp = jc.Prescribed(held, jc.LinearMotion(mesh.vertices, (0, 0, 0)))
    >>> scene = jc.sheet(mesh, jc.Material(), gravity=(0, 0, -9.81), prescribed=clamp)
    >>> relaxed = jc.relax(scene, jc.initial_state(scene, mesh.vertices))
    >>> bool(relaxed.converged), round(1e3 * float(relaxed.state.x[:, 2].min()), 3)  # sag in mm
    (True, -0.069)
    """
    if force_tolerance is not None and not (is_number(force_tolerance) and force_tolerance > 0):
        raise ValueError(f"force_tolerance = {force_tolerance!r} N must be positive.")
    require_limit("max_iterations", max_iterations)
    state = _at(scene, state, t)
    solver = choose_linear_solver(linear)
    state = restarted(scene, state, state.x, jnp.zeros_like(state.x))
    tolerance = None if force_tolerance is None else as_float(force_tolerance)
    left = jnp.asarray(max_iterations)
    known = is_known(state.x, scene.mass)
    if known:
        require_run(scene.n_nodes, 0, scene.contact is not None)
        check_start(scene, state)
        make_room("relax", scene, state, solver)
    if known and scene.contact is not None:
        return _relax_apart(scene, state, tolerance, solver, left)
    return _relax(scene, state, tolerance, solver, left, _first_shift(scene))[0]


def _at(scene: Scene, state: State, t: ScalarLike | None) -> State:
    """Return the state at time `t` in s, by default its own, with supported nodes where they are held.

    **Raises:** ValueError for a state of another scene, or, without `t`, one off its supports.
    """
    if t is None:
        check_state(scene, state)
    else:
        check_fits(scene, state)
        require_shape("t", t, ())
        require_finite("t", t)
        state = eqx.tree_at(lambda s: s.t, state, as_float(t))
    if scene.prescribed is None:
        return state
    check_motion(scene.prescribed, state.t)
    return eqx.tree_at(lambda s: s.x, state, scene.prescribed.position(state.x, state.t))


def _relax_apart(
    scene: Scene, state: State, tolerance: Scalar | None, solver: AbstractLinearSolver, left: Count
) -> Relaxed:
    """Repeat `_relax`, with new contact lists for each call."""
    reallocation, shift, most = Reallocation(scene, solver.one_matrix), _first_shift(scene), left
    scene = reallocation.first(scene, state)
    check_gap(scene, state)
    while True:
        outcome, shift = _relax(scene, state, tolerance, solver, left, shift)
        left, state = left - outcome.iterations, outcome.state
        if not bool(outcome.result == _WHY.reach) or left <= 0:
            return outcome._replace(iterations=most - left)
        scene = reallocation.first(scene, state)


def _first_shift(scene: Scene) -> Scalar:
    return SHIFT_START * _largest(scene)


def _largest(scene: Scene) -> Scalar:
    """Return the largest spring frequency squared in 1/s2."""
    return jnp.max(scene.membrane.stiffness) / jnp.min(scene.mass)


def _sizes(f: NodeVectors) -> NodeValues:
    return jnp.sqrt(jnp.sum(f * f, axis=1))


def _size(f: NodeVectors) -> Scalar:
    """Return the largest magnitude of nodal forces (n, 3)."""
    return jnp.max(_sizes(f))


def _free(scene: Scene, state: State, f: NodeVectors) -> NodeVectors:
    return f if scene.prescribed is None else scene.prescribed.free(f, state.t)


def _point(scene: Scene, state: State, x: NodeVectors) -> _Point:
    terms = force_terms(scene, x, state.p, state.t)
    net = _free(scene, state, sum(terms, jnp.zeros_like(x)))
    parts = energies(scene, x, jnp.zeros_like(x), state.p, state.t)
    magnitude = sum(map(jnp.abs, parts), jnp.zeros(()))
    if scene.gravity is not None:
        magnitude = magnitude + jnp.sum(jnp.abs(scene.gravity.force() * x))
    return _Point(x, net, jnp.max(sum(map(_sizes, terms))), sum(parts, jnp.zeros(())), magnitude)


def _within_reach(scene: Scene, x: NodeVectors, step: NodeVectors) -> NodeVectors:
    """Shorten the step (n, 3) from `x` to the reach of contact lists that were built there."""
    if scene.contact is None:
        return step
    reach = STRIDE * jnp.min(scene.own_lists.pairs.reference.skin)
    # A zero step gives an infinite quotient, and stays zero.
    return step * jnp.minimum(1.0, reach / jnp.max(motion(x, x + step)))


def _turn(scene: Scene, step: NodeVectors) -> Scalar:
    """Estimate the largest turn in rad, or strain, of an edge in a step (n, 3)."""
    a, b = scene.membrane.nodes.T
    return jnp.max(_sizes(step[a] - step[b]) / scene.membrane.rest_length)


def _rounding(x: NodeVectors, stiffness: Scalar) -> Scalar:
    """Return the force error in N that rounding of positions causes at a node of `stiffness` in N/m."""
    return jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x)) * stiffness


def _stepped(
    scene: Scene,
    state: State,
    point: _Point,
    values: Float[Array, " entries"],
    factor: Factor,
    linear: AbstractLinearSolver,
) -> tuple[NodeVectors, Flag]:
    """Return the positions (n, 3) after a Newton step, and whether the tangent is indefinite.

    Corrections remove the second-order lengthening of edges that turn."""

    def correct(carry: _Correction) -> _Correction:
        _, count, turning, _, _ = carry
        rhs = point.force + turning
        solution = linear.solve(scene.sparsity, factor, values, rhs.reshape(-1), FORCING)
        y = point.x + _within_reach(scene, point.x, solution.x.reshape(point.x.shape))
        new = _free(scene, state, scene.membrane.turning_force(point.x, y))
        return y, count + 1, new, _size(new - turning), solution.indefinite

    def unfinished(carry: _Correction) -> Flag:
        _, count, _, change, indefinite = carry
        unsettled = (change > SETTLED * _size(point.force)) & ~indefinite
        return (count == 0) | (unsettled & (count <= CORRECTIONS))

    zero = jnp.zeros_like(point.x)
    start = (point.x, jnp.asarray(0), zero, jnp.zeros(()), jnp.asarray(False))
    y, _, _, _, indefinite = jax.lax.while_loop(unfinished, correct, start)
    return y, indefinite


@eqx.filter_jit
def _relax(
    scene: Scene,
    state: State,
    given: Scalar | None,
    linear: AbstractLinearSolver,
    max_iterations: Count,
    shift: Scalar,
) -> tuple[Relaxed, Scalar]:
    """Return the outcome and the last shift. The outcome's positions have the derivative of an equilibrium;
    the iteration has none."""
    scene = scene if linear.one_matrix else without_matrix(scene)
    given_scene, given_state = scene, state
    scene, state, given, shift = jax.lax.stop_gradient((scene, state, given, shift))
    top = _largest(scene)

    def own_tolerance(carry: _Carry) -> Scalar:
        return jnp.maximum(RELATIVE * carry.point.scale, ROUNDINGS * carry.rounding)

    def tolerance(carry: _Carry) -> Scalar:
        return own_tolerance(carry) if given is None else given

    def body(carry: _Carry) -> _Carry:
        old = carry.point
        values = elastic_tangent(scene, old.x, state.p, state.t, carry.shift, carry.taut)
        factor = linear.factor(scene.sparsity, values, carry.factor)
        x, indefinite = _stepped(scene, state, old, values, factor, linear)
        new = _point(scene, state, x)
        # Near the minimum the energy no longer changes in float64, but the force still decreases.
        calmer = _size(new.force) < _size(old.force)
        same = new.energy <= old.energy + SAME * old.magnitude
        through = passes(scene, eqx.tree_at(lambda s: s.x, state, old.x), x, state.t, unlisted_turn(scene, x))
        finite = jnp.isfinite(new.energy) & jnp.isfinite(_size(new.force))
        turn = _turn(scene, x - old.x)
        keep = finite & ~indefinite & ~through & (turn < TURN) & ((new.energy < old.energy) | (calmer & same))
        held_up = (scene.contact is not None) & through & carry.moved
        # After an indefinite tangent, first try a tangent without the negative stiffness of compression.
        soften = indefinite & ~carry.taut
        grown = jnp.where(held_up | soften, carry.shift, GROW * carry.shift)
        shrunk = carry.shift * jnp.clip(turn / AIM, SHRINK, 1.0)
        lost = jnp.max(jnp.abs(x - old.x)) <= 4.0 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x))
        why = _WHY.where(finite, _WHY.stalled, _WHY.nonfinite)
        why = _WHY.where(through, _WHY.blocked, why)
        why = _WHY.where(indefinite, _WHY.unstable, why)
        return _Carry(
            jax.tree.map(lambda a, b: jnp.where(keep, a, b), new, old),
            jnp.where(keep, jnp.maximum(shrunk, SHIFT_FLOOR * top), grown),
            soften,
            factor,
            carry.iterations + 1,
            _rounding(
                old.x, jnp.max(values[scene.sparsity.diagonal] - jnp.repeat(carry.shift * scene.mass, 3))
            ),
            carry.moved | keep,
            held_up,
            lost & ~keep & ~indefinite,
            _WHY.where(keep, _WHY.budget, why),
        )

    def unfinished(carry: _Carry) -> Flag:
        going = (carry.iterations < max_iterations) & ~carry.held_up & ~carry.over
        return (_size(carry.point.force) > tolerance(carry)) & going

    no, point = jnp.asarray(False), _point(scene, state, state.x)
    start = _Carry(
        point, shift, no, linear.start(scene.sparsity), jnp.asarray(0),
        _rounding(state.x, VALENCE * jnp.max(scene.membrane.stiffness)), no, no, no, _WHY.budget,
    )  # fmt: skip
    idle = no
    if given is not None:
        idle = (given >= point.scale) & (_size(point.force) > own_tolerance(start))
    end = jax.lax.while_loop(unfinished, body, start)
    left = _size(end.point.force)
    # The iteration shifts its matrices until they are definite, so count eigenvalues of the unshifted one. A
    # shift just above rounding remains, so that rigid motions of a free sheet do not count.
    bare = elastic_tangent(scene, end.point.x, state.p, state.t, PROBE_SHIFT * top, no)
    last = linear.factor(scene.sparsity, bare, end.factor)
    linear.release(last, last.negative)
    conditions = Conditions(given_scene, given_state.p, given_state.t, SHIFT_FLOOR * top, last.negative)
    x = with_derivative(conditions, end.point.x, linear)
    rested = restarted(given_scene, given_state, x, jnp.zeros_like(x))
    converged = (left <= tolerance(end)) & ~idle
    # The cause of the last rejection explains the end only if it stopped the iteration.
    stopped = end.over | (end.iterations >= max_iterations)
    named = (end.why == _WHY.unstable) | (end.why == _WHY.blocked)
    result = _WHY.where(end.over | named, end.why, _WHY.budget)
    result = _WHY.where(stopped, result, _WHY.reach)
    result = _WHY.where(jnp.isfinite(left), result, _WHY.nonfinite)
    result = _WHY.where(idle, _WHY.loose, result)
    result = _WHY.where(converged, _WHY.converged, result)
    outcome = Relaxed(rested, converged, end.iterations, left, last.negative, result, end.point.scale)
    return outcome, end.shift
