"""Run campaigns: many runs, each in its own folder; a repeated call completes the missing runs."""

import os
from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import pandas as pd
from distributed import Client

from jaxcrumple._jax.tree import require_limit
from jaxcrumple.io import RunDirectory, RunDirectoryError
from jaxcrumple.io.atomic import refusal, write_bytes
from jaxcrumple.io.rundir import is_run
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.run.config import RunConfig
from jaxcrumple.run.estimate import require_config
from jaxcrumple.run.run import stored_config
from jaxcrumple.solvers.start import check_start
from jaxcrumple.state import initial_state
from jaxcrumple.sweeps.batch import require_lanes
from jaxcrumple.sweeps.cases import blamed
from jaxcrumple.sweeps.cluster import Cluster, connected, local_workers, run_all
from jaxcrumple.sweeps.run_members import (
    check_same,
    ended_summary,
    flat_options,
    lane_solver,
    run_missing,
    run_missing_as_lanes,
    summary_of,
)
from jaxcrumple.sweeps.table import Tell

TABLE = "campaign.csv"
# Longest name of a folder in bytes. The folder of the campaign also holds a table and the locks.
LONGEST = 255
# What stands for the summary of a run that goes on.
UNFINISHED = {"result": "unfinished"}
# A job of a worker that runs lanes has at most WAITING times as many runs.
WAITING = 4


def campaign(
    runs: Mapping[str, RunConfig],
    folder: str | Path,
    *,
    cluster: Cluster = None,
    lanes: int = 1,
    max_seconds: float | None = None,
    tell: Tell = lambda name, result: None,
) -> pd.DataFrame:
    """Complete the runs that are missing in `folder`, side by side, each in a subfolder of its name.

    Runs save checkpoints. If a worker is lost, another worker resumes its run from the last checkpoint. A
    repeated call resumes unfinished runs and only reads finished ones. A run that raises an exception does
    not stop the others: its result is "error" with a message, and the next call tries it again.

    **Arguments:**

    - `runs`: configurations by name, from `configure` or `grid`.
    - `cluster`: as in `sweep`; its workers must have access to `folder`.
    - `lanes`: number of runs that a worker takes side by side as lanes of one program, for GPUs. Each worker
      gets a group of runs, of which those that end make room for the others, and tells them when the group
      ends. Lanes take the two-level solver by default.
    - `max_seconds`: wall time of each run, without compile time, after which it ends with the result
      "budget"; a repeated call resumes it.
    - `tell`: called with name and result of each run as it ends.

    **Returns:** a table with one row for each run: the options in which runs differ, such as thickness, then
    from result on its `summary.json`, such as crease_length and energy.bending. The file `campaign.csv`
    also has the runs of earlier campaigns in the folder, and is written even if this call is interrupted.

    **Raises:** ValueError, before any run starts, for a name that no folder can have, a folder that holds
    another run, a value that is no configuration, a run that cannot be built, or `lanes` of a solver that
    takes one sheet at a time; `WorkersLostError` if all workers or their scheduler are lost.
    """
    require_limit("max_seconds", max_seconds)
    require_lanes(lanes)
    place = Path(folder).absolute()
    check_runs(runs, place)
    if lanes > 1:
        for name, config in runs.items():
            with blamed(name):
                lane_solver(config)
    summaries = {name: ended_summary(place / name) for name in runs}
    for name, summary in summaries.items():
        if summary:
            tell(name, summary["result"])
    missing = [name for name, summary in summaries.items() if not summary]
    try:
        if missing:
            require_config(runs[missing[0]], local_workers(cluster, len(missing)))
            with connected(cluster, len(missing)) as client:
                for name, summary in _done(
                    client, {name: runs[name] for name in missing}, place, max_seconds, lanes
                ):
                    summaries[name] = summary
                    tell(name, summary["result"])
    finally:
        _write_table(runs, summaries, place)
    return _table(runs, summaries)


def read_campaign(folder: str | Path) -> pd.DataFrame:
    """Return the table of all runs in a folder as they are now, started by a campaign or one by one.

    A run that has not ended has the result "unfinished".

    **Raises:** ValueError for a folder without runs, `RunDirectoryError` for a damaged run.
    """
    folders = {path.name: path for path in sorted(Path(folder).glob("*")) if is_run(path)}
    if not folders:
        raise ConfigError(f"{folder} has no folders of runs; give the folder of a campaign.")
    stored = {name: stored_config(RunDirectory.open(path)) for name, path in folders.items()}
    return _table(stored, {name: summary_of(path) or UNFINISHED for name, path in folders.items()})


def _write_table(
    runs: Mapping[str, RunConfig], summaries: Mapping[str, Mapping[str, Any]], place: Path
) -> None:
    """Write the table of all ended runs in the folder."""
    others = {path.parent.name: path.parent for path in sorted(place.glob("*/summary.json"))}
    earlier = {name: summary_of(path) for name, path in others.items() if not summaries.get(name)}
    ended = {name: summary for name, summary in {**summaries, **earlier}.items() if summary}
    if ended:
        known = {name: runs.get(name) or stored_config(RunDirectory.open(others[name])) for name in ended}
        write_bytes(place / TABLE, _table(known, ended).to_csv().encode(errors="backslashreplace"))


def _table(runs: Mapping[str, RunConfig], summaries: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return a table with one row for each run: the options in which runs differ, then its summary from
    `result` on."""
    index = pd.Index(list(summaries), name="run")
    rows = pd.json_normalize(list(summaries.values())).set_index(index)
    options = pd.DataFrame([flat_options(runs[name]) for name in summaries], index=index)
    differ = options.astype(str).nunique() > 1
    varied = options.loc[:, differ].rename(columns=lambda name: name.rpartition(".")[2])
    # The summary of a run that raised an exception has no options.
    both = varied.columns.intersection(rows.columns)
    varied[both] = rows[both].where(rows[both].notna(), varied[both])
    return varied.join(rows[["result", *rows.columns.difference(["result", *both], sort=False)]])


def check_runs(runs: Mapping[str, RunConfig], place: Path) -> None:
    """Check the runs of a campaign and create its folder.

    **Raises:** as `campaign`.
    """
    if not isinstance(runs, Mapping) or not runs:
        raise ConfigError("runs must be configurations by name, such as jaxcrumple.grid(...) returns.")
    for name, config in runs.items():
        if not isinstance(config, RunConfig):
            raise ConfigError(
                f"run {name!r} is a {type(config).__name__}; make a configuration with jaxcrumple.configure."
            )
        if not isinstance(name, str) or Path(name).name != name or name.startswith(".") or name == TABLE:
            raise ConfigError(f"run {name!r} has a name that no folder may have; choose another one.")
        if (size := len(os.fsencode(name))) > LONGEST:
            raise ConfigError(
                f"run {name[:40]!r}... has a name of {size} bytes; a folder's name may have {LONGEST}; "
                "choose a shorter one."
            )
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refusal(place, error) from error
    for name, config in runs.items():
        # A damaged run does not stop the others; the table holds its message.
        with suppress(RunDirectoryError) if is_run(place / name) else nullcontext():
            check_same(name, config, place / name)


def _done(
    client: Client, runs: Mapping[str, RunConfig], place: Path, limit: float | None, lanes: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield names and summaries of runs as they end, or as their group ends."""
    names = list(runs)
    for _, future in run_all(client, _check, [(name, runs[name]) for name in names]):
        future.result()
    groups = _groups(names, lanes, len(client.scheduler_info(n_workers=-1)["workers"]))
    jobs: list[Any] = [({place / name: runs[name] for name in group}, lanes, limit) for group in groups]
    for index, future in run_all(client, _run_group, jobs):
        error = future.exception()
        broken = {"result": "error", "message": f"{type(error).__name__}: {error}"}
        summaries = [broken] * len(groups[index]) if error is not None else future.result()
        yield from zip(groups[index], summaries, strict=True)


def _groups(names: list[str], lanes: int, workers: int) -> list[list[str]]:
    """Divide runs into jobs of the workers: single runs, or batches in which some wait for free lanes."""
    if lanes == 1:
        return [[name] for name in names]
    size = min(WAITING * lanes, max(lanes, -(-len(names) // max(1, workers))))
    count = -(-len(names) // size)
    # Neighbours in the list differ in the option that varies fastest; each job has some of all values.
    return [names[first::count] for first in range(count)]


def _run_group(runs: dict[Path, RunConfig], lanes: int, limit: float | None) -> list[dict[str, Any]]:
    if lanes > 1:
        return run_missing_as_lanes(runs, lanes, limit)
    return [run_missing(config, folder, limit) for folder, config in runs.items()]


def _check(name: str, config: RunConfig) -> None:
    """Build a run to check it, and refuse an impossible start."""
    with blamed(name):
        require_config(config)
        setup = config.build()
        check_start(setup.scene, initial_state(setup.scene, setup.x))
