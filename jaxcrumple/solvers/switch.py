"""When to change the representation: the acceleration monitor (Section 3.4)."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from jaxcrumple.model.scene import Scene
from jaxcrumple.system import IMPLICIT, QUASISTATIC, Monitor


class Switch(eqx.Module):
    """Thresholds on the mean of the last accelerations (the window's length is the state's).

    - `up`: above it the quasistatic stage hands over to a stage with inertia.
    - `down`: below it that stage hands back.
    - `ignore`: quasistatic steps after a restart whose accelerations do not count (the velocity jumps to
      the one that balances the forces, and low order makes a spurious peak).
    - `minimum_steps`: quasistatic steps before the monitor may switch (the paper's rule).
    - `dwell`: inertial times m/b_iso that an implicit stage with inertia stays below `down` before it
      hands back. At its start forces balance by construction, and a vibration rests twice a period.
    - `measure`: "displacement" compares $a_{max} (m/b_{iso})^2 / \\sqrt A$, which is how far off
      positions get where inertia is left out, with the thresholds; "acceleration" the paper's
      $a_{max}/a_{ref}$, whose unit is that of stretching and grows with the number of nodes.
    """

    up: Array | float = eqx.field(default=0.03, converter=jnp.asarray)
    down: Array | float = eqx.field(default=0.01, converter=jnp.asarray)
    dwell: Array | float = eqx.field(default=1.0, converter=jnp.asarray)
    ignore: Array | float = eqx.field(default=5, converter=jnp.asarray)
    minimum_steps: Array | float = eqx.field(default=10, converter=jnp.asarray)
    measure: Literal["displacement", "acceleration"] = eqx.field(static=True, default="displacement")

    def measured(self, scene: Scene, monitor: Monitor) -> Array:
        """What the thresholds are compared with."""
        mean = jnp.mean(monitor.ratios)
        if self.measure == "acceleration":
            return mean
        return mean * scene.reference_acceleration * scene.inertial_time**2 / scene.length_scale


def observe(
    scene: Scene, monitor: Monitor, stage: Array, acceleration: Array, h: Array, switch: Switch
) -> Monitor:
    """Monitor after an accepted step of size `h` with `acceleration` (n, 3)."""
    largest = jnp.sqrt(jnp.max(jnp.sum(acceleration * acceleration, axis=1)))
    counted = (stage != QUASISTATIC) | (monitor.steps >= switch.ignore)
    ratio = jnp.where(counted, largest / scene.reference_acceleration, 0.0)
    ratios = jnp.concatenate([ratio[None], monitor.ratios[:-1]])
    seen = Monitor(ratios, monitor.steps + 1, monitor.since + h)
    restless = (stage == IMPLICIT) & (switch.measured(scene, seen) >= switch.down)
    return eqx.tree_at(lambda m: m.since, seen, jnp.where(restless, 0.0, seen.since))


def fresh_monitor(monitor: Monitor) -> Monitor:
    """Monitor at the start of a stage."""
    return jax.tree.map(jnp.zeros_like, monitor)


def wants_inertia(scene: Scene, monitor: Monitor, switch: Switch) -> Array:
    """Whether the accelerations of a quasistatic stage call for inertia."""
    return (switch.measured(scene, monitor) > switch.up) & (monitor.steps >= switch.minimum_steps)


def has_settled(scene: Scene, monitor: Monitor, switch: Switch) -> Array:
    """Whether a stage with inertia no longer needs it."""
    calm = switch.measured(scene, monitor) < switch.down
    lasted = monitor.since >= switch.dwell * jnp.where(switch.dwell > 0, scene.inertial_time, 0.0)
    return calm & (monitor.steps >= monitor.ratios.shape[0]) & lasted
