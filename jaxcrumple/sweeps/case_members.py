"""Cases of a sweep as members of a batch."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from jaxcrumple.contact.lists import ContactLists
from jaxcrumple.observers import Observer
from jaxcrumple.solvers.start import check_start
from jaxcrumple.state import State, initial_state
from jaxcrumple.sweeps.batch import run_batch
from jaxcrumple.sweeps.cases import Case, Limits, blamed
from jaxcrumple.sweeps.members import Start
from jaxcrumple.sweeps.table import Frames, Measure, Outcome, Tell, broken


class CaseMember:
    """A case of a sweep in a batch; `outcome` tells how it ended."""

    def __init__(
        self, case: Case, times: Float[np.ndarray, " times"], measure: Measure, limits: Limits, tell: Tell
    ):
        self.case, self.times, self.measure, self.limits, self.tell = case, times, measure, limits, tell
        self.name, self.solver = case.name, case.solver
        self.frames: Frames | None = None
        self.outcome: Outcome | None = None

    @property
    def observers(self) -> Sequence[Observer]:
        """What measures the frames."""
        return [] if self.frames is None else [self.frames]

    def begin(self) -> Start:
        """Build the case and check its start."""
        setup = self.case.build()
        state = initial_state(setup.scene, setup.x)
        with blamed(self.name):
            check_start(setup.scene, state)
        self.frames = Frames(self.measure, setup)
        return Start(setup.scene, state, self.times, seconds=self.limits.seconds)

    def pause(self) -> None:
        """Drop what `begin` built."""
        self.frames = None

    def spend(self, seconds: float) -> None:
        """Ignore the time."""

    def end(self, state: State, result: str, lists: ContactLists | None) -> None:
        """Keep the outcome."""
        assert self.frames is not None
        self._keep(Outcome(result, self.frames.found, jax.device_get(state)))

    def fail(self, error: Exception) -> None:
        """Keep the exception as the outcome, with the frames so far."""
        self._keep(broken(error, [] if self.frames is None else self.frames.found))

    def _keep(self, outcome: Outcome) -> None:
        self.outcome, self.frames = outcome, None
        self.tell(self.name, outcome.result)


def run_cases(
    cases: Sequence[Case],
    times: Float[np.ndarray, " times"],
    measure: Measure,
    limits: Limits,
    devices: Sequence[jax.Device],
    most: int,
    tell: Tell,
) -> list[Outcome]:
    """Run cases as lanes, at most `most` side by side, and return their outcomes.

    **Raises:** ValueError if one of the first cases cannot begin, or if a solver takes one sheet at a time.
    """
    members = [CaseMember(case, times, measure, limits, tell) for case in cases]
    run_batch(members, devices, most, limits.attempts)
    outcomes = [member.outcome for member in members]
    assert all(outcomes)
    return [outcome for outcome in outcomes if outcome is not None]
