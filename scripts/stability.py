"""Stress test: a Latin hypercube of sheets in a shrinking sphere, each in a process of its own.

Every run must end with a named result within its budget of wall time. A run that ends in `success` is
repeated at a tenth of its tolerance over its first quarter. No node may differ by more than twice rtol *
sqrt(A), or than twice what the errors that its steps may leave grow to: all nodes are shifted, by long waves
and noise, by the error that one step may leave, 40 times on the way, and what becomes of that is multiplied
by the run's steps over these shifts. A sheet that buckles from less falls to either side or at another
moment, and no tolerance tells to which or when. A run that had to be killed, one whose process failed, a
number that is not finite, a node behind the wall, and, with contact, a frame that passes through itself
count as failures too.

Results are kept line by line; the same command goes on where it was stopped.

    python scripts/stability.py [--contact] [--runs N] [--seconds S] [--workers W]
"""

import argparse
import concurrent.futures
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from benchlib import RESULTS, markdown, save
from matplotlib.figure import Figure
from scipy.stats import qmc

from jaxcrumple import Solution, initial_state, simulate
from jaxcrumple.contact.potentials import DEFAULT_POTENTIAL
from jaxcrumple.measure import count_intersections
from jaxcrumple.run.config import RunConfig, configure
from jaxcrumple.run.progress import why_steps_are_short
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import smooth_imperfection
from jaxcrumple.solvers.log import STEP
from jaxcrumple.solvers.scheme import REFERENCE_SHARE, Integrator
from jaxcrumple.state import restarted

SIZE, START, END = 0.1, 0.071, 0.05
FRAMES, COMPARED = 20, 5
# Error over the tolerance that counts as a broken one.
BROKEN = 2.0
# Wall time of the shifted run over that of the run: a restart after each shift costs short steps.
PATIENCE = 4.0
# Shifts from one compared frame to the next.
SHIFTS = 8
# Wall seconds for imports and compiling, in each of its runs, before a process counts as hanging.
GRACE = 240.0
NODES = (200, 400, 800, 1500, 3000, 6000, 12000)
SWEEPS = (0, 1, 3, 10, 30, 100)
# Dimensions of the cube that are powers of ten, with their ranges.
DECADES = {
    "slenderness": (-4, -2),
    "speed": (-3, 0),
    "yield_strain": (-3, 0.3),
    "plastic_time": (-5, -1),
    "drag_rate": (1, 5),
    "internal_damping_time": (-9, -5),
    "roughness": (-2, 1),
}
# Above this surface strain at yield the sheet is elastic.
ELASTIC = 1.0
FAILURES = ("hangs", "crashes", "not finite", "behind the wall", "intersections", "broken tolerance")


def sample(
    runs: int, seed: int = 0, largest: int = max(NODES), contact: str | None = None
) -> list[RunConfig]:
    """Configurations of a Latin hypercube with at most `largest` nodes."""
    cube = qmc.LatinHypercube(d=len(DECADES) + 2, seed=seed).random(runs)
    ladder = [n for n in NODES if n <= largest]
    return [_config(point, number, ladder, contact) for number, point in enumerate(cube)]


def _config(point: np.ndarray, number: int, ladder: list[int], contact: str | None) -> RunConfig:
    exponents = (low + u * (high - low) for u, (low, high) in zip(point, DECADES.values(), strict=False))
    value = {name: float(f"{10**e:.3g}") for name, e in zip(DECADES, exponents, strict=True)}
    thickness = value["slenderness"] * SIZE
    elastic = value["yield_strain"] > ELASTIC
    settings = {
        "thickness": thickness,
        "imperfection": value["roughness"] * thickness,
        "speed": value["speed"],
        "radius": START,
        "size": SIZE,
        "yield_curvature": None if elastic else 2.0 * value["yield_strain"] / thickness,
        "plastic_time": value["plastic_time"],
        "drag_rate": value["drag_rate"],
        "internal_damping_time": value["internal_damping_time"],
        "sweeps": SWEEPS[int(point[-1] * len(SWEEPS))],
        "frames": FRAMES,
        "contact": contact,
    }
    nodes = ladder[int(point[-2] * len(ladder))]
    t_end = (START - END) / value["speed"]
    return configure("radial", nodes=nodes, seed=number, t_end=t_end, settings=settings)


def judged(config: RunConfig, seconds: float) -> dict:
    """What became of a run: its result and cost, and which failures it shows."""
    setup, rtol = config.build(), config.solver.rtol
    solution = _run(setup, config, rtol, np.linspace(0.0, config.t_end, FRAMES + 1)[1:], seconds)
    counters, state = solution.state.counters, solution.state
    failures = []
    numbers = (solution.x, solution.v, state.x, state.v)
    if not all(np.all(np.isfinite(a)) for a in numbers):
        failures.append("not finite")
    behind, radius = _behind(setup, solution), _radius(setup, solution)
    if np.any(behind > 0):
        failures.append("behind the wall")
    if setup.scene.contact is not None and _intersections(setup, solution):
        failures.append("intersections")
    error = shifted = np.full(1, np.nan)
    failed = solution.result != "success"
    if not failed:
        times = solution.t[:COMPARED]
        tight = _run(setup, config, 0.1 * rtol, times, seconds)
        error = _distance(solution.x, tight.x)
        if np.any(error > BROKEN * rtol):
            shifted = _distance(_shifted(setup, config, times, PATIENCE * seconds), tight.x)
            excused = _grown(shifted, _steps(solution, times[-1]), len(error))
            if np.any(error > BROKEN * np.maximum(rtol, excused)):
                failures.append("broken tolerance")
    return {
        "result": solution.result,
        "failures": failures,
        "why": why_steps_are_short(initial_state(setup.scene, setup.x), state) if failed else "",
        "reached": float(state.t) / config.t_end,
        "behind": float(np.max(behind / radius)),
        "errors": error.tolist(),
        "shifted": shifted.tolist(),
        "events": len(solution.events),
        "steps": np.asarray(counters.steps).tolist(),
        "rejected": np.asarray(counters.rejected).tolist(),
        "newton": int(counters.newton),
        "compile_s": solution.compile_s,
        "run_s": solution.run_s,
    }


def _run(setup: Setup, config: RunConfig, rtol: float, times: np.ndarray, seconds: float) -> Solution:
    start = initial_state(setup.scene, setup.x)
    return simulate(setup.scene, start, times, solver=_solver(config, rtol), max_seconds=seconds)


def _solver(config: RunConfig, rtol: float) -> Integrator:
    """The run's integrator at another tolerance."""
    return config.solver.model_copy(update={"rtol": rtol}).build()


def _radius(setup: Setup, solution: Solution) -> np.ndarray:
    """Radius in m of the sphere at each frame and at the end."""
    times = np.append(solution.t, solution.state.t)
    return np.asarray(jax.vmap(setup.scene.walls[0].shape.radius)(times))


def _behind(setup: Setup, solution: Solution) -> np.ndarray:
    """Distance in m of the outermost node behind the wall, at each frame and at the end."""
    wall = setup.scene.walls[0]
    positions, times = [*solution.x, solution.state.x], [*solution.t, solution.state.t]
    return np.array([-np.min(wall.gap(jnp.asarray(x), t)) for x, t in zip(positions, times, strict=True)])


def _intersections(setup: Setup, solution: Solution) -> int:
    """How often edges pass through triangles, at each frame and at the end together."""
    return sum(count_intersections(setup.mesh, x) for x in (*solution.x, solution.state.x))


def _distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Largest distances of a node over sqrt(A), at the frames that both have."""
    frames = min(len(x), len(y))
    return np.linalg.norm(x[:frames] - y[:frames], axis=2).max(axis=1) / SIZE


def _steps(solution: Solution, t: float) -> int:
    """Accepted steps up to a time, as the history has them: 16 explicit ones, which leave less, are one."""
    history = solution.history
    return int(np.sum((history["kind"] == STEP) & (history["t"] <= t)))


def _grown(shifted: np.ndarray, steps: int, frames: int) -> np.ndarray:
    """What the errors of as many steps may have grown to by each of the frames.

    Where the shifted run has no frame any more, that of its last one.
    """
    largest = np.maximum.accumulate(np.append(0.0, shifted))
    known = np.minimum(np.arange(1, frames + 1), len(shifted))
    return largest[known] * max(1.0, steps / (SHIFTS * COMPARED))


def _shifted(setup: Setup, config: RunConfig, times: np.ndarray, seconds: float) -> np.ndarray:
    """Positions at a tenth of the tolerance, shifted again and again by what a step may leave.

    Once is not enough: a shift dies away before a buckling that comes later.
    """
    rtol = config.solver.rtol
    solver = _solver(config, 0.1 * rtol)
    shift = _shift(setup, REFERENCE_SHARE * rtol * SIZE)
    state, frames, begin = initial_state(setup.scene, setup.x), [], time.perf_counter()
    stops = np.interp(
        np.arange(1, SHIFTS * len(times) + 1) / SHIFTS, np.arange(len(times) + 1), [0.0, *times]
    )
    for number, stop in enumerate(stops, start=1):
        state = restarted(setup.scene, state, state.x + shift * (-1) ** number, state.v)
        left = seconds - (time.perf_counter() - begin)
        state = simulate(setup.scene, state, stop, solver=solver, max_seconds=left).state
        if float(state.t) < stop:
            break
        if number % SHIFTS == 0:
            frames.append(np.asarray(state.x))
    return np.array(frames).reshape(-1, *setup.x.shape)


def _shift(setup: Setup, amplitude: float) -> np.ndarray:
    """Displacements (n, 3) in m of every wavelength: long waves and noise, both of the same `amplitude`."""
    points = np.asarray(setup.x)[:, :2]
    waves = [smooth_imperfection(points, SIZE, amplitude, seed) for seed in range(3)]
    noise = np.random.default_rng(0).uniform(-amplitude, amplitude, size=setup.x.shape)
    return np.stack(waves, axis=1) + noise


def asked(config: RunConfig, seconds: float) -> dict:
    """What decides the result of a run."""
    return {"config": config.model_dump(mode="json"), "seconds": seconds}


def one(number: int, config: RunConfig, seconds: float) -> dict:
    """Result of one run, made in a process of its own."""
    command = [sys.executable, __file__, "--one", config.model_dump_json(), "--seconds", str(seconds)]
    start = time.perf_counter()
    outcome = {"number": number, "asked": asked(config, seconds)}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=(2 + PATIENCE) * seconds + 3 * GRACE, check=False
        )
    except subprocess.TimeoutExpired:
        return outcome | {"result": "killed", "failures": ["hangs"]}
    if done.returncode:
        return outcome | {"result": "crash", "failures": ["crashes"], "why": done.stderr[-2000:]}
    found = json.loads(done.stdout.splitlines()[-1])
    return outcome | found | {"process_s": time.perf_counter() - start}


def study(configs: list[RunConfig], seconds: float, workers: int, log: Path) -> list[dict]:
    """All results, those that the `log` holds not made again."""
    log.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    known = {line["number"]: line for line in lines}
    todo = [
        (number, config)
        for number, config in enumerate(configs)
        if known.get(number, {}).get("asked") != asked(config, seconds)
    ]
    with concurrent.futures.ThreadPoolExecutor(workers) as pool, log.open("a") as file:
        jobs = [pool.submit(one, number, config, seconds) for number, config in todo]
        for job in concurrent.futures.as_completed(jobs):
            found = job.result()
            known[found["number"]] = found
            print(json.dumps(found), file=file, flush=True)
            print(found["number"], found["result"], found["failures"], flush=True)
    return [known[number] for number in range(len(configs))]


def table(found: list[dict], seconds: float) -> str:
    """Counts of results and failures, and a line for each run that neither succeeded nor ran out of time."""
    rtol, rows = found[0]["asked"]["config"]["solver"]["rtol"], []
    for result in sorted({row["result"] for row in found}):
        mine = [row for row in found if row["result"] == result]
        errors = np.array([np.max(row["errors"] or np.nan) for row in mine if result == "success"])
        rows.append(
            [
                result,
                len(mine),
                f"{np.median([row.get('run_s', np.nan) for row in mine]):.1f}",
                f"{np.mean([row.get('reached', 0.0) for row in mine]):.2f}",
                " / ".join(str(np.sum(errors < share * rtol)) for share in (0.1, 1.0, 10.0, np.inf)),
                *(sum(failure in row["failures"] for row in mine) for failure in FAILURES),
            ]
        )
    header = ["result", "runs", "median s", "mean share of the way", "error < 0.1 / 1 / 10 / any rtol"]
    text = f"{len(found)} runs, rtol {rtol:g}, {seconds:g} s each.\n\n{markdown([*header, *FAILURES], rows)}"
    odd = [row for row in found if row["failures"] or row["result"] not in ("success", "budget")]
    lines = [
        f"- run {row['number']}: {row['result']}, {', '.join(row['failures']) or 'no failure'}"
        f" ({row.get('why') or 'no reason given'})"
        for row in odd
    ]
    return "\n".join([text, "", *lines]) if lines else text


def draw(found: list[dict]) -> Figure:
    """Share of the way that each run went, against each dimension, by result."""
    configs = [row["asked"]["config"] for row in found]
    frame = pd.DataFrame(
        [
            config["material"]
            | config["options"]
            | {"nodes": config["nodes"], "result": row["result"], "reached": row.get("reached", 0.0)}
            for config, row in zip(configs, found, strict=True)
        ]
    )
    names = ["thickness", "nodes", "sweeps", "speed", "yield_curvature", "plastic_time", "drag_rate"]
    names += ["internal_damping_time"]
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    for axes, name in zip(figure.subplots(2, 4, sharey=True).flat, names, strict=True):
        for result, group in frame.groupby("result"):
            axes.plot(group[name], group["reached"], ".", label=result)
        axes.set(xscale="symlog" if name == "sweeps" else "log", xlabel=name, ylabel="share of the way")
    figure.axes[0].legend(frameon=False, fontsize=8)
    return figure


def main() -> None:
    """Run the study, or one of its runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0, help="budget of each run")
    parser.add_argument("--contact", action="store_true", help="self-avoiding sheets")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--log", type=Path, help="file of results (default: runs/STUDY.jsonl)")
    parser.add_argument("--json", type=Path, help="write the figures by name to this file")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of table and plot")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    opts = parser.parse_args()
    if opts.one:
        jax.config.update("jax_compilation_cache_dir", str(Path("runs/cache").absolute()))
        print(json.dumps(judged(RunConfig.model_validate_json(opts.one), opts.seconds)))
        return
    name, contact = ("stability_contact", DEFAULT_POTENTIAL) if opts.contact else ("stability", None)
    log = opts.log or Path(f"runs/{name}.jsonl")
    found = study(sample(opts.runs, contact=contact), opts.seconds, opts.workers, log)
    figures = {"failures": float(sum(bool(row["failures"]) for row in found))}
    save(opts, name, table(found, opts.seconds), draw(found), figures, found)


if __name__ == "__main__":
    main()
