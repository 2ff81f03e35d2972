"""Collect the outcomes of a sweep in one labelled table."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from jaxcrumple.run.summary import figures
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.state import CAUSES, STAGES, State
from jaxcrumple.sweeps.cases import Grid

Measure = Callable[[Setup, State], Mapping[str, Any]]
Tell = Callable[[str, str], None]

# Frames and cases may have different coordinates; missing values are NaN.
_JOINED: Any = {"data_vars": "all", "coords": "minimal", "join": "outer", "compat": "equals"}

_LENGTHS = ("crease_length", "max_wall_penetration", "min_gap")

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


class Outcome(NamedTuple):
    """Outcome of a case: name of the `result`, measured values of its `frames`, last `state` (None if lost),
    and a `message` if it raised an exception."""

    result: str
    frames: list[xr.Dataset]
    state: State | None
    message: str = ""


def broken(error: BaseException, frames: Sequence[xr.Dataset] = (), state: State | None = None) -> Outcome:
    """Return the outcome of a case that raised an exception."""
    return Outcome("error", list(frames), state, f"{type(error).__name__}: {error}")


class Frames:
    """An observer that measures the frames of a case; `found` holds the values so far.

    A measurement that raises ends the case, whose outcome then tells the exception.
    """

    def __init__(self, measure: Measure, setup: Setup):
        self.measure, self.setup = measure, setup
        self.found: list[xr.Dataset] = []

    def frame(self, index: int, state: State) -> None:
        """Measure a frame."""
        self.found.append(measured(self.measure, self.setup, state))

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Ignore steps."""


def standard_measure(setup: Setup, state: State) -> dict[str, Any]:
    """Measure energies by term in J, crease length in m, edge strains and contacts, as in a run's summary."""
    found = figures(setup, state)
    energy = found.pop("energy")
    found["min_gap"] = np.nan if found["min_gap"] is None else found["min_gap"]
    lengths = {name: xr.DataArray(found[name], attrs={"units": "m"}) for name in _LENGTHS}
    terms = xr.DataArray(list(energy.values()), {"term": list(energy)}, "term", attrs={"units": "J"})
    return {"energy": terms, **found, **lengths}


def measured(measure: Measure, setup: Setup, state: State) -> xr.Dataset:
    """Measure one state.

    **Raises:** ValueError for a measure that does not return values by name.
    """
    found = measure(setup, state)
    if not isinstance(found, Mapping):
        raise ValueError(f"measure must return a dictionary by name, not {type(found).__name__}.")
    known = {key: _known(key, value) for key, value in found.items()}
    try:
        return xr.Dataset(known)
    except ValueError as error:
        raise ValueError(f"the values that measure returned do not form a table: {error}.") from error


def _known(name: str, value: Any) -> Any:
    """Return a value with its numbers on the host."""
    if isinstance(value, xr.DataArray):
        return value
    names, array = value if isinstance(value, tuple) and len(value) == 2 else ((), value)
    names, known = (names,) if isinstance(names, str) else tuple(names), np.asarray(array)
    if len(names) != known.ndim:
        raise ValueError(
            f"measure's {name!r} has sizes {known.shape} and dimensions {names}; return a pair of a name for "
            "each and the array, as (('node', 'axis'), state.x)."
        )
    return names, known


def table(
    grid: Grid, times: Float[np.ndarray, " times"], outcomes: Sequence[Outcome], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """Arrange the outcomes over the names of the grid; measured values also over time, NaN after the end of a
    case."""
    rows = [_row(times, outcome) for outcome in outcomes]
    lanes = xr.concat(rows, "case", **_JOINED)
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
    if outcome.state is not None:
        known |= _spent(outcome.state)
    whole = xr.Dataset(known, {"time": ("time", times, {"units": "s"})})
    if not outcome.frames:
        return whole
    moments = pd.Index(times[: len(outcome.frames)], name="time")
    frames = xr.concat(outcome.frames, moments, **_JOINED)
    return whole.merge(frames.reindex(time=times), join="left")


def _spent(state: State) -> dict[str, Any]:
    """Return the reached time in s and the step counters of a case."""
    counters = state.counters
    return {
        "t_reached": ((), float(state.t), {"units": "s"}),
        "steps": xr.DataArray(np.asarray(counters.steps), {"stage": list(STAGES)}, "stage"),
        "rejected": xr.DataArray(np.asarray(counters.rejected), {"cause": list(CAUSES)}, "cause"),
        "newton_iterations": int(counters.newton),
        "linear_iterations": int(counters.linear),
        "switches": int(counters.switches),
    }
