"""Stamping: a ball presses a disc into a die (Fig. 7), and a plate presses a curved shell flat.

References: Hure, Roman & Bico, Phys. Rev. Lett. 109, 054302 (2012); for the shell, Tobasco et al.,
arXiv:2004.02839.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.model.walls import Ball, PiecewiseLinear, Plane, Sphere, of_time
from jaxcrumple.scenes.quantities import Length, Speed
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions, wrapped
from jaxcrumple.scenes.snap import check_gap, check_positive

UP = np.array([0.0, 0.0, 1.0])


@door
def stamping(
    nodes: int = 1000,
    seed: int = 0,
    *,
    radius: Length = 0.05,
    die: Length = 0.053,
    gap: Length = 5e-3,
    speed: Speed = 0.02,
    **options: Any,
) -> Setup:
    """Build a disc in a spherical die and a ball that presses it to the bottom.

    It is the stamping of Fig. 7 (Hure, Roman & Bico, Phys. Rev. Lett. 109 (2012) 054302). The ball descends
    until it is concentric with the die; the space between them is then the `gap`.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `radius` of the disc, `die`:
    radius of the die, `gap` in m; `speed` of the ball in m/s, without the initial clearance (the actual speed
    is slightly higher); `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or a speed that are not positive, a disc that does not fit into the
    die, or a gap of at most two thicknesses or at least the depth of the die under the disc.
    """
    check_positive(radius=radius, die=die, gap=gap, speed=speed)
    sheet = SheetOptions(**options)
    rim = radius + 2.0 * sheet.clearance
    # The rim starts at least one clearance from the die.
    inner = die - sheet.clearance - sheet.imperfection
    if die < rim or inner < radius:
        least = max(rim, radius + die - inner)
        raise ValueError(
            f"die = {die} m has no room for a disc of {radius} m; choose at least {least:.4g} m."
        )
    deepest = die - math.sqrt(die**2 - radius**2)
    check_gap(gap, sheet.thickness, deepest, "the depth of the die under the disc")
    mesh = sheet.disc(radius, nodes, seed)
    depth = min(math.sqrt(die**2 - rim**2), math.sqrt(inner**2 - radius**2))
    x = mesh.vertices - np.array([0.0, 0.0, depth])
    ball = die - gap
    start = ball - depth + sheet.clearance + sheet.imperfection
    time = stamping_time(die, radius, gap, speed)
    way = PiecewiseLinear(jnp.array([0.0, time]), jnp.array([start, 0.0]))
    walls = [Sphere(jnp.zeros(3), of_time(die)), Ball(jnp.zeros(3), as_float(UP), as_float(ball), way)]
    return sheet.setup(mesh, walls, x=x)


def stamping_time(die: float, radius: float, gap: float, speed: float) -> float:
    """Return the time in s at which the ball reaches the bottom."""
    return (die - gap - math.sqrt(max(die**2 - radius**2, 0.0))) / speed


@door
def shell(
    nodes: int = 1000,
    seed: int = 0,
    *,
    radius: Length = 0.05,
    curvature_radius: Length = 0.06,
    gap: Length = 2e-3,
    speed: Speed = 0.02,
    **options: Any,
) -> Setup:
    """Build a shell, a spherical cap at rest, that two plates press flat.

    It wrinkles as in Tobasco et al., arXiv:2004.02839.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `radius`: arc length from
    apex to rim, `curvature_radius` of the sphere, final `gap` between the plates in m; `speed` of the upper
    plate in m/s, without the initial clearance (the actual speed is slightly higher); `options` of the sheet:
    `SheetOptions`.

    **Raises:** ValueError for lengths or a speed that are not positive, a shell of more than half a sphere,
    or a gap of at most two thicknesses or at least the height of the shell.
    """
    check_positive(radius=radius, curvature_radius=curvature_radius, gap=gap, speed=speed)
    sheet = SheetOptions(**options)
    if radius > 0.5 * math.pi * curvature_radius:
        raise ValueError(
            f"curvature_radius = {curvature_radius} m makes a shell of {radius} m more than half of a ball; "
            f"choose at least {2.0 * radius / math.pi:.4g} m."
        )
    rise = curvature_radius * (1.0 - math.cos(radius / curvature_radius))
    check_gap(gap, sheet.thickness, rise, "the height of the shell")
    flat = sheet.disc(radius, nodes, seed)
    mesh = flat.with_rest_shape(wrapped(flat.vertices, curvature_radius))
    low, high = mesh.vertices[:, 2].min() - sheet.clearance, mesh.vertices[:, 2].max() + sheet.clearance
    time = shell_time(radius, curvature_radius, gap, speed)
    plate = PiecewiseLinear(jnp.array([0.0, time]), jnp.array([-high, -(low + gap)]))
    return sheet.setup(mesh, [Plane(as_float(UP), of_time(low)), Plane(as_float(-UP), plate)])


def shell_time(radius: float, curvature_radius: float, gap: float, speed: float) -> float:
    """Return the time in s at which the shell is flat."""
    return (curvature_radius * (1.0 - math.cos(radius / curvature_radius)) - gap) / speed
