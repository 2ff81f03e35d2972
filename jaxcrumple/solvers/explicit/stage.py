"""The explicit stage in the loop of `integrate`: short steps, with the contact lists of several."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Flag, NodeVectors, Scalar, ScalarLike
from jaxcrumple._jax.tree import select
from jaxcrumple.contact.lists import motion
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.schedule import largest_move, listed_active, still_ready, with_active
from jaxcrumple.solvers.implicit.bdf import push
from jaxcrumple.solvers.log import follow
from jaxcrumple.solvers.loop import (
    EXPLICIT_COST,
    EXPLICIT_LOG_EVERY,
    Carry,
    after_attempt,
    is_going,
    is_interrupted,
    with_work,
)
from jaxcrumple.solvers.outcome import counted, given_up, is_tiny
from jaxcrumple.solvers.proposal import ProposedStep, propose
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.solvers.stages import Entry, after_explicit
from jaxcrumple.solvers.switch import observe
from jaxcrumple.state import EXPLICIT, IMPLICIT

# Explicit steps for which the contact lists are built to stay valid.
LOOK_AHEAD = 16
# Points that an implicit step of order 2 with inertia and its error estimate need.
SECOND_ORDER = 3


def look_ahead(scene: Scene, carry: Carry, solver: Integrator) -> NodeVectors:
    """Return the positions (n, 3) that contact lists for the next explicit steps must cover."""
    state, (wanted, _) = carry.state, _wanted(scene, carry, solver)
    ahead = state.x + LOOK_AHEAD * wanted * state.v
    return state.x + largest_move(scene, carry.schedule, state.x, ahead) * (ahead - state.x)


def _wanted(scene: Scene, carry: Carry, solver: Integrator) -> tuple[Scalar, Scalar]:
    """Return the length in s of the next step, and the largest stable one."""
    assert solver.explicit is not None
    state = carry.state
    cap = solver.explicit.safety * solver.limit(scene, state)
    started = state.h_explicit > 0
    wanted = jnp.minimum(jnp.where(started, jnp.minimum(state.h_explicit, cap), cap), solver.max_step)
    if scene.contact is None:
        return wanted, cap
    return wanted * largest_move(scene, carry.schedule, state.x, state.x + wanted * state.v), cap


def explicit_steps(scene: Scene, carry: Carry, t_stop: ScalarLike, solver: Integrator) -> Carry:
    """Make explicit steps until the stage ends, or something must precede the next one."""

    def body(carry: Carry) -> Carry:
        return _step(scene, carry, t_stop, solver)

    with jax.named_scope("explicit-steps"):
        return jax.lax.while_loop(_takes_explicit, body, carry)


def _takes_explicit(carry: Carry) -> Flag:
    """Return whether the next step is explicit."""
    return is_going(carry) & carry.ready & (carry.state.stage == EXPLICIT) & ~is_interrupted(carry)


def _step(scene: Scene, carry: Carry, t_stop: ScalarLike, solver: Integrator) -> Carry:
    """Make a step, unless the contact lists do not serve it."""
    state, (wanted, cap) = carry.state, _wanted(scene, carry, solver)
    proposed = propose(state.t, wanted, t_stop)
    if scene.contact is None or carry.schedule is None:
        return _attempt(scene, carry, solver, proposed, cap)
    straight = state.x + wanted * state.v
    following = straight + 0.5 * wanted**2 * state.slopes.acceleration
    differs = motion(straight, following)
    holds = carry.checked | still_ready(scene, state, carry.schedule, following, differs)
    # Under vmap every lane runs this code, so each lane must check for itself that it takes the step.
    going = holds & _takes_explicit(carry)

    def attempt(carry: Carry) -> Carry:
        assert carry.schedule is not None
        now, schedule = with_active(scene, carry.state, carry.schedule, following, differs, going)
        return _attempt(scene, carry._replace(state=now, schedule=schedule), solver, proposed, cap)

    return jax.lax.cond(holds, attempt, lambda carry: carry, carry._replace(ready=holds))


def _attempt(scene: Scene, carry: Carry, solver: Integrator, proposed: ProposedStep, cap: Scalar) -> Carry:
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
    if solver.has(IMPLICIT):
        # The next implicit step with inertia has order 2 at once, with an error estimate.
        last = push(state.history, h, tried.x, tried.v, tried.p, jnp.asarray(2, int), SECOND_ORDER)
        moved = eqx.tree_at(lambda s: s.history, moved, last)
    moved = select(tried.accepted, with_work(scene, state, moved, h), state)
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
    after = after_attempt(carry, moved, log, entry, handover, EXPLICIT_COST, tried.accepted & proposed.lands)
    started = eqx.tree_at(lambda s: s.slopes, state, tried.slopes)
    return select(known, after, carry._replace(state=started, spent=carry.spent + EXPLICIT_COST))
