"""The acceleration monitor: criteria for changes between stages with and without inertia (Section 3.4)."""

from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.arrays import Count, Flag, NodeVectors, Scalar
from jaxcrumple._jax.tree import as_float, is_known
from jaxcrumple.geometry.hinge import longest
from jaxcrumple.scene import Scene
from jaxcrumple.state import IMPLICIT, QUASISTATIC, Monitor

Measure = Literal["displacement", "acceleration"]


class Switch(eqx.Module):
    """Set thresholds on the mean of the last accelerations. The state sets the length of this window.

    - `up`: above it, the quasistatic stage hands over to a stage with inertia.
    - `down`: below it, the stage with inertia hands back. `integrator` sets `up` = 3 rtol and `down` = rtol,
      so that the error of neglected inertia vanishes with the tolerance. The defaults are those of
      rtol = 1e-4.
    - `ignore`: number of quasistatic steps after a restart whose accelerations do not count. In these steps
      the velocity jumps to balance the forces, and low order causes a spurious peak.
    - `minimum_steps`: quasistatic steps before the monitor may switch (the paper's rule).
    - `dwell`: time, in units of m/b_iso, that an implicit stage with inertia must stay below `down` before it
      hands back. The forces balance at its start by construction, and a vibration rests twice a period.
    - `measure`: "displacement" compares the thresholds with a_max (m / b_iso)^2 / sqrt(A), the relative
      position error of neglected inertia. "acceleration" uses the paper's a_max / a_ref (section 3.4); its
      unit a_ref is set by stretching and grows with the number of nodes.

    **Raises:** ValueError for an unknown measure, a negative number, or `down` above `up`.
    """

    up: Scalar | float = eqx.field(default=3e-4, converter=as_float)
    down: Scalar | float = eqx.field(default=1e-4, converter=as_float)
    dwell: Scalar | float = eqx.field(default=1.0, converter=as_float)
    ignore: Scalar | float = eqx.field(default=5, converter=as_float)
    minimum_steps: Scalar | float = eqx.field(default=10, converter=as_float)
    measure: Measure = eqx.field(static=True, default="displacement")

    def __check_init__(self) -> None:
        if self.measure not in get_args(Measure):
            known = ", ".join(get_args(Measure))
            raise ValueError(f"measure={self.measure!r} is unknown; choose one of {known}.")
        for name in ("up", "down", "dwell", "ignore", "minimum_steps"):
            value = getattr(self, name)
            if is_known(value) and not np.all(np.asarray(value) >= 0):
                raise ValueError(f"{name} = {value} of a Switch must be zero or positive.")
        if is_known(self.up, self.down) and np.any(np.asarray(self.down) > np.asarray(self.up)):
            raise ValueError(
                f"down = {self.down} lies above up = {self.up}: a stage would end as soon as it began."
            )

    def value(
        self,
        ratio: Scalar | float,
        reference_acceleration: Scalar | float,
        inertial_time: Scalar | float,
        length_scale: Scalar | float,
    ) -> Any:
        """Convert a `ratio` a_max / a_ref to the measure of the thresholds.

        **Arguments:** scales of a `Scene`: `reference_acceleration` in m/s2, `inertial_time` in s,
        `length_scale` in m.
        """
        if self.measure == "acceleration":
            return ratio
        return ratio * reference_acceleration * inertial_time**2 / length_scale

    def measured(self, scene: Scene, monitor: Monitor) -> Scalar:
        """Return the mean of the `monitor` of a `State`, in the measure of the thresholds."""
        scales = scene.reference_acceleration, scene.inertial_time, scene.length_scale
        return self.value(jnp.mean(monitor.ratios), *scales)


def observe(
    scene: Scene, monitor: Monitor, stage: Count, acceleration: NodeVectors, h: Scalar, switch: Switch
) -> Monitor:
    """Update the monitor after an accepted step of size `h` s with `acceleration` (n, 3) in m/s2."""
    counted = (stage != QUASISTATIC) | (monitor.steps >= switch.ignore)
    ratio = jnp.where(counted, longest(acceleration) / scene.reference_acceleration, 0.0)
    ratios = jnp.concatenate([ratio[None], monitor.ratios[:-1]])
    seen = Monitor(ratios, monitor.steps + 1, monitor.since + h, jnp.asarray(False), monitor.futile)
    restless = (stage == IMPLICIT) & (switch.measured(scene, seen) >= switch.down)
    return eqx.tree_at(lambda m: m.since, seen, jnp.where(restless, 0.0, seen.since))


def wants_inertia(scene: Scene, monitor: Monitor, switch: Switch) -> Flag:
    """Return whether the accelerations of a quasistatic stage require inertia."""
    return (switch.measured(scene, monitor) > switch.up) & (monitor.steps >= switch.minimum_steps)


def has_settled(scene: Scene, monitor: Monitor, switch: Switch) -> Flag:
    """Return whether a stage with inertia no longer needs it."""
    calm = switch.measured(scene, monitor) < switch.down
    lasted = monitor.since >= switch.dwell * jnp.where(switch.dwell > 0, scene.inertial_time, 0.0)
    return calm & (monitor.steps >= monitor.ratios.shape[0]) & lasted
