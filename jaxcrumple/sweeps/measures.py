"""What a sweep measures of its cases."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from jaxcrumple.run.summary import figures
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.state import State

Measure = Callable[[Setup, State], Mapping[str, Any]]

_LENGTHS = ("crease_length", "max_wall_penetration", "min_gap")


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
