"""What the figures share: the runs behind one, and how it is made of them."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from jaxcrumple.io import Run, load
from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.run.config import RunConfig
from jaxcrumple.sweep import campaign
from jaxcrumple.sweep.table import Tell

Runs = Mapping[str, Run]


class Figure(NamedTuple):
    """A figure of the paper.

    `summary`: what it shows; `runs`: configurations by name, for a laptop or, given True, at the paper's
    size; `draw`: makes the pictures, and the data behind them as tables, in a folder, and returns their
    paths.
    """

    summary: str
    runs: Callable[[bool], dict[str, RunConfig]]
    draw: Callable[[Runs, Path], list[Path]]


def make_figure(
    figure: Figure, folder: str | Path, *, full: bool = False, tell: Tell = lambda name, result: None
) -> list[Path]:
    """Do the runs of a figure that `folder` lacks, side by side, and draw it; returns the files.

    **Raises:** ValueError where `folder` is a file, or a run did not come to its end, after all have ended.
    """
    place = Path(folder)
    if place.exists() and not place.is_dir():
        raise ValueError(f"{place} is a file; give a folder for the figure.")
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


def save_table(table: pd.DataFrame, path: Path) -> Path:
    """Write the data behind a picture, all or nothing."""
    write_bytes(path, table.to_csv(index=False).encode())
    return path
