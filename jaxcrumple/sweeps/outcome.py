"""Outcome of a case of a sweep."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from jaxcrumple.state import State


class Outcome(NamedTuple):
    """Outcome of a case: name of the `result`, measured values of its `frames`, what it `spent` (None if
    lost), and a `message` if it raised an exception."""

    result: str
    frames: list[xr.Dataset]
    spent: dict[str, Any] | None
    message: str = ""


def broken(error: BaseException, frames: Sequence[xr.Dataset] = ()) -> Outcome:
    """Return the outcome of a case that raised an exception."""
    return Outcome("error", list(frames), None, f"{type(error).__name__}: {error}")


def spent_by(state: State) -> dict[str, Any]:
    """Return the reached time in s and the step counters of a case, as JSON types."""
    counters = state.counters
    return {
        "t_reached": float(state.t),
        "steps": np.asarray(counters.steps).tolist(),
        "rejected": np.asarray(counters.rejected).tolist(),
        "newton_iterations": int(counters.newton),
        "linear_iterations": int(counters.linear),
        "switches": int(counters.switches),
    }


def joined(parts: Sequence[xr.Dataset], along: str | pd.Index) -> xr.Dataset:
    """Join measured values along a new dimension. Their coordinates may differ; missing values are NaN."""
    return xr.concat(parts, along, data_vars="all", coords="minimal", join="outer", compat="equals")
