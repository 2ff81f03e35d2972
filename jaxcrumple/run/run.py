"""Run a configuration into a folder of results, resumable after any interruption."""

import importlib.metadata
import resource
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxcrumple._jax.door import door
from jaxcrumple.io import RunDirectory, RunDirectoryError, load_checkpoint, sheet_fields, write_vtkhdf
from jaxcrumple.io.frames import Stiffness
from jaxcrumple.io.lock import writing
from jaxcrumple.io.manifest import Manifest
from jaxcrumple.io.rundir import FILM, PARTIAL, RUN, is_run, make_folder, read_contents
from jaxcrumple.io.sketch import SAME, first_difference, sketch_scene
from jaxcrumple.io.verify import check_sound, damages, go_back
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.observers import Observer
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.run.config import PYTHON, RunConfig, SolverOptions, config_of
from jaxcrumple.run.estimate import require_config
from jaxcrumple.run.summary import physics
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.simulation import frame_times, simulate
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.solvers.start import check_start, pierced
from jaxcrumple.state import RESULTS, STAGES, State, initial_state

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


@door
def start_run(
    run: RunConfig | Setup,
    out: str | Path,
    observers: Sequence[Observer] = (),
    *,
    solver: SolverOptions | Mapping[str, Any] | None = None,
    max_seconds: float | None = None,
    wait: bool = False,
) -> dict[str, Any]:
    """Run a configuration, or a `Setup` with an end time, into a new folder `out` and return the summary.

    **Arguments:** `run`: of `configure`, `grid` or `read_scene_file`, or a `Setup`; `observers`: each an
    `Observer` of the run; `solver`: options of the solver for a `Setup`, e.g. `{"rtol": 1e-3}`; a
    configuration has its own. `max_seconds`: wall time, without compile time, after which the run ends with
    the result "budget", and `resume_run` continues it; `wait`: whether to wait for another process that
    writes into the folder, instead of refusing.

    **Raises:** `RunDirectoryError` if `out` exists or cannot be written; ValueError for impossible options,
    or a sheet that starts behind a wall or intersects itself. Both occur before the run begins and leave
    nothing on the disk.
    """
    if not isinstance(run, Setup) and solver is not None:
        raise ConfigError("the configuration has its own solver; give solver only with a Setup.")
    config = config_of(run, solver) if isinstance(run, Setup) else run
    own = config.solver.build()
    RunDirectory.check_free(out)
    require_config(config)
    setup = run if isinstance(run, Setup) else run.build()
    state = initial_state(setup.scene, setup.x, ledger=config.solver.ledger)
    check_start(setup.scene, state)
    with writing(make_folder(out), wait=wait):
        folder = RunDirectory.create(out, *_parts(config, setup))
        return _go(config, folder, setup, own, state, {}, observers, max_seconds)


@door
def resume_run(
    out: str | Path,
    observers: Sequence[Observer] = (),
    *,
    setup: Setup | None = None,
    max_seconds: float | None = None,
    wait: bool = False,
) -> dict[str, Any]:
    """Resume the run in folder `out` from its last checkpoint and return the summary.

    This first verifies all files of the run. For a successful run it only reads the summary.

    **Arguments:** `setup`: the `Setup` of a run that began with one, built again; `observers`, `max_seconds`,
    `wait`: as in `start_run`.

    **Raises:** `RunDirectoryError` if `out` is not a run, is damaged, or another process writes into it;
    ValueError if the options, or `setup`, no longer build the original scene.
    """
    path = RunDirectory.open(out).path
    with writing(path, wait=wait):
        lacking = check_sound(path)
        folder = RunDirectory.open(path)
        summary = {} if lacking else folder.read_summary()
        if summary.get("result") == "success":
            return summary
        config = stored_config(folder)
        solver, setup = config.solver.build(), _built_again(config, folder, setup)
        folder.cut()
        state, spent = initial_state(setup.scene, setup.x, ledger=config.solver.ledger), {}
        if folder.manifest.checkpoint is not None:
            state, metadata = load_checkpoint(path / folder.manifest.checkpoint, state)
            spent = metadata["spent"]
        return _go(config, folder, setup, solver, state, spent, observers, max_seconds)


def repair_run(out: str | Path) -> float | None:
    """Take the run in folder `out` back to the last undamaged checkpoint, and return its time in s.

    `resume_run` continues from there to the same answer. Returns None if nothing is damaged.

    **Raises:** `RunDirectoryError` if `out` is not a run, another process writes into it, or no part is
    sound.
    """
    path = Path(out)
    if not (path.is_dir() and is_run(path)):
        RunDirectory.open(path)
    with writing(path):
        if not damages(path):
            return None
        t = go_back(path)
        if t is not None:
            RunDirectory.open(path).cut()
            return t
        _begin_again(path)
        return 0.0


def _parts(config: RunConfig, setup: Setup) -> tuple[dict[str, Any], Mesh, Stiffness, dict[str, Any]]:
    """Return the initial contents of the folder of a run."""
    scene = setup.scene
    stiffness = np.asarray(scene.membrane.stiffness), np.asarray(scene.bending.stiffness)
    return config.model_dump(mode="json"), setup.mesh, stiffness, sketch_scene(scene, setup.x)


def _begin_again(path: Path) -> None:
    """Empty the folder of a run in which only `run.json` is sound; the run then restarts at t = 0."""
    try:
        contents = read_contents(path, (path / RUN).read_bytes())
    except (OSError, RunDirectoryError) as error:
        raise RunDirectoryError(
            f"no part of {str(path)!r} is sound, so the run cannot resume ({error}); start it again in a new "
            "folder"
        ) from error
    folder = RunDirectory(path, contents, Manifest())
    config = stored_config(folder)
    setup = _built_again(config, folder, None, mesh=False)
    folder.clear()
    RunDirectory.begin(path, *_parts(config, setup))


def _built_again(config: RunConfig, folder: RunDirectory, setup: Setup | None, *, mesh: bool = True) -> Setup:
    """Build the run's mesh, scene and start again, or take those of a `setup`.

    **Raises:** ValueError if they differ from those of the original run.
    """
    require_config(config)
    if setup is not None and config.scene != PYTHON:
        raise ConfigError(f"the run began with the options of {config.scene!r}; resume it without setup.")
    setup = config.build() if setup is None else setup
    other = first_difference(folder.built, sketch_scene(setup.scene, setup.x))
    if mesh and not _same_mesh(folder.load_mesh(), setup.mesh):
        other = "mesh"
    if other:
        raise RunDirectoryError(
            f"the options of {str(folder.path)!r} now make another {other} than the run began with: a file "
            "that they name was changed, or the function or Setup of the scene, or this version of the "
            "program builds it differently. Restore what was changed, or start a new run in another folder"
        )
    return setup


def _same_mesh(saved: Mesh, now: Mesh) -> bool:
    if not np.array_equal(saved.faces, now.faces):
        return False
    size = float(np.max(np.ptp(saved.vertices, axis=0)))
    return np.allclose(saved.vertices, now.vertices, rtol=0.0, atol=SAME * size)


def stored_config(folder: RunDirectory) -> RunConfig:
    """Read the configuration of the run in a folder."""
    try:
        return RunConfig(**folder.config)
    except ValueError as error:
        raise RunDirectoryError(f"{folder.path}: run.json cannot be read as a run: {error}") from error


class Ending(NamedTuple):
    """End of a run: last valid state, name of the result, its explanation, and compile time in s."""

    state: State
    result: str
    message: str
    compile_s: float


def _go(
    config: RunConfig,
    folder: RunDirectory,
    setup: Setup,
    solver: Integrator,
    state: State,
    spent: dict[str, float],
    observers: Sequence[Observer],
    max_seconds: float | None,
) -> dict[str, Any]:
    """Simulate the remaining time and write all files; the summary comes last, so it certifies the others."""
    recorder = RunRecorder(folder, config.frames, spent)
    times, reached = frame_times(config.t_end, config.frames), len(folder.frames())
    if reached == len(times):
        ending = _ended(setup, state)
    else:
        watchers = (recorder, *observers)
        solution = simulate(
            setup.scene,
            state,
            times,
            solver=solver,
            observers=watchers,
            first_frame=reached,
            max_seconds=max_seconds,
        )
        ending = Ending(solution.state, solution.result, solution.message, solution.compile_s)
        # Save the last valid state even between frames.
        recorder.checkpoint(ending.state)
    export(folder)
    summary = _summary(config, folder, setup, ending, recorder)
    folder.finish(summary)
    return summary


def _ended(setup: Setup, state: State) -> Ending:
    """Return the ending of a run that was interrupted after its last frame."""
    scene = setup.scene
    through = scene.contact is not None and len(pierced(scene, state.x))
    result = RESULTS.intersected if through else RESULTS.success
    return Ending(state, "intersected" if through else "success", RESULTS[result], 0.0)  # type: ignore[misc]


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


def _summary(
    config: RunConfig, folder: RunDirectory, setup: Setup, ending: Ending, recorder: RunRecorder
) -> dict[str, Any]:
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


def check_resumable(config: RunConfig, given: Collection[str], out: str | Path) -> None:
    """Refuse to resume a run whose options differ from the requested ones.

    Only the options of `config` named in `given` count.

    **Raises:** `ConfigError` that names the differing options and their values.
    """
    stored, wanted = flat(stored_config(RunDirectory.open(out))), flat(config)
    different = [name for name in ("scene", *given) if stored.get(name) != wanted[name]]
    if different:
        was = ", ".join(f"{name} = {stored.get(name)!r}, not {wanted[name]!r}" for name in different)
        raise ConfigError(
            f"{out} was started with {was}; resume it with the values it has (or without any), or start "
            "a new run in another folder."
        )


def flat(config: RunConfig) -> dict[str, Any]:
    """Return all options by name."""
    top = config.model_dump()
    groups = [top.pop(name) or {} for name in ("options", "material", "solver")]
    return top | {name: value for group in groups for name, value in group.items()}
