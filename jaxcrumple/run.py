"""One run from a configuration to a folder of results, resumable at any moment."""

import importlib.metadata
import resource
import sys
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxcrumple.config import ConfigError, RunConfig
from jaxcrumple.io import (
    RunDirectory,
    RunDirectoryError,
    load_checkpoint,
    save_checkpoint,
    sheet_fields,
    write_vtkhdf,
)
from jaxcrumple.model.scene import Scene
from jaxcrumple.scenes import Setup
from jaxcrumple.simulate import Observer, Solution, frame_times, simulate
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.start import check_start
from jaxcrumple.state import STAGES, State, initial_state
from jaxcrumple.summary import physics

PACKAGES = ("jaxcrumple", "jax", "jaxlib", "numpy", "scipy", "diffrax", "equinox")


class Recorder:
    """Saves frames, rows and a checkpoint as a run goes on.

    A checkpoint holds how many rows and frames belong to it, so that a run that is killed between
    two checkpoints resumes from the last one as if nothing had been written since.
    """

    def __init__(self, folder: RunDirectory, fingerprint: dict[str, Any], spent: dict[str, float]):
        self.folder = folder
        self.fingerprint = fingerprint
        self.spent = spent
        self.start = time.perf_counter(), time.process_time()

    def frame(self, index: int, state: State) -> None:
        """Save a frame."""
        self.folder.save_frame(index, float(state.t), state.x, state.v, state.p)
        self.checkpoint(state)

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Append rows, then checkpoint."""
        numbers = history.assign(stage=[STAGES.index(stage) for stage in history["stage"]])
        self.folder.append_history(list(history.columns), numbers.to_numpy(float))
        self.folder.append_events(events.to_dict("records"), list(events.columns))
        self.checkpoint(state)

    def checkpoint(self, state: State) -> None:
        """Save the whole state."""
        metadata = {"counts": self.folder.counts._asdict(), "spent": self.totals()}
        save_checkpoint(self.folder.checkpoint_path, state, metadata, fingerprint=self.fingerprint)

    def totals(self) -> dict[str, float]:
        """Wall and CPU seconds of this run, earlier sessions included."""
        wall, cpu = self.start
        return {
            "run_s": self.spent.get("run_s", 0.0) + time.perf_counter() - wall,
            "cpu_s": self.spent.get("cpu_s", 0.0) + time.process_time() - cpu,
        }


def start_run(config: RunConfig, out: str | Path, observers: Sequence[Observer] = ()) -> dict[str, Any]:
    """Run a configuration into a new folder `out`; returns its summary.

    **Raises:** `RunDirectoryError` when `out` is taken or cannot be written, ValueError for
    impossible options or a sheet that starts behind a wall or within itself; both before the run begins, and
    nothing is left on the disk.
    """
    solver = config.solver.build()
    RunDirectory.check_free(out)
    setup = config.build()
    state = initial_state(setup.scene, setup.x, ledger=config.solver.ledger)
    check_start(setup.scene, state)
    folder = RunDirectory.create(out, config.model_dump(mode="json"))
    folder.save_mesh(setup.mesh)
    return _go(config, folder, setup, solver, state, 0, {}, observers)


def resume_run(out: str | Path, observers: Sequence[Observer] = ()) -> dict[str, Any]:
    """Go on with the run in folder `out` from its last checkpoint; returns its summary.

    **Raises:** `RunDirectoryError` when `out` is not a run, `CheckpointError` when its checkpoint is
    damaged or belongs to another run.
    """
    folder = RunDirectory.open(out)
    config = stored_config(folder)
    solver = config.solver.build()
    setup = config.build()
    like = initial_state(setup.scene, setup.x, ledger=config.solver.ledger)
    if not folder.checkpoint_path.exists():
        folder.rewind(0, 0, 0)
        folder.save_mesh(setup.mesh)
        return _go(config, folder, setup, solver, like, 0, {}, observers)
    state, metadata = load_checkpoint(folder.checkpoint_path, like, fingerprint=_fingerprint(config))
    counts = metadata["counts"]
    folder.rewind(counts["history_rows"], counts["event_rows"], counts["frames"])
    return _go(config, folder, setup, solver, state, counts["frames"], metadata["spent"], observers)


def stored_config(folder: RunDirectory) -> RunConfig:
    """The configuration a folder's run was started with."""
    try:
        return RunConfig(**folder.config)
    except ValueError as error:
        raise RunDirectoryError(f"{folder.path}: run.json cannot be read as a run: {error}") from error


def _fingerprint(config: RunConfig) -> dict[str, Any]:
    return config.model_dump(mode="json")


def _go(
    config: RunConfig,
    folder: RunDirectory,
    setup: Setup,
    solver: Integrator,
    state: State,
    first_frame: int,
    spent: dict[str, float],
    observers: Sequence[Observer],
) -> dict[str, Any]:
    recorder = Recorder(folder, _fingerprint(config), spent)
    solution = simulate(
        setup.scene,
        state,
        frame_times(config.t_end, config.frames),
        solver=solver,
        observers=(recorder, *observers),
        first_frame=first_frame,
    )
    if solution.result != "success":
        # The last good state is worth seeing even where no frame was due.
        recorder.checkpoint(solution.state)
    summary = _summary(config, folder, setup, solution, recorder)
    folder.write_summary(summary)
    export(folder, setup.scene)
    return summary


def export(folder: RunDirectory, scene: Scene) -> None:
    """Write the film for ParaView from the saved frames."""
    mesh = folder.load_mesh()
    fields = sheet_fields(mesh, np.asarray(scene.membrane.stiffness), np.asarray(scene.bending.stiffness))
    frames = (folder.load_frame(index) for index in folder.frames())
    write_vtkhdf(folder.vtkhdf_path, mesh, frames, *fields)


def _summary(
    config: RunConfig, folder: RunDirectory, setup: Setup, solution: Solution, recorder: Recorder
) -> dict[str, Any]:
    state, counters = solution.state, solution.state.counters
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "scene": config.scene,
        "nodes": setup.mesh.n_nodes,
        "seed": config.seed,
        "t_end": config.t_end,
        "t_reached": float(state.t),
        "rtol": config.solver.rtol,
        "result": solution.result,
        "message": solution.message,
        "compile_s": solution.compile_s,
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
        **physics(setup, state, folder.history.read(), folder.events.read()),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
    }


def check_resumable(config: RunConfig, given: Collection[str], out: str | Path) -> None:
    """Refuse to resume a folder whose run was asked something else.

    Of `config` only what was `given` counts, by name.

    **Raises:** `ConfigError` naming the options that differ, and their values.
    """
    stored, wanted = flat(stored_config(RunDirectory.open(out))), flat(config)
    different = [name for name in ("scene", *given) if stored.get(name) != wanted[name]]
    if different:
        was = ", ".join(f"{name} = {stored.get(name)!r}, not {wanted[name]!r}" for name in different)
        raise ConfigError(
            f"{out} was started with {was}; resume it with the values it has (or with none at all), or start "
            "a new run in another folder."
        )


def flat(config: RunConfig) -> dict[str, Any]:
    """All options by name."""
    top = config.model_dump()
    groups = [top.pop(name) for name in ("options", "material", "solver")]
    return top | {name: value for group in groups for name, value in group.items()}
