"""When to change the representation: the acceleration monitor (Section 3.4)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.system import DYNAMIC, QUASISTATIC, Monitor


class Switch(eqx.Module):
    """Thresholds on the mean of the last a_max/a_ref (the window's length is the state's).

    - `up`: above it the quasistatic stage hands over to the dynamic one.
    - `down`: below it the dynamic stage hands back.
    - `ignore`: quasistatic steps after a restart whose ratios do not count (the start at low order
      makes a spurious peak).
    - `minimum_steps`: quasistatic steps before the monitor may switch (the paper's rule).
    - `dwell`: seconds the dynamic stage lasts at least. At its start forces balance by construction,
      so a small acceleration proves nothing until inertia had its time (m/b_iso).
    - `enabled`: False keeps the run quasistatic; a step that collapses then ends it.
    """

    up: Array | float = eqx.field(default=1e-5, converter=jnp.asarray)
    down: Array | float = eqx.field(default=3e-6, converter=jnp.asarray)
    dwell: Array | float = eqx.field(default=1e-3, converter=jnp.asarray)
    ignore: Array | float = eqx.field(default=5, converter=jnp.asarray)
    minimum_steps: Array | float = eqx.field(default=10, converter=jnp.asarray)
    enabled: bool = eqx.field(static=True, default=True)


def observe(monitor: Monitor, stage: Array, ratio: Array, h: Array, switch: Switch) -> Monitor:
    """Monitor after an accepted step of size `h` with acceleration `ratio` a_max/a_ref."""
    counted = (stage == DYNAMIC) | (monitor.steps >= switch.ignore)
    ratio = jnp.where(counted, ratio, 0.0)
    ratios = jnp.concatenate([ratio[None], monitor.ratios[:-1]])
    return Monitor(ratios, monitor.steps + 1, monitor.since + h)


def fresh_monitor(monitor: Monitor) -> Monitor:
    """Monitor at the start of a stage."""
    return jax.tree.map(jnp.zeros_like, monitor)


def wants_switch(monitor: Monitor, stage: Array, switch: Switch) -> Array:
    """Whether the monitor calls for the other stage."""
    if not switch.enabled:
        return jnp.asarray(False)
    mean = jnp.mean(monitor.ratios)
    up = (stage == QUASISTATIC) & (mean > switch.up) & (monitor.steps >= switch.minimum_steps)
    window = monitor.ratios.shape[0]
    settled = (mean < switch.down) & (monitor.steps >= window) & (monitor.since >= switch.dwell)
    return up | ((stage == DYNAMIC) & settled)
