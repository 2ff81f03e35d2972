"""Developable cone: a disc pushed into a hollow cone at its middle (Cerda & Mahadevan 1998, 2005).

The disc touches the cone everywhere except in one sector, where it bends away. For shallow cones the angle of
that sector is universal, about 139 degrees.
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float, require_shape
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.loads import LinearMotion, Prescribed
from jaxcrumple.model.walls import Cone, PiecewiseLinear
from jaxcrumple.scenes.quantities import Length, Slope, Speed
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions
from jaxcrumple.scenes.snap import check_positive

# Inner and outer radius of the ring in which the sector is measured, in units of the disc radius.
RING = (0.5, 0.9)


@door
def dcone(
    nodes: int = 2000,
    seed: int = 0,
    *,
    radius: Length = 0.05,
    slope: Slope = 0.1,
    speed: Speed = 0.02,
    **options: Any,
) -> Setup:
    """Build a disc that is held at its middle while a hollow cone rises around it.

    It bends to a developable cone (Cerda & Mahadevan, Phys. Rev. Lett. 80 (1998) 2358). `free_sector`
    measures its angle, in the equilibrium that `relax` finds: at its end time the sheet still moves.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `radius` of the disc in m;
    `slope` of the cone's side; `speed` of the cone in m/s; `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for a radius, a slope or a speed that is not positive.
    """
    check_positive(radius=radius, slope=slope, speed=speed)
    sheet = SheetOptions(**options)
    mesh = _around_a_node(sheet.disc(radius, nodes, seed))
    tilt = math.atan(slope)
    # The middle node lies within a node distance of the disc's centre, and within the imperfection.
    reach = radius * (1.0 + math.sqrt(2.0 * math.pi / (math.sqrt(3.0) * nodes)))
    depth = 2.0 * sheet.imperfection
    # In the end the middle is just outside the range of the cone, one thickness from its side.
    lowest = -(sheet.clearance + depth + reach * math.sin(tilt)) / math.cos(tilt)
    highest = -sheet.thickness / math.cos(tilt)
    tip = PiecewiseLinear(jnp.array([0.0, (highest - lowest) / speed]), jnp.array([lowest, highest]))
    cone = Cone(jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]), as_float(0.5 * math.pi - tilt), tip)
    held = np.repeat(~np.any(mesh.vertices, axis=1)[:, None], 3, axis=1)
    motion = LinearMotion(jnp.asarray(mesh.vertices), jnp.zeros(3))
    return sheet.setup(mesh, [cone], prescribed=Prescribed(jnp.asarray(held), motion))


def _around_a_node(mesh: Mesh) -> Mesh:
    """Return the mesh with its middle node at the origin.

    Beside the axis of the cone, the node would be nearer to the side of the cone than at its tip.
    """
    middle = np.argmin(np.linalg.norm(mesh.vertices[:, :2], axis=1))
    return mesh.with_rest_shape(mesh.vertices - mesh.vertices[middle])


def dcone_time(radius: float, slope: float, speed: float) -> float:
    """Return the time in s at which the cone stops rising, for a thin sheet."""
    return radius * slope / speed


@door
def free_sector(setup: Setup, x: NodeVectorsLike, t: float) -> float:
    """Return the angle in rad of the sector in which a d-cone is off its cone.

    For a shallow cone it is about 139 degrees (Cerda & Mahadevan, Proc. R. Soc. A 461 (2005) 671). The
    relative height is the height over the cone divided by the distance from the middle. At both ends of the
    sector it grows as the cube of the angle, since the force there is concentrated. A fit with the third and
    fourth powers of the angle finds the ends. A threshold of the height would miss them by its cube root.

    **Arguments:** `setup`: of `dcone`; `x` (n, 3): positions in m; `t`: time in s.

    **Raises:** ValueError for a wrong shape of `x`, or a sheet without such a sector.
    """
    require_shape("x", x, (setup.mesh.n_nodes, 3))
    x = np.asarray(x)
    flat = np.linalg.norm(setup.mesh.vertices[:, :2], axis=1)
    share = flat / flat.max()
    ring = (share > RING[0]) & (share < RING[1])
    gap = np.asarray(setup.scene.walls[0].gap(jnp.asarray(x), as_float(t)))[ring]
    angle = np.arctan2(x[ring, 1], x[ring, 0])
    lifted = (gap - np.quantile(gap, 0.25)) / flat[ring]
    middle = np.angle(np.sum(lifted * np.exp(1j * angle)))
    from_middle = np.angle(np.exp(1j * (angle - middle)))
    ends = [_end(sign * from_middle, lifted) for sign in (-1.0, 1.0)]
    if not all(0.0 < end < np.pi for end in ends):
        raise ValueError(
            f"x has no free sector: its ends would be {ends[0]:.3g} and {ends[1]:.3g} rad from its middle. "
            "Give a d-cone at rest that is pushed in by several thicknesses, on a finer mesh."
        )
    return sum(ends)


def _end(angle: Float[np.ndarray, " points"], lifted: Float[np.ndarray, " points"]) -> float:
    """Return the angle in rad at which one side of the sector ends."""
    from scipy.optimize import least_squares  # half a second, and no run needs it

    used = (angle > 0) & (lifted < 0.3 * lifted.max())

    def misfit(guess: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " used"]:
        end, steep, bend, floor = guess
        inside = np.maximum(end - angle[used], 0.0)
        return inside**3 * (steep + bend * inside) + floor - lifted[used]

    size = lifted.max()
    found = least_squares(misfit, [1.2, size, 0.0, 0.0], x_scale=[1.0, size, size, size])
    return float(found.x[0])
