"""The snaps of a run: times of accelerations so large that inertia determines the motion."""

import numpy as np
from jaxtyping import Float

from jaxcrumple.scene import Scene

# A snap begins when the position error of neglected inertia (measure "displacement" of the acceleration
# monitor) exceeds HIGH of the sheet's size. It ends when the error stays below for REST inertial times.
HIGH, REST = 1e-2, 10.0
# Number of times in a record. It is the same for every run, so that a new record does not recompile.
MOST = 64


def snaps(
    scene: Scene, x: Float[np.ndarray, "points nodes 3"], t: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " 64"]:
    """Return the times (64,) in s at which the first 64 snaps begin, padded with infinity.

    **Arguments:** `x` (k, n, 3): positions in m at the ends of accepted steps; `t` (k,): their times in s.
    """
    found = np.full(MOST, np.inf)
    if len(t) < 3:
        return found
    h = np.maximum(np.diff(t), np.finfo(float).tiny)
    v = np.diff(x, axis=0) / h[:, None, None]
    a = 2.0 * np.diff(v, axis=0) / (h[1:] + h[:-1])[:, None, None]
    time = float(scene.inertial_time)
    share = np.linalg.norm(a, axis=2).max(axis=1) * time**2 / float(scene.length_scale)
    high = t[1:-1][share > HIGH]
    begins = high[np.diff(high, prepend=-np.inf) > REST * time][:MOST]
    found[: len(begins)] = begins
    return found
