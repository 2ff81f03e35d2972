"""The record of steps that a traced integration keeps for its caller."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

# Kinds of rows: an accepted step, the last state of a stage, the first state of the next.
STEP, BEFORE, AFTER = 0, 1, 2
ENERGIES = ("stretch", "bending", "contact", "confinement", "gravity", "extra", "kinetic")
# Columns of `events.csv`: a change of stage, with energies in J before and after it.
EVENT_COLUMNS = (
    "t", "origin", "to", "acceleration_mean", "h",
    *(f"{name}_{side}" for side in ("before", "after") for name in ENERGIES),
)  # fmt: skip


class Row(NamedTuple):
    """One line of `history.csv`; energies and work in J, times in s, counts and work since the start of the
    run."""

    kind: Array | int
    t: Array
    stage: Array
    h: Array
    acceleration: Array
    acceleration_mean: Array
    stretch: Array
    bending: Array
    contact: Array
    confinement: Array
    gravity: Array
    extra: Array
    kinetic: Array
    order: Array | int
    error: Array | float
    newton_iterations: Array
    linear_iterations: Array
    factors: Array
    quasistatic_steps: Array
    implicit_steps: Array
    explicit_steps: Array
    rejected_steps: Array
    work_walls: Array
    work_supports: Array
    work_drag: Array
    work_damping: Array
    work_plastic: Array
    work_numerical: Array


class Trail(NamedTuple):
    """Accepted steps in order, the first `length` of them valid: `x` (capacity, n, 3) m and `t` s at their
    ends, their size `h` s, `stage` and `order` (capacity,)."""

    x: Array
    t: Array
    h: Array
    stage: Array
    order: Array
    length: Array

    @property
    def full(self) -> Array:
        """Whether there is no room for another step."""
        return self.length >= self.t.shape[0]


class Log(NamedTuple):
    """Rows (capacity, columns), the first `length` of them valid, and the trail, where one is wanted."""

    rows: Array
    length: Array
    trail: Trail | None = None

    @property
    def capacity(self) -> int:
        """Rows that fit."""
        return self.rows.shape[0]


def empty_log(capacity: int, nodes: int = 0, steps: int = 0) -> Log:
    """A log without rows, with a trail of a sheet of `nodes` with room for `steps`, if any."""
    zero = jnp.asarray(0)
    trail = None
    if steps:
        none, number = jnp.zeros(steps, int), jnp.zeros(steps)
        trail = Trail(jnp.zeros((steps, nodes, 3)), number, number, none, none, zero)
    return Log(jnp.zeros((capacity, len(Row._fields))), zero, trail)


def append(log: Log, row: Row, wanted: Array | bool = True) -> Log:
    """Log with `row` added, or unchanged unless `wanted`."""
    values = jnp.stack([jnp.asarray(value, log.rows.dtype) for value in row])
    index = jnp.where(wanted, log.length, log.capacity)
    rows = log.rows.at[index].set(values, mode="drop")
    return log._replace(rows=rows, length=log.length + jnp.asarray(wanted, int))


def follow(log: Log, x: Array, t: Array, h: Array, stage: Array, order: Array | int, accepted: Array) -> Log:
    """Log with a step in its trail, if it has one and the step is `accepted`."""
    trail = log.trail
    if trail is None:
        return log
    at = jnp.where(accepted, trail.length, trail.t.shape[0])
    step = {"x": x, "t": t, "h": h, "stage": stage, "order": order}
    moved = {name: getattr(trail, name).at[at].set(value, mode="drop") for name, value in step.items()}
    return log._replace(trail=Trail(**moved, length=trail.length + jnp.asarray(accepted, int)))
