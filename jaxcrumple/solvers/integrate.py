"""`integrate`: run the stages of a scheme, and the changes between them, as one traced function."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Flag, ScalarLike
from jaxcrumple._jax.batched_cond import where_needed
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float, require_shape, select
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.schedule import (
    listed,
    ready_for,
    ready_to_restore,
    renewed,
    start_schedule,
    waits,
    without_matrix,
)
from jaxcrumple.solvers.explicit.stage import explicit_steps, look_ahead
from jaxcrumple.solvers.implicit.stage import implicit_steps, no_trial, proposed_implicit
from jaxcrumple.solvers.log import Log, empty_log
from jaxcrumple.solvers.loop import LOG_CAPACITY, Carry, is_going, limit_is_due, restores
from jaxcrumple.solvers.outcome import with_result
from jaxcrumple.solvers.scheme import Integrator, checked_solver
from jaxcrumple.solvers.stages import logged, no_entry, stay
from jaxcrumple.state import EXPLICIT, RESULTS, State, check_state


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
    uninterrupted run.

    **Arguments:** `t_stop` in s; `solver`: an `Integrator`; `max_attempts`: largest number of step attempts;
    `trail`: the log keeps up to this many accepted steps with their positions, and the call ends when it is
    full; 0 keeps none and sets no limit.

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
        trial = no_trial(listed(scene, schedule), state, solver)
    left, log = as_float(max_attempts), empty_log(LOG_CAPACITY, scene.n_nodes, trail)
    nothing = jnp.asarray(0)
    # Only an exact solver reuses a factor in later steps. It has none at the start of a call.
    held = jnp.asarray(solver.implicit is None or not solver.implicit.linear.exact)
    done = state.t >= t_stop
    no = jnp.asarray(False)
    # As in an uninterrupted run, explicit steps use their lists for as long as these hold.
    ready = state.stage == EXPLICIT
    idle = no_entry(), stay(state), nothing, nothing, left, done
    carry = Carry(state, schedule, ready, no, log, factor, held, trial, *idle)

    def stages(carry: Carry) -> Carry:
        carry = _renewed(scene, carry._replace(rounds=carry.rounds + 1), solver)
        carry = _prepared(scene, carry, t_stop, solver)
        if solver.implicit is not None:
            carry = implicit_steps(scene, carry, solver)
        if solver.has(EXPLICIT):
            carry = explicit_steps(scene, carry, t_stop, solver)
        now, several = listed(scene, carry.schedule), len(solver.stages) > 1
        state, log = logged(now, carry.state, carry.log, carry.entry, carry.handover if several else None)
        stays = carry.ready & (state.stage == carry.state.stage)
        return carry._replace(state=state, log=log, ready=stays, entry=no_entry(), handover=stay(state))

    end = jax.lax.while_loop(is_going, stages, carry)
    if solver.implicit is not None and end.factor is not None:
        solver.implicit.linear.release(end.factor, end.state.x)
    return end.state, end.log


def _prepared(scene: Scene, carry: Carry, t_stop: ScalarLike, solver: Integrator) -> Carry:
    """Propose an implicit step, and request what the next step of any stage needs of the contact lists."""
    state, schedule, trial = carry.state, carry.schedule, carry.trial
    explicit, underway = state.stage == EXPLICIT, jnp.asarray(False)
    if trial is not None:
        underway = trial.underway
        proposed = select(underway, trial.proposed, proposed_implicit(scene, carry, t_stop, solver))
        carry = carry._replace(trial=trial._replace(proposed=proposed))
    yes = jnp.asarray(True)
    if scene.contact is None:
        return carry._replace(ready=yes, checked=yes)
    ahead, differs = state.x, jnp.zeros(())
    if solver.implicit is not None and trial is not None:
        ahead = solver.implicit.predict(scene, state, proposed.h)
        differs = solver.implicit.differs(scene, state, proposed.h)
    if solver.has(EXPLICIT):
        ahead = jnp.where(explicit, look_ahead(scene, carry, solver), ahead)
        differs = jnp.where(explicit, 0.0, differs)
    asked = ready_for(scene, state, schedule, ahead, differs)
    restoring = restores(carry) & ~explicit
    there = state, *ready_to_restore(scene, state, schedule)
    keeps = underway | (explicit & carry.ready)
    state, schedule, ready = select(restoring, there, select(keeps, (state, schedule, yes), asked))
    return carry._replace(state=state, schedule=schedule, ready=ready, checked=ready & ~keeps)


def _renewed(scene: Scene, carry: Carry, solver: Integrator) -> Carry:
    """Rebuild the contact lists and measure the stability limit, if the next step needs it.

    The limit is part of the state, so that an interrupted run continues with the same numbers.
    """
    state, schedule = renewed(scene, carry.state, carry.schedule)
    now, waiting = listed(scene, schedule), waits(state)
    due = limit_is_due(carry) & ~waiting
    limit = where_needed(due, solver.measured, state.limit, now, state.x, state.t, state.p)
    measured = state.monitor.measured | due
    state = eqx.tree_at(lambda s: (s.limit, s.monitor.measured), state, (limit, measured))
    unsound = ~_is_sound(scene, state) & ~waiting
    state = with_result(state, unsound, RESULTS.nonfinite)
    return carry._replace(state=state, schedule=schedule)


def _is_sound(scene: Scene, state: State) -> Flag:
    """Return whether stability limit and scales are finite; otherwise every step fails."""
    numbers = (state.limit.step, scene.reference_acceleration, scene.velocity_scale, scene.length_scale)
    return jnp.all(jnp.isfinite(jnp.stack(numbers)))
