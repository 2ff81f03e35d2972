"""Read sweeps and campaigns from TOML files."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from jaxcrumple.options.toml import read_toml
from jaxcrumple.options.units import TIME
from jaxcrumple.options.validation import ConfigError, validated
from jaxcrumple.run.config import Options, unit_named
from jaxcrumple.scenes.functions import scene_entry
from jaxcrumple.sweeps.cases import checked_grid


class SweepFile(Options):
    """A grid of a named scene: `over` holds the varied options, `settings` the common ones.

    `seeds`: number of seeds of the random meshes, or a list of them, over which each case is repeated.
    `t_end`: end time in s, by default that of the scene. `frames`: number of evenly spaced times at which a
    sweep measures, by default only the end; a campaign saves this number of frames and the start, by default
    as many as a run. `max_seconds`: wall time of each case in s, after which it ends with the result
    "budget"; by default unlimited.
    """

    scene: str
    over: dict[str, list[Any]] = Field(default_factory=dict)
    seeds: int | list[int] | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    t_end: Annotated[float | None, TIME] = Field(None, gt=0, allow_inf_nan=False)
    frames: int | None = Field(None, ge=1, le=100_000)
    max_seconds: Annotated[float | None, TIME] = Field(None, gt=0, allow_inf_nan=False)

    @property
    def end(self) -> float:
        """End time in s."""
        return scene_entry(self.scene).t_end if self.t_end is None else self.t_end


def read_sweep(path: str | Path) -> SweepFile:
    """Read a file of `scene`, `seeds`, `t_end`, `frames`, `max_seconds`, and tables `settings` and `over`.

    The word none means None. Numbers are in SI units; strings may carry a unit.

    **Raises:** `ConfigError` if the file cannot be read or has unknown or impossible entries.
    """
    values, _ = read_toml(path)
    try:
        found = validated(SweepFile, values)
        scene_entry(found.scene)
        for name in ("seeds", "frames", "t_end", "max_seconds"):
            if name in found.settings or name in found.over:
                raise ConfigError(f"{name} is the same for all: give it at the top, before the tables.")
        over = {name: _in_si(found.scene, name, values) for name, values in found.over.items()}
        over = checked_grid(over, found.settings, found.seeds)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    return found.model_copy(update={"over": over})


def _in_si(scene: str, name: str, values: list[Any]) -> list[Any]:
    """Convert the values of an option to SI numbers, which the tables and the names of runs show."""
    unit = unit_named(scene, name)
    if unit is None:
        return values
    try:
        return [unit.si(value) for value in values]
    except ValueError as error:
        raise ConfigError(f"over.{name} = {values!r}: one {error}.", ("over", name)) from error
