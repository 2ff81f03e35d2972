"""Show the progress of a run on the console."""

import time

import numpy as np
import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column

from jaxcrumple.observers import Phase
from jaxcrumple.run.locking import locking
from jaxcrumple.run.pace import Pace, duration
from jaxcrumple.solvers.log import ENERGIES
from jaxcrumple.state import CAUSES, EXPLICIT, IMPLICIT, QUASISTATIC, RESULTS, STAGES, State

# Seconds between lines if the output is not a terminal.
INTERVAL = 10.0
# What each phase waits for.
WAITING = {
    "building": "mesh and scene",
    "searching": "layers near each other",
    "compiling": "once per kind of run and size of lists; later runs read the program",
    "stepping": "",
}


class ConsoleProgress:
    """Show phase, time, rate, remaining time, stage, step size, energy, and the cause if a run is slow."""

    def __init__(self, t_end: float, console: Console):
        self.console = console
        self.t_end = t_end
        self.now = ""
        self.last: State | None = None
        self.pace: Pace | None = None
        self.printed = self.since = 0.0
        columns = (
            SpinnerColumn(),
            TextColumn("{task.fields[phase]}"),
            TimeElapsedColumn(),
            BarColumn(bar_width=20),
            TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
        )
        self.bar = Progress(*columns, console=console, expand=True, disable=not console.is_terminal)
        self.task = self.bar.add_task("", total=t_end, phase="")

    def __enter__(self) -> "ConsoleProgress":
        self.bar.start()
        self._enter("building")
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def frame(self, index: int, state: State) -> None:
        """Ignore frames."""

    def phase(self, phase: Phase) -> None:
        """Show what the run waits for."""
        if phase != self.now:
            self._enter(phase)

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Update the bar, or print a line."""
        text = self._told(state, history)
        self.bar.update(self.task, completed=float(state.t), description=text)
        for event in events.itertuples():
            if "quasistatic" not in (event.origin, event.to):
                continue  # With inertia throughout, snaps switch to explicit steps and back dozens of times.
            self._say(f"t = {event.t:.5f} s: {event.origin} -> {event.to}")
        now = time.perf_counter()
        if not self.console.is_terminal and now - self.printed > INTERVAL:
            self.printed = now
            self._say(text)
        self.last = state

    def _enter(self, phase: str) -> None:
        now = time.perf_counter()
        if self.pace is not None:
            if phase == "stepping":
                self.pace.skip(now - self.since)
            self.since = now
        self.now = phase
        self.bar.update(self.task, phase=phase)
        if waiting := WAITING[phase]:
            self.bar.update(self.task, description=waiting)
            if not self.console.is_terminal:
                self._say(f"{phase}: {waiting}")

    def _say(self, line: str) -> None:
        self.bar.console.print(line, soft_wrap=True, highlight=False, markup=False)

    def _told(self, state: State, history: pd.DataFrame) -> str:
        """Describe the present state, and the way since the last one."""
        parts = [f"t = {float(state.t):.4f} of {self.t_end:.4g} s", *self._rate(state)]
        stage = STAGES[int(state.stage)]
        h = float(state.h_explicit if stage == "explicit" else state.h)
        parts += [stage, f"h = {h:.1e} s"]
        if len(history):
            energies = history[list(ENERGIES)].iloc[-1]
            parts += [f"E = {energies.sum() * 1e3:.3g} mJ", locking(energies.to_dict())]
        if self.last is not None:
            parts.append(why_steps_are_short(self.last, state))
        return ", ".join(part for part in parts if part)

    def _rate(self, state: State) -> list[str]:
        """Return steps per second since the last state, and the remaining time."""
        now, t = time.perf_counter(), float(state.t)
        if self.pace is None or self.last is None:
            self.pace = Pace(now, t)
            return []
        made = int(np.sum(np.asarray(state.counters.steps) - np.asarray(self.last.counters.steps)))
        parts = [f"{made / (now - self.pace.w[-1]):.0f} steps/s"]
        self.pace.add(now, t)
        left = self.pace.left(self.t_end)
        return parts if left is None or t >= self.t_end else [*parts, f"{duration(left)} or more left"]


def why_steps_are_short(before: State, after: State) -> str:
    """Explain in words why steps between two states were short; return "" if they were not."""
    steps = np.asarray(after.counters.steps) - np.asarray(before.counters.steps)
    rejected = np.asarray(after.counters.rejected) - np.asarray(before.counters.rejected)
    reasons = {
        "error": "the tolerance",
        "newton": "Newton's iteration failing on large steps",
        "unstable": "an equilibrium about to buckle",
        "fold": "hinges about to pass 180 degrees",
        "nonfinite": "numbers that are not finite",
        "contact": "layers or walls that longer steps would pass through",
    }
    going = bool(after.result != RESULTS.collapsed)
    if going and steps[EXPLICIT] > steps[QUASISTATIC] + steps[IMPLICIT]:
        return f"a snap: explicit steps of {float(after.h_explicit):.1e} s, at their stability limit"
    worst = int(np.argmax(rejected))
    if rejected[worst] * 4 > steps[QUASISTATIC] + steps[IMPLICIT]:
        return f"steps are cut by {reasons[CAUSES[worst]]}"
    return ""
