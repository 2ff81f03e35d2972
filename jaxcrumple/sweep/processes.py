"""Each case of a sweep as a run of its own, in worker processes."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr

from jaxcrumple.scenes import Setup
from jaxcrumple.simulate import simulate
from jaxcrumple.state import State, initial_state
from jaxcrumple.sweep.cases import Case, blamed
from jaxcrumple.sweep.cluster import Cluster, connected, run_all
from jaxcrumple.sweep.table import Measure, Outcome, Tell, measured


class _Frames:
    """Measures every frame of a run."""

    def __init__(self, measure: Measure, setup: Setup):
        self.measure, self.setup = measure, setup
        self.found: list[xr.Dataset] = []

    def frame(self, index: int, state: State) -> None:
        self.found.append(measured(self.measure, self.setup, state))

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        pass


def run_case(case: Case, times: np.ndarray, measure: Measure, max_attempts: float) -> Outcome:
    """One case, alone."""
    setup = case.build()
    frames = _Frames(measure, setup)
    state = initial_state(setup.scene, setup.x)
    budget = None if np.isinf(max_attempts) else int(max_attempts)
    with blamed(case.name):
        solution = simulate(
            setup.scene, state, times, solver=case.solver, observers=[frames], max_attempts=budget
        )
    return Outcome(solution.result, jax.device_get(solution.state), frames.found)


def run_processes(
    cases: Sequence[Case],
    times: np.ndarray,
    measure: Measure,
    max_attempts: float,
    cluster: Cluster,
    tell: Tell,
) -> list[Outcome]:
    """Outcomes of the cases, each a run in a worker of the cluster.

    **Raises:** ValueError for a case that cannot be built, before any of them runs.
    """
    outcomes: dict[int, Outcome] = {}
    with connected(cluster, len(cases)) as client:
        for _, future in run_all(client, _check, [(case,) for case in cases]):
            future.result()
        jobs: list[Any] = [(case, times, measure, max_attempts) for case in cases]
        for index, future in run_all(client, run_case, jobs):
            outcomes[index] = future.result()
            tell(cases[index].name, outcomes[index].result)
    return [outcomes[index] for index in range(len(cases))]


def _check(case: Case) -> None:
    """Build a case and drop it."""
    case.build()
