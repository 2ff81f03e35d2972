"""The command line: `jaxcrumple run`, `check`, `calibrate`, `sweep`, `campaign`, `figure` and others."""

import importlib.metadata
import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import jax
import typer
from rich.console import Console

if TYPE_CHECKING:
    from jaxcrumple.config import RunConfig

app = typer.Typer(
    help="Simulate thin elastoplastic sheets that fold, buckle and crumple.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
console = Console()


def _version(asked: bool) -> None:
    if asked:
        console.print(f"jaxcrumple {importlib.metadata.version('jaxcrumple')}", highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and stop.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point: double precision, a compilation cache, and errors as one line."""
    jax.config.update("jax_enable_x64", True)
    _enable_compilation_cache()
    try:
        app()
    except (ValueError, OverflowError) as error:
        # Every refusal of the library names its cause and cure; a traceback would hide it.
        Console(stderr=True).print(
            f"error: {error}", style="red", markup=False, highlight=False, soft_wrap=True
        )
        sys.exit(2)


def _enable_compilation_cache() -> None:
    """Keep compiled programs between runs, unless the user chose a place or none."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(base / "jaxcrumple" / "xla"))


SceneOrFile = Annotated[
    str, typer.Argument(metavar="SCENE|FILE.toml", help="A scene (see `jaxcrumple scenes`) or a scene file.")
]
Nodes = Annotated[int | None, typer.Option(help="Nodes of the mesh (default: 1000).")]
EndTime = Annotated[str | None, typer.Option(help="End time in s, or with a unit (default: the scene's).")]
Seed = Annotated[int | None, typer.Option(help="Seed of mesh and imperfection (default: 0).")]
Setting = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="An option of scene, material or solver; may repeat."),
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
) -> None:
    """Run a scene and write its trajectory, tables, checkpoint, summary and pictures to a folder."""
    from jaxcrumple.config import pairs
    from jaxcrumple.io import RunDirectory
    from jaxcrumple.progress import ConsoleProgress
    from jaxcrumple.run import check_resumable, flat, resume_run, start_run, stored_config

    folder = out or Path("runs") / Path(scene).with_suffix("").name
    given = {"nodes": nodes, "t_end": t_end, "seed": seed}
    asked: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    if resume and not asked and not settings and not _is_file(scene):
        config = stored_config(RunDirectory.open(folder)).model_copy(update={"scene": scene})
    else:
        config = _asked(scene, settings, asked)
    if resume:
        named = [*asked, *(key for key, _ in pairs(settings or ()))]
        check_resumable(config, flat(config) if _is_file(scene) else named, folder)
    try:
        with ConsoleProgress(config.t_end, console) as progress:
            summary = resume_run(folder, [progress]) if resume else start_run(config, folder, [progress])
    except KeyboardInterrupt:
        console.print(f"stopped; go on with: jaxcrumple run {scene} --resume --out {folder}", soft_wrap=True)
        raise typer.Exit(130) from None
    pictures = _plot(folder)
    _report(summary, folder, pictures)
    if summary["result"] != "success":
        raise typer.Exit(1)


@app.command()
def check(
    scene: SceneOrFile,
    nodes: Nodes = None,
    t_end: EndTime = None,
    seed: Seed = None,
    settings: Setting = None,
) -> None:
    """Say what a scene or a scene file will run and what that takes; build it and say what pushes its start.

    No run is compiled, only the forces at the start.
    """
    from jaxcrumple.check import check_built, described

    given = {"nodes": nodes, "t_end": t_end, "seed": seed}
    config = _asked(scene, settings, {key: value for key, value in given.items() if value is not None})
    for line in described(config):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    balance = check_built(config)
    console.print(
        "starts in balance, clear of itself and its walls"
        if balance.in_balance
        else "starts out of balance, so the sheet moves at once:"
    )
    for line in balance.lines:
        console.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)


def _is_file(scene: str) -> bool:
    return scene.endswith(".toml")


def _asked(scene: str, settings: list[str] | None, top: dict[str, Any]) -> "RunConfig":
    """The configuration of a scene or a scene file, with what else is given."""
    from jaxcrumple.config import configure
    from jaxcrumple.scene_file import read_scene_file

    make = read_scene_file if _is_file(scene) else configure
    return make(scene, settings=settings or (), **top)


calibrations = typer.Typer(help="Find properties of a sheet from what is measured.", no_args_is_help=True)
app.add_typer(calibrations, name="calibrate")


@calibrations.command("fold")
def calibrate_by_fold(
    target_angle: Annotated[float, typer.Option(help="Angle in degrees between the halves; 180 is flat.")],
    nodes: Annotated[int, typer.Option(help="Nodes of the mesh.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of the mesh.")] = 0,
    std: Annotated[float, typer.Option(help="Standard deviation of the angle in degrees.")] = 1.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the result to this file.")] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="File of all runs, from which to go on.")] = None,
) -> None:
    """Find the yield curvature for which a folded sheet keeps an angle."""
    import json
    import math

    from jaxcrumple.calibrate import calibrate_fold

    if not 0 < target_angle < 180:
        raise ValueError(
            f"--target-angle = {target_angle:g} must lie between 0 and 180 degrees; 180 is flat."
        )
    if not (math.isfinite(std) and std > 0):
        raise ValueError(f"--std = {std:g} must be a positive angle in degrees.")
    if json_file is not None:
        _check_place(json_file, "--json")
    found = calibrate_fold(
        math.radians(target_angle),
        nodes=nodes,
        seed=seed,
        std=math.radians(std),
        checkpoint=checkpoint,
        tell=_tell_evaluation,
    )
    result = {
        "yield_curvature": found.yield_curvature,
        "std": found.std,
        "c0": found.c0,
        "c0_std": found.c0_std,
        "angle_deg": math.degrees(found.angle),
        "evaluations": found.fit.evaluations,
        "gradient_evaluations": found.fit.gradient_evaluations,
        "snaps": found.fit.snaps,
        "success": found.success,
        "message": found.fit.message,
        "target_angle_deg": target_angle,
        "nodes": nodes,
        "seed": seed,
    }
    console.print(
        f"yield curvature {found.yield_curvature:.4g} +- {found.std:.2g} 1/m, c0 = {found.c0:.4g}; the fold "
        f"then keeps {result['angle_deg']:.4g} degrees ({found.fit.message})",
        soft_wrap=True,
    )
    if json_file is not None:
        json_file.write_text(json.dumps(result, indent=2))
    if not found.success:
        raise ValueError(f"no yield curvature was found for which the fold keeps {target_angle:g} degrees.")


def _tell_evaluation(row) -> None:
    """A line for each run of a fit that is not known already."""
    if row["kind"] == "residuals" and row["seconds"] > 0.0:
        value, loss, seconds = row["yield_curvature"], row["loss"], row["seconds"]
        console.print(f"yield curvature {value:.5g} 1/m: loss {loss:.3g}, {seconds:.0f} s")


SweepPath = Annotated[Path, typer.Argument(help="TOML file: scene, t_end, frames; tables settings, over.")]
SchedulerAddress = Annotated[
    str | None, typer.Option(help="Address of a Dask scheduler (default: workers on this machine).")
]


@app.command()
def sweep(
    file: SweepPath,
    out: Annotated[Path | None, typer.Option(help="New netCDF file (default: FILE with .nc).")] = None,
    backend: Annotated[str, typer.Option(help="auto, batch or processes.")] = "auto",
    scheduler: SchedulerAddress = None,
) -> None:
    """Run a scene over a grid of its numbers, and write all outcomes to one netCDF file."""
    from jaxcrumple.simulate import frame_times
    from jaxcrumple.sweep.file import read_sweep
    from jaxcrumple.sweep.sweep import sweep

    asked = read_sweep(file)
    path = out or file.with_suffix(".nc")
    if path.exists():
        raise ValueError(f"{path} exists; give another --out, or remove it.")
    _check_place(path, "--out")
    table = sweep(
        asked.scene,
        asked.over,
        frame_times(asked.end, asked.frames or 1)[1:],
        settings=asked.settings,
        backend=backend,  # type: ignore[arg-type]
        cluster=scheduler,
        tell=_tell_case,
    )
    table.to_netcdf(path, engine="scipy")
    console.print(f"{table.result.size} runs in {table.attrs['seconds']:.0f} s: {path}", soft_wrap=True)
    _all_must_succeed((table.result == "success").all())


@app.command()
def campaign(
    file: SweepPath,
    out: Annotated[Path | None, typer.Option(help="Folder of all runs (default: runs/FILE).")] = None,
    scheduler: SchedulerAddress = None,
) -> None:
    """Run a scene over a grid, each run into a folder of its own; again: only what is missing."""
    from jaxcrumple.sweep import campaign, grid
    from jaxcrumple.sweep.file import read_sweep

    asked, folder = read_sweep(file), out or Path("runs") / file.stem
    frames = {} if asked.frames is None else {"frames": asked.frames}
    runs = grid(asked.scene, asked.over, asked.settings | frames, t_end=asked.end)
    table = campaign(runs, folder, cluster=scheduler, tell=_tell_case)
    console.print(f"{len(table)} runs: {folder / 'campaign.csv'}", soft_wrap=True)
    _all_must_succeed((table["result"] == "success").all())


@app.command()
def figure(
    name: Annotated[str, typer.Argument(help="Number of the paper's figure, such as 8b.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of runs and pictures (default: figures/NAME).")
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="At the paper's size, not that of a laptop.")] = False,
) -> None:
    """Do the runs of a figure of the paper that its folder lacks, and draw it."""
    from jaxcrumple.figures import FIGURES, make_figure
    from jaxcrumple.words import nearest

    if name not in FIGURES:
        raise ValueError(f"figure {name!r} is unknown{nearest(name, FIGURES)}")
    folder = out or Path("figures") / (f"{name}_full" if full else name)
    for path in make_figure(FIGURES[name], folder, full=full, tell=_tell_case):
        console.print(str(path), markup=False, highlight=False, soft_wrap=True)


def _check_place(path: Path, option: str) -> None:
    """Refuse a file that cannot be written, before any work for it."""
    folder = path.absolute().parent
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give {option} a file.")
    try:
        with tempfile.TemporaryFile(dir=folder):
            return
    except OSError as error:
        raise ValueError(f"{folder} is no folder that may be written; give another {option}.") from error


def _tell_case(name: str, result: str) -> None:
    console.print(f"{name}: {result}", markup=False, highlight=False, soft_wrap=True)


def _all_must_succeed(success) -> None:
    if not success:
        raise typer.Exit(1)


@app.command()
def scenes(
    toml: Annotated[
        str | None, typer.Option(metavar="SCENE", help="Write a scene file with all defaults instead.")
    ] = None,
) -> None:
    """List the scenes and their options with defaults."""
    from jaxcrumple.config import MaterialOptions, RunConfig, SolverOptions
    from jaxcrumple.scenes import SCENES

    if toml is not None:
        from jaxcrumple.template import template

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


def _print_options(model) -> None:
    options = ", ".join(f"{name}={field.default}" for name, field in model.model_fields.items())
    console.print(f"  {model.__doc__}\n    {options}", markup=False)


@app.command()
def plot(folder: Annotated[Path, typer.Argument(help="Folder of a run, finished or not.")]) -> None:
    """Draw the pictures of a run again, and write its film for ParaView."""
    from jaxcrumple.io import RunDirectory
    from jaxcrumple.run import film

    pictures = _plot(folder)
    for picture in [*pictures, film(RunDirectory.open(folder))]:
        console.print(str(picture), markup=False)


@app.command()
def verify(folder: Annotated[Path, typer.Argument(help="Folder of a run, or of several.")]) -> None:
    """Compare all files of a run with their checksums. Nothing is changed."""
    from jaxcrumple.io import RunDirectory, verify_runs

    found = verify_runs(folder)
    for place, wrong in found.items():
        counts = "" if wrong else ", {2} frames, {0} rows of history".format(*RunDirectory.open(place).counts)
        console.print(f"{place}: {'damaged' if wrong else 'sound'}{counts}", soft_wrap=True)
        for cause in wrong.values():
            console.print(f"  {cause}", markup=False, highlight=False, soft_wrap=True)
        if wrong:
            console.print(f"  go back to what is sound: jaxcrumple repair {place}", soft_wrap=True)
    if any(found.values()):
        raise typer.Exit(1)


@app.command()
def repair(folder: Annotated[Path, typer.Argument(help="Folder of a run.")]) -> None:
    """Take a damaged run back to the last moment at which all of it is sound, to go on from there."""
    from jaxcrumple.io import RunDirectory
    from jaxcrumple.run import repair_run

    t = repair_run(folder)
    if t is None:
        console.print(f"{folder} is sound; nothing was changed", soft_wrap=True)
        return
    scene = RunDirectory.open(folder).config["scene"]
    console.print(
        f"{folder} is at t = {t:.4g} s again; go on with: jaxcrumple run {scene} --resume --out {folder}",
        soft_wrap=True,
    )


def _plot(folder: Path) -> list[Path]:
    from jaxcrumple.plot import plot_run

    return plot_run(folder)


def _report(summary: dict, folder: Path, pictures: list[Path]) -> None:
    steps, share, energy = summary["steps"], summary["dynamic_share"], summary["energy"]
    lines = [
        f"result: {summary['result']} ({summary['message']})",
        f"t = {summary['t_reached']:.4g} s after {summary['run_s']:.0f} s ({summary['cpu_s']:.0f} CPU s; "
        f"{summary['compile_s']:.0f} s of compiling at the last start included), rtol {summary['rtol']:g}",
        f"steps: {steps['quasistatic']} quasistatic, {steps['implicit']} implicit and {steps['explicit']} "
        f"explicit with inertia, {steps['rejected']} "
        f"rejected; {summary['switches']} switches",
        f"inertia: {share['time']:.2%} of the time, {share['steps']:.1%} of the steps",
        f"energy: {energy['bending'] * 1e3:.3g} mJ bending, {energy['stretch'] * 1e3:.3g} mJ stretch",
        f"edge strain: {summary['max_edge_strain']:.2%} largest, {summary['rms_edge_strain']:.2%} rms; "
        f"wall penetration {summary['max_wall_penetration'] * 1e6:.3g} um; "
        f"creases {summary['crease_length'] * 100:.3g} cm",
        *(f"picture: {picture}" for picture in pictures),
        f"all results: {folder}",
    ]
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
