"""A sweep over yield curvature and thickness: lanes of one program, and processes, against single runs.

The scene is `radial`, phantom, to R = 4.9 cm, with the two-level solver everywhere. What compiles is compiled
before the clock starts, but for the processes, which start anew. The table shows seconds over those of the
runs one after the other, and how far a lane is from its single run while that has not snapped, and in bending
energy at the end. On a GPU only the lanes run there; give the CPU's seconds by --single.

    python scripts/bench_sweep.py [--nodes N] [--lanes L ...] [--single SECONDS]
"""

import os
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


def swept(nodes: int, count: int, backend: str, times=TIMES) -> xr.Dataset:
    """The sweep by one of the ways."""
    settings = SETTINGS | {"nodes": nodes}
    return jc.sweep("radial", grid(count), times, settings=settings, measure=measure, backend=backend)


def single(nodes: int, case: dict[str, float]) -> jc.Solution:
    """One case alone."""
    setup = jc.radial(nodes, contact=None, material=jc.Material(**case))
    solver, start = jc.integrator(RTOL, linear="two-level"), jc.initial_state(setup.scene, setup.x)
    return jc.simulate(setup.scene, start, TIMES, solver=solver)


def timed(function: Callable[[], xr.Dataset]) -> tuple[float, xr.Dataset]:
    """Seconds and result."""
    start = time.perf_counter()
    found = function()
    return time.perf_counter() - start, found


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


def main() -> None:
    """Run all ways; print and save."""
    parser = options(__doc__ or "", [500])
    parser.add_argument("--lanes", type=int, nargs="+", default=[16])
    parser.add_argument("--single", type=float, help="seconds of a single run, where it is not run here")
    opts = parser.parse_args()
    nodes, rows, ratios = opts.nodes[0], [], {}
    for count in opts.lanes:
        runs, alone = {}, (opts.single or 0.0) * count
        if opts.single is None:
            for yields in grid(count)["yield_curvature"]:
                for thickness in THICKNESS:
                    case = {"yield_curvature": yields, "thickness": thickness}
                    runs[yields, thickness] = single(nodes, case)
                    alone += runs[yields, thickness].run_s
        print(f"{count} single runs: {alone:.1f} s", flush=True)
        ways = {"lanes in turn": False, "lanes side by side": True}
        if jax.default_backend() != "cpu":
            ways.pop("lanes in turn")
        tables = {}
        for name, side_by_side in ways.items():
            lanes.best_side_by_side = lambda device, way=side_by_side: way
            swept(nodes, count, "batch", TIMES[:1] * 1e-3)
            tables[name] = timed(lambda count=count: swept(nodes, count, "batch"))
        if jax.default_backend() == "cpu":
            tables["processes"] = timed(lambda count=count: swept(nodes, count, "processes"))
        for name, (seconds, table) in tables.items():
            good = int((table.result == "success").sum())
            shown = compared(table, runs) if runs else ["", "", ""]
            rows.append([count, name, f"{seconds:.1f}", f"{seconds / alone:.2f}", f"{good}", *shown])
            ratios[f"{count} lanes, {name}"] = seconds / alone
            print(rows[-1], flush=True)
    head = ["lanes", "way", "s", "over single runs", "success", "before events, over 10 rtol"]
    head += ["energy at the end, median", "largest"]
    cores = len(os.sched_getaffinity(0))
    text = f"{markdown(head, rows)}\n\nn = {nodes}, rtol = {RTOL:g}, t = {TIMES[-1]:g} s, {cores} core(s)."
    save(opts, f"sweep_{nodes}_{jax.default_backend()}", text, None, ratios, rows)


if __name__ == "__main__":
    main()
