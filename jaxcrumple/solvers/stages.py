"""Changes of stage: their conditions after a step, and the start of the next stage."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, Scalar
from jaxcrumple._jax.tree import select
from jaxcrumple.history import NEVER, restart_history
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.log import AFTER, BEFORE, STEP, Log, Row, append
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.solvers.switch import has_settled, wants_inertia
from jaxcrumple.state import CAUSES, EXPLICIT, IMPLICIT, QUASISTATIC, State, fresh_monitor, no_work
from jaxcrumple.system import Energies, energies

# A rejected quasistatic step below this share of the explicit stability limit ends the stage: integrating the
# motion is then cheaper. The share is below 1, because a start at low order may need a few such short steps.
COLLAPSE = 0.05
# If even steps of this share of m/b_iso cannot follow the equilibrium, a stage with inertia starts. Larger
# values switch earlier than the accelerations require, and change the solution by more than rtol.
LOST = 0.02
# An implicit step costs as much as this many explicit steps; a shorter implicit step is not worth its cost.
# Contact adds to the cost of both: with it the ratio is 3.5 to 5 from 200 to 3000 nodes.
BREAK_EVEN, BREAK_EVEN_IN_CONTACT = 10, 4
# Length of an explicit stage, in stability limits, before the next implicit stage is SPELL. It doubles after
# each implicit stage of fewer than FUTILE steps, PATIENCE times at most.
SPELL, FUTILE, PATIENCE = 200, 10, 2


class Handover(NamedTuple):
    """Name the `stage` of the next step, and the size `h` in s of its first step if the stage is new."""

    stage: Count
    h: Scalar

    def when(self, wanted: Flag, stage: int, h: Scalar) -> "Handover":
        """Return a change to `stage` with first step `h` if `wanted`, else this one."""
        return Handover(jnp.where(wanted, stage, self.stage), jnp.where(wanted, h, self.h))


def stay(state: State) -> Handover:
    """Return the hand-over without a change of stage."""
    return Handover(state.stage, state.h)


def after_implicit(
    scene: Scene, state: State, h: Scalar, accepted: Flag, cause: Count, solver: Integrator, bounded: Flag
) -> Handover:
    """Choose the next stage after an implicit step, which led to `state` or was rejected for `cause`.

    `h`: size of the step in s; `bounded`: whether contact limited the length of the step."""
    quasistatic, inertial = state.stage == QUASISTATIC, state.stage == IMPLICIT
    limit, rejected, handover = solver.limit(scene, state), ~accepted, stay(state)
    short = state.h < COLLAPSE * limit
    asked = quasistatic & accepted & wants_inertia(scene, state.monitor, solver.switch)
    h_explicit = solver.explicit.safety * limit if solver.explicit is not None else limit
    if solver.has(IMPLICIT):
        lost = rejected & (cause != CAUSES.index("error")) & (state.h < LOST * scene.inertial_time)
        handover = handover.when(quasistatic & (asked | lost | (rejected & short)), IMPLICIT, state.h)
        if solver.has(QUASISTATIC):
            down = inertial & accepted & has_settled(scene, state.monitor, solver.switch)
            handover = handover.when(down, QUASISTATIC, state.h)
        if solver.has(EXPLICIT):
            # Without contact, accepted steps that do not grow are few: they begin a snap.
            short_step = rejected | bounded | ((state.h <= h) & (scene.contact is not None))
            brief = inertial & short_step & (state.h < _break_even(scene) * limit)
            handover = handover.when(brief, EXPLICIT, h_explicit)
    elif solver.has(EXPLICIT):
        handover = handover.when(asked | (rejected & short), EXPLICIT, h_explicit)
    return handover


def after_explicit(scene: Scene, state: State, accepted: Flag, cap: Scalar, solver: Integrator) -> Handover:
    """Choose the next stage after an explicit step; `cap`: longest step of the stage in s."""
    if solver.has(IMPLICIT):
        spell = SPELL * 2 ** jnp.minimum(state.monitor.futile, PATIENCE)
        over = accepted & (state.monitor.since > spell * cap)
        return stay(state).when(over, IMPLICIT, _break_even(scene) * cap)
    if solver.has(QUASISTATIC):
        settled = accepted & has_settled(scene, state.monitor, solver.switch)
        return stay(state).when(settled, QUASISTATIC, solver.restart_steps * cap)
    return stay(state)


def _break_even(scene: Scene) -> int:
    """Return how many explicit steps cost as much as an implicit one."""
    return BREAK_EVEN if scene.contact is None else BREAK_EVEN_IN_CONTACT


class Entry(NamedTuple):
    """Hold what the log tells of the last step: its size `h` in s, `order` and `error`, if it is `due`."""

    due: Flag
    h: Scalar
    order: Count
    error: Scalar


def no_entry() -> Entry:
    """Return an entry that is not due."""
    return Entry(jnp.asarray(False), jnp.zeros(()), jnp.asarray(0), jnp.zeros(()))


def logged(
    scene: Scene, state: State, log: Log, entry: Entry, handover: Handover | None
) -> tuple[State, Log]:
    """Log the last step if its `entry` is due. Change the stage if `handover` asks for it, and log the states
    before and after. None: the scheme has one stage."""

    def written() -> tuple[State, Log]:
        # Positions and velocities do not change, and so the energies of all rows are equal.
        stored = energies(scene, state.x, state.v, state.p, state.t)
        rows = append(log, _row(state, stored, STEP, entry.h, entry.order, entry.error), entry.due)
        if handover is None:
            return state, rows
        changed = _changed(state, handover)
        last = _row(state, stored, BEFORE, handover.h, 0, 0.0)
        first = last._replace(
            kind=AFTER,
            stage=changed.stage,
            acceleration=changed.monitor.ratios[0],
            acceleration_mean=jnp.mean(changed.monitor.ratios),
        )
        return select(changes, changed, state), append(append(rows, last, changes), first, changes)

    changes = jnp.asarray(False) if handover is None else handover.stage != state.stage
    return jax.lax.cond(entry.due | changes, written, lambda: (state, log))


def _changed(state: State, handover: Handover) -> State:
    """Return the state at the start of a stage.

    Stages with inertia and quasistatic stages share the history; it restarts in a quasistatic stage after an
    explicit one, whose velocities do not balance the forces."""
    explicit = handover.stage == EXPLICIT
    # A history that mixes points with and without inertia supports order 2 at most at first.
    kept = eqx.tree_at(lambda y: y.order, state.history, jnp.minimum(state.history.order, 2))
    fresh = restart_history(state.x, state.v, state.p)
    restarts = (state.stage == EXPLICIT) & (handover.stage == QUASISTATIC)
    history = select(restarts, fresh, kept)
    monitor = state.monitor
    tried = jnp.where(monitor.steps < FUTILE, monitor.futile + 1, 0)
    futile = jnp.where(state.stage == EXPLICIT, monitor.futile, tried)
    return eqx.tree_at(
        lambda s: (
            s.stage,
            s.slopes.known,
            s.h,
            s.h_explicit,
            s.history,
            s.monitor,
            s.counters.switches,
            s.kept.age,
        ),
        state,
        (
            handover.stage,
            jnp.asarray(False),
            jnp.where(explicit, state.h, handover.h),
            jnp.where(explicit, handover.h, state.h_explicit),
            history,
            fresh_monitor(monitor.ratios.shape[0], futile),
            state.counters.switches + 1,
            jnp.asarray(NEVER, int),
        ),
    )


def _row(
    state: State, stored: Energies, kind: int, h: Scalar, order: Count | int, error: Scalar | float
) -> Row:
    """Return the log row of a state with the energies `stored`."""
    monitor, count = state.monitor, state.counters
    return Row(
        kind=kind,
        t=state.t,
        stage=state.stage,
        h=h,
        acceleration=monitor.ratios[0],
        acceleration_mean=jnp.mean(monitor.ratios),
        energies=stored,
        order=order,
        error=error,
        newton_iterations=count.newton,
        linear_iterations=count.linear,
        factors=count.factors,
        quasistatic_steps=count.steps[QUASISTATIC],
        implicit_steps=count.steps[IMPLICIT],
        explicit_steps=count.steps[EXPLICIT],
        rejected_steps=jnp.sum(count.rejected),
        work=no_work() if state.work is None else state.work,
    )
