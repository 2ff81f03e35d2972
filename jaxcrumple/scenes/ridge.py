"""Minimal ridge: a sheet bent to a sharp corner at two opposite edges.

A ridge connects the two corners and sags at its middle. Its curvature there times its length X scales as
$(\\sqrt{\\kappa/Y}/X)^{-1/3}$ (Lobkovsky et al., Science 270, 1482 (1995)).
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.arrays import NodeVectors, NodeVectorsLike, Scalar
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.measure.creases import mean_curvature
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.loads import AbstractMotion, Prescribed
from jaxcrumple.model.walls import PiecewiseLinear
from jaxcrumple.scenes.quantities import Angle, Duration, Length
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions
from jaxcrumple.scenes.snap import check_positive

# Width of the frames that hold the corners, in units of the ridge length.
FRAME = 0.05
# Length of the middle part over which the curvature is averaged, in units of the ridge length.
MIDDLE = 0.1


class BendingMotion(AbstractMotion):
    """Rotation of both halves upwards about the line x = 0, each by half of `turn(t)` in rad.

    `position` (n, 3): rest positions in m.
    """

    position: NodeVectors = eqx.field(converter=as_float)
    turn: PiecewiseLinear

    def __call__(self, t: Scalar | float) -> NodeVectors:
        """Return the positions (n, 3) in m at time `t`."""
        x, y, z = self.position.T
        half = 0.5 * self.turn(t)
        cos, sin = jnp.cos(half), jnp.sin(half)
        return jnp.stack([x * cos - jnp.sign(x) * z * sin, y, z * cos + jnp.abs(x) * sin], axis=1)


@door
def ridge(
    nodes: int = 3000,
    seed: int = 0,
    *,
    length: Length = 0.1,
    width: Length = 0.1,
    turn: Angle = 0.5 * math.pi,
    close: Duration = 0.2,
    **options: Any,
) -> Setup:
    """Build a rectangular sheet, `length` along y and `width` along x, bent at its ends about the line x = 0.

    It becomes a minimal ridge (Lobkovsky et al., Science 270 (1995) 1482), whose curvature `ridge_curvature`
    measures. Frames hold the two ends. Each frame adds a twentieth of the length and bends to a corner during
    `close`. The sheet between the frames is free.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `length`, `width` in m;
    `turn`: bend angle of the corner in rad; `close` in s; `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or a time that are not positive, or `turn` >= pi.
    """
    check_positive(length=length, width=width, turn=turn, close=close)
    if turn >= math.pi:
        raise ValueError(f"turn = {turn} rad closes the corner; choose less than pi.")
    sheet = SheetOptions(**options)
    along = length * (1.0 + 2.0 * FRAME)
    flat = rectangle(width, along, nodes, seed=seed, sweeps=sheet.sweeps)
    mesh = sheet.imperfect(flat, max(width, along), seed)
    held = np.abs(mesh.vertices[:, 1]) > 0.5 * length
    motion = BendingMotion(
        jnp.asarray(mesh.vertices), PiecewiseLinear(jnp.array([0.0, close]), jnp.array([0.0, turn]))
    )
    return sheet.setup(mesh, [], prescribed=Prescribed(jnp.asarray(np.repeat(held[:, None], 3, 1)), motion))


@door
def ridge_curvature(mesh: Mesh, x: NodeVectorsLike) -> float:
    """Return the curvature in 1/m across the middle of a ridge along y at positions `x` (n, 3) in m.

    It is the largest mean curvature, averaged over narrow strips along the middle part of the ridge. The
    curvature along the ridge is negligible.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    along = np.abs(mesh.vertices[:, 1]) < 0.5 * MIDDLE * np.ptp(mesh.vertices[:, 1])
    across, curvature = mesh.vertices[along, 0], np.abs(mean_curvature(mesh, x))[along]
    spacing = 1.0 / mesh.linear_density
    kernel = np.exp(-0.5 * ((across[:, None] - across) / spacing) ** 2)
    return float(np.max(kernel @ curvature / kernel.sum(axis=1)))
