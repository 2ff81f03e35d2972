"""Commands `jaxcrumple run`, `check`, `calibrate`, `sweep`, `campaign`, `figure` and others."""

import importlib.metadata
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jaxcrumple.cli.calibrate import calibrations
from jaxcrumple.cli.console import (
    command,
    console,
    keep_programs,
    noted,
    run_program,
    say,
)
from jaxcrumple.cli.dataset import dataset
from jaxcrumple.cli.device import Device, use_device
from jaxcrumple.cli.figures import figure
from jaxcrumple.cli.help import explain, report
from jaxcrumple.cli.limits import Limit, all_must_succeed, seconds
from jaxcrumple.cli.outcome import tell_next, tell_outcome
from jaxcrumple.cli.pictures import draw_run, plot, view
from jaxcrumple.cli.sweeps import campaign, ensemble, sweep

if TYPE_CHECKING:
    from pydantic import BaseModel

    from jaxcrumple.run.config import RunConfig

app = typer.Typer(
    help="Simulate thin elastoplastic sheets that fold, buckle and crumple.",
    epilog="Exit codes: 0 success; 1 a run ended without success, or memory ran out; 2 refused, with the "
    "reason in the message; 70 a bug of the program; 130 Ctrl-C; 143 SIGTERM; 141 the output has no reader.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _version(asked: bool) -> None:
    if asked:
        say(f"jaxcrumple {importlib.metadata.version('jaxcrumple')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and stop.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    keep_programs()


def main() -> None:
    """Run the command line in double precision; end every command with one line and an exit code."""
    run_program(app)


SceneOrFile = Annotated[
    str,
    typer.Argument(
        metavar="SCENE|FILE.toml|MODULE:FUNCTION",
        help="A scene (see `jaxcrumple scenes`), a scene file, or a function that returns a Setup, in a "
        "module or in FILE.py.",
    ),
]
Nodes = Annotated[int | None, typer.Option(help="Nodes of the mesh (default: 1000).")]
EndTime = Annotated[str | None, typer.Option(help="End time in s, or with a unit (default: the scene's).")]
Seed = Annotated[int | None, typer.Option(help="Seed of mesh and imperfection (default: 0).")]
Setting = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="An option of scene, material or solver; repeatable."),
]


@app.command()
def run(
    scene: SceneOrFile,
    nodes: Nodes = None,
    t_end: EndTime = None,
    seed: Seed = None,
    settings: Setting = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder for results (default: runs/SCENE or FILE).")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    max_seconds: Limit = None,
    device: Device = None,
) -> None:
    """Run a scene and write its trajectory, tables, checkpoint, summary and pictures to a folder."""
    use_device(device)
    folder, limit = out or Path("runs") / Path(scene.rpartition(":")[2]).stem, seconds(max_seconds)
    given = {"nodes": nodes, "t_end": t_end, "seed": seed}
    asked: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    stored = resume and not asked and not settings and not _is_file(scene)
    config = _stored(folder, scene) if stored else _asked(scene, settings, asked)

    # After the refusals, because they take seconds.
    from jaxcrumple.run.config import pairs
    from jaxcrumple.run.progress import ConsoleProgress
    from jaxcrumple.run.run import check_resumable, flat, resume_run, start_run

    if resume:
        named = [*asked, *(key for key, _ in pairs(settings or ()))]
        check_resumable(config, flat(config) if _is_file(scene) else named, folder)
    go_on = _resume_command(scene, folder, asked, settings)
    with noted(lambda: _kept(folder, go_on)):
        with ConsoleProgress(config.t_end, console) as progress:
            go = partial(resume_run, folder) if resume else partial(start_run, config, folder)
            summary = go([progress], max_seconds=limit)
        tell_outcome(summary)
    draw = command("plot", folder)
    with noted(lambda: f"the run has ended and is saved; draw it with: {draw}"), console.status("drawing"):
        pictures = draw_run(folder)
    for picture in pictures:
        say(f"picture: {picture}")
    tell_next(summary, folder, go_on)
    all_must_succeed(summary["result"] == "success")


# A sheet of thin paper in a sphere, to 4.1 cm: small enough to take about a minute with compiling.
DEMO = {"nodes": 500, "t_end": "3", "settings": ["thickness=0.1 mm", "rtol=3e-2"]}


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="New folder for results.")] = Path("runs/demo"),
    show: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Crumple a small sheet in a minute, draw it, and write a page to turn it in a browser."""
    run("radial", out=out, **DEMO)  # type: ignore[arg-type]
    view([out], show=show)


def _stored(folder: Path, scene: str) -> "RunConfig":
    """Return the configuration of the run in a folder, of this `scene`."""
    from jaxcrumple.io import RunDirectory
    from jaxcrumple.run.run import stored_config
    from jaxcrumple.scenes.functions import absolute

    return stored_config(RunDirectory.open(folder)).model_copy(update={"scene": absolute(scene)})


def _resume_command(scene: str, folder: Path, asked: dict[str, Any], settings: Sequence[str] | None) -> str:
    """Return the command that resumes a run; it repeats the options that replace values of a scene file."""
    repeated: list[Any] = []
    if _is_file(scene):
        for key, value in asked.items():
            repeated += [f"--{key.replace('_', '-')}", value]
        for setting in settings or ():
            repeated += ["--set", setting]
    return command("run", scene, *repeated, "--resume", "--out", folder)


def _kept(folder: Path, go_on: str) -> str:
    """Describe what an interrupted run has saved, and how to resume it."""
    saved = (folder / "run.json").exists()
    return f"what was saved is kept; go on with: {go_on}" if saved else "nothing was saved yet"


@app.command()
def check(
    scene: SceneOrFile,
    nodes: Nodes = None,
    t_end: EndTime = None,
    seed: Seed = None,
    settings: Setting = None,
) -> None:
    """Describe a run and estimate its cost; build its scene and report forces at the start.

    This compiles only the forces at the start, not the run.
    """
    given = {"nodes": nodes, "t_end": t_end, "seed": seed}
    config = _asked(scene, settings, {key: value for key, value in given.items() if value is not None})

    from jaxcrumple.run.check import check_built, described

    for line in described(config):
        say(line)
    balance = check_built(config)
    say(
        "starts in balance, clear of itself and its walls"
        if balance.in_balance
        else "starts out of balance, so the sheet moves at once:"
    )
    for line in balance.lines:
        say(f"  {line}")


def _is_file(scene: str) -> bool:
    return scene.endswith(".toml")


def _asked(scene: str, settings: list[str] | None, top: dict[str, Any]) -> "RunConfig":
    """Configure a scene or a scene file with the options of the command."""
    if _is_file(scene):
        from jaxcrumple.run.scene_file import read_scene_file

        return read_scene_file(scene, settings=settings or (), **top)
    from jaxcrumple.run.config import configure

    return configure(scene, settings=settings or (), **top)


app.add_typer(calibrations, name="calibrate")

for of_many in (sweep, campaign, ensemble, figure):
    app.command()(of_many)


@app.command()
def scenes(
    toml: Annotated[
        str | None, typer.Option(metavar="SCENE", help="Write a scene file with all defaults instead.")
    ] = None,
) -> None:
    """List the scenes and their options with defaults."""
    from jaxcrumple.run.config import MaterialOptions, RunConfig, SolverOptions
    from jaxcrumple.scenes.catalogue import SCENES

    if toml is not None:
        from jaxcrumple.run.template import template

        print(template(toml), end="")
        return
    for name, entry in SCENES.items():
        console.print(f"[bold]{name}[/bold]: {entry.summary}; ends at t = {entry.t_end:g} s")
        _print_options(entry.options)
    console.print(
        f"[bold]every run[/bold]\n  frames={RunConfig.model_fields['frames'].default} saved after the start"
    )
    _print_options(MaterialOptions)
    _print_options(SolverOptions)


def _print_options(model: "type[BaseModel]") -> None:
    from jaxcrumple.options.units import unit_of

    def shown(field: Any) -> str:
        unit, text = unit_of(field), str(field.default)
        return text if unit is None or field.default is None else f"{text} {unit.symbol}"

    options = ", ".join(f"{name}={shown(field)}" for name, field in model.model_fields.items())
    console.print(f"  {model.__doc__}\n    {options}", markup=False)


for other in (dataset, plot, view, explain, report):
    app.command()(other)


@app.command()
def verify(folder: Annotated[Path, typer.Argument(help="Folder of a run, or of several.")]) -> None:
    """Compare all files of a run with their checksums; change nothing."""
    from jaxcrumple.io import RunDirectory, verify_runs

    found = verify_runs(folder)
    for place, wrong in found.items():
        counts = "" if wrong else ", {2} frames, {0} rows of history".format(*RunDirectory.open(place).counts)
        say(f"{place}: {'damaged' if wrong else 'sound'}{counts}")
        for cause in wrong.values():
            say(f"  {cause}")
        if wrong:
            say(f"  return to the last undamaged checkpoint: {command('repair', place)}")
    if any(found.values()):
        raise typer.Exit(1)


@app.command()
def repair(folder: Annotated[Path, typer.Argument(help="Folder of a run.")]) -> None:
    """Return a damaged run to its last undamaged checkpoint, so that it can be resumed."""
    from jaxcrumple.io import RunDirectory
    from jaxcrumple.run.run import repair_run

    t = repair_run(folder)
    if t is None:
        say(f"{folder} is sound; nothing was changed")
        return
    run = RunDirectory.open(folder)
    counts, go_on = run.counts, _resume_command(run.config["scene"], folder, {}, None)
    say(f"{counts.frames} frames and {counts.history_rows} rows of history are left")
    if pictures := sorted(path.name for path in folder.glob("*.png")):
        say(f"pictures from before the repair: {', '.join(pictures)}")
    say(f"{folder} is at t = {t:.4g} s again; go on with: {go_on}")
