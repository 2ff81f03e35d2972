"""Static equilibrium by damped Newton iteration (pseudo-transient continuation)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require_run
from jaxcrumple._jax.program_cache import make_room
from jaxcrumple._jax.tree import as_float, is_known, is_number, require_limit
from jaxcrumple.contact.lists import motion
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.reallocate import Renewal
from jaxcrumple.solvers.contact.schedule import passes, sharpest, without_places
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.solvers.linear.registry import choose_linear_solver
from jaxcrumple.solvers.start import check_gap, check_start
from jaxcrumple.state import State, check_state, restarted
from jaxcrumple.system import elastic_tangent, energies, force_terms

# The shift is a pseudo inertia: m * shift is added to the stiffness. It starts at SHIFT_START times
# the largest spring frequency squared, shrinks after a success, by SHRINK at most and less where edges
# already turn by AIM rad, and grows after a failure, as after a step that turns an edge by more than TURN.
SHIFT_START, SHIFT_FLOOR = 1e-4, 1e-16
SHRINK, GROW = 0.1, 6.0
AIM, TURN = 0.3, 1.0
# A straight step lengthens the edges that it turns. So many further solves with the same factor take that
# back, until the forces of it change by less than SETTLED of those that drive the step.
CORRECTIONS, SETTLED = 5, 0.1
# Relative residual of the linear systems.
FORCING = 1e-6
# Shift at which the eigenvalues of the stiffness are counted, in the same units.
PROBE_SHIFT = 1e-12
# Share of the reach of the lists of contact that a step may take.
STRIDE = 0.99
# Default tolerance: this share of the force scale, but no less than so many roundings.
RELATIVE, ROUNDINGS = 1e-9, 8.0
# Energies that differ by less, relative to the magnitudes they are sums of, count as equal.
SAME = 1e-10
# Edges that meet in a node of a regular mesh: their springs add up.
VALENCE = 6.0


class RELAXED(eqx.Enumeration):  # type: ignore[misc]
    """Why `relax` stopped."""

    converged = "the net force on every free node is within the tolerance"
    budget = "max_iterations were used up; call relax again with the state to go on"
    loose = (
        "force_tolerance is above all forces that act on any node, so that every position would count as "
        "equilibrium; nothing was moved. Leave it out, or give less than the load of one node"
    )
    stalled = (
        "no step lowers energy or force any more: what is left is rounding, and force_tolerance asks for "
        "less. Leave it out, or give more"
    )
    blocked = "what would lower the energy further passes through a wall or the sheet itself"
    unstable = "max_iterations were used up while the stiffness had negative eigenvalues, as beside a snap"
    reach = (
        "the lists of contact reach no further; call relax outside of jit, grad and vmap, which renews them"
    )
    nonfinite = (
        "energies or forces are not finite at the last positions or beside them. Look for edges of length "
        "zero, layers within the core of a barrier, or a parameter that is NaN"
    )


# The same for type checkers, to whom the members are strings.
_WHY: Any = RELAXED


class Relaxed(NamedTuple):
    """Outcome of `relax`.

    `state` at rest (v = 0); `converged`; `iterations`: tangents factored; `max_force` in N left on a free
    node; `negative` eigenvalues of the last stiffness: above 0 the equilibrium is unstable, -1 unknown;
    `result`: why it stopped, a member of `RELAXED`, in words `reason`; `force_scale` in N: the
    largest sum of the magnitudes of all forces on a node, which the default tolerance is relative to.
    """

    state: State
    converged: Array
    iterations: Array
    max_force: Array
    negative: Array
    result: RELAXED
    force_scale: Array

    @property
    def reason(self) -> str:
        """Why it stopped, in words."""
        return _WHY[self.result]


class _Point(NamedTuple):
    """Positions, the net `force` on free nodes, its scale, the energy and the magnitude of its terms."""

    x: Array
    force: Array
    scale: Array
    energy: Array
    magnitude: Array


class _Carry(NamedTuple):
    """`taut`: whether the next tangent leaves out what compression takes from it; `moved`: whether a step was
    made with these lists of contact; `held_up`: whether one more after that would leave them, or pass through
    something; `over`: a further step would be lost in rounding; `why`: what forbade the last step."""

    point: _Point
    shift: Array
    taut: Array
    factor: Factor
    iterations: Array
    rounding: Array
    moved: Array
    held_up: Array
    over: Array
    why: RELAXED


@door
def relax(
    scene: Scene,
    state: State,
    *,
    force_tolerance: float | None = None,
    linear: str | AbstractLinearSolver = "auto",
    max_iterations: int = 500,
) -> Relaxed:
    """Minimise the potential energy at the state's time, with its rest curvature p held fixed.

    No step passes through a wall or through the sheet itself. The lists of contact are made anew on the host;
    inside a function that JAX traces, those of the scene are all there is.

    **Arguments:** `force_tolerance`: largest net force in N on any free node at the end; by default 1e-9 of
    the largest sum of the magnitudes of all forces on a node, loads and reactions included, but no less than
    rounding leaves; `linear`: a linear solver or its name; `max_iterations`: tangents factored.

    **Returns:** a `Relaxed`, whose `result` says why the iteration stopped.

    **Raises:** ValueError for a tolerance that is not positive, a state of another scene, or a start from
    which no run can proceed: behind a wall, with a hinge at 180 degrees or, in a scene with contact, passing
    through itself.
    """
    if force_tolerance is not None and not (is_number(force_tolerance) and force_tolerance > 0):
        raise ValueError(f"force_tolerance = {force_tolerance!r} N must be positive.")
    require_limit("max_iterations", max_iterations)
    check_state(scene, state)
    solver = choose_linear_solver(linear)
    x = state.x if scene.prescribed is None else scene.prescribed.position(state.x, state.t)
    state = restarted(scene, state, x, jnp.zeros_like(x))
    tolerance = None if force_tolerance is None else as_float(force_tolerance)
    left = jnp.asarray(max_iterations)
    known = is_known(x, scene.mass)
    if known:
        require_run(scene.n_nodes, 0, scene.contact is not None)
        check_start(scene, state)
        make_room("relax", scene, state, solver)
    if known and scene.contact is not None:
        return _relax_apart(scene, state, tolerance, solver, left)
    return _relax(scene, state, tolerance, solver, left, _first_shift(scene))[0]


def _relax_apart(scene: Scene, state: State, tolerance: Array | None, solver, left: Array) -> Relaxed:
    """`_relax` again and again, with new lists of contact between."""
    renewal, shift, most = Renewal(scene, solver.one_matrix), _first_shift(scene), left
    scene = renewal.first(scene, state)
    check_gap(scene, state)
    while True:
        outcome, shift = _relax(scene, state, tolerance, solver, left, shift)
        left, state = left - outcome.iterations, outcome.state
        if not bool(outcome.result == _WHY.reach) or left <= 0:
            return outcome._replace(iterations=most - left)
        scene = renewal.first(scene, state)


def _first_shift(scene: Scene) -> Array:
    return SHIFT_START * _largest(scene)


def _largest(scene: Scene) -> Array:
    """Largest spring frequency squared in 1/s2."""
    return jnp.max(scene.membrane.stiffness) / jnp.min(scene.mass)


def _sizes(f: Array) -> Array:
    return jnp.sqrt(jnp.sum(f * f, axis=1))


def _size(f: Array) -> Array:
    """Largest of nodal forces (n, 3)."""
    return jnp.max(_sizes(f))


def _free(scene: Scene, state: State, f: Array) -> Array:
    return f if scene.prescribed is None else scene.prescribed.free(f, state.t)


def _point(scene: Scene, state: State, x: Array) -> _Point:
    terms = force_terms(scene, x, state.p, state.t)
    net = _free(scene, state, sum(terms, jnp.zeros_like(x)))
    parts = energies(scene, x, jnp.zeros_like(x), state.p, state.t)
    magnitude = sum(map(jnp.abs, parts), jnp.zeros(()))
    if scene.gravity is not None:
        magnitude = magnitude + jnp.sum(jnp.abs(scene.gravity.force() * x))
    return _Point(x, net, jnp.max(sum(map(_sizes, terms))), sum(parts, jnp.zeros(())), magnitude)


def _within_reach(scene: Scene, x: Array, step: Array) -> Array:
    """The step (n, 3) from `x`, shortened to what lists of contact that were made there allow for."""
    if scene.contact is None:
        return step
    reach = STRIDE * jnp.min(scene.contact.near.around.reach)
    # A step of zero stays one: the quotient is infinite then.
    return step * jnp.minimum(1.0, reach / jnp.max(motion(x, x + step)))


def _turn(scene: Scene, step: Array) -> Array:
    """Largest angle in rad, about, by which a step (n, 3) turns or stretches an edge."""
    a, b = scene.membrane.nodes.T
    return jnp.max(_sizes(step[a] - step[b]) / scene.membrane.rest_length)


def _rounding(x: Array, stiffness: Array) -> Array:
    """What rounding of positions leaves of the force in N on a node of this `stiffness` in N/m."""
    return jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x)) * stiffness


def _stepped(scene: Scene, state: State, point: _Point, values: Array, factor: Factor, linear):
    """The end (n, 3) of Newton's step, its edges no longer than its linear part makes them, and whether the
    tangent is indefinite."""

    def correct(carry: tuple) -> tuple:
        _, count, turning, _, _ = carry
        rhs = point.force + turning
        solution = linear.solve(scene.pattern, factor, values, rhs.reshape(-1), FORCING)
        y = point.x + _within_reach(scene, point.x, solution.x.reshape(point.x.shape))
        new = _free(scene, state, scene.membrane.turning_force(point.x, y))
        return y, count + 1, new, _size(new - turning), solution.indefinite

    def unfinished(carry: tuple) -> Array:
        _, count, _, change, indefinite = carry
        unsettled = (change > SETTLED * _size(point.force)) & ~indefinite
        return (count == 0) | (unsettled & (count <= CORRECTIONS))

    zero = jnp.zeros_like(point.x)
    start = (point.x, jnp.asarray(0), zero, jnp.zeros(()), jnp.asarray(False))
    y, _, _, _, indefinite = jax.lax.while_loop(unfinished, correct, start)
    return y, indefinite


@eqx.filter_jit
def _relax(
    scene: Scene, state: State, given: Array | None, linear, max_iterations: Array, shift: Array
) -> tuple[Relaxed, Array]:
    """The outcome and the last shift."""
    scene = scene if linear.one_matrix else without_places(scene)
    top = _largest(scene)

    def own_tolerance(carry: _Carry) -> Array:
        return jnp.maximum(RELATIVE * carry.point.scale, ROUNDINGS * carry.rounding)

    def tolerance(carry: _Carry) -> Array:
        return own_tolerance(carry) if given is None else given

    def body(carry: _Carry) -> _Carry:
        old = carry.point
        values = elastic_tangent(scene, old.x, state.p, state.t, carry.shift, carry.taut)
        factor = linear.factor(scene.pattern, values, carry.factor)
        x, indefinite = _stepped(scene, state, old, values, factor, linear)
        new = _point(scene, state, x)
        # Near the minimum the energy no longer changes in float64, but the force still falls.
        calmer = _size(new.force) < _size(old.force)
        same = new.energy <= old.energy + SAME * old.magnitude
        through = passes(scene, eqx.tree_at(lambda s: s.x, state, old.x), x, state.t, sharpest(scene, x))
        finite = jnp.isfinite(new.energy) & jnp.isfinite(_size(new.force))
        turn = _turn(scene, x - old.x)
        keep = finite & ~indefinite & ~through & (turn < TURN) & ((new.energy < old.energy) | (calmer & same))
        held_up = (scene.contact is not None) & through & carry.moved
        # The first answer to an indefinite tangent is one without what compression takes from it.
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
            _rounding(x, jnp.max(values[scene.pattern.diagonal] - jnp.repeat(carry.shift * scene.mass, 3))),
            carry.moved | keep,
            held_up,
            lost & ~keep & ~indefinite,
            _WHY.where(keep, _WHY.budget, why),
        )

    def unfinished(carry: _Carry) -> Array:
        going = (carry.iterations < max_iterations) & ~carry.held_up & ~carry.over
        return (_size(carry.point.force) > tolerance(carry)) & going

    no, point = jnp.asarray(False), _point(scene, state, state.x)
    start = _Carry(
        point, shift, no, linear.start(scene.pattern), jnp.asarray(0),
        _rounding(state.x, VALENCE * jnp.max(scene.membrane.stiffness)), no, no, no, _WHY.budget,
    )  # fmt: skip
    idle = no
    if given is not None:
        idle = (given >= point.scale) & (_size(point.force) > own_tolerance(start))
    end = jax.lax.while_loop(unfinished, body, start)
    left = _size(end.point.force)
    # The iteration's own matrices are shifted until they are definite: judge the bare one. A trace
    # of the shift stays, above rounding, so that rigid motions of a free sheet do not count.
    bare = elastic_tangent(scene, end.point.x, state.p, state.t, PROBE_SHIFT * top, no)
    last = linear.factor(scene.pattern, bare, end.factor)
    linear.release(last, last.negative)
    rested = restarted(scene, state, end.point.x, jnp.zeros_like(end.point.x))
    converged = (left <= tolerance(end)) & ~idle
    # What forbade the last step explains only an end that it brought about.
    stopped = end.over | (end.iterations >= max_iterations)
    named = (end.why == _WHY.unstable) | (end.why == _WHY.blocked)
    result = _WHY.where(end.over | named, end.why, _WHY.budget)
    result = _WHY.where(stopped, result, _WHY.reach)
    result = _WHY.where(jnp.isfinite(left), result, _WHY.nonfinite)
    result = _WHY.where(idle, _WHY.loose, result)
    result = _WHY.where(converged, _WHY.converged, result)
    outcome = Relaxed(rested, converged, end.iterations, left, last.negative, result, end.point.scale)
    return outcome, end.shift
