"""`sweep`: run a scene over a grid of option values."""

import inspect
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import numpy as np
import xarray as xr

from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require_run
from jaxcrumple._jax.tree import require_limit
from jaxcrumple.io.sketch import sketch
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.simulation import Times, checked_times
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import initial_state
from jaxcrumple.sweeps.batch import LANES, require_lanes
from jaxcrumple.sweeps.case_files import kept_in
from jaxcrumple.sweeps.case_members import run_cases
from jaxcrumple.sweeps.case_run import Plan, complete
from jaxcrumple.sweeps.cases import Case, Grid, Limits, Scenes, Seeds, cases_of, checked_grid
from jaxcrumple.sweeps.cluster import Cluster, local_workers
from jaxcrumple.sweeps.measures import Measure, measured, standard_measure
from jaxcrumple.sweeps.outcome import Outcome
from jaxcrumple.sweeps.processes import run_processes
from jaxcrumple.sweeps.table import Tell, check_names, table

Backend = Literal["auto", "batch", "processes"]


@door
def sweep(
    scene: Scenes,
    over: Mapping[str, Iterable[Any]],
    times: Times,
    *,
    settings: Mapping[str, Any] | None = None,
    seeds: Seeds = None,
    solver: Integrator | None = None,
    measure: Measure = standard_measure,
    backend: Backend = "auto",
    cluster: Cluster = None,
    devices: Sequence[jax.Device] | None = None,
    lanes: int = LANES,
    folder: str | Path | None = None,
    max_attempts: int | None = None,
    max_seconds: float | None = None,
    tell: Tell = lambda name, result: None,
) -> xr.Dataset:
    """Run a scene for every combination of option values.

    **Arguments:**

    - `scene`: name of a scene, or a function of the names in `over` and `settings` that returns a `Setup`.
    - `over`: lists of values by name, numbers or words. For a named scene: any option of scene, material or
      solver, `nodes` and `seed`.
    - `times`: increasing times in s at which to measure, or only the end time.
    - `settings`: common values of all cases, by name as in `over`.
    - `seeds`: number of seeds of the random meshes, from 0 on, or a list of them, as a last name of `over`.
    - `solver`: integrator for a scene that is a function, by default `integrator()`.
    - `measure`: function of the case's `Setup` and a `State`; it returns by name numbers, pairs of dimensions
      and array, or DataArrays. By default: energies, crease length, strains and contacts. `sweep` tests it on
      the start of the first case before any case runs.
    - `backend`: "batch": all cases are lanes of one program on the `devices` (by default all of the default
      kind), and cases of other node numbers or contact levels follow; this requires a linear solver that
      supports batches. "processes": each case is a run in a worker
      process. "auto": "batch" if `devices` are given, or if JAX has an accelerator and no `cluster` is given;
      else "processes".
    - `cluster`: for the workers: a Dask cluster, a Dask client or the address of a scheduler; by default
      workers on this machine, one per core.
    - `lanes`: most cases side by side in a batch; the others wait, and take the places of those that ended.
    - `folder`: where each case saves its measured values and its state, at frames and between them. The same
      call with this folder goes on after a kill, or after the loss of a worker; it only reads cases that have
      ended, and it may vary more values than before. Cases with the result "error" or "budget" go on, too.
      Workers of a `cluster` must have access to it.
    - `max_attempts`, `max_seconds`: step attempts, and wall time in s without compile time, after which a
      case ends with the result "budget". The wall time of a lane is that of the calls in which it took part.
    - `tell`: callback, called with name and result of each case as it ends.

    **Returns:** an xarray Dataset over the names in `over`, with `result`, `t_reached`, `steps` and counters
    of each case, and with the measured values over `time`, NaN after the end of a case. A failed case does
    not stop the others. A case that raises an exception, e.g. in `measure`, has the result "error" and a
    `message`.

    **Raises:** ValueError for impossible values and cases, and `RunDirectoryError` for a folder that holds
    something else, before any case runs.
    """
    backend = _chosen(backend, cluster, devices)
    if max_attempts is not None and max_attempts < 1:
        raise ValueError(f"max_attempts = {max_attempts!r} must be at least 1.")
    require_limit("max_seconds", max_seconds)
    require_lanes(lanes)
    limits = Limits(
        np.inf if max_attempts is None else max_attempts,
        np.inf if max_seconds is None else max_seconds,
    )
    stops = checked_times(times)
    linear = "two-level" if backend == "batch" else "auto"
    settings = {} if settings is None else settings
    grid = checked_grid(over, settings, seeds)
    cases = cases_of(scene, grid, settings, float(stops[-1]), solver, linear)
    first, names = _try(cases[0], grid, measure)
    plan = Plan(stops, measure, limits, None if folder is None else Path(folder).absolute())
    start = time.perf_counter()

    def run(missing: list[Case]) -> list[Outcome]:
        if backend == "batch":
            return run_cases(missing, plan, jax.devices() if devices is None else devices, lanes, tell)
        workers = local_workers(cluster, len(missing))
        require_run(first.scene.n_nodes, len(stops), first.scene.contact is not None, workers)
        return run_processes(missing, plan, cluster, tell)

    if plan.folder is None:
        outcomes = run(cases)
    else:
        solved_by = settings.get("linear", linear) if isinstance(scene, str) else cases[0].solver
        with kept_in(plan.folder, _shared(scene, plan, settings, names, solved_by)):
            outcomes = complete(cases, first, plan, run, tell)
    return table(grid, stops, outcomes, {"backend": backend, "seconds": time.perf_counter() - start})


def _shared(
    scene: Scenes, plan: Plan, settings: Mapping[str, Any], names: Sequence[str], solver: Any
) -> dict[str, Any]:
    """Return what all cases of a sweep in a folder share, as JSON types."""
    return {
        "scene": scene if isinstance(scene, str) else getattr(scene, "__qualname__", type(scene).__name__),
        "settings": {key: _plain(value) for key, value in settings.items()},
        "times": plan.times,
        "measured values": names,
        "solver": eqx.tree_pformat(solver, short_arrays=False, width=10**6),
    }


def _plain(value: Any) -> Any:
    """Return a word or a number as it is, and of other objects their type and a sketch of their arrays."""
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return [type(value).__name__, *sketch(value)]


def _chosen(backend: Backend, cluster: Cluster, devices: Sequence[jax.Device] | None) -> Backend:
    """Choose the backend.

    **Raises:** ValueError for an unknown backend, an empty list of devices, or an argument that the backend
    does not use.
    """
    if backend not in ("auto", "batch", "processes"):
        raise ValueError(f"backend = {backend!r} is unknown; choose auto, batch or processes.")
    if backend == "auto":
        accelerated = jax.default_backend() != "cpu" and cluster is None
        backend = "batch" if accelerated or devices is not None else "processes"
    if backend == "batch" and cluster is not None:
        raise ValueError("a cluster is for backend='processes'; a batch runs on the devices of this process.")
    if backend == "processes" and devices is not None:
        raise ValueError("devices are for backend='batch'; leave them out, or choose that backend.")
    if devices is not None and not len(devices):
        raise ValueError("devices = [] leaves no device to run on; give at least one, or leave devices out.")
    return backend


def _try(case: Case, grid: Grid, measure: Measure) -> tuple[Setup, list[str]]:
    """Measure the start of a case before any case runs; return its setup and the names of measured values.

    **Raises:** ValueError for a case that cannot be built, an invalid measure, or a reserved name; and any
    error that `measure` raises.
    """
    try:
        inspect.signature(measure).bind(None, None)
    except TypeError as error:
        raise ValueError(
            f"measure must be a function of a case's Setup and a State that returns values by name: {error}."
        ) from error
    setup = case.build()
    found = measured(measure, setup, initial_state(setup.scene, setup.x))
    check_names(grid, found)
    return setup, sorted(map(str, found.data_vars))
