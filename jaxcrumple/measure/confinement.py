"""Forces on walls: what confines a sheet feels of it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxcrumple._jax.door import door
from jaxcrumple.model.walls import Wall


@door
def wall_force(wall: Wall, x: ArrayLike, t: float) -> float:
    """Total force in N with which the sheet at positions `x` (n, 3) in m presses on a wall at time `t`,
    along its normals: for a sphere that shrinks $F(R) = -dU/dR$, its pressure times its area."""
    return float(np.linalg.norm(np.asarray(wall.force(jnp.asarray(x), jnp.asarray(t))), axis=1).sum())
