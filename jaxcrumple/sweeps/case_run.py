"""A case of a sweep while it runs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from jaxcrumple.io.sketch import sketch_scene
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.solvers.start import check_start
from jaxcrumple.state import State, initial_state
from jaxcrumple.sweeps.case_files import UNFINISHED, CaseFiles
from jaxcrumple.sweeps.cases import Case, Limits, blamed
from jaxcrumple.sweeps.measures import Measure, measured
from jaxcrumple.sweeps.outcome import Outcome, broken, spent_by
from jaxcrumple.sweeps.table import Tell


class Plan(NamedTuple):
    """What all cases of a sweep share: `times` (f,) in s of the frames, how to `measure` them, `limits`, and
    the `folder` that keeps what they reach, None to keep nothing."""

    times: Float[np.ndarray, " times"]
    measure: Measure
    limits: Limits
    folder: Path | None = None

    def files(self, case: Case) -> CaseFiles | None:
        """Return the files of a case."""
        return None if self.folder is None else CaseFiles(self.folder, case.name)


class CaseRun:
    """A case from where it begins or goes on: its `setup`, `state` and `frames` so far.

    It is an observer that measures each frame, and saves what is reached if the plan has a folder. A
    measurement that raises ends the case, whose outcome then tells the exception.
    """

    def __init__(self, case: Case, plan: Plan):
        self.plan, self.files = plan, plan.files(case)
        self.setup = case.build()
        self.state = initial_state(self.setup.scene, self.setup.x)
        self.frames: list[xr.Dataset] = []
        with blamed(case.name):
            check_start(self.setup.scene, self.state)
        if self.files is not None:
            self.built = sketch_scene(self.setup.scene, self.setup.x)
            self.files.check_built(self.built)
            self.state, self.frames = self.files.saved(self.state)

    def frame(self, index: int, state: State) -> None:
        """Measure a frame."""
        self.frames.append(measured(self.plan.measure, self.setup, state))
        if self.files is not None and index + 1 < len(self.plan.times):
            self.files.save_frames(self.frames, self.built)
            self._save(state)

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Save the state."""
        self._save(state)

    def end(self, state: State, result: str) -> Outcome:
        """Return the outcome, and save it unless the case can go on."""
        outcome = Outcome(result, self.frames, spent_by(state))
        if result in UNFINISHED:
            self._save(state)
        elif self.files is not None:
            self.files.finish(outcome, self.built)
        return outcome

    def fail(self, error: Exception) -> Outcome:
        """Return the outcome of a case that an exception ended; the next call tries it again."""
        return broken(error, self.frames)

    def _save(self, state: State) -> None:
        if self.files is not None:
            self.files.save_state(state, len(self.frames), self.built)


def complete(
    cases: Sequence[Case],
    first: Setup,
    plan: Plan,
    run: Callable[[list[Case]], list[Outcome]],
    tell: Tell,
) -> list[Outcome]:
    """Read the outcomes of cases that have ended in the folder of a plan, and `run` the others.

    `first`: setup of the first case.

    **Raises:** `RunDirectoryError` for a damaged file, or if the first case is now built otherwise.
    """
    files = [plan.files(case) for case in cases]
    if files[0] is not None:
        files[0].check_built(sketch_scene(first.scene, first.x))
    outcomes = [None if file is None else file.outcome() for file in files]
    for case, outcome in zip(cases, outcomes, strict=True):
        if outcome is not None:
            tell(case.name, outcome.result)
    missing = [case for case, outcome in zip(cases, outcomes, strict=True) if outcome is None]
    found = iter(run(missing) if missing else [])
    return [next(found) if outcome is None else outcome for outcome in outcomes]
