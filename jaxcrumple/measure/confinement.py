"""Forces of the sheet on its walls."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import require_shape
from jaxcrumple.model.walls import Wall


@door
def wall_force(wall: Wall, x: NodeVectorsLike, t: float) -> float:
    """Return the sum of the magnitudes in N of the normal forces of the sheet on a wall.

    `wall`: a `Wall` of the scene; `x` (n, 3): positions in m; `t`: time in s. For a shrinking sphere this is
    -dU/dR, pressure times area. A testing machine measures a component of the vector sum,
    `-wall.force(x, t).sum(axis=0)`.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    require_shape("x", x, (len(wall.stiffness), 3))
    return float(np.linalg.norm(np.asarray(wall.force(jnp.asarray(x), jnp.asarray(t))), axis=1).sum())
