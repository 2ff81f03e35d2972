"""Define a figure of the paper: its runs, and how to draw it from them."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from jaxcrumple.io import Run, load
from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.run.config import RunConfig
from jaxcrumple.sweeps.campaign import campaign, check_runs, read_campaign
from jaxcrumple.sweeps.table import Tell

Runs = Mapping[str, Run]


class Figure(NamedTuple):
    """A figure of the paper.

    `summary`: content of the figure; `runs`: function that returns configurations by name, for a laptop
    (False) or at the paper's size (True); `draw`: function that writes the pictures and their data as tables
    to a folder, and returns their paths.
    """

    summary: str
    runs: Callable[[bool], dict[str, RunConfig]]
    draw: Callable[[Runs, Path], list[Path]]


class Ensemble(NamedTuple):
    """A figure of runs that differ in their seeds, which can do without some of them.

    `summary`, `runs`: as of `Figure`; `draw`: as of `Figure`, of the runs that succeeded and the results of
    the others by name.
    """

    summary: str
    runs: Callable[[bool], dict[str, RunConfig]]
    draw: Callable[[Runs, Mapping[str, str], Path], list[Path]]


def _quiet(name: str, result: str) -> None:
    """Tell nothing."""


def make_figure(figure: Figure, folder: str | Path, *, full: bool = False, tell: Tell = _quiet) -> list[Path]:
    """Complete the runs of a figure in `folder`, side by side, draw the figure, and return the files.

    **Raises:** ValueError if `folder` is a file or, after all runs have ended, if a run did not succeed.
    """
    place = _folder(folder)
    configs = figure.runs(full)
    if configs:
        table = campaign(configs, place / "runs", tell=tell)
        failed = table.index[table["result"] != "success"]
        if len(failed):
            raise ValueError(
                f"run {failed[0]!r} of the figure ended in {table['result'][failed[0]]}; see its folder in "
                f"{place / 'runs'}, and remove that to run it again."
            )
    place.mkdir(parents=True, exist_ok=True)
    return figure.draw({name: load(place / "runs" / name) for name in configs}, place)


def make_ensemble(
    ensemble: Ensemble,
    folder: str | Path,
    *,
    full: bool = False,
    finished: bool = False,
    tell: Tell = _quiet,
) -> list[Path]:
    """Complete the runs of an ensemble in `folder`, side by side, draw those that succeeded, and return the
    files; with `finished`, start no run.

    **Raises:** ValueError if `folder` is a file, or if fewer than two runs succeeded.
    """
    place = _folder(folder)
    configs = ensemble.runs(full)
    if finished:
        results = read_campaign(place / "runs")["result"].reindex(list(configs), fill_value="not started")
        check_runs(configs, place / "runs")
    else:
        results = campaign(configs, place / "runs", tell=tell)["result"]
    good = results.index[results == "success"]
    if len(good) < 2:
        counts = ", ".join(f"{count} {result}" for result, count in results.value_counts().items())
        raise ValueError(f"an ensemble needs two runs that succeed; its {len(results)} runs are: {counts}.")
    runs = {name: load(place / "runs" / name) for name in good}
    return ensemble.draw(runs, results.drop(good).to_dict(), place)


def _folder(folder: str | Path) -> Path:
    """Return the path of a folder.

    **Raises:** ValueError if it is a file.
    """
    place = Path(folder)
    if place.exists() and not place.is_dir():
        raise ValueError(f"{place} is a file; give a folder for the figure.")
    return place


def save_table(table: pd.DataFrame, path: Path) -> Path:
    """Write the data of a picture atomically."""
    write_bytes(path, table.to_csv(index=False).encode())
    return path
