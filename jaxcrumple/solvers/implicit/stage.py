"""The implicit stages in the loop of `integrate`: propose a step, solve its equations, and judge it."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Flag, ScalarLike
from jaxcrumple._jax.tree import select
from jaxcrumple.contact.coverage import covers
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.schedule import around, crowded, largest_move, listed, rescheduled
from jaxcrumple.solvers.implicit.base import ImplicitAttempt, aligns
from jaxcrumple.solvers.implicit.bdf import push
from jaxcrumple.solvers.log import follow
from jaxcrumple.solvers.loop import (
    IMPLICIT_COST,
    Carry,
    Trial,
    after_attempt,
    is_going,
    is_interrupted,
    with_work,
)
from jaxcrumple.solvers.outcome import counted, given_up, is_tiny
from jaxcrumple.solvers.proposal import ProposedStep, propose
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.solvers.stages import Entry, after_implicit
from jaxcrumple.solvers.switch import observe
from jaxcrumple.state import EXPLICIT, State


def no_trial(scene: Scene, state: State, solver: Integrator) -> Trial:
    """Return a trial that is not underway."""
    assert solver.implicit is not None
    no, nought = jnp.asarray(False), jnp.zeros(())
    shapes = eqx.filter_eval_shape(solver.implicit.begin, scene, state, nought, no)
    begun = jax.tree.map(lambda shape: jnp.zeros(shape.shape, shape.dtype), shapes)
    return Trial(no, ProposedStep(nought, nought, nought, no, no), begun)


def proposed_implicit(scene: Scene, carry: Carry, t_stop: ScalarLike, solver: Integrator) -> ProposedStep:
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


def implicit_steps(scene: Scene, carry: Carry, solver: Integrator) -> Carry:
    """Make a step of the quasistatic stage or of the implicit stage with inertia, if it is their turn."""

    def unfinished(carry: Carry) -> Flag:
        turn = carry.ready & (carry.state.stage != EXPLICIT)
        return is_going(carry) & turn & ~is_interrupted(carry)

    with jax.named_scope("implicit-steps"):
        return jax.lax.while_loop(unfinished, lambda carry: _attempt(scene, carry, solver), carry)


def _attempt(scene: Scene, carry: Carry, solver: Integrator) -> Carry:
    """Solve the equations of a step as far as the contact lists permit, and end the step if they are solved
    or cannot be. If the factor of the lagged tangent is missing, only recompute it."""
    implicit, trial = solver.implicit, carry.trial
    assert implicit is not None and trial is not None and carry.factor is not None
    now, state, proposed = listed(scene, carry.schedule), carry.state, trial.proposed
    begun = jax.lax.cond(
        trial.underway,
        lambda: trial.begun,
        lambda: implicit.begin(now, state, proposed.h, carry.held),
    )
    if carry.schedule is not None:
        begun = implicit.given_up(begun, trial.underway & crowded(scene, carry.schedule))
    begun, factor = implicit.go_on(now, state, proposed.h, begun, carry.factor)
    carry = carry._replace(factor=factor, trial=Trial(jnp.asarray(True), proposed, begun))
    over = implicit.is_over(begun)
    return jax.lax.switch(
        over.astype(int) + (over & implicit.restores(begun)),
        (
            lambda carry: _interposed(now, carry, solver),
            lambda carry: _ended(now, carry, solver),
            _restored,
        ),
        carry,
    )


def _over(carry: Carry) -> Carry:
    """Return the loop variables after a solve: its factor is there, and no step is underway."""
    assert carry.trial is not None
    over = carry.trial._replace(underway=jnp.zeros_like(carry.trial.underway))
    return carry._replace(held=jnp.ones_like(carry.held), trial=over, ready=jnp.zeros_like(carry.ready))


def _restored(carry: Carry) -> Carry:
    """Take the recomputed factor, and request the lists of the state again."""
    return _over(carry)._replace(schedule=rescheduled(carry.state, carry.schedule))


def _interposed(scene: Scene, carry: Carry, solver: Integrator) -> Carry:
    """Request the contact lists that the step underway needs, if it needs other ones."""
    assert solver.implicit is not None and carry.trial is not None
    if scene.contact is None or carry.schedule is None:
        return carry
    x = solver.implicit.iterate(carry.trial.begun)
    asked = around(scene, carry.state, carry.schedule, x)
    state, schedule = select(covers(scene.own_lists, x), (carry.state, carry.schedule), asked)
    return carry._replace(state=state, schedule=schedule)


def _ended(scene: Scene, carry: Carry, solver: Integrator) -> Carry:
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
    handover = after_implicit(scene, moved, h, tried.accepted, tried.cause, solver, proposed.bounded)
    hopeless = ~tried.accepted & (handover.stage != EXPLICIT) & is_tiny(moved.h, moved.t)
    moved = given_up(moved, hopeless, tried.cause)
    done = tried.accepted & proposed.lands
    return after_attempt(_over(carry), moved, log, entry, handover, IMPLICIT_COST, done)


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
    return select(tried.accepted, with_work(scene, state, moved, proposed.h), state)
