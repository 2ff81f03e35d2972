"""Command `jaxcrumple dataset`: a campaign as a data set for machine learning."""

from pathlib import Path
from typing import Annotated

import typer

from jaxcrumple.cli.console import console, say


def dataset(
    folder: Annotated[Path, typer.Argument(help="Folder of a campaign.")],
    out: Annotated[Path | None, typer.Option(help="New folder (default: FOLDER with -data).")] = None,
    pixels: Annotated[int, typer.Option(help="Pixels along a side of the maps.")] = 64,
    frames: Annotated[str, typer.Option(help="Frames of each run: all, or the last one.")] = "all",
) -> None:
    """Write the runs of a campaign as a data set for machine learning: maps, meshes, parameters, splits."""
    from jaxcrumple.dataset.export import export_dataset

    place = out or folder.with_name(f"{folder.name}-data")
    with console.status("writing"):
        card = export_dataset(folder, place, pixels=pixels, frames=frames)  # type: ignore[arg-type]
    for name, reason in card["left_out"].items():
        say(f"left out {name}: {reason}")
    for name, found in card["splits"].items():
        say(f"{name}: {found['samples']} samples of {found['runs']} runs, {len(found['seeds'])} seeds")
    say(f"data set: {place}")
