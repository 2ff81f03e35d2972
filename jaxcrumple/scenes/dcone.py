"""A developable cone: a disc whose middle is pushed into a hollow cone (Cerda & Mahadevan 1998, 2005).

It touches the cone everywhere but in one sector, where it bends away. For shallow cones the angle of that
sector depends on nothing and is about 139 degrees.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.mesh.mesh import FloatArray
from jaxcrumple.model.loads import LinearMotion, Prescribed
from jaxcrumple.model.walls import Cone, Corners
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions
from jaxcrumple.scenes.snap import check_positive

# Ring, as shares of the disc's radius, in which the sector is measured.
RING = (0.5, 0.9)


@door
def dcone(
    nodes: int = 2000,
    seed: int = 0,
    *,
    radius: float = 0.05,
    slope: float = 0.1,
    speed: float = 0.02,
    **options: Any,
) -> Setup:
    """A disc whose middle is held while a hollow cone comes up around it.

    **Arguments:** `nodes` of the random mesh made with `seed`; `radius` of the disc in m; `slope` of the
    cone's side; `speed` of the cone in m/s; `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for a radius, a slope or a speed that is not positive.
    """
    check_positive(radius=radius, slope=slope, speed=speed)
    sheet = SheetOptions(**options)
    mesh = sheet.disc(radius, nodes, seed)
    tilt = math.atan(slope)
    # At last the middle is as far from the tip as where the cone is not felt any more.
    lowest = -(sheet.clearance + sheet.imperfection + radius * math.sin(tilt)) / math.cos(tilt)
    highest = -sheet.thickness / math.cos(tilt)
    tip = Corners(jnp.array([0.0, (highest - lowest) / speed]), jnp.array([lowest, highest]))
    cone = Cone(jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]), as_float(0.5 * math.pi - tilt), tip)
    middle = int(np.argmin(np.linalg.norm(mesh.vertices[:, :2], axis=1)))
    held = np.zeros((mesh.n_nodes, 3), bool)
    held[middle] = True
    motion = LinearMotion(jnp.asarray(mesh.vertices), jnp.zeros(3))
    return sheet.setup(mesh, [cone], prescribed=Prescribed(jnp.asarray(held), motion))


def dcone_time(radius: float, slope: float, speed: float) -> float:
    """Time in s after which the cone has come up, for a thin sheet."""
    return radius * slope / speed


@door
def free_sector(setup: Setup, x: FloatArray, t: float) -> float:
    """Angle in rad of the sector in which a d-cone is off its cone, at positions `x` (n, 3) in m and time
    `t`.

    A line of heights over the cone as a share of the distance from the middle, against the angle around it,
    leaves zero as the cube of the angle at both ends of the sector, for the force there is concentrated; the
    ends are fitted, with the next power of the angle, since any threshold of the height would miss them by
    its cube root.
    """
    flat = np.linalg.norm(setup.mesh.vertices[:, :2], axis=1)
    share = flat / flat.max()
    ring = (share > RING[0]) & (share < RING[1])
    gap = np.asarray(setup.scene.walls[0].gap(jnp.asarray(x), as_float(t)))[ring]
    angle = np.arctan2(x[ring, 1], x[ring, 0])
    lifted = (gap - np.quantile(gap, 0.25)) / flat[ring]
    middle = np.angle(np.sum(lifted * np.exp(1j * angle)))
    from_middle = np.angle(np.exp(1j * (angle - middle)))
    return sum(_end(sign * from_middle, lifted) for sign in (-1.0, 1.0))


def _end(angle: FloatArray, lifted: FloatArray) -> float:
    """Angle at which one side of the sector ends."""
    used = (angle > 0) & (lifted < 0.3 * lifted.max())

    def misfit(guess: FloatArray) -> FloatArray:
        end, steep, bend, floor = guess
        inside = np.maximum(end - angle[used], 0.0)
        return inside**3 * (steep + bend * inside) + floor - lifted[used]

    size = lifted.max()
    found = least_squares(misfit, [1.2, size, 0.0, 0.0], x_scale=[1.0, size, size, size])
    return float(found.x[0])
