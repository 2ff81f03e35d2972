"""`integrate`: run the stages of a scheme, and the changes between them, as one traced function."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, Scalar, ScalarLike
from jaxcrumple._jax.batched_cond import where_needed
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float, require_shape, select
from jaxcrumple.contact.coverage import covers
from jaxcrumple.contact.lists import motion
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.schedule import (
    Schedule,
    around,
    largest_move,
    listed,
    listed_active,
    ready_for,
    ready_to_restore,
    renewed,
    rescheduled,
    start_schedule,
    still_ready,
    waits,
    with_active,
    without_matrix,
)
from jaxcrumple.solvers.implicit.base import ImplicitAttempt, aligns
from jaxcrumple.solvers.implicit.bdf import push
from jaxcrumple.solvers.implicit.newton import must_restore
from jaxcrumple.solvers.linear.base import Factor
from jaxcrumple.solvers.log import Log, empty_log, follow
from jaxcrumple.solvers.outcome import counted, given_up, is_tiny, with_result
from jaxcrumple.solvers.proposal import ProposedStep, propose
from jaxcrumple.solvers.scheme import Integrator, checked_solver
from jaxcrumple.solvers.stages import (
    Entry,
    Handover,
    after_explicit,
    after_implicit,
    logged,
    no_entry,
    stay,
)
from jaxcrumple.solvers.switch import observe
from jaxcrumple.solvers.work import booked
from jaxcrumple.state import EXPLICIT, RESULTS, State, check_state

# A call ends after BUDGET cost units, so that its caller can save and report.
BUDGET = 4096
IMPLICIT_COST, EXPLICIT_COST = 32, 1
# The log keeps one explicit step in this many, because explicit steps are short and numerous.
EXPLICIT_LOG_EVERY = 16
LOG_CAPACITY = BUDGET // IMPLICIT_COST + BUDGET // EXPLICIT_LOG_EVERY + 64
# Steps of a stage between measurements of the stability limit, which changes as the sheet folds.
LIMIT_EVERY = 64
# Explicit steps for which the contact lists are built to stay valid.
LOOK_AHEAD = 16
# A call ends after this many consecutive rounds of list rebuilds and stage changes without a step.
MOST_ROUNDS = 64


class _Trial(NamedTuple):
    """Hold an implicit step: whether it is `underway`, its length, and what the formula has begun."""

    underway: Flag
    proposed: ProposedStep
    begun: Any


class _Carry(NamedTuple):
    state: State
    schedule: Schedule | None
    log: Log
    factor: Factor | None
    held: Flag
    trial: _Trial | None
    entry: Entry
    handover: Handover
    spent: Count
    rounds: Count
    left: Scalar
    done: Flag


@door
def integrate(
    scene: Scene,
    state: State,
    t_stop: ScalarLike,
    solver: Integrator,
    max_attempts: ScalarLike = jnp.inf,
    trail: int = 0,
) -> tuple[State, Log]:
    """Advance a state to `t_stop` in s, or until `max_attempts` or the budget of one call are used up.

    The function is pure: wrap it in `eqx.filter_jit`; new numbers do not recompile it. The returned state has
    `result` success if no step failed for good, and time `t_stop` if it reached that time; call again to
    continue. The step sequence depends on the state alone, so that a saved state continues like an
    uninterrupted run. `trail`: the log keeps up to this many accepted steps with their positions, and the
    call ends when it is full; 0 keeps none and sets no limit.

    **Returns:** the new `State` and the `Log` of this call.

    **Raises:** ValueError for a state of another scene, or an object that is not a solver.
    """
    check_state(scene, state)
    checked_solver(solver)
    require_shape("t_stop", t_stop, ())
    scene = scene if solver.one_matrix else without_matrix(scene)
    state, schedule = start_schedule(scene, state, solver.has(EXPLICIT))
    start_h = jnp.where(state.h > 0, state.h, jnp.minimum(solver.first_step, solver.max_step))
    known = jnp.any(state.stage == jnp.asarray(solver.stages))
    stage = jnp.where(known, state.stage, solver.stages[0])
    state = eqx.tree_at(lambda s: (s.h, s.stage), state, (start_h, stage))
    factor, trial = None, None
    if solver.implicit is not None:
        factor = solver.implicit.linear.start(listed(scene, schedule).sparsity)
        trial = _no_trial(listed(scene, schedule), state, solver)
    left, log = as_float(max_attempts), empty_log(LOG_CAPACITY, scene.n_nodes, trail)
    nothing = jnp.asarray(0)
    # Only an exact solver reuses a factor in later steps. It has none at the start of a call.
    held = jnp.asarray(solver.implicit is None or not solver.implicit.linear.exact)
    done = state.t >= t_stop
    carry = _Carry(
        state, schedule, log, factor, held, trial, no_entry(), stay(state), nothing, nothing, left, done
    )

    def stages(carry: _Carry) -> _Carry:
        carry = _renewed(scene, carry._replace(rounds=carry.rounds + 1), solver)
        if solver.implicit is not None:
            carry = _implicit_stages(scene, carry, t_stop, solver)
        if solver.has(EXPLICIT):
            carry = _explicit_stage(scene, carry, t_stop, solver)
        now, several = listed(scene, carry.schedule), len(solver.stages) > 1
        state, log = logged(now, carry.state, carry.log, carry.entry, carry.handover if several else None)
        return carry._replace(state=state, log=log, entry=no_entry(), handover=stay(state))

    end = jax.lax.while_loop(_going, stages, carry)
    if solver.implicit is not None and end.factor is not None:
        solver.implicit.linear.release(end.factor, end.state.x)
    return end.state, end.log


def _renewed(scene: Scene, carry: _Carry, solver: Integrator) -> _Carry:
    """Rebuild the contact lists and measure the stability limit, if the next step needs it.

    The limit is part of the state, so that an interrupted run continues with the same numbers.
    """
    state, schedule = renewed(scene, carry.state, carry.schedule)
    now, waiting = listed(scene, schedule), waits(state)
    due = _limit_is_due(carry) & ~waiting
    limit = where_needed(due, solver.measured, state.limit, now, state.x, state.t, state.p)
    measured = state.monitor.measured | due
    state = eqx.tree_at(lambda s: (s.limit, s.monitor.measured), state, (limit, measured))
    unsound = ~_is_sound(scene, state) & ~waiting
    state = with_result(state, unsound, RESULTS.nonfinite)
    return carry._replace(state=state, schedule=schedule)


def _limit_is_due(carry: _Carry) -> Flag:
    """Return whether the stability limit must be measured before the next step."""
    monitor = carry.state.monitor
    return (monitor.steps % LIMIT_EVERY == 0) & ~monitor.measured & ~_restores(carry)


def _restores(carry: _Carry) -> Flag:
    """Return whether the next attempt only recomputes the factor of the lagged tangent."""
    return jnp.asarray(False) if carry.factor is None else must_restore(carry.state.kept, carry.held)


def _is_sound(scene: Scene, state: State) -> Flag:
    """Return whether stability limit and scales are finite; otherwise every step fails."""
    numbers = (state.limit.step, scene.reference_acceleration, scene.velocity_scale, scene.length_scale)
    return jnp.all(jnp.isfinite(jnp.stack(numbers)))


def _going(carry: _Carry) -> Flag:
    room = carry.log.length < LOG_CAPACITY - 4
    if carry.log.trail is not None:
        room = room & ~carry.log.trail.full
    sound = (carry.state.result == RESULTS.success) & ~waits(carry.state)
    going = (carry.spent < BUDGET) & (carry.left > 0) & (carry.rounds < MOST_ROUNDS)
    return ~carry.done & room & sound & going


def _interrupted(carry: _Carry) -> Flag:
    """Return whether a stage change, an entry in the log, a limit measurement or a list rebuild must precede
    the next step."""
    over = (carry.handover.stage != carry.state.stage) | carry.entry.due | _limit_is_due(carry)
    return over if carry.schedule is None else over | carry.schedule.due


def _tried(
    carry: _Carry, state: State, log: Log, entry: Entry, handover: Handover, cost: int, done: Flag
) -> _Carry:
    """Return the loop variables after another attempt; `done`: whether it ended the call."""
    return carry._replace(
        state=state,
        log=log,
        entry=entry,
        handover=handover,
        spent=carry.spent + cost,
        rounds=jnp.zeros_like(carry.rounds),
        left=carry.left - 1.0,
        done=done,
    )


def _implicit_stages(scene: Scene, carry: _Carry, t_stop: ScalarLike, solver: Integrator) -> _Carry:
    """Run the quasistatic stage and the implicit stage with inertia until the stage changes."""

    def unfinished(carry: _Carry) -> Flag:
        return _going(carry) & (carry.state.stage != EXPLICIT) & ~_interrupted(carry)

    def body(carry: _Carry) -> _Carry:
        return _implicit_step(scene, carry, t_stop, solver)

    return jax.lax.while_loop(unfinished, body, carry)


def _no_trial(scene: Scene, state: State, solver: Integrator) -> _Trial:
    """Return a trial that is not underway."""
    assert solver.implicit is not None
    no, nought = jnp.asarray(False), jnp.zeros(())
    shapes = eqx.filter_eval_shape(solver.implicit.begin, scene, state, nought, no)
    begun = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    return _Trial(no, ProposedStep(nought, nought, nought, no, no), begun)


def _implicit_step(scene: Scene, carry: _Carry, t_stop: ScalarLike, solver: Integrator) -> _Carry:
    """Begin the next step and solve its equations, or go on with a step that waited for contact lists."""
    assert solver.implicit is not None and carry.trial is not None
    state, underway = carry.state, carry.trial.underway
    proposed = select(underway, carry.trial.proposed, _proposed(scene, carry, t_stop, solver))
    if scene.contact is None:
        return _implicit_attempt(scene, carry, solver, proposed)
    ahead = solver.implicit.predict(scene, state, proposed.h)
    restores = _restores(carry)
    differs = solver.implicit.differs(scene, state, proposed.h)
    state, schedule, ready = ready_for(scene, state, carry.schedule, ahead, differs)
    to_restore, ready_then = ready_to_restore(scene, carry.state, carry.schedule)
    state = select(restores | underway, carry.state, state)
    schedule = select(restores, to_restore, select(underway, carry.schedule, schedule))
    ready = jnp.where(restores, ready_then, underway | ready)

    def attempt(carry: _Carry) -> _Carry:
        return _implicit_attempt(scene, carry, solver, proposed)

    return jax.lax.cond(ready, attempt, lambda carry: carry, carry._replace(state=state, schedule=schedule))


def _proposed(scene: Scene, carry: _Carry, t_stop: ScalarLike, solver: Integrator) -> ProposedStep:
    """Propose the next implicit step."""
    assert solver.implicit is not None
    state = carry.state
    wanted = jnp.minimum(state.h, solver.max_step)
    # The step that aligns the velocity with the forces is as short as an explicit step.
    aligning = aligns(state)
    wanted = jnp.where(aligning, jnp.minimum(wanted, solver.limit(scene, state)), wanted)
    bounded = jnp.asarray(False)
    if scene.contact is not None:
        ahead, known = solver.implicit.predict(scene, state, wanted), state.history.count > 1
        share = largest_move(scene, carry.schedule, state.x, ahead, known)
        wanted, bounded = wanted * share, known & (share < 1)
    return propose(state.t, wanted, t_stop, bounded)


def _implicit_attempt(scene: Scene, carry: _Carry, solver: Integrator, proposed: ProposedStep) -> _Carry:
    """Solve the equations of a step as far as the contact lists permit; if they are solved, end the step."""
    implicit, trial = solver.implicit, carry.trial
    assert implicit is not None and trial is not None and carry.factor is not None
    now, state = listed(scene, carry.schedule), carry.state
    begun = select(trial.underway, trial.begun, implicit.begin(now, state, proposed.h, carry.held))
    begun, factor = implicit.go_on(now, state, proposed.h, begun, carry.factor)
    carry = carry._replace(factor=factor, trial=_Trial(jnp.asarray(True), proposed, begun))
    return jax.lax.cond(
        implicit.is_over(begun),
        lambda carry: _ended(now, carry, solver),
        lambda carry: _interposed(now, carry, solver),
        carry,
    )


def _interposed(scene: Scene, carry: _Carry, solver: Integrator) -> _Carry:
    """Request the contact lists that the step underway needs, if it needs other ones."""
    assert solver.implicit is not None and carry.trial is not None
    if scene.contact is None or carry.schedule is None:
        return carry
    x = solver.implicit.iterate(carry.trial.begun)
    asked = around(scene, carry.state, carry.schedule, x)
    state, schedule = select(covers(scene.own_lists, x), (carry.state, carry.schedule), asked)
    return carry._replace(state=state, schedule=schedule)


def _ended(scene: Scene, carry: _Carry, solver: Integrator) -> _Carry:
    """End the step underway: accept or reject it, log it, and choose the next stage."""
    assert solver.implicit is not None and carry.trial is not None and carry.factor is not None
    state, proposed, aligning = carry.state, carry.trial.proposed, aligns(carry.state)
    h = proposed.h
    tried = solver.implicit.end(scene, state, h, carry.trial.begun, carry.factor)
    moved = _moved(scene, state, tried, proposed, solver)
    suggested = tried.next_h
    # A step shortened to end at `t_stop` must not shorten the next one.
    held = tried.accepted & ((h < proposed.wanted) | aligning)
    suggested = jnp.where(held, jnp.maximum(suggested, state.h), suggested)
    suggested = jnp.where(jnp.isfinite(suggested), suggested, 0.1 * h)
    counters = counted(
        state.counters, state.stage, tried.accepted, tried.cause, tried.newton, tried.linear, tried.factors
    )
    moved = eqx.tree_at(
        lambda s: (s.h, s.history.order, s.kept, s.counters),
        moved,
        (suggested, tried.next_order, tried.kept, counters),
    )
    entry = Entry(tried.accepted, h, tried.order, tried.error)
    log = follow(carry.log, moved.x, moved.t, h, state.stage, tried.order, tried.accepted)
    handover = after_implicit(scene, moved, tried.accepted, tried.cause, solver, proposed.bounded)
    hopeless = ~tried.accepted & (handover.stage != EXPLICIT) & is_tiny(moved.h, moved.t)
    moved = given_up(moved, hopeless, tried.cause)
    over = carry.trial._replace(underway=jnp.asarray(False))
    carry = carry._replace(held=jnp.ones_like(carry.held), trial=over)
    after = _tried(carry, moved, log, entry, handover, IMPLICIT_COST, tried.accepted & proposed.lands)
    restored = carry._replace(schedule=rescheduled(state, carry.schedule))
    return after._replace(
        **{
            name: select(tried.restored, getattr(restored, name), getattr(after, name))
            for name in _Carry._fields
            if name not in ("factor", "held", "trial")
        }
    )


def _moved(
    scene: Scene, state: State, tried: ImplicitAttempt, proposed: ProposedStep, solver: Integrator
) -> State:
    """Return the state after an implicit step, or the old state if the step is rejected."""
    moved = eqx.tree_at(
        lambda s: (s.t, s.x, s.v, s.history, s.monitor),
        state,
        (
            proposed.t, tried.x, tried.v,
            push(state.history, proposed.h, tried.x, tried.v, tried.p, tried.next_order),
            observe(scene, state.monitor, state.stage, tried.acceleration, proposed.h, solver.switch),
        ),
    )  # fmt: skip
    if state.p is not None:
        moved = eqx.tree_at(lambda s: s.p, moved, tried.p)
    return select(tried.accepted, _with_work(scene, state, moved, proposed.h), state)


def _with_work(scene: Scene, before: State, after: State, h: Scalar) -> State:
    """Update the work ledger after an accepted step, if the state has one."""
    if before.work is None:
        return after
    return eqx.tree_at(lambda s: s.work, after, booked(scene, before, after, h))


def _explicit_stage(scene: Scene, carry: _Carry, t_stop: ScalarLike, solver: Integrator) -> _Carry:
    """Run the explicit stage until it ends or is interrupted."""

    def body(carry: _Carry) -> _Carry:
        return _explicit_step(scene, carry, t_stop, solver)

    return jax.lax.while_loop(_takes_explicit, body, carry)


def _takes_explicit(carry: _Carry) -> Flag:
    """Return whether the next step is explicit."""
    return _going(carry) & (carry.state.stage == EXPLICIT) & ~_interrupted(carry)


def _explicit_step(scene: Scene, carry: _Carry, t_stop: ScalarLike, solver: Integrator) -> _Carry:
    assert solver.explicit is not None
    state = carry.state
    cap = solver.explicit.safety * solver.limit(scene, state)
    started = state.h_explicit > 0
    wanted = jnp.minimum(jnp.where(started, jnp.minimum(state.h_explicit, cap), cap), solver.max_step)
    if scene.contact is None:
        return _explicit_attempt(scene, carry, solver, propose(state.t, wanted, t_stop), cap)
    wanted = wanted * largest_move(scene, carry.schedule, state.x, state.x + wanted * state.v)
    straight = state.x + wanted * state.v
    following = straight + 0.5 * wanted**2 * state.slopes.acceleration
    differs = motion(straight, following)

    def looked_ahead() -> tuple[State, Schedule | None, Flag]:
        ahead = state.x + LOOK_AHEAD * wanted * state.v
        ahead = state.x + largest_move(scene, carry.schedule, state.x, ahead) * (ahead - state.x)
        return ready_for(scene, state, carry.schedule, ahead)

    holds, held = still_ready(scene, state, carry.schedule, following, differs), (state, carry.schedule, True)
    after, schedule, ready = jax.lax.cond(holds, lambda: held, looked_ahead)
    # Under vmap every lane runs this code, so each lane must check for itself that it takes the step.
    going = ready & _takes_explicit(carry)

    def attempt(carry: _Carry) -> _Carry:
        assert carry.schedule is not None
        now, schedule = with_active(scene, carry.state, carry.schedule, following, differs, going)
        carry = carry._replace(state=now, schedule=schedule)
        return _explicit_attempt(scene, carry, solver, propose(state.t, wanted, t_stop), cap)

    return jax.lax.cond(ready, attempt, lambda carry: carry, carry._replace(state=after, schedule=schedule))


def _explicit_attempt(
    scene: Scene, carry: _Carry, solver: Integrator, proposed: ProposedStep, cap: Scalar
) -> _Carry:
    assert solver.explicit is not None
    scene, state, order = listed_active(scene, carry.schedule), carry.state, solver.explicit.order
    # The first step of a spell lacks the slopes at its start. A step of length zero computes them.
    known, wanted = state.slopes.known, proposed.wanted
    h = jnp.where(known, proposed.h, 0.0)
    tried = solver.explicit.attempt(scene, state, h, cap)
    moved = eqx.tree_at(
        lambda s: (s.t, s.x, s.v, s.slopes, s.monitor),
        state,
        (
            proposed.t, tried.x, tried.v, tried.slopes,
            observe(scene, state.monitor, state.stage, tried.slopes.acceleration, h, solver.switch),
        ),
    )  # fmt: skip
    if state.p is not None:
        moved = eqx.tree_at(lambda s: s.p, moved, tried.p)
    moved = select(tried.accepted, _with_work(scene, state, moved, h), state)
    next_h = jnp.where(tried.accepted & (h < wanted), jnp.maximum(tried.next_h, wanted), tried.next_h)
    moved = eqx.tree_at(lambda s: s.h_explicit, moved, next_h)
    counters = counted(state.counters, EXPLICIT, tried.accepted, tried.cause)
    moved = eqx.tree_at(lambda s: s.counters, moved, counters)
    moved = given_up(moved, ~tried.accepted & is_tiny(next_h, state.t), tried.cause)
    sampled = tried.accepted & (counters.steps[EXPLICIT] % EXPLICIT_LOG_EVERY == 0)
    entry = Entry(sampled, h, jnp.asarray(order), tried.error)
    log = follow(carry.log, moved.x, moved.t, h, state.stage, order, tried.accepted)
    handover = after_explicit(scene, moved, tried.accepted, cap, solver)
    if carry.schedule is not None:
        turn = jnp.where(tried.accepted, tried.turn, carry.schedule.turn)
        carry = carry._replace(schedule=carry.schedule._replace(turn=turn))
    after = _tried(carry, moved, log, entry, handover, EXPLICIT_COST, tried.accepted & proposed.lands)
    started = eqx.tree_at(lambda s: s.slopes, state, tried.slopes)
    return select(known, after, carry._replace(state=started, spent=carry.spent + EXPLICIT_COST))
