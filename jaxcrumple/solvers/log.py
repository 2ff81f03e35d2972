"""The log of steps that the traced `integrate` returns."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import Count, Flag, NodeVectors, Scalar
from jaxcrumple.state import Work
from jaxcrumple.system import Energies

# Kinds of rows: an accepted step, the last state of a stage, the first state of the next.
STEP, BEFORE, AFTER = 0, 1, 2
ENERGIES = Energies._fields
# Columns of `events.csv`: a change of stage, with energies in J before and after it.
EVENT_COLUMNS = (
    "t", "origin", "to", "acceleration_mean", "h",
    *(f"{name}_{side}" for side in ("before", "after") for name in ENERGIES),
)  # fmt: skip


class Row(NamedTuple):
    """Hold one line of `history.csv`: energies and work in J, times in s.

    Counts and work are totals since the start of the run. The columns are `COLUMNS`."""

    kind: Count | int
    t: Scalar
    stage: Count
    h: Scalar
    acceleration: Scalar
    acceleration_mean: Scalar
    energies: Energies
    order: Count | int
    error: Scalar | float
    newton_iterations: Count
    linear_iterations: Count
    factors: Count
    quasistatic_steps: Count
    implicit_steps: Count
    explicit_steps: Count
    rejected_steps: Count
    work: Work


_NESTED = {"energies": ENERGIES, "work": tuple(f"work_{name}" for name in Work._fields)}
#: Names of the numbers of a `Row`, in order.
COLUMNS = tuple(column for name in Row._fields for column in _NESTED.get(name, (name,)))


class Trail(NamedTuple):
    """Hold accepted steps in order; the first `length` entries are valid.

    `x` (capacity, n, 3) m and `t` s at the end of each step, its size `h` s, `stage` and `order`
    (capacity,)."""

    x: Float[Array, "capacity nodes 3"]
    t: Float[Array, " capacity"]
    h: Float[Array, " capacity"]
    stage: Int[Array, " capacity"]
    order: Int[Array, " capacity"]
    length: Count

    @property
    def full(self) -> Flag:
        """Return whether there is no room for another step."""
        return self.length >= self.t.shape[0]


class Log(NamedTuple):
    """Hold rows (capacity, columns), of which the first `length` are valid, and a trail or None."""

    rows: Float[Array, "capacity columns"]
    length: Count
    trail: Trail | None = None

    @property
    def capacity(self) -> int:
        """Return the largest number of rows."""
        return self.rows.shape[0]


def empty_log(capacity: int, nodes: int = 0, steps: int = 0) -> Log:
    """Build a log without rows, with a trail for `steps` steps of a sheet of `nodes` nodes (none if 0)."""
    zero = jnp.asarray(0)
    trail = None
    if steps:
        none, number = jnp.zeros(steps, int), jnp.zeros(steps)
        trail = Trail(jnp.zeros((steps, nodes, 3)), number, number, none, none, zero)
    return Log(jnp.zeros((capacity, len(COLUMNS))), zero, trail)


def append(log: Log, row: Row, wanted: Flag | bool = True) -> Log:
    """Append `row` to the log if `wanted`."""
    values = jnp.stack([jnp.asarray(value, log.rows.dtype) for value in jax.tree.leaves(row)])
    index = jnp.where(wanted, log.length, log.capacity)
    rows = log.rows.at[index].set(values, mode="drop")
    return log._replace(rows=rows, length=log.length + jnp.asarray(wanted, int))


def follow(
    log: Log, x: NodeVectors, t: Scalar, h: Scalar, stage: Count, order: Count | int, accepted: Flag
) -> Log:
    """Append a step to the trail of the log, if it has a trail and the step is `accepted`."""
    trail = log.trail
    if trail is None:
        return log
    at = jnp.where(accepted, trail.length, trail.t.shape[0])
    step = {"x": x, "t": t, "h": h, "stage": stage, "order": order}
    moved = {name: getattr(trail, name).at[at].set(value, mode="drop") for name, value in step.items()}
    return log._replace(trail=Trail(**moved, length=trail.length + jnp.asarray(accepted, int)))
