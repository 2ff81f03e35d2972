"""The record of steps that a traced integration keeps for its caller."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

# Kinds of rows: an accepted step, the last state of a stage, the first state of the next.
STEP, BEFORE, AFTER = 0, 1, 2


class Row(NamedTuple):
    """One line of `history.csv`; energies in J, times in s, counts since the start of the run."""

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


class Log(NamedTuple):
    """Rows (capacity, columns), the first `length` of them valid."""

    rows: Array
    length: Array

    @property
    def capacity(self) -> int:
        """Rows that fit."""
        return self.rows.shape[0]


def empty_log(capacity: int) -> Log:
    """A log without rows."""
    return Log(jnp.zeros((capacity, len(Row._fields))), jnp.asarray(0))


def append(log: Log, row: Row, wanted: Array | bool = True) -> Log:
    """Log with `row` added, or unchanged unless `wanted`."""
    values = jnp.stack([jnp.asarray(value, log.rows.dtype) for value in row])
    index = jnp.where(wanted, log.length, log.capacity)
    return Log(log.rows.at[index].set(values, mode="drop"), log.length + jnp.asarray(wanted, int))
