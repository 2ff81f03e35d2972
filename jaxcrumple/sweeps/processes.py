"""Run each case of a sweep as a separate run in a worker process."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.start import check_start
from jaxcrumple.state import initial_state
from jaxcrumple.sweeps.cases import Case, Limits, blamed
from jaxcrumple.sweeps.cluster import Cluster, connected, run_all
from jaxcrumple.sweeps.errors import WorkersLostError
from jaxcrumple.sweeps.table import Frames, Measure, Outcome, Tell, broken


def run_case(case: Case, times: Float[np.ndarray, " times"], measure: Measure, limits: Limits) -> Outcome:
    """Run one case. If it raises, e.g. in `measure`, the outcome keeps the earlier frames."""
    setup = case.build()
    frames = Frames(measure, setup)
    state = initial_state(setup.scene, setup.x)
    try:
        solution = simulate(
            setup.scene,
            state,
            times,
            solver=case.solver,
            observers=[frames],
            max_attempts=None if np.isinf(limits.attempts) else int(limits.attempts),
            max_seconds=limits.seconds,
        )
    except Exception as error:
        return broken(error, frames.found)
    return Outcome(solution.result, frames.found, jax.device_get(solution.state))


def run_processes(
    cases: Sequence[Case],
    times: Float[np.ndarray, " times"],
    measure: Measure,
    limits: Limits,
    cluster: Cluster,
    tell: Tell,
) -> list[Outcome]:
    """Run each case in a worker of the cluster and return the outcomes.

    If workers or their scheduler are lost for good, unfinished cases have the result "error".

    **Raises:** ValueError, before any case runs, for a case that cannot be built or cannot start;
    `WorkersLostError` if the workers are lost before that, or cannot run any case.
    """
    outcomes: dict[int, Outcome] = {}
    with connected(cluster, len(cases)) as client:
        for _, future in run_all(client, _check, [(case,) for case in cases]):
            future.result()
        jobs: list[Any] = [(case, times, measure, limits) for case in cases]
        try:
            for index, future in run_all(client, run_case, jobs):
                error = future.exception()
                outcomes[index] = future.result() if error is None else broken(error)
                tell(cases[index].name, outcomes[index].result)
        except WorkersLostError as error:
            for index in set(range(len(cases))) - set(outcomes):
                outcomes[index] = broken(error)
                tell(cases[index].name, outcomes[index].result)
    return [outcomes[index] for index in range(len(cases))]


def _check(case: Case) -> None:
    """Build a case to check it, and check its start."""
    setup = case.build()
    with blamed(case.name):
        check_start(setup.scene, initial_state(setup.scene, setup.x))
