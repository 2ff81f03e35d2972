"""A minimal ridge: a sheet that is bent to a sharp corner at two opposite edges.

Lobkovsky et al., Science 270, 1482 (1995): between the two corners a ridge sags, whose curvature at its
middle times its length X grows as $(\\sqrt{\\kappa/Y}/X)^{-1/3}$.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.measure.creases import mean_curvature
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.mesh.mesh import FloatArray, Mesh
from jaxcrumple.model.loads import AbstractMotion, Prescribed
from jaxcrumple.model.walls import Corners
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions
from jaxcrumple.scenes.snap import check_positive

# Width of the frames that hold the corners, as a share of the length of the ridge.
FRAME = 0.05
# The middle of the ridge, as a share of its length, over which its curvature is averaged.
MIDDLE = 0.1


class Bending(AbstractMotion):
    """The halves beside the line x = 0 turn up about it, each by half of the `turn` in rad at each time.

    `position` (n, 3) in m: where the nodes are at rest.
    """

    position: Array = eqx.field(converter=as_float)
    turn: Corners

    def __call__(self, t: Array) -> Array:
        """Positions at time `t`."""
        x, y, z = self.position.T
        half = 0.5 * self.turn(t)
        cos, sin = jnp.cos(half), jnp.sin(half)
        return jnp.stack([x * cos - jnp.sign(x) * z * sin, y, z * cos + jnp.abs(x) * sin], axis=1)


@door
def ridge(
    nodes: int = 3000,
    seed: int = 0,
    *,
    length: float = 0.1,
    width: float = 0.1,
    turn: float = 0.5 * math.pi,
    close: float = 0.2,
    **options: Any,
) -> Setup:
    """A rectangular sheet, `length` along y and `width` along x, whose ends are bent about the line x = 0.

    Frames, of a twentieth of the length, hold the two ends and turn their halves up to a corner for the time
    `close`; between them the sheet is free.

    **Arguments:** `nodes` of the random mesh made with `seed`; `length`, `width` in m; `turn`: by how much
    the corner is bent in rad; `close` in s; `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or a time that are not positive, or a turn of more than half a turn.
    """
    check_positive(length=length, width=width, turn=turn, close=close)
    if turn >= math.pi:
        raise ValueError(f"turn = {turn} rad closes the corner; choose less than pi.")
    sheet = SheetOptions(**options)
    along = length * (1.0 + 2.0 * FRAME)
    flat = rectangle(width, along, nodes, seed=seed, sweeps=sheet.sweeps)
    mesh = sheet.imperfect(flat, max(width, along), seed)
    held = np.abs(mesh.vertices[:, 1]) > 0.5 * length
    motion = Bending(jnp.asarray(mesh.vertices), Corners(jnp.array([0.0, close]), jnp.array([0.0, turn])))
    return sheet.setup(mesh, [], prescribed=Prescribed(jnp.asarray(np.repeat(held[:, None], 3, 1)), motion))


@door
def ridge_curvature(mesh: Mesh, x: FloatArray) -> float:
    """Curvature in 1/m across the middle of a ridge along y at positions `x` (n, 3) in m.

    The largest mean curvature of strips along the ridge, whose own curvature is small, near its middle.
    """
    along = np.abs(mesh.vertices[:, 1]) < 0.5 * MIDDLE * np.ptp(mesh.vertices[:, 1])
    across, curvature = mesh.vertices[along, 0], np.abs(mean_curvature(mesh, x))[along]
    spacing = 1.0 / mesh.linear_density
    kernel = np.exp(-0.5 * ((across[:, None] - across) / spacing) ** 2)
    return float(np.max(kernel @ curvature / kernel.sum(axis=1)))
