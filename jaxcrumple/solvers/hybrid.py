"""`integrate`: the hybrid of the quasistatic and the dynamic stage as one traced function."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.scene import Scene
from jaxcrumple.solvers import explicit, quasistatic
from jaxcrumple.solvers.bdf import push
from jaxcrumple.solvers.choice import choose_linear_solver
from jaxcrumple.solvers.explicit import Explicit
from jaxcrumple.solvers.linear import AbstractLinearSolver, Factor
from jaxcrumple.solvers.log import AFTER, BEFORE, STEP, Log, Row, append, empty_log
from jaxcrumple.solvers.quasistatic import Quasistatic
from jaxcrumple.solvers.switch import Switch, fresh_monitor, observe, wants_switch
from jaxcrumple.system import (
    DYNAMIC,
    QUASISTATIC,
    RESULTS,
    Counters,
    State,
    energies,
    rates,
    restart_history,
)

# Cost units: a call ends after BUDGET units, so that its caller can save, and reports in between.
BUDGET = 1024
QUASISTATIC_COST, DYNAMIC_COST = 32, 1
# One dynamic step in this many is logged: they are short and many.
DYNAMIC_LOG_EVERY = 16
LOG_CAPACITY = BUDGET // QUASISTATIC_COST + BUDGET // DYNAMIC_LOG_EVERY + 64
# A quasistatic step below this share of the explicit stability limit hands over: to integrate the
# motion is cheaper then. Not 1, because a start at low order may need a few steps that short.
COLLAPSE = 0.05
# Relative to the time, a step below this is lost to rounding.
SMALLEST_STEP = 1e-13


class Hybrid(eqx.Module):
    """How to integrate: options of both stages and of the switch.

    - `first_step`: first quasistatic step of a run in s.
    - `restart_steps`: first quasistatic step after a dynamic stage, in explicit stability limits.
    - `max_step`: largest step in s.
    """

    quasistatic: Quasistatic
    explicit: Explicit
    switch: Switch
    first_step: Array = eqx.field(default=1e-4, converter=jnp.asarray)
    restart_steps: Array = eqx.field(default=10.0, converter=jnp.asarray)
    max_step: Array | float = eqx.field(default=jnp.inf, converter=jnp.asarray)


def hybrid(
    rtol: float = 1e-4,
    *,
    linear: str | AbstractLinearSolver = "auto",
    switch: Switch | None = None,
    max_order: int = 4,
    max_step: Array | float = jnp.inf,
) -> Hybrid:
    """The hybrid integrator at relative tolerance `rtol`, with steps of `max_step` s at most.

    **Raises:** ValueError for a tolerance outside (0, 0.1), a step limit that is not positive, an
    unknown linear solver or order.
    """
    if not 0 < rtol < 0.1:
        raise ValueError(f"rtol = {rtol!r} must lie between 0 and 0.1; 1e-4 is a good start.")
    if not max_step > 0:
        raise ValueError(f"max_step = {max_step!r} s must be positive; leave it out for no limit.")
    if max_order not in (1, 2, 3, 4):
        raise ValueError(f"max_order = {max_order!r} must be 1, 2, 3 or 4.")
    solver = choose_linear_solver(linear) if isinstance(linear, str) else linear
    tolerance = jnp.asarray(float(rtol))
    return Hybrid(
        Quasistatic(tolerance, solver, max_order=max_order),
        Explicit(tolerance),
        switch or Switch(),
        max_step=max_step,
    )


class _Carry(NamedTuple):
    state: State
    log: Log
    factor: Factor
    spent: Array
    done: Array


def integrate(scene: Scene, state: State, t_stop: Array, solver: Hybrid) -> tuple[State, Log]:
    """Advance a state until `t_stop`, or until this call's budget is used up.

    Pure and traced: wrap it in `eqx.filter_jit`; numbers may change without recompiling. The
    returned state has `result` success if nothing went wrong, and time `t_stop` if it got there;
    call again to go on. The step sequence depends on the state alone, so a saved state continues as
    an uninterrupted run does.

    **Returns:** the new `State` and the `Log` of this call.
    """
    state = _with_result(state, ~_is_sound(scene, state), RESULTS.nonfinite)
    start_h = jnp.where(state.h > 0, state.h, jnp.minimum(solver.first_step, solver.max_step))
    state = eqx.tree_at(lambda s: s.h, state, start_h)
    zero = jnp.asarray(0)
    factor = solver.quasistatic.linear.start(scene.pattern)
    carry = _Carry(state, empty_log(LOG_CAPACITY), factor, zero, state.t >= t_stop)

    def both(carry: _Carry) -> _Carry:
        carry = _quasistatic_stage(scene, carry, t_stop, solver)
        return _dynamic_stage(scene, carry, t_stop, solver)

    end = jax.lax.while_loop(_going, both, carry)
    return end.state, end.log


def _is_sound(scene: Scene, state: State) -> Array:
    """Whether rates, scales and stability limit are finite: where they are not, no step can end well."""
    numbers = (
        rates(scene, state.x, state.v, state.p, state.t),
        explicit.stability_limit(scene, state.x),
        (scene.reference_acceleration, scene.velocity_scale, scene.length_scale),
    )
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(numbers)]))


def _going(carry: _Carry) -> Array:
    room = carry.log.length < LOG_CAPACITY - 4
    sound = carry.state.result == RESULTS.success
    return ~carry.done & room & sound & (carry.spent < BUDGET)


def _clip_step(t: Array, h: Array, t_stop: Array) -> tuple[Array, Array]:
    """Step that lands on `t_stop` without a sliver before it, and whether it lands."""
    left = t_stop - t
    lands = h >= left * (1.0 - 1e-9)
    return jnp.where(lands, left, jnp.where(h > 0.5 * left, 0.5 * left, h)), lands


def _row(scene: Scene, state: State, kind: int, h, order, error) -> Row:
    parts = energies(scene, state.x, state.v, state.p, state.t)
    monitor, count = state.monitor, state.counters
    return Row(
        kind, state.t, state.stage, h, monitor.ratios[0], jnp.mean(monitor.ratios), *parts,
        order, error, count.newton, count.linear, count.quasistatic, count.dynamic,
        jnp.sum(count.rejected),
    )  # fmt: skip


def _select(keep: Array, new, old):
    return jax.tree.map(lambda a, b: jnp.where(keep, a, b), new, old)


def _max_norm(a: Array) -> Array:
    return jnp.sqrt(jnp.max(jnp.sum(a * a, axis=1)))


def _quasistatic_stage(scene: Scene, carry: _Carry, t_stop: Array, solver: Hybrid) -> _Carry:
    """Run the quasistatic stage for as long as it lasts."""
    limit = explicit.stability_limit(scene, carry.state.x)

    def unfinished(carry: _Carry) -> Array:
        return _going(carry) & (carry.state.stage == QUASISTATIC)

    def body(carry: _Carry) -> _Carry:
        return _quasistatic_step(scene, carry, t_stop, solver, limit)

    return jax.lax.while_loop(unfinished, body, carry)


def _quasistatic_step(scene: Scene, carry: _Carry, t_stop: Array, solver: Hybrid, limit) -> _Carry:
    state = carry.state
    wanted = jnp.minimum(state.h, solver.max_step)
    # The step that aligns the velocity with the forces is as short as an explicit one.
    aligning = state.history.count == 0
    wanted = jnp.where(aligning, jnp.minimum(wanted, limit), wanted)
    h, lands = _clip_step(state.t, wanted, t_stop)
    tried = quasistatic.attempt(scene, state, h, solver.quasistatic, carry.factor)
    ratio = _max_norm(tried.v - state.v) / h / scene.reference_acceleration
    t = jnp.where(lands, t_stop, state.t + h)
    moved = eqx.tree_at(
        lambda s: (s.t, s.x, s.v, s.history, s.monitor),
        state,
        (
            t, tried.x, tried.v, push(state.history, h, tried.x, tried.p),
            observe(state.monitor, state.stage, ratio, h, solver.switch),
        ),
    )  # fmt: skip
    if state.p is not None:
        moved = eqx.tree_at(lambda s: s.p, moved, tried.p)
    moved = _select(tried.accepted, moved, state)
    suggested = quasistatic.next_step(tried, h)
    # A step shortened only to land on a given time must not make the next one short.
    held = tried.accepted & ((h < wanted) | aligning)
    suggested = jnp.where(held, jnp.maximum(suggested, state.h), suggested)
    moved = eqx.tree_at(lambda s: s.h, moved, jnp.where(jnp.isfinite(suggested), suggested, 0.1 * h))
    counters = _count(state.counters, QUASISTATIC, tried.accepted, tried.cause, tried.newton, tried.linear)
    moved = eqx.tree_at(lambda s: s.counters, moved, counters)
    row = _row(scene, moved, STEP, h, tried.order, tried.error)
    log = append(carry.log, row, tried.accepted)
    done = tried.accepted & lands
    if solver.switch.enabled:
        collapsed = ~tried.accepted & (moved.h < COLLAPSE * limit)
        asked = tried.accepted & wants_switch(moved.monitor, moved.stage, solver.switch)
        h_explicit = solver.explicit.safety * limit
        moved, log = _maybe_switch(scene, moved, log, asked | collapsed, DYNAMIC, h_explicit)
    else:
        lost = ~tried.accepted & (moved.h < SMALLEST_STEP * jnp.maximum(moved.t, 1.0))
        moved = _with_result(moved, lost, RESULTS.collapsed)
    return _Carry(moved, log, tried.factor, carry.spent + QUASISTATIC_COST, done)


def _count(counters: Counters, stage: int, accepted, cause, newton, linear) -> Counters:
    accepted = jnp.asarray(accepted, int)
    step = {QUASISTATIC: "quasistatic", DYNAMIC: "dynamic"}[stage]
    rejected = counters.rejected.at[jnp.maximum(cause, 0)].add(1 - accepted)
    counters = eqx.tree_at(
        lambda c: (c.rejected, c.newton, c.linear),
        counters,
        (rejected, counters.newton + newton, counters.linear + linear),
    )
    return eqx.tree_at(lambda c: getattr(c, step), counters, getattr(counters, step) + accepted)


def _maybe_switch(scene: Scene, state: State, log: Log, wanted, stage: int, h) -> tuple[State, Log]:
    """Hand over to `stage` with first step `h` if `wanted`, logging both sides."""

    def switch() -> tuple[State, Log]:
        before = append(log, _row(scene, state, BEFORE, h, 0, 0.0))
        switched = _switched(state, stage, h)
        return switched, append(before, _row(scene, switched, AFTER, h, 0, 0.0))

    return jax.lax.cond(wanted, switch, lambda: (state, log))


def _switched(state: State, stage: int, h: Array) -> State:
    """The state at the start of a stage; the quasistatic one starts a new history."""
    state = eqx.tree_at(
        lambda s: (s.stage, s.monitor, s.counters.switches),
        state,
        (jnp.asarray(stage), fresh_monitor(state.monitor), state.counters.switches + 1),
    )
    if stage == DYNAMIC:
        return eqx.tree_at(lambda s: s.h_explicit, state, h)
    history = restart_history(state.x, state.p)
    return eqx.tree_at(lambda s: (s.h, s.history), state, (h, history))


def _with_result(state: State, failed: Array, result: Any) -> State:
    return eqx.tree_at(lambda s: s.result, state, RESULTS.where(failed, result, state.result))


def _dynamic_stage(scene: Scene, carry: _Carry, t_stop: Array, solver: Hybrid) -> _Carry:
    """Run the dynamic stage for as long as it lasts."""
    cap = solver.explicit.safety * explicit.stability_limit(scene, carry.state.x)
    stages = explicit.first_stages(scene, carry.state)

    def unfinished(loop) -> Array:
        carry, *_ = loop
        return _going(carry) & (carry.state.stage == DYNAMIC)

    def body(loop):
        carry, stages, fresh = loop
        carry, stages, accepted = _dynamic_step(scene, carry, t_stop, solver, cap, stages, fresh)
        return carry, stages, fresh & ~accepted

    return jax.lax.while_loop(unfinished, body, (carry, stages, jnp.asarray(True)))[0]


def _dynamic_step(scene: Scene, carry: _Carry, t_stop, solver: Hybrid, cap, stages, fresh):
    state = carry.state
    started = state.h_explicit > 0
    wanted = jnp.minimum(jnp.where(started, jnp.minimum(state.h_explicit, cap), cap), solver.max_step)
    h, lands = _clip_step(state.t, wanted, t_stop)
    tried = explicit.attempt(scene, state, h, cap, stages, fresh, solver.explicit)
    stages = _select(tried.accepted, tried.stages, stages)
    acceleration = tried.acceleration
    ratio = _max_norm(acceleration) / scene.reference_acceleration
    moved = eqx.tree_at(
        lambda s: (s.t, s.x, s.v, s.monitor),
        state,
        (
            jnp.where(lands, t_stop, state.t + h), tried.x, tried.v,
            observe(state.monitor, state.stage, ratio, h, solver.switch),
        ),
    )  # fmt: skip
    if state.p is not None:
        moved = eqx.tree_at(lambda s: s.p, moved, tried.p)
    moved = _select(tried.accepted, moved, state)
    next_h = jnp.where(tried.accepted & (h < wanted), jnp.maximum(tried.next_h, wanted), tried.next_h)
    moved = eqx.tree_at(lambda s: s.h_explicit, moved, next_h)
    counters = _count(state.counters, DYNAMIC, tried.accepted, tried.cause, 0, 0)
    moved = eqx.tree_at(lambda s: s.counters, moved, counters)
    lost = ~tried.accepted & (next_h < SMALLEST_STEP * jnp.maximum(state.t, 1.0))
    moved = _with_result(moved, lost, RESULTS.collapsed)
    sampled = tried.accepted & (counters.dynamic % DYNAMIC_LOG_EVERY == 0)
    log = jax.lax.cond(
        sampled, lambda: append(carry.log, _row(scene, moved, STEP, h, 4, tried.error)), lambda: carry.log
    )
    asked = tried.accepted & wants_switch(moved.monitor, moved.stage, solver.switch)
    moved, log = _maybe_switch(scene, moved, log, asked, QUASISTATIC, solver.restart_steps * cap)
    done = tried.accepted & lands
    return _Carry(moved, log, carry.factor, carry.spent + DYNAMIC_COST, done), stages, tried.accepted
