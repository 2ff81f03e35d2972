"""Export a campaign as a data set for machine learning."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcrumple.dataset.card import CARD, described
from jaxcrumple.dataset.card_text import README, text_of
from jaxcrumple.dataset.maps import CHANNELS
from jaxcrumple.dataset.parameters import Parameter, parameters
from jaxcrumple.dataset.source import CHOSEN, Frames, survey
from jaxcrumple.dataset.splits import SPLITS, split_seeds
from jaxcrumple.dataset.statistics import Statistics
from jaxcrumple.dataset.write import write_samples, write_table
from jaxcrumple.io.atomic import json_bytes, whole_folder
from jaxcrumple.measure.raster import Raster
from jaxcrumple.options.validation import ConfigError

if TYPE_CHECKING:
    import zarr

DATA = "data.zarr"
#: Least and most pixels along a side of the maps.
PIXELS = 8, 4096


def export_dataset(
    folder: str | Path, out: str | Path, *, pixels: int = 64, frames: Frames = "all"
) -> dict[str, Any]:
    """Write the successful runs of a campaign as a data set for machine learning, and return its data card.

    The new folder `out` holds `data.zarr` (Zarr, version 3) and the data card, as `card.json` and as text in
    `README.md`. Runs are split by seed into the groups train, validation and test, so that no seed is in two.
    The folder appears when it is complete. Memory holds one frame and a few shards at a time.

    Each group has these arrays, padded with zeros to the largest mesh. A chunk is one sample.

    - `maps` (samples, 7, pixels, pixels), float32: on the undeformed sheet, x, y, z in m, elastic and
      plastic mean curvature in 1/m, crease (1 mountain, -1 valley, 0), and mask (1 on the sheet).
    - `x` (samples, n, 3) in m and `p` (samples, h): positions and rest curvatures of each sample.
    - `t` (samples,) in s, `run` (samples,), `frame` (samples,): time, row of the run below, number of frame.
    - `vertices` (runs, n, 3) in m, `faces`, `edges`, `hinges`: the mesh of each run, as of `Mesh`; `rows`
      (runs, 4): how many of them are not padding.
    - `parameters` (runs, k), `seed` (runs,): options in which runs differ, in SI units. The attributes of
      `data.zarr` name the columns.

    **Arguments:** `folder`: of `campaign`; `out`: must not exist; `pixels`: along each side of a square that
    covers all undeformed sheets; `frames`: "all" saved frames of each run, or the "last" one.

    **Raises:** ConfigError for a wrong option or a folder without successful runs; `RunDirectoryError` for a
    damaged run, or if `out` cannot be written; ValueError for a rest shape that is not flat; ImportError
    without the extra `data` (Zarr).
    """
    place = Path(out)
    _check(place, pixels, frames)
    sources, left_out = survey(Path(folder), frames)
    bounds = np.stack([source.bounds for source in sources])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    raster = Raster.square(low, high, pixels, f"a map of {pixels} x {pixels} pixels")
    split = split_seeds(source.seed for source in sources)
    if missing := set(SPLITS) - set(split.values()):
        warnings.warn(
            f"{len(split)} seed(s) leave no run for {' and '.join(sorted(missing))}: vary seed in the "
            "campaign, with three values or more.",
            stacklevel=2,
        )
    sizes = {name: max(source.rows[name] for source in sources) for name in sources[0].rows}
    columns, statistics = parameters([source.options for source in sources]), Statistics()
    with whole_folder(place) as beginning:
        root = _root(beginning / DATA, raster, columns)
        for name in SPLITS:
            rows = [row for row, source in enumerate(sources) if split[source.seed] == name]
            chosen, group = [sources[row] for row in rows], root.create_group(name)
            write_samples(group, chosen, sizes, raster, statistics if name == "train" else None)
            table = [[column.values[row] for column in columns] for row in rows]
            write_table(group, "parameters", table, (len(rows), len(columns)))
        card = described(sources, left_out, split, columns, raster, frames, statistics)
        (beginning / README).write_text(text_of(card), encoding="utf-8")
        (beginning / CARD).write_bytes(json_bytes(card))
    return card


def _check(out: Path, pixels: int, frames: str) -> None:
    """Refuse impossible options before any work."""
    if importlib.util.find_spec("zarr") is None:
        raise ImportError("a data set needs Zarr, version 3 (pip install 'zarr>=3.1').")
    if not isinstance(pixels, int) or not PIXELS[0] <= pixels <= PIXELS[1]:
        raise ConfigError(f"pixels = {pixels}; give a whole number from {PIXELS[0]} to {PIXELS[1]}.")
    if frames not in CHOSEN:
        raise ConfigError(f"frames = {frames!r} is unknown; give {' or '.join(map(repr, CHOSEN))}.")
    if out.exists():
        raise ConfigError(f"{out} exists; give another folder for the data set, or remove it.")


def _root(path: Path, raster: Raster, columns: Sequence[Parameter]) -> zarr.Group:
    """Create the group of all splits; its attributes tell what a loader needs."""
    import zarr

    return zarr.create_group(
        path,
        zarr_format=3,
        attributes={
            "channels": list(CHANNELS),
            "parameters": [column.name for column in columns],
            "pixel": raster.pixel,
            "origin": raster.origin.tolist(),
        },
    )
