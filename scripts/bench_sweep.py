"""A sweep over yield curvature and thickness: lanes of one program, and processes, against single runs.

The scene is `radial`, phantom, to R = 4.9 cm, with the two-level solver everywhere. What compiles is compiled
before the clock starts, but for the processes, which start anew. The table shows CPU seconds (on a GPU wall
seconds), how many of them set the lanes up, the cost over that of the runs one after the other, and how far a
lane is from its single run while that has not snapped, and in bending energy at the end. On a GPU only the
lanes run there; give the CPU's seconds by --single.

    python scripts/bench_sweep.py [--nodes N] [--lanes L ...] [--end T] [--ways WAY ...] [--single SECONDS]
"""

import os
import resource
import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
import xarray as xr
from benchlib import markdown, options, save

import jaxcrumple as jc
from jaxcrumple.sweeps import lanes

RTOL, TIMES = 1e-2, np.linspace(0.2, 2.2, 11)
THICKNESS, YIELDS = (1.5e-4, 2.5e-4), (100.0, 300.0)
_energies = eqx.filter_jit(jc.energies)
SETTINGS = {"contact": None, "rtol": RTOL, "linear": "two-level"}


def grid(count: int) -> dict[str, list[float]]:
    """So many cases."""
    return {"yield_curvature": np.linspace(*YIELDS, count // 2).tolist(), "thickness": list(THICKNESS)}


def measure(setup, state) -> dict:
    """Positions, and the bending energy in J."""
    bending = _energies(setup.scene, state.x, state.v, state.p, state.t).bending
    return {"x": (("node", "axis"), state.x), "bending": bending}


def swept(nodes: int, count: int, backend: str, times) -> xr.Dataset:
    """The sweep by one of the ways."""
    settings = SETTINGS | {"nodes": nodes}
    return jc.sweep("radial", grid(count), times, settings=settings, measure=measure, backend=backend)


def single(nodes: int, case: dict[str, float], times) -> jc.Solution:
    """One case alone."""
    setup = jc.radial(nodes, contact=None, material=jc.Material(**case))
    solver, start = jc.integrator(RTOL, linear="two-level"), jc.initial_state(setup.scene, setup.x)
    return jc.simulate(setup.scene, start, times, solver=solver)


def clock() -> float:
    """CPU seconds of this process and its ended workers; on a GPU wall seconds."""
    if jax.default_backend() != "cpu":
        return time.perf_counter()
    workers = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + workers.ru_utime + workers.ru_stime


def timed(function: Callable[[], xr.Dataset]) -> tuple[float, xr.Dataset]:
    """Seconds and result."""
    start = clock()
    found = function()
    return clock() - start, found


def compared(table: xr.Dataset, runs: dict[tuple[float, float], jc.Solution]) -> list[str]:
    """Largest distances of lanes from their single runs before the first change of stage, over 10 rtol of the
    sheet's size, and relative differences of the bending energy at the end."""
    early, late = [0.0], []
    for (yields, thickness), run in runs.items():
        lane = table.sel(yield_curvature=yields, thickness=thickness)
        before = run.t < (run.events["t"].min() if len(run.events) else np.inf)
        apart = np.abs(lane.x.values - run.x).max(axis=(1, 2)) / (10 * RTOL * 0.1)
        early.append(float(np.max(apart[before], initial=0.0)))
        energy = run.history["bending"].iloc[-1]
        late.append(abs(float(lane.bending[-1]) / energy - 1.0))
    return [f"{max(early):.1e}", f"{np.median(late):.1e}", f"{max(late):.1e}"]


WAYS = {"lanes in turn": False, "lanes side by side": True, "processes": None}


def way(name: str, nodes: int, count: int, times) -> tuple[float, float, xr.Dataset]:
    """Seconds to set up and in all, and the table, of one of the ways."""
    if WAYS[name] is None:
        return np.nan, *timed(lambda: swept(nodes, count, "processes", times))
    lanes.best_side_by_side = lambda device: WAYS[name]
    short = times[:1] * 1e-6
    swept(nodes, count, "batch", short)
    begun, _ = timed(lambda: swept(nodes, count, "batch", short))
    return begun, *timed(lambda: swept(nodes, count, "batch", times))


def alone(nodes: int, count: int, times) -> tuple[float, dict[tuple[float, float], jc.Solution]]:
    """Seconds and results of the single runs, one after the other."""
    cases = [(yields, thickness) for yields in grid(count)["yield_curvature"] for thickness in THICKNESS]
    named = {case: dict(zip(("yield_curvature", "thickness"), case, strict=True)) for case in cases}
    single(nodes, named[cases[0]], times[:1] * 1e-6)
    start = clock()
    runs = {case: single(nodes, given, times) for case, given in named.items()}
    return clock() - start, runs


def main() -> None:
    """Run all ways; print and save."""
    parser = options(__doc__ or "", [500])
    parser.add_argument("--lanes", type=int, nargs="+", default=[16])
    parser.add_argument("--end", type=float, default=TIMES[-1], help="end time in s")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--single", type=float, help="seconds of a single run, where it is not run here")
    opts = parser.parse_args()
    nodes, rows, ratios = opts.nodes[0], [], {}
    times = TIMES[opts.end * (1.0 + 1e-9) >= TIMES]
    for count in opts.lanes:
        spent, runs = (opts.single * count, {}) if opts.single else alone(nodes, count, times)
        rows.append(
            [count, "single runs", "", f"{spent:.1f}", f"{spent / count:.2f}", "1.00", count, *[""] * 3]
        )
        print(rows[-1], flush=True)
        for name in opts.ways:
            begun, seconds, table = way(name, nodes, count, times)
            good = int((table.result == "success").sum())
            shown = compared(table, runs) if runs else [""] * 3
            ratio = seconds / spent
            rows.append(
                [
                    count,
                    name,
                    f"{begun:.1f}",
                    f"{seconds:.1f}",
                    f"{seconds / count:.2f}",
                    f"{ratio:.2f}",
                    good,
                    *shown,
                ]
            )
            ratios[f"{count} lanes, {name}"] = ratio
            print(rows[-1], flush=True)
    head = ["lanes", "way", "set up, s", "in all, s", "a lane, s", "over single runs", "success"]
    head += ["before events, over 10 rtol", "energy at the end, median", "largest"]
    cores = len(os.sched_getaffinity(0))
    kind = "CPU seconds" if jax.default_backend() == "cpu" else "wall seconds"
    about = f"n = {nodes}, rtol = {RTOL:g}, t = {times[-1]:g} s, {cores} core(s), {kind}."
    save(
        opts,
        f"sweep_{nodes}_{jax.default_backend()}",
        f"{markdown(head, rows)}\n\n{about}",
        None,
        ratios,
        rows,
    )


if __name__ == "__main__":
    main()
