"""Options in which the runs of a data set differ, as columns of numbers, and their units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from jaxcrumple.options.units import unit_of
from jaxcrumple.run.config import MaterialOptions, RunConfig, SolverOptions
from jaxcrumple.scenes.catalogue import SCENES

# Options that say nothing about the sheet of a sample.
_OTHER = {"seed", "frames"}


class Parameter(NamedTuple):
    """An option: its SI `unit`, None if it has none; its `values` (runs,), NaN for none; for an option of
    words, such as a kind of contact, its `words`, of which a value is the index."""

    name: str
    unit: str | None
    values: Float[np.ndarray, " runs"]
    words: list[str]


def parameters(options: Sequence[Mapping[str, Any]]) -> list[Parameter]:
    """Return the options in which runs differ, from the options by name of each run."""
    return [
        Parameter(name, unit(options[0]["scene"], name), *_encoded([run.get(name) for run in options]))
        for name in _names(options)
        if name not in _OTHER and not _same(options, name)
    ]


def common(options: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the options that all runs share, by name."""
    return {name: options[0].get(name) for name in _names(options) if _same(options, name)}


def unit(scene: str, name: str) -> str | None:
    """Return the SI unit of an option; None if it has none. Scenes of the user tell no units."""
    models: list[type[BaseModel]] = [RunConfig, MaterialOptions, SolverOptions]
    if scene in SCENES:
        models.append(SCENES[scene].options)
    fields = (model.model_fields.get(name) for model in models)
    found = next((unit_of(field) for field in fields if field is not None), None)
    return None if found is None else found.symbol


def _names(options: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for run in options for name in run))


def _same(options: Sequence[Mapping[str, Any]], name: str) -> bool:
    return len({str(run.get(name)) for run in options}) == 1


def _encoded(values: Sequence[Any]) -> tuple[Float[np.ndarray, " runs"], list[str]]:
    """Return values as numbers, and the words that they count."""
    if all(value is None or isinstance(value, int | float) for value in values):
        return np.array([np.nan if value is None else value for value in values], float), []
    words = sorted({str(value) for value in values})
    return np.array([words.index(str(value)) for value in values], float), words
