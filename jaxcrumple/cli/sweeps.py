"""Commands `jaxcrumple sweep`, `campaign` and `ensemble`."""

from pathlib import Path
from typing import Annotated

import typer

from jaxcrumple.cli.console import check_place, noted, say
from jaxcrumple.cli.device import Device, use_device
from jaxcrumple.cli.limits import Limit, all_must_succeed, seconds
from jaxcrumple.cli.outcome import tell_case, tell_ensemble

SweepPath = Annotated[
    Path, typer.Argument(help="TOML file: scene, t_end, frames, max_seconds; tables settings, over.")
]
SchedulerAddress = Annotated[
    str | None, typer.Option(help="Address of a Dask scheduler (default: workers on this machine).")
]
Lanes = Annotated[
    int | None, typer.Option(min=1, help="Cases side by side in one program, for GPUs; others wait.")
]


def sweep(
    file: SweepPath,
    out: Annotated[Path | None, typer.Option(help="New netCDF file (default: FILE with .nc).")] = None,
    backend: Annotated[str, typer.Option(help="auto, batch or processes.")] = "auto",
    scheduler: SchedulerAddress = None,
    lanes: Lanes = None,
    folder: Annotated[
        Path | None, typer.Option(help="Folder to save cases in while they run; the same command goes on.")
    ] = None,
    max_seconds: Limit = None,
    device: Device = None,
) -> None:
    """Run a scene over a grid of option values, and write all results to one netCDF file."""
    use_device(device, scheduler)
    from jaxcrumple.io.atomic import write_bytes
    from jaxcrumple.simulation import frame_times
    from jaxcrumple.sweeps.batch import LANES
    from jaxcrumple.sweeps.file import read_sweep
    from jaxcrumple.sweeps.sweep import sweep

    limit, asked = seconds(max_seconds), read_sweep(file)
    path = out or file.with_suffix(".nc")
    if path.exists():
        raise ValueError(f"{path} exists; give another --out, or remove it.")
    check_place(path, "--out")
    kept = "a sweep without --folder saves nothing before its end"
    if folder is not None:
        kept = f"what was saved is kept in {folder}; go on with the same command"
    with noted(lambda: kept):
        table = sweep(
            asked.scene,
            asked.over,
            frame_times(asked.end, asked.frames or 1)[1:],
            settings=asked.settings,
            backend=backend,  # type: ignore[arg-type]
            cluster=scheduler,
            lanes=LANES if lanes is None else lanes,
            folder=folder,
            max_seconds=asked.max_seconds if limit is None else limit,
            tell=tell_case,
        )
    write_bytes(path, bytes(table.to_netcdf(engine="scipy")))
    say(f"{table.result.size} runs in {table.attrs['seconds']:.0f} s: {path}")
    all_must_succeed(bool((table.result == "success").all()))


def campaign(
    file: SweepPath,
    out: Annotated[Path | None, typer.Option(help="Folder of all runs (default: runs/FILE).")] = None,
    scheduler: SchedulerAddress = None,
    lanes: Lanes = None,
    max_seconds: Limit = None,
    device: Device = None,
) -> None:
    """Run a scene over a grid, one resumable run folder per case; run again to complete the missing ones."""
    use_device(device, scheduler)
    from jaxcrumple.sweeps.campaign import campaign
    from jaxcrumple.sweeps.cases import grid
    from jaxcrumple.sweeps.file import read_sweep

    limit, asked, folder = seconds(max_seconds), read_sweep(file), out or Path("runs") / file.stem
    frames = {} if asked.frames is None else {"frames": asked.frames}
    runs = grid(asked.scene, asked.over, asked.settings | frames, t_end=asked.end)
    limit = asked.max_seconds if limit is None else limit
    before = sum((folder / name / "summary.json").exists() for name in runs)
    say(f"{len(runs)} runs, {before} of them ended before; each kind of run compiles first, a minute or so")
    with noted(lambda: f"what was saved is kept in {folder}; go on with the same command"):
        table = campaign(runs, folder, cluster=scheduler, lanes=lanes or 1, max_seconds=limit, tell=tell_case)
    say(f"{len(table)} runs: {folder / 'campaign.csv'}")
    all_must_succeed(bool((table["result"] == "success").all()))


def ensemble(
    folder: Annotated[Path, typer.Argument(help="Folder of a campaign, ended or not.")],
) -> None:
    """Write mean, spread and interval over the seeds of each measure of a campaign to its ensemble.csv."""
    from jaxcrumple.sweeps.ensemble import write_ensemble

    statistics, path = write_ensemble(folder)
    tell_ensemble(statistics)
    say(f"mean, standard deviation and 95 % interval of all measures: {path}")
