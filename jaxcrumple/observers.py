"""Observers: what a run tells while it goes, e.g. to save it or to show its progress."""

from collections.abc import Sequence
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple.solvers.log import COLUMNS
from jaxcrumple.solvers.tables import events_table, history_table
from jaxcrumple.state import State

# What a run does: search for near layers on the host, compile or read its program, or step.
Phase = Literal["searching", "compiling", "stepping"]
NO_ROWS = np.zeros((0, len(COLUMNS)))


class Observer(Protocol):
    """Receive the progress of a run, e.g. to save or to show it: any object with these two methods."""

    def frame(self, index: int, state: State) -> None:
        """Receive the `state` at the frame time number `index`, counted from 0."""

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Receive the new rows of `history` and `events`, and the number of `frames` so far.

        A run calls it at frame times and between them. The columns are those of `Solution.history`.
        """


@runtime_checkable
class PhaseObserver(Protocol):
    """An observer that also receives the phase of a run."""

    def phase(self, phase: Phase) -> None:
        """Receive the `phase` that begins, or continues after a call of the program.

        Phases: "searching" for contact lists on the host, "compiling" or reading the program, "stepping".
        """


def tell_phase(observers: Sequence[Observer], phase: Phase) -> None:
    """Tell the phase to the observers that receive it."""
    for observer in observers:
        if isinstance(observer, PhaseObserver):
            observer.phase(phase)


def tell_rows(
    observers: Sequence[Observer],
    state: State,
    rows: Sequence[Float[np.ndarray, "_ columns"]],
    frames: int,
) -> None:
    """Tell all observers the new rows of the log and the number of frames so far."""
    table = np.concatenate([NO_ROWS, *rows])
    history, events = history_table(table), events_table(table)
    for observer in observers:
        observer.chunk(state, history, events, frames)
