"""Long campaigns: many runs, each in a folder of its own, of which only what is missing is done."""

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
from jaxcrumple.io.lock import writing
from jaxcrumple.io.rundir import is_run, make_folder
from jaxcrumple.run.config import ConfigError, RunConfig
from jaxcrumple.run.estimate import require_config
from jaxcrumple.run.run import resume_run, start_run, stored_config
from jaxcrumple.solvers.start import check_start
from jaxcrumple.state import initial_state
from jaxcrumple.sweep.cases import blamed
from jaxcrumple.sweep.cluster import Cluster, connected, local_workers, run_all
from jaxcrumple.sweep.table import Tell

TABLE = "campaign.csv"
# Bytes of the longest name that a folder may have; a table and the locks stand beside the folders.
LONGEST = 255
# The result of a run whose time was up.
BUDGET = "budget"


def campaign(
    runs: Mapping[str, RunConfig],
    folder: str | Path,
    *,
    cluster: Cluster = None,
    max_seconds: float | None = None,
    tell: Tell = lambda name, result: None,
) -> pd.DataFrame:
    """Do the runs that `folder` lacks, side by side, each into the folder of its name.

    Runs save checkpoints as they go. What a lost worker was at goes on from there in another one, and so
    does what is unfinished when a campaign is started again; what is finished is only read. A run that
    breaks stops alone: it has the result "error" and its message, and is tried again the next time.

    **Arguments:** `runs`: configurations by name, of `configure` or `grid`; `cluster`: as in `sweep`, whose
    workers must see `folder`; `max_seconds`: wall time of each run, compiling left out, after which it ends
    with the result "budget", to go on where the campaign is started again; `tell`: called with name and
    result of each run as it ends.

    **Returns:** a table with a line for each run, the numbers of its `summary.json`. The file
    `campaign.csv` has those of earlier campaigns into the folder as well, and is written too where this one
    is broken off.

    **Raises:** ValueError for a name that is none of a folder, one that holds another run, what is no
    configuration, or a run that cannot be built, before any of them runs; `WorkersLostError` where all
    workers, or their scheduler, are gone.
    """
    require_limit("max_seconds", max_seconds)
    place = Path(folder).absolute()
    _check_runs(runs, place)
    summaries = {name: _ended(place / name) for name in runs}
    for name, summary in summaries.items():
        if summary:
            tell(name, summary["result"])
    missing = [name for name, summary in summaries.items() if not summary]
    try:
        if missing:
            require_config(runs[missing[0]], local_workers(cluster, len(missing)))
            with connected(cluster, len(missing)) as client:
                for name, summary in _done(
                    client, {name: runs[name] for name in missing}, place, max_seconds
                ):
                    summaries[name] = summary
                    tell(name, summary["result"])
    finally:
        _write_table(summaries, place)
    return _table(summaries)


def _write_table(summaries: Mapping[str, Mapping[str, Any]], place: Path) -> None:
    """Write the table of all runs in the folder that have ended."""
    others = {path.parent.name: path.parent for path in sorted(place.glob("*/summary.json"))}
    earlier = {name: _summary(path) for name, path in others.items() if not summaries.get(name)}
    ended = {name: summary for name, summary in {**summaries, **earlier}.items() if summary}
    if ended:
        write_bytes(place / TABLE, _table(ended).to_csv().encode(errors="backslashreplace"))


def _table(summaries: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """A line for each run."""
    rows = pd.json_normalize(list(summaries.values()))
    return rows.set_index(pd.Index(list(summaries), name="run"))


def _check_runs(runs: Mapping[str, RunConfig], place: Path) -> None:
    """Refuse what is no campaign, and make its folder."""
    if not isinstance(runs, Mapping) or not runs:
        raise ConfigError("runs must be configurations by name, such as jaxcrumple.grid(...) makes.")
    for name, config in runs.items():
        if not isinstance(config, RunConfig):
            raise ConfigError(
                f"run {name!r} is a {type(config).__name__}; make its configuration by jaxcrumple.configure."
            )
        if not isinstance(name, str) or Path(name).name != name or name.startswith(".") or name == TABLE:
            raise ConfigError(f"run {name!r} has no name that a folder may have; choose another one.")
        if (size := len(os.fsencode(name))) > LONGEST:
            raise ConfigError(
                f"run {name[:40]!r}... has a name of {size} bytes, and a folder's may have {LONGEST}; choose "
                "a shorter one."
            )
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refusal(place, error) from error
    for name, config in runs.items():
        # A damaged run stops alone, with its message in the table.
        with suppress(RunDirectoryError) if is_run(place / name) else nullcontext():
            _check_same(name, config, place / name)


def _done(
    client: Client, runs: Mapping[str, RunConfig], place: Path, limit: float | None
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Summaries of runs by name, as they end."""
    names = list(runs)
    for _, future in run_all(client, _check, [(name, runs[name]) for name in names]):
        future.result()
    for index, future in run_all(client, run_missing, [(runs[name], place / name, limit) for name in names]):
        error = future.exception()
        broken = {"result": "error", "message": f"{type(error).__name__}: {error}"}
        yield names[index], future.result() if error is None else broken


def run_missing(config: RunConfig, folder: Path, max_seconds: float | None = None) -> dict[str, Any]:
    """Summary of a run, begun, gone on with or read, whichever is left to do.

    Whoever else is at it is waited for.
    """
    if not is_run(folder):
        make_folder(folder)
    with writing(folder, wait=True):
        if not is_run(folder):
            return start_run(config, folder, max_seconds=max_seconds)
        _check_same(folder.name, config, folder)
        return _ended(folder) or resume_run(folder, max_seconds=max_seconds)


def _ended(folder: Path) -> dict[str, Any]:
    """How a run ended; empty where it has not, or only its time was up."""
    summary = _summary(folder)
    return {} if summary.get("result") == BUDGET else summary


def _summary(folder: Path) -> dict[str, Any]:
    """How a run ended; empty where it has not, or where its folder is damaged."""
    try:
        return RunDirectory.open(folder).read_summary() if is_run(folder) else {}
    except RunDirectoryError:
        return {}


def _check_same(name: str, config: RunConfig, folder: Path) -> None:
    if not is_run(folder):
        RunDirectory.check_free(folder)
        return
    stored = stored_config(RunDirectory.open(folder))
    if stored != config:
        here, asked = (_flat(one) for one in (stored, config))
        option = next(key for key in {**here, **asked} if here.get(key) != asked.get(key))
        raise ConfigError(
            f"{folder} holds a run with {option} = {here.get(option)!r}, but {name!r} asks for "
            f"{asked.get(option)!r}; choose another folder or name."
        )


def _flat(config: RunConfig) -> dict[str, Any]:
    """All options by name."""
    return pd.json_normalize(config.model_dump()).iloc[0].to_dict()


def _check(name: str, config: RunConfig) -> None:
    """Build a run, refuse a start from which it cannot proceed, and drop it."""
    with blamed(name):
        require_config(config)
        setup = config.build()
        check_start(setup.scene, initial_state(setup.scene, setup.x))
