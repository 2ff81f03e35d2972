"""Run a configuration into a folder of results, resumable after any interruption."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxcrumple._jax.door import door
from jaxcrumple.io import RunDirectory, RunDirectoryError, load_checkpoint
from jaxcrumple.io.frames import Stiffness
from jaxcrumple.io.lock import writing
from jaxcrumple.io.manifest import Manifest
from jaxcrumple.io.rundir import RUN, is_run, make_folder, read_contents
from jaxcrumple.io.sketch import SAME, first_difference, sketch_scene
from jaxcrumple.io.verify import check_sound, damages, go_back
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.observers import Observer
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.run.begun import Begun, Ending, RunRecorder
from jaxcrumple.run.config import PYTHON, RunConfig, SolverOptions, config_of
from jaxcrumple.run.estimate import require_config
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.start import check_start
from jaxcrumple.state import initial_state


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
    with started(run, out, solver=solver, wait=wait) as begun:
        return finished(begun, observers, max_seconds)


@contextmanager
def started(
    run: RunConfig | Setup,
    out: str | Path,
    *,
    solver: SolverOptions | Mapping[str, Any] | None = None,
    wait: bool = False,
) -> Iterator[Begun]:
    """Begin a run in a new folder, as `start_run` does, and hold the lock of the folder inside."""
    config = config_of(run, solver) if isinstance(run, Setup) else run
    own = config.solver.build()
    RunDirectory.check_free(out)
    require_config(config)
    setup = run if isinstance(run, Setup) else run.build()
    state = initial_state(setup.scene, setup.x, ledger=config.solver.ledger)
    check_start(setup.scene, state)
    with writing(make_folder(out), wait=wait):
        folder = RunDirectory.create(out, *_parts(config, setup))
        yield Begun(config, folder, setup, own, state, RunRecorder(folder, config.frames, {}))


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
    with continued(out, setup=setup, wait=wait) as begun:
        return begun if isinstance(begun, dict) else finished(begun, observers, max_seconds)


@contextmanager
def continued(
    out: str | Path, *, setup: Setup | None = None, wait: bool = False
) -> Iterator[Begun | dict[str, Any]]:
    """Open a run that goes on from its last checkpoint, as `resume_run` does, and hold the lock of its folder
    inside. Yield the summary of a successful run."""
    path = RunDirectory.open(out).path
    with writing(path, wait=wait):
        lacking = check_sound(path)
        folder = RunDirectory.open(path)
        summary = {} if lacking else folder.read_summary()
        if summary.get("result") == "success":
            yield summary
            return
        config = stored_config(folder)
        solver, setup = config.solver.build(), _built_again(config, folder, setup)
        folder.cut()
        state, spent = initial_state(setup.scene, setup.x, ledger=config.solver.ledger), {}
        if folder.manifest.checkpoint is not None:
            state, metadata = load_checkpoint(path / folder.manifest.checkpoint, state)
            spent = metadata["spent"]
        yield Begun(config, folder, setup, solver, state, RunRecorder(folder, config.frames, spent))


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


def finished(begun: Begun, observers: Sequence[Observer], max_seconds: float | None) -> dict[str, Any]:
    """Simulate the remaining time, write all files, and return the summary."""
    ending = begun.ended()
    if ending is None:
        solution = simulate(
            begun.setup.scene,
            begun.state,
            begun.times,
            solver=begun.solver,
            observers=(begun.recorder, *observers),
            first_frame=begun.reached,
            max_seconds=max_seconds,
        )
        ending = Ending(solution.state, solution.result, solution.message, solution.compile_s)
    return begun.finish(ending)


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
