"""Collect the outcomes of a sweep in one labelled table."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from jaxcrumple.state import CAUSES, STAGES
from jaxcrumple.sweeps.cases import Grid
from jaxcrumple.sweeps.outcome import Outcome, joined

Tell = Callable[[str, str], None]

# Names that every table contains.
RESERVED = (
    "case",
    "cause",
    "linear_iterations",
    "message",
    "newton_iterations",
    "rejected",
    "result",
    "stage",
    "steps",
    "switches",
    "t_reached",
    "time",
)


def table(
    grid: Grid, times: Float[np.ndarray, " times"], outcomes: Sequence[Outcome], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """Arrange the outcomes over the names of the grid; measured values also over time, NaN after the end of a
    case."""
    rows = [_row(times, outcome) for outcome in outcomes]
    lanes = joined(rows, "case")
    words = [pd.Index(_alike(values)) for values in grid.values()]
    index = pd.MultiIndex.from_product(words, names=list(grid))
    lanes = lanes.assign_coords(xr.Coordinates.from_pandas_multiindex(index, "case")).unstack("case")
    # Unstacking sorts; restore the order of the grid.
    lanes = lanes.reindex(dict(zip(grid, words, strict=True)))
    return lanes.transpose(*grid, "time", ...).assign_attrs(attributes)


def _alike(values: Sequence[Any]) -> list[Any]:
    """Convert values to one type, as a file requires: all to words if one is a word or None."""
    if all(isinstance(value, int | float | np.number) for value in values):
        return list(values)
    return ["none" if value is None else str(value) for value in values]


def check_names(grid: Grid, measured: xr.Dataset) -> None:
    """Refuse a name that would occur twice in the table.

    **Raises:** ValueError that gives the name.
    """
    found = {*measured.variables, *measured.dims}
    for name in (*grid, *found):
        if name in RESERVED or (name in grid and name in found):
            raise ValueError(f"the table of a sweep has a {name!r} of its own: choose another name.")


def _row(times: Float[np.ndarray, " times"], outcome: Outcome) -> xr.Dataset:
    known = {"result": outcome.result, "message": outcome.message}
    if outcome.spent is not None:
        known |= _labelled(outcome.spent)
    whole = xr.Dataset(known, {"time": ("time", times, {"units": "s"})})
    if not outcome.frames:
        return whole
    moments = pd.Index(times[: len(outcome.frames)], name="time")
    frames = joined(outcome.frames, moments)
    return whole.merge(frames.reindex(time=times), join="left")


def _labelled(spent: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a case spent with units and coordinates."""
    return {
        **spent,
        "t_reached": ((), spent["t_reached"], {"units": "s"}),
        "steps": xr.DataArray(spent["steps"], {"stage": list(STAGES)}, "stage"),
        "rejected": xr.DataArray(spent["rejected"], {"cause": list(CAUSES)}, "cause"),
    }
