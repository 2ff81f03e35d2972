"""Radial confinement: a square sheet in a sphere that shrinks (Figs. 5, 6, 8) and may expand again."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.model.walls import PiecewiseLinear, Ramp, Sphere
from jaxcrumple.scenes.quantities import Duration, Length, Speed
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions
from jaxcrumple.scenes.snap import check_positive


@door
def radial(
    nodes: int = 1000,
    seed: int = 0,
    *,
    size: Length = 0.1,
    radius: Length = 0.071,
    speed: Speed = 0.01,
    hold: Duration | None = None,
    **options: Any,
) -> Setup:
    """Build a square sheet in a sphere that shrinks at constant speed.

    It is the radial confinement of Figs. 5, 6 and 8.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `size`: edge of the sheet,
    `radius`: initial radius of the sphere in m; `speed` in m/s; `hold`: time in s at which the sphere stops;
    `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or a speed that are not positive, a sheet that does not fit, or a
    `hold` later than the time of zero radius.

    >>> setup = jc.radial(60, speed=0.02, contact=None)  # a phantom sheet, which passes through itself
    >>> print(setup.x.shape, f"{setup.scene.walls[0].shape.radius(1.0):.3f} m")  # after 1 s
    (60, 3) 0.051 m
    """
    check_positive(size=size, radius=radius, speed=speed)
    if hold is not None and not 0 < hold * speed < radius:
        raise ValueError(
            f"hold = {hold!r} s must be a time between 0 and {radius / speed:g} s, when the sphere has "
            "zero radius."
        )
    _check_fits(size, radius)
    until = np.inf if hold is None else hold
    wall = Sphere(jnp.zeros(3), Ramp(as_float(radius), as_float(-speed), as_float(until)))
    sheet = SheetOptions(**options)
    return sheet.setup(sheet.square(size, nodes, seed), [wall])


@door
def unload(
    nodes: int = 1000,
    seed: int = 0,
    *,
    size: Length = 0.1,
    radius: Length = 0.071,
    least: Length = 0.045,
    speed: Speed = 0.01,
    hold: Duration = 0.1,
    **options: Any,
) -> Setup:
    """Build a square sheet in a sphere that shrinks, rests and expands again.

    The sphere shrinks from `radius` to `least` at `speed`, rests for the time `hold`, and expands at the same
    speed. The scene shows the hysteresis of the wall force and the springback of the sheet.

    **Arguments:** `least`: smallest radius in m; `hold`: time in s at that radius; `size`, `radius`, `speed`
    and `options` as in `radial`.

    **Raises:** ValueError for lengths, a speed or a time that are not positive, `least` >= `radius`, or a
    sheet that does not fit.
    """
    check_positive(size=size, radius=radius, least=least, speed=speed, hold=hold)
    if least >= radius:
        raise ValueError(f"least = {least} m must be less than the radius {radius} m at the start.")
    _check_fits(size, radius)
    way = (radius - least) / speed
    moments = [0.0, way, way + hold, 2.0 * way + hold]
    wall = Sphere(
        jnp.zeros(3), PiecewiseLinear(jnp.array(moments), jnp.array([radius, least, least, radius]))
    )
    sheet = SheetOptions(**options)
    return sheet.setup(sheet.square(size, nodes, seed), [wall])


def _check_fits(size: float, radius: float) -> None:
    if radius < size / np.sqrt(2.0):
        raise ValueError(
            f"radius = {radius} m leaves the corners of a sheet of size {size} m outside; "
            f"choose at least {size / np.sqrt(2.0):.4g} m."
        )
