"""Command `jaxcrumple figure`: figures of the paper."""

from pathlib import Path
from typing import Annotated

import typer

from jaxcrumple.cli.console import noted, say
from jaxcrumple.cli.outcome import tell_case


def figure(
    name: Annotated[str, typer.Argument(help="Number of the paper's figure, such as 8b.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of runs and pictures (default: figures/NAME).")
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="Use the paper's size instead of a laptop's.")] = False,
    many: Annotated[
        bool, typer.Option("--ensemble", help="Use 24 seeds, and draw mean, spread and intervals (9 only).")
    ] = False,
    finished: Annotated[
        bool, typer.Option("--finished", help="With --ensemble: start no run, draw those that succeeded.")
    ] = False,
) -> None:
    """Draw a figure of the paper; first complete the runs that its folder lacks."""
    from jaxcrumple.options.suggest import nearest
    from jaxcrumple.paper import ENSEMBLES, FIGURES, make_ensemble, make_figure

    if name not in FIGURES:
        raise ValueError(f"figure {name!r} is unknown{nearest(name, FIGURES)}")
    if many and name not in ENSEMBLES:
        raise ValueError(f"figure {name} has no ensemble; figure {' or '.join(ENSEMBLES)} has one.")
    if finished and not many:
        raise ValueError("--finished needs --ensemble; any other figure needs all its runs.")
    folder = out or Path("figures") / f"{name}{'_ensemble' if many else ''}{'_full' if full else ''}"
    with noted(lambda: f"{folder} keeps the completed runs; go on with the same command"):
        paths = (
            make_ensemble(ENSEMBLES[name], folder, full=full, finished=finished, tell=tell_case)
            if many
            else make_figure(FIGURES[name], folder, full=full, tell=tell_case)
        )
    for path in paths:
        say(str(path))
