"""Cases of a sweep as members of a batch."""

from collections.abc import Sequence

import jax

from jaxcrumple.contact.lists import ContactLists
from jaxcrumple.observers import Observer
from jaxcrumple.state import State
from jaxcrumple.sweeps.batch import run_batch
from jaxcrumple.sweeps.case_run import CaseRun, Plan
from jaxcrumple.sweeps.cases import Case
from jaxcrumple.sweeps.members import Start
from jaxcrumple.sweeps.outcome import Outcome, broken
from jaxcrumple.sweeps.table import Tell


class CaseMember:
    """A case of a sweep in a batch; `outcome` tells how it ended."""

    def __init__(self, case: Case, plan: Plan, tell: Tell):
        self.case, self.plan, self.tell = case, plan, tell
        self.name, self.solver = case.name, case.solver
        self.run: CaseRun | None = None
        self.outcome: Outcome | None = None

    @property
    def observers(self) -> Sequence[Observer]:
        """What measures the frames."""
        return [] if self.run is None else [self.run]

    def begin(self) -> Start:
        """Build the case and check its start."""
        self.run = CaseRun(self.case, self.plan)
        reached, limits = len(self.run.frames), self.plan.limits
        return Start(self.run.setup.scene, self.run.state, self.plan.times, reached, limits.seconds)

    def pause(self) -> None:
        """Drop what `begin` built."""
        self.run = None

    def spend(self, seconds: float) -> None:
        """Ignore the time."""

    def end(self, state: State, result: str, lists: ContactLists | None) -> None:
        """Keep the outcome."""
        assert self.run is not None
        self._keep(self.run.end(jax.device_get(state), result))

    def fail(self, error: Exception) -> None:
        """Keep the exception as the outcome, with the frames so far."""
        self._keep(broken(error) if self.run is None else self.run.fail(error))

    def _keep(self, outcome: Outcome) -> None:
        self.outcome, self.run = outcome, None
        self.tell(self.name, outcome.result)


def run_cases(
    cases: Sequence[Case], plan: Plan, devices: Sequence[jax.Device], most: int, tell: Tell
) -> list[Outcome]:
    """Run cases as lanes, at most `most` side by side, and return their outcomes.

    **Raises:** ValueError if one of the first cases cannot begin, or if a solver takes one sheet at a time.
    """
    members = [CaseMember(case, plan, tell) for case in cases]
    run_batch(members, devices, most, plan.limits.attempts)
    outcomes = [member.outcome for member in members]
    assert all(outcomes)
    return [outcome for outcome in outcomes if outcome is not None]
