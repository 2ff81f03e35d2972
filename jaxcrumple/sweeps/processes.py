"""Run each case of a sweep as a separate run in a worker process."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxcrumple.simulation import simulate
from jaxcrumple.sweeps.case_run import CaseRun, Plan
from jaxcrumple.sweeps.cases import Case
from jaxcrumple.sweeps.cluster import Cluster, connected, run_all
from jaxcrumple.sweeps.errors import WorkersLostError
from jaxcrumple.sweeps.outcome import Outcome, broken
from jaxcrumple.sweeps.table import Tell


def run_case(case: Case, plan: Plan) -> Outcome:
    """Run one case. If it raises, e.g. in `measure`, the outcome keeps the earlier frames."""
    run = CaseRun(case, plan)
    try:
        solution = simulate(
            run.setup.scene,
            run.state,
            plan.times,
            solver=case.solver,
            observers=[run],
            first_frame=len(run.frames),
            max_attempts=None if np.isinf(plan.limits.attempts) else int(plan.limits.attempts),
            max_seconds=plan.limits.seconds,
        )
        return run.end(jax.device_get(solution.state), solution.result)
    except Exception as error:
        return run.fail(error)


def run_processes(cases: Sequence[Case], plan: Plan, cluster: Cluster, tell: Tell) -> list[Outcome]:
    """Run each case in a worker of the cluster and return the outcomes.

    If workers or their scheduler are lost for good, unfinished cases have the result "error".

    **Raises:** ValueError, before any case runs, for a case that cannot be built, cannot start or cannot go
    on; `WorkersLostError` if the workers are lost before that, or cannot run any case.
    """
    outcomes: dict[int, Outcome] = {}
    jobs: list[Any] = [(case, plan) for case in cases]
    with connected(cluster, len(cases)) as client:
        for _, future in run_all(client, _check, jobs):
            future.result()
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


def _check(case: Case, plan: Plan) -> None:
    """Build a case to check it, its start and its saved part."""
    CaseRun(case, plan)
