"""When to change the representation: the acceleration monitor (Section 3.4)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.system import QUASISTATIC, Monitor


class Switch(eqx.Module):
    """Thresholds on the mean of the last a_max/a_ref (the window's length is the state's).

    - `up`: above it the quasistatic stage hands over to a stage with inertia.
    - `down`: below it that stage hands back.
    - `ignore`: quasistatic steps after a restart whose ratios do not count (the start at low order
      makes a spurious peak).
    - `minimum_steps`: quasistatic steps before the monitor may switch (the paper's rule).
    - `dwell`: seconds a stage with inertia lasts at least. At its start forces balance by construction,
      so a small acceleration proves nothing until inertia had its time (m/b_iso).
    """

    up: Array | float = eqx.field(default=1e-5, converter=jnp.asarray)
    down: Array | float = eqx.field(default=3e-6, converter=jnp.asarray)
    dwell: Array | float = eqx.field(default=1e-3, converter=jnp.asarray)
    ignore: Array | float = eqx.field(default=5, converter=jnp.asarray)
    minimum_steps: Array | float = eqx.field(default=10, converter=jnp.asarray)


def observe(monitor: Monitor, stage: Array, ratio: Array, h: Array, switch: Switch) -> Monitor:
    """Monitor after an accepted step of size `h` with acceleration `ratio` a_max/a_ref."""
    counted = (stage != QUASISTATIC) | (monitor.steps >= switch.ignore)
    ratio = jnp.where(counted, ratio, 0.0)
    ratios = jnp.concatenate([ratio[None], monitor.ratios[:-1]])
    return Monitor(ratios, monitor.steps + 1, monitor.since + h)


def fresh_monitor(monitor: Monitor) -> Monitor:
    """Monitor at the start of a stage."""
    return jax.tree.map(jnp.zeros_like, monitor)


def wants_inertia(monitor: Monitor, switch: Switch) -> Array:
    """Whether the accelerations of a quasistatic stage call for inertia."""
    return (jnp.mean(monitor.ratios) > switch.up) & (monitor.steps >= switch.minimum_steps)


def has_settled(monitor: Monitor, switch: Switch) -> Array:
    """Whether a stage with inertia no longer needs it."""
    calm = jnp.mean(monitor.ratios) < switch.down
    return calm & (monitor.steps >= monitor.ratios.shape[0]) & (monitor.since >= switch.dwell)
