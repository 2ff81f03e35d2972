"""The snaps of a run: when it accelerates so much that inertia decides where it goes."""

import numpy as np

from jaxcrumple.scene import Scene

# A snap begins where positions would be off by this share of the sheet's size if inertia were left out (the
# acceleration monitor's "displacement"), and is over when that did not happen for so many inertial times.
HIGH, REST = 1e-2, 10.0
# Times that a record keeps: as many for every run, so that none compiles anew.
MOST = 64


def snaps(scene: Scene, x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Instants in s at which snaps begin, the first 64 of them, and infinity for those that are fewer.

    **Arguments:** positions `x` (k, n, 3) in m at the ends of accepted steps `t` (k,) in s.
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
