"""Runs of a campaign, each in its own folder: alone, or as members of a batch."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from jaxcrumple.contact.lists import ContactLists
from jaxcrumple.io import RunDirectory, RunDirectoryError
from jaxcrumple.io.lock import writing
from jaxcrumple.io.rundir import is_run, make_folder
from jaxcrumple.observers import Observer
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.run.begun import Begun, Ending, LaneRecorder
from jaxcrumple.run.config import RunConfig
from jaxcrumple.run.run import continued, finished, started, stored_config
from jaxcrumple.simulation import message_of
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State
from jaxcrumple.sweeps.batch import run_batch
from jaxcrumple.sweeps.members import Start

# The result of a run that used up its wall time.
BUDGET = "budget"


def run_missing(config: RunConfig, folder: Path, max_seconds: float | None = None) -> dict[str, Any]:
    """Start, resume or read a run, as its folder requires, and return its summary.

    This waits for any other process that writes into the folder.
    """
    with _opened(config, folder, wait=True) as begun:
        return begun if isinstance(begun, dict) else finished(begun, (), max_seconds)


def run_missing_as_lanes(
    runs: Mapping[Path, RunConfig], most: int, max_seconds: float | None = None
) -> list[dict[str, Any]]:
    """Start, resume or read runs by folder, at most `most` side by side, and return their summaries.

    A run that another process writes has the result "error".
    """
    members = [RunMember(folder, config, max_seconds) for folder, config in runs.items()]
    run_batch(members, jax.devices(), most)
    return [member.summary for member in members]


class RunMember:
    """A run of a campaign in a batch; `summary` tells how it ended."""

    def __init__(self, folder: Path, config: RunConfig, max_seconds: float | None):
        self.folder, self.config = folder, config
        self.name, self.solver = folder.name, lane_solver(config)
        self.seconds = np.inf if max_seconds is None else max_seconds
        self.begun: Begun | None = None
        self.recorder: LaneRecorder | None = None
        self.summary: dict[str, Any] = {}
        self.held = ExitStack()

    @property
    def observers(self) -> Sequence[Observer]:
        """What writes the folder."""
        return [] if self.recorder is None else [self.recorder]

    def begin(self) -> Start | None:
        """Open the folder; None if its run has ended or cannot be opened."""
        try:
            begun = self.held.enter_context(_opened(self.config, self.folder, wait=False))
            if isinstance(begun, dict):
                self._keep(begun)
                return None
            ending = begun.ended()
            if ending is not None:
                self._keep(begun.finish(ending))
                return None
        except Exception as error:
            self.fail(error)
            return None
        self.recorder = LaneRecorder(begun.folder, begun.config.frames, begun.recorder.spent)
        self.begun = begun._replace(recorder=self.recorder)
        return Start(begun.setup.scene, begun.state, begun.times, begun.reached, self.seconds)

    def pause(self) -> None:
        """Close the folder."""
        self.begun = self.recorder = None
        self.held.close()

    def spend(self, seconds: float) -> None:
        """Add to the time of the run."""
        if self.recorder is not None:
            self.recorder.spend(seconds)

    def end(self, state: State, result: str, lists: ContactLists | None) -> None:
        """Write what remains to be written."""
        assert self.begun is not None
        message = message_of(self.begun.setup.scene, state, result)
        self._keep(self.begun.finish(Ending(state, result, message, 0.0)))

    def fail(self, error: Exception) -> None:
        """Tell the exception; the folder keeps its last checkpoint."""
        self._keep({"result": "error", "message": f"{type(error).__name__}: {error}"})

    def _keep(self, summary: dict[str, Any]) -> None:
        self.summary = summary
        self.pause()


def lane_solver(config: RunConfig) -> Integrator:
    """Return the solver of a run in a batch: two-level by default, which takes many sheets at a time.

    **Raises:** ConfigError for a linear solver that takes one.
    """
    options = config.solver
    if options.linear is None:
        options = options.model_copy(update={"linear": "two-level"})
    solver = options.build()
    if solver.one_matrix:
        raise ConfigError(
            f"linear = {options.linear!r} handles one sheet at a time; for lanes leave it out or choose "
            "'two-level'."
        )
    return solver


@contextmanager
def _opened(config: RunConfig, folder: Path, *, wait: bool) -> Iterator[Begun | dict[str, Any]]:
    """Begin or continue the run in a folder, which stays locked inside; yield the summary of an ended run."""
    if not is_run(folder):
        make_folder(folder)
    with writing(folder, wait=wait):
        if not is_run(folder):
            with started(config, folder) as begun:
                yield begun
            return
        check_same(folder.name, config, folder)
        summary = ended_summary(folder)
        if summary:
            yield summary
            return
        with continued(folder) as again:
            yield again


def ended_summary(folder: Path) -> dict[str, Any]:
    """Return the summary of an ended run; empty for an unfinished run and for the result "budget"."""
    found = summary_of(folder)
    return {} if found.get("result") == BUDGET else found


def summary_of(folder: Path) -> dict[str, Any]:
    """Return the summary of an ended run; empty if it is unfinished or its folder is damaged."""
    try:
        return RunDirectory.open(folder).read_summary() if is_run(folder) else {}
    except RunDirectoryError:
        return {}


def check_same(name: str, config: RunConfig, folder: Path) -> None:
    """Check that a folder is free or holds a run of these options.

    **Raises:** ConfigError that names the first option that differs.
    """
    if not is_run(folder):
        RunDirectory.check_free(folder)
        return
    stored = stored_config(RunDirectory.open(folder))
    if stored != config:
        here, asked = (flat_options(one) for one in (stored, config))
        option = next(key for key in {**here, **asked} if here.get(key) != asked.get(key))
        raise ConfigError(
            f"{folder} holds a run with {option} = {here.get(option)!r}, but {name!r} asks for "
            f"{asked.get(option)!r}; choose another folder or name."
        )


def flat_options(config: RunConfig) -> dict[str, Any]:
    """Return all options by dotted name."""
    return pd.json_normalize(config.model_dump()).iloc[0].to_dict()
