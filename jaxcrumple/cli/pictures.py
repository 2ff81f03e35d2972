"""Commands `jaxcrumple plot` and `jaxcrumple view`: pictures, films and pages of runs."""

from pathlib import Path
from typing import Annotated

import typer

from jaxcrumple.cli.console import say


def plot(
    folder: Annotated[Path, typer.Argument(help="Folder of a run, finished or not.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Draw only the sheet, to this file: .png, .pdf, .svg; a film: .gif or .mp4."),
    ] = None,
    field: Annotated[
        str, typer.Option(help="Colours of --out: curvature, damage, strain, contact, or paper for none.")
    ] = "curvature",
    frame: Annotated[int, typer.Option(help="Frame of --out, by index; -1 is the last one.")] = -1,
    view: Annotated[
        str | None, typer.Option(help="Direction from the sheet to the camera of --out, X,Y,Z.")
    ] = None,
    walls: Annotated[bool, typer.Option(help="Whether --out shows the walls.")] = True,
    width: Annotated[
        str | None,
        typer.Option(help="Width of --out in print, such as '86 mm': no caption, small letters, 600 dpi."),
    ] = None,
) -> None:
    """Draw the pictures of a run again, and write its frames for ParaView; or draw one picture or a film."""
    given = {"--field": field != "curvature", "--frame": frame != -1, "--view": view, "--no-walls": not walls}
    given["--width"] = width
    if out is None and (alone := [name for name, value in given.items() if value]):
        raise ValueError(f"{' and '.join(alone)} need --out, the file of one picture or film.")
    for picture in _all(folder) if out is None else [_one(folder, out, field, frame, view, walls, width)]:
        say(str(picture))


def view(
    folders: Annotated[list[Path], typer.Argument(help="Folders of one run, or of several to compare.")],
    out: Annotated[
        Path | None,
        typer.Option(help="The page (default: view.html in the folder of one run, or here)."),
    ] = None,
    show: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Write a page to turn runs in a browser, offline: the sheet over time, its creases and energies."""
    import webbrowser

    from jaxcrumple.viewer.page import view as write

    target = out or (folders[0] / "view.html" if len(folders) == 1 else Path("view.html"))
    say(str(write(folders, target)))
    if show:
        webbrowser.open(target.resolve().as_uri())


def draw_run(folder: Path) -> list[Path]:
    """Draw the standard pictures of a run into its folder."""
    from jaxcrumple.plot.plot import plot_run

    return plot_run(folder)


def _all(folder: Path) -> list[Path]:
    from jaxcrumple.io import RunDirectory
    from jaxcrumple.run.begun import film

    pictures, frames = draw_run(folder), film(RunDirectory.open(folder))
    return pictures if frames is None else [*pictures, frames]


def _one(
    folder: Path, out: Path, field: str, frame: int, view: str | None, walls: bool, width: str | None
) -> Path:
    from jaxcrumple.io import load
    from jaxcrumple.plot.camera import VIEW
    from jaxcrumple.plot.film import FILMS, film
    from jaxcrumple.plot.picture import picture

    direction = VIEW if view is None else _direction(view)
    run = load(folder)
    if out.suffix.lower() in FILMS:
        return film(run, out, field=field, walls=walls, view=direction)
    return picture(run, frame, field=field, walls=walls, view=direction, width=width).save(out)


def _direction(text: str) -> tuple[float, ...]:
    """Convert "X,Y,Z" to numbers.

    **Raises:** ValueError unless it has three of them.
    """
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3:
        raise ValueError(f"--view {text!r} must be three numbers, such as -0.45,-0.8,0.55.")
    return numbers
