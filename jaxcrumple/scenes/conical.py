"""Conical packing: a disc pulled by its middle through a small hole (Fig. 7, low and high confinement).

References: Mellado, Cheng & Concha, Phys. Rev. E 83, 036607 (2011), and Boué et al., Phys. Rev. Lett. 97,
166104 (2006).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import NodeVectors, Scalar
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.model.loads import AbstractMotion, Prescribed
from jaxcrumple.model.walls import HoledPlate, OfTime, PiecewiseLinear, of_time
from jaxcrumple.scenes.quantities import Length, Speed
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions
from jaxcrumple.scenes.snap import check_positive


class Along(AbstractMotion):
    """Motion of all nodes from `position` (n, 3) in m along `direction` (3,) by `distance(t)` in m."""

    position: NodeVectors = eqx.field(converter=as_float)
    direction: Float[Array, " 3"] = eqx.field(converter=as_float)
    distance: OfTime

    def __call__(self, t: Scalar | float) -> NodeVectors:
        """Return the positions (n, 3) in m at time `t`."""
        return self.position + self.distance(t) * self.direction


@door
def conical(
    nodes: int = 1000,
    seed: int = 0,
    *,
    radius: Length = 0.05,
    opening: Length = 0.015,
    edge: Length = 0.005,
    pull: Length = 0.025,
    speed: Speed = 0.02,
    grip: Length = 0.006,
    **options: Any,
) -> Setup:
    """Build a disc on a plate with a hole; its middle is pulled through the hole.

    It is the conical confinement of Fig. 7 (Mellado, Cheng & Concha, Phys. Rev. E 83 (2011) 036607).

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `radius` of the disc,
    `opening`: radius of the hole, `edge`: fillet radius of its rim, `pull`: distance of the pull, `grip`:
    radius of the pulled region, all in m; `speed` of the pull in m/s; `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or a speed that are not positive, a grip that does not pass the hole or
    holds no node, or a hole too large for the disc.
    """
    check_positive(radius=radius, opening=opening, edge=edge, pull=pull, speed=speed, grip=grip)
    sheet = SheetOptions(**options)
    if grip + sheet.clearance > opening:
        raise ValueError(f"grip = {grip} m does not pass a hole of {opening} m; choose a smaller one.")
    if opening + edge >= radius:
        raise ValueError(
            f"opening = {opening} m, with its edge of {edge} m, lets the disc of {radius} m fall through; "
            "choose a smaller one."
        )
    mesh = sheet.disc(radius, nodes, seed)
    held = np.linalg.norm(mesh.vertices[:, :2], axis=1) < grip
    if not held.any():
        raise ValueError(f"grip = {grip} m holds no node; choose a larger one, or more nodes.")
    x = mesh.vertices + np.array([0.0, 0.0, edge + sheet.clearance + sheet.imperfection])
    down = jnp.array([0.0, 0.0, -1.0])
    motion = Along(
        jnp.asarray(x), down, PiecewiseLinear(jnp.array([0.0, pull / speed]), jnp.array([0.0, pull]))
    )
    grips = Prescribed(jnp.asarray(np.repeat(held[:, None], 3, axis=1)), motion)
    return sheet.setup(
        mesh, [HoledPlate(jnp.zeros(3), -down, of_time(opening), as_float(edge))], x=x, prescribed=grips
    )
