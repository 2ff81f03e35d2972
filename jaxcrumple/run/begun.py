"""The folder of a run while it is written: its recorder, its ending, its summary and its film."""

import importlib.metadata
import resource
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple.io import RunDirectory, sheet_fields, write_vtkhdf
from jaxcrumple.io.lock import writing
from jaxcrumple.io.rundir import FILM, PARTIAL
from jaxcrumple.run.config import RunConfig
from jaxcrumple.run.summary import physics
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.simulation import frame_times, message_of
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.solvers.start import pierced
from jaxcrumple.state import STAGES, State

# Number of checkpoints that remain at the end, beside the last one.
KEPT = 4
PACKAGES = ("jaxcrumple", "jax", "jaxlib", "numpy", "scipy", "diffrax", "equinox")


class RunRecorder:
    """Save frames, rows and checkpoints during a run.

    Each checkpoint commits all earlier rows and frames, so a killed run resumes from the last checkpoint as
    if nothing had been written since. About KEPT checkpoints remain at the end.
    """

    def __init__(self, folder: RunDirectory, frames: int, spent: dict[str, float]):
        self.folder = folder
        self.stride = max(1, round(frames / KEPT))
        self.spent = spent
        self.start = time.perf_counter(), time.process_time()

    def frame(self, index: int, state: State) -> None:
        """Save a frame."""
        self.folder.save_frame(float(state.t), state.x, state.v, state.p)
        self.checkpoint(state, keep=index % self.stride == 0)

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Append rows, then write a checkpoint."""
        numbers = history.assign(stage=[STAGES.index(stage) for stage in history["stage"]])
        self.folder.append_history(numbers.to_numpy(float))
        self.folder.append_events(events.to_dict("records"))
        self.checkpoint(state)

    def checkpoint(self, state: State, *, keep: bool = False) -> None:
        """Save the whole state."""
        self.folder.commit(state, {"t": float(state.t), "spent": self.totals()}, keep=keep)

    def totals(self) -> dict[str, float]:
        """Return wall and CPU seconds of this run, including earlier sessions."""
        wall, cpu = self.start
        return {
            "run_s": self.spent.get("run_s", 0.0) + time.perf_counter() - wall,
            "cpu_s": self.spent.get("cpu_s", 0.0) + time.process_time() - cpu,
        }


class LaneRecorder(RunRecorder):
    """Record a run in a batch, whose time is its share of that of the batch."""

    share = 0.0

    def spend(self, seconds: float) -> None:
        """Add wall seconds."""
        self.share += seconds

    def totals(self) -> dict[str, float]:
        """Return the seconds of this run, including earlier sessions."""
        return {name: self.spent.get(name, 0.0) + self.share for name in ("run_s", "cpu_s")}


class Ending(NamedTuple):
    """End of a run: last valid state, name of the result, its explanation, and compile time in s."""

    state: State
    result: str
    message: str
    compile_s: float


class Begun(NamedTuple):
    """A run whose folder is open for writing, at the `state` from which it goes on."""

    config: RunConfig
    folder: RunDirectory
    setup: Setup
    solver: Integrator
    state: State
    recorder: RunRecorder

    @property
    def times(self) -> Float[np.ndarray, " times"]:
        """Times in s of all frames."""
        return frame_times(self.config.t_end, self.config.frames)

    @property
    def reached(self) -> int:
        """Number of frames in the folder."""
        return len(self.folder.frames())

    def ended(self) -> Ending | None:
        """Return the ending of a run that was interrupted after its last frame, None for another one."""
        if self.reached < len(self.times):
            return None
        scene = self.setup.scene
        through = scene.contact is not None and len(pierced(scene, self.state.x))
        name = "intersected" if through else "success"
        return Ending(self.state, name, message_of(scene, self.state, name), 0.0)

    def finish(self, ending: Ending) -> dict[str, Any]:
        """Write all remaining files; the summary comes last, so it certifies the others."""
        # Save the last valid state even between frames.
        if ending.state is not self.state:
            self.recorder.checkpoint(ending.state)
        export(self.folder)
        summary = _summary(self, ending)
        self.folder.finish(summary)
        return summary


def export(folder: RunDirectory, name: str = FILM) -> Path | None:
    """Write the saved frames as a file for ParaView; return its path, or None without frames."""
    if not folder.frames():
        return None
    mesh, stiffness = folder.load_sheet()
    fields = sheet_fields(mesh, *stiffness)
    write_vtkhdf(folder.path / name, mesh, folder.load_frames(), *fields)
    return folder.path / name


def film(folder: RunDirectory) -> Path | None:
    """Return the path of a run's ParaView file; write it again if it is missing or damaged.

    For an unfinished run, write the frames so far under another name. Returns None without frames.
    """
    if not folder.finished:
        return export(folder, PARTIAL)
    if folder.is_sound(FILM):
        return folder.path / FILM
    with writing(folder.path):
        path = export(folder)
        folder.add_film()
    return path


def _summary(begun: Begun, ending: Ending) -> dict[str, Any]:
    config, folder, setup, recorder = begun.config, begun.folder, begun.setup, begun.recorder
    state, counters = ending.state, ending.state.counters
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "scene": config.scene,
        "nodes": setup.mesh.n_nodes,
        "seed": config.seed,
        "t_end": config.t_end,
        "t_reached": float(state.t),
        "rtol": config.solver.rtol,
        "result": ending.result,
        "message": ending.message,
        "compile_s": ending.compile_s,
        **recorder.totals(),
        # ru_maxrss is in kB on Linux and in bytes on macOS.
        "peak_memory_mb": peak / (2**20 if sys.platform == "darwin" else 2**10),
        "steps": {
            **dict(zip(STAGES, map(int, counters.steps), strict=True)),
            "rejected": int(np.sum(counters.rejected)),
        },
        "newton_iterations": int(counters.newton),
        "linear_iterations": int(counters.linear),
        "factors": int(counters.factors),
        "switches": int(counters.switches),
        **physics(setup, state, folder.read_history(), folder.read_events()),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
    }
