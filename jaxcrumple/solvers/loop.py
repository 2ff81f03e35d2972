"""The variables of the loop of `integrate`, and what its stages share."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import Count, Flag, Scalar
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.schedule import Schedule, waits
from jaxcrumple.solvers.implicit.newton import must_restore
from jaxcrumple.solvers.linear.base import Factor
from jaxcrumple.solvers.log import Log
from jaxcrumple.solvers.proposal import ProposedStep
from jaxcrumple.solvers.stages import Entry, Handover
from jaxcrumple.solvers.work import booked
from jaxcrumple.state import RESULTS, State

# A call ends after BUDGET cost units, so that its caller can save and report.
BUDGET = 4096
IMPLICIT_COST, EXPLICIT_COST = 32, 1
# The log keeps one explicit step in this many, because explicit steps are short and numerous.
EXPLICIT_LOG_EVERY = 16
LOG_CAPACITY = BUDGET // IMPLICIT_COST + BUDGET // EXPLICIT_LOG_EVERY + 64
# Steps of a stage between measurements of the stability limit, which changes as the sheet folds.
LIMIT_EVERY = 64
# A call ends after this many consecutive rounds of list rebuilds and stage changes without a step.
MOST_ROUNDS = 64


class Trial(NamedTuple):
    """Hold an implicit step: whether it is `underway`, its length, and what the formula has begun."""

    underway: Flag
    proposed: ProposedStep
    begun: Any


class Carry(NamedTuple):
    """Hold the variables of the loop.

    `schedule`: of the contact lists; `ready`: whether they serve the next step as far as is known, and
    whether this was `checked` at this very state; `factor` of the last tangent, and whether it is `held`;
    `trial`: the implicit step underway; `entry`: what the log must tell before the next step; `handover`:
    stage of the next step; `spent`: cost of the call; `rounds` without a step; `left`: number of attempts
    that remain; `done`: whether the call has reached its end time."""

    state: State
    schedule: Schedule | None
    ready: Flag
    checked: Flag
    log: Log
    factor: Factor | None
    held: Flag
    trial: Trial | None
    entry: Entry
    handover: Handover
    spent: Count
    rounds: Count
    left: Scalar
    done: Flag


def is_going(carry: Carry) -> Flag:
    """Return whether the call goes on: it has budget, room in its log, and nothing to wait for."""
    room = carry.log.length < LOG_CAPACITY - 4
    if carry.log.trail is not None:
        room = room & ~carry.log.trail.full
    sound = (carry.state.result == RESULTS.success) & ~waits(carry.state)
    going = (carry.spent < BUDGET) & (carry.left > 0) & (carry.rounds < MOST_ROUNDS)
    return ~carry.done & room & sound & going


def is_interrupted(carry: Carry) -> Flag:
    """Return whether a stage change, an entry in the log, a limit measurement or a list rebuild must precede
    the next step."""
    over = (carry.handover.stage != carry.state.stage) | carry.entry.due | limit_is_due(carry)
    return over if carry.schedule is None else over | carry.schedule.due


def limit_is_due(carry: Carry) -> Flag:
    """Return whether the stability limit must be measured before the next step."""
    monitor = carry.state.monitor
    return (monitor.steps % LIMIT_EVERY == 0) & ~monitor.measured & ~restores(carry)


def restores(carry: Carry) -> Flag:
    """Return whether the next attempt only recomputes the factor of the lagged tangent."""
    return jnp.asarray(False) if carry.factor is None else must_restore(carry.state.kept, carry.held)


def after_attempt(
    carry: Carry, state: State, log: Log, entry: Entry, handover: Handover, cost: int, done: Flag
) -> Carry:
    """Return the loop variables after another attempt; `done`: whether it ended the call."""
    return carry._replace(
        state=state,
        checked=jnp.zeros_like(carry.checked),
        log=log,
        entry=entry,
        handover=handover,
        spent=carry.spent + cost,
        rounds=jnp.zeros_like(carry.rounds),
        left=carry.left - 1.0,
        done=done,
    )


def with_work(scene: Scene, before: State, after: State, h: Scalar) -> State:
    """Update the work ledger after an accepted step, if the state has one."""
    if before.work is None:
        return after
    return eqx.tree_at(lambda s: s.work, after, booked(scene, before, after, h))
