"""Avalanches: duration and released energy of the snaps of a crumpling sheet.

A snap begins where inertia is not negligible. The criterion is that of `jaxcrumple.replays.snaps`: without
inertia, positions would change by more than a given fraction of the size of the sheet.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import ArrayLike, Float, Int, Real

from jaxcrumple.replays.snaps import HIGH, REST
from jaxcrumple.solvers.log import STEP

STORED = ("stretch", "bending", "contact")


def avalanches(
    history: pd.DataFrame, *, reference_acceleration: float, inertial_time: float, length_scale: float
) -> pd.DataFrame:
    """Return a table with one row per snap of a run.

    Columns: `begin`, `end` in s; `peak`: the largest acceleration in units of `length_scale` /
    `inertial_time`^2; `released` in J: the decrease of the elastic energy (stretching, bending, contact) from
    the step before the snap to its end, plus the work of walls and supports in that time if the run recorded
    it.

    **Arguments:** `history`: table of the run; `reference_acceleration` in m/s2, `inertial_time` in s (mass
    over drag) and `length_scale` in m: scales of its `Scene`.

    **Raises:** ValueError for a history without steps, or for scales that are not positive and finite.
    """
    scales = np.array([reference_acceleration, inertial_time, length_scale], float)
    if not np.all(np.isfinite(scales) & (scales > 0)):
        raise ValueError(f"scales {scales} must be positive and finite; a sheet without drag has no snaps")
    steps = history[history["kind"] == STEP] if len(history) else history
    if len(steps) == 0:
        raise ValueError("the history has no steps; run longer")
    share = steps["acceleration"].to_numpy() * reference_acceleration * inertial_time**2 / length_scale
    t = steps["t"].to_numpy()
    high = np.flatnonzero(share > HIGH)
    parts = np.split(high, np.flatnonzero(np.diff(t[high]) > REST * inertial_time) + 1) if len(high) else []
    energy = steps[list(STORED)].sum(axis=1).to_numpy()
    work = steps["work_walls"].to_numpy() + steps["work_supports"].to_numpy()
    rows = [_row(t, share, energy, work, part, REST * inertial_time) for part in parts]
    return pd.DataFrame(rows, columns=["begin", "end", "peak", "released"])


def _row(
    t: Float[np.ndarray, " steps"],
    share: Float[np.ndarray, " steps"],
    energy: Float[np.ndarray, " steps"],
    work: Float[np.ndarray, " steps"],
    part: Int[np.ndarray, " part"],
    rest: float,
) -> tuple[float, float, float, float]:
    before = max(part[0] - 1, 0)
    end = min(int(np.searchsorted(t, t[part[-1]] + rest)), len(t) - 1)
    released = energy[before] - energy[end] + work[end] - work[before]
    return float(t[before]), float(t[end]), float(share[part].max()), float(released)


def power_law_exponent(
    values: Real[ArrayLike, " values"] | Sequence[float], least: float
) -> tuple[float, float]:
    """Fit the density x^(-alpha) to all `values` >= `least` by maximum likelihood.

    Return the exponent and its standard error (Clauset, Shalizi & Newman, SIAM Review 51 (2009) 661, eqs. 3.1
    and 3.2).

    **Raises:** ValueError if `least` is not positive, or if fewer than two values reach it.

    >>> exponent, error = measure.power_law_exponent([1.0, 2.0, 4.0, 8.0], least=1.0)
    >>> round(exponent, 3), round(error, 3)  # 1 + 4 / ln(1 * 2 * 4 * 8)
    (1.962, 0.481)
    """
    found = np.asarray(values, float)
    found = found[found >= least]
    if not (least > 0 and len(found) > 1):
        raise ValueError(f"{len(found)} values are at least {least}; give a positive bound that two reach")
    spread = float(np.sum(np.log(found / least)))
    if spread == 0.0:
        raise ValueError(f"all values are {least}; give at least two different values")
    exponent = 1.0 + len(found) / spread
    return exponent, (exponent - 1.0) / float(np.sqrt(len(found)))
