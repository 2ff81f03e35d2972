"""Outcomes of a sweep as one labelled table."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from jaxcrumple.scenes import Setup
from jaxcrumple.state import CAUSES, STAGES, State
from jaxcrumple.summary import figures
from jaxcrumple.sweep.cases import Grid

Measure = Callable[[Setup, State], Mapping[str, Any]]
Tell = Callable[[str, str], None]

# Frames and cases may have other values on other places; what one lacks is NaN.
_JOINED: Any = {"data_vars": "all", "coords": "minimal", "join": "outer", "compat": "equals"}

_LENGTHS = ("crease_length", "max_wall_penetration", "min_gap")

# What every table has.
RESERVED = (
    "case",
    "cause",
    "linear_iterations",
    "newton_iterations",
    "rejected",
    "result",
    "stage",
    "steps",
    "switches",
    "t_reached",
    "time",
)


class Outcome(NamedTuple):
    """What became of a case: `result` in a word, its last `state`, and what was measured at its `frames`."""

    result: str
    state: State
    frames: list[xr.Dataset]


def standard_measure(setup: Setup, state: State) -> dict[str, Any]:
    """Energies by term in J, crease length in m, edge strains, and contacts, as in a run's summary."""
    found = figures(setup, state)
    energy = found.pop("energy")
    found["min_gap"] = np.nan if found["min_gap"] is None else found["min_gap"]
    lengths = {name: xr.DataArray(found[name], attrs={"units": "m"}) for name in _LENGTHS}
    terms = xr.DataArray(list(energy.values()), {"term": list(energy)}, "term", attrs={"units": "J"})
    return {"energy": terms, **found, **lengths}


def measured(measure: Measure, setup: Setup, state: State) -> xr.Dataset:
    """What is measured of one state.

    **Raises:** ValueError for a measure that returns something else than values by name.
    """
    found = measure(setup, state)
    try:
        return xr.Dataset({key: _known(value) for key, value in found.items()})
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"measure returned {found!r}; it must return numbers, (dimensions, array) or DataArrays by name "
            f"({error})."
        ) from error


def _known(value: Any) -> Any:
    """A value with its numbers on the host."""
    if isinstance(value, tuple):
        return value[0], np.asarray(value[1])
    return value if isinstance(value, xr.DataArray) else np.asarray(value)


def table(
    grid: Grid, times: np.ndarray, outcomes: Sequence[Outcome], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """The outcomes over the grid's names, and over time where they were measured; NaN where a case did not
    get there."""
    rows = [_row(times, outcome) for outcome in outcomes]
    lanes = xr.concat(rows, "case", **_JOINED)
    words = [pd.Index(_alike(values)) for values in grid.values()]
    index = pd.MultiIndex.from_product(words, names=list(grid))
    lanes = lanes.assign_coords(xr.Coordinates.from_pandas_multiindex(index, "case")).unstack("case")
    # Unstacking sorts; the grid keeps the order it was given in.
    lanes = lanes.reindex(dict(zip(grid, words, strict=True)))
    return lanes.transpose(*grid, "time", ...).assign_attrs(attributes)


def _alike(values: Sequence[Any]) -> list[Any]:
    """Values of one kind, as a file wants them: all words where one is a word or None."""
    if all(isinstance(value, int | float | np.number) for value in values):
        return list(values)
    return ["none" if value is None else str(value) for value in values]


def check_names(grid: Grid, measured: xr.Dataset) -> None:
    """Refuse what would stand in the table twice.

    **Raises:** ValueError that says which name.
    """
    for name in (*grid, *measured.variables):
        if name in RESERVED or (name in grid and name in measured.variables):
            raise ValueError(f"the table of a sweep has a {name!r} of its own: choose another name.")


def _row(times: np.ndarray, outcome: Outcome) -> xr.Dataset:
    counters = outcome.state.counters
    whole = xr.Dataset(
        {
            "result": outcome.result,
            "t_reached": ((), float(outcome.state.t), {"units": "s"}),
            "steps": ("stage", np.asarray(counters.steps)),
            "rejected": ("cause", np.asarray(counters.rejected)),
            "newton_iterations": int(counters.newton),
            "linear_iterations": int(counters.linear),
            "switches": int(counters.switches),
        },
        {"stage": list(STAGES), "cause": list(CAUSES), "time": ("time", times, {"units": "s"})},
    )
    if not outcome.frames:
        return whole
    moments = pd.Index(times[: len(outcome.frames)], name="time")
    frames = xr.concat(outcome.frames, moments, **_JOINED)
    return whole.merge(frames.reindex(time=times), join="left")
