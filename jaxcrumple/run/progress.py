"""Show the progress of a run on the console."""

import time

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from jaxcrumple.run.locking import locking
from jaxcrumple.simulation import explain
from jaxcrumple.solvers.log import ENERGIES
from jaxcrumple.state import STAGES, State

# Seconds between lines if the output is not a terminal.
INTERVAL = 10.0
# Share of the simulated time below which the remaining time cannot be estimated.
EARLY = 0.05


class ConsoleProgress:
    """Show time, stage, step size, energy, remaining time, and the cause if a run is slow."""

    def __init__(self, t_end: float, console: Console):
        self.console = console
        self.last: State | None = None
        self.printed = self.begin = self.first = 0.0
        columns = (
            TextColumn("t = {task.completed:.4f} of {task.total:.4g} s"),
            BarColumn(bar_width=20),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )
        self.bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self.task = self.bar.add_task("compiling", total=t_end)

    def __enter__(self) -> "ConsoleProgress":
        self.bar.start()
        if not self.console.is_terminal:
            self._say("compiling")
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def frame(self, index: int, state: State) -> None:
        """Ignore frames."""

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Update the bar, or print a line."""
        if self.last is None:
            self.begin, self.first = time.perf_counter(), float(state.t)
        stage = STAGES[int(state.stage)]
        h = float(state.h_explicit if stage == "explicit" else state.h)
        why = explain(self.last, state) if self.last is not None else ""
        energy = locks = ""
        if len(history):
            last = history[list(ENERGIES)].iloc[-1]
            energy, locks = f"E = {last.sum() * 1e3:.3g} mJ", locking(last.to_dict())
        text = ", ".join(part for part in (stage, f"h = {h:.1e} s", energy, locks, why) if part)
        self.bar.update(self.task, completed=float(state.t), description=text)
        for event in events.itertuples():
            if "quasistatic" not in (event.origin, event.to):
                continue  # With inertia throughout, snaps switch to explicit steps and back dozens of times.
            self._say(f"t = {event.t:.5f} s: {event.origin} -> {event.to}")
        now = time.perf_counter()
        if not self.console.is_terminal and now - self.printed > INTERVAL:
            self.printed = now
            total = self.bar.tasks[self.task].total or 0.0
            self._say(f"t = {float(state.t):.4f} of {total:.4g} s, {self._left(state, total)}{text}")
        self.last = state

    def _say(self, line: str) -> None:
        self.bar.console.print(line, soft_wrap=True, highlight=False, markup=False)

    def _left(self, state: State, total: float) -> str:
        """Estimate the remaining time from the mean speed since the first steps, as text."""
        gone = float(state.t) - self.first
        if gone < EARLY * total:
            return ""
        return f"about {(total - float(state.t)) * (time.perf_counter() - self.begin) / gone:.0f} s left, "
