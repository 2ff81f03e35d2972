"""The data card: what a data set holds, as JSON."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from jaxcrumple.dataset.maps import CHANNELS
from jaxcrumple.dataset.parameters import Parameter, common, unit
from jaxcrumple.dataset.source import Frames, Source
from jaxcrumple.dataset.splits import SPLITS
from jaxcrumple.dataset.statistics import Statistics
from jaxcrumple.measure.raster import Raster

CARD = "card.json"
FORMAT, VERSION = "jaxcrumple-dataset", 1


def described(
    sources: Sequence[Source],
    left_out: Mapping[str, str],
    split: Mapping[int, str],
    columns: Sequence[Parameter],
    raster: Raster,
    frames: Frames,
    statistics: Statistics,
) -> dict[str, Any]:
    """Return the data card as JSON types.

    **Arguments:** `left_out`: reasons by run; `split`: of each seed; `columns`: the parameters;
    `statistics`: of the maps for training.
    """
    options = [source.options for source in sources]
    of_channels = statistics.of_channels()
    same = {name: value for name, value in common(options).items() if name != "scene"}
    return {
        "format": FORMAT,
        "version": VERSION,
        "written_by": {name: importlib.metadata.version(name) for name in ("jaxcrumple", "zarr", "numpy")},
        "simulated_by": _versions(sources),
        # The folder of a user's own scene is nobody's business.
        "scenes": sorted({PurePath(run["scene"]).name for run in options}),
        "frames": frames,
        "grid": {"pixels": raster.shape[0], "pixel": raster.pixel, "origin": raster.origin.tolist()},
        "channels": {name: {**channel._asdict(), **of_channels[name]} for name, channel in CHANNELS.items()},
        "parameters": {column.name: _range(column) for column in columns},
        "options": {
            name: {"unit": unit(options[0]["scene"], name), "value": value} for name, value in same.items()
        },
        "splits": {name: _counts([s for s in sources if split[s.seed] == name]) for name in SPLITS},
        "left_out": dict(left_out),
    }


def _versions(sources: Sequence[Source]) -> dict[str, list[str]]:
    """Return the versions of each package that made the runs."""
    names = dict.fromkeys(name for source in sources for name in source.versions)
    return {
        name: sorted({source.versions[name] for source in sources if name in source.versions})
        for name in names
    }


def _range(column: Parameter) -> dict[str, Any]:
    if column.words:
        return {"unit": None, "words": column.words}
    least, most = float(np.nanmin(column.values)), float(np.nanmax(column.values))
    return {"unit": column.unit, "min": least, "max": most}


def _counts(sources: Sequence[Source]) -> dict[str, Any]:
    seeds = sorted({source.seed for source in sources})
    return {"samples": sum(len(source.frames) for source in sources), "runs": len(sources), "seeds": seeds}
