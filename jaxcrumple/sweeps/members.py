"""Members of a batch: what a lane begins with, and who is told how it goes."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from jaxcrumple.contact.lists import ContactLists
from jaxcrumple.observers import Observer
from jaxcrumple.replays.record import StepRecorder
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State


class Start(NamedTuple):
    """Hold what a lane begins with: `scene`, `state`, and the number of `frames` that it has reached.

    `times` (f,) in s of the frames; `seconds`: wall time in s without compile time after which the lane ends
    with the result "budget"; `recorder` of its steps for `replay`, or None.
    """

    scene: Scene
    state: State
    times: Float[np.ndarray, " frames"]
    frames: int = 0
    seconds: float = np.inf
    recorder: StepRecorder | None = None


class Member(Protocol):
    """One sheet of a batch. `observers` are told of its frames and steps, after `begin`."""

    name: str
    solver: Integrator

    @property
    def observers(self) -> Sequence[Observer]: ...

    def begin(self) -> Start | None:
        """Build or read what the lane begins with; None if there is nothing to do."""

    def spend(self, seconds: float) -> None:
        """Receive the member's share of the wall time of a call, in s."""

    def end(self, state: State, result: str, lists: ContactLists | None) -> None:
        """Receive the last `state`, the name of the result, and the contact `lists`, None without contact."""

    def pause(self) -> None:
        """Give back what `begin` took: the member waits, and begins again, or the batch was interrupted."""

    def fail(self, error: Exception) -> None:
        """Receive an exception that ended the lane, from `begin`, an observer or `end`."""
