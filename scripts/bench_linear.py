"""Linear solvers on tangents of `radial`, set-up included, against the paper's preconditioner.

A call factors a new matrix, that of Newton's first iteration in the step which the recorded run takes next
(or the stiffness there with a small shift), and solves one right-hand side to a relative residual of 1e-2 and
of 1e-6. Two right-hand sides: independent random loads on all nodes, which hold every wavelength and give
the ratios; and Newton's own residual, which is smooth, so that 1e-2 of it leaves the soft modes unsolved.
The two-level set-up is shared by the two solves of a step; the direct solver's symbolic analysis by a whole
run. Of the paper's method the best block size counts.
Equal threads: the process is confined to as many cores as asked for, and MKL has as many threads.
Meshes of more than 12000 nodes start from the shape of that one and settle for 5 ms; on them the paper's
method has one block size and one tolerance, for it takes minutes a solve.

    python scripts/bench_linear.py [--nodes N ...] [--cores C] [--resume] [--json FILE]
"""

import itertools
import os
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from benchlib import (
    LARGEST_RUN,
    STATES,
    Log,
    confine,
    markdown,
    next_equations,
    options,
    paired,
    recorded,
    save,
)
from matplotlib.figure import Figure

from jaxcrumple._jax import threads
from jaxcrumple.solvers.linear.block_jacobi import BlockCG
from jaxcrumple.solvers.linear.direct import Direct
from jaxcrumple.solvers.linear.registry import direct_available
from jaxcrumple.solvers.linear.two_level import TwoLevel
from jaxcrumple.system import elastic_tangent, linearize

# Block sizes of the paper's method. The largest meshes run the first, close to the best at every size.
BLOCKS = (24, 48, 96)
TOLERANCES = (1e-2, 1e-6)
# Newton solves that share one two-level set-up.
SHARED = 2
LOW_SIGMA = 2e4
# Every timed matrix is a new one: a factor is kept for as long as the values are the same.
FRESH = itertools.count(1)


def matrices(nodes: int, folder: Path):
    """Pattern and (state, sigma in 1/s2, load, values, right-hand side) of each case."""
    for name, t in STATES.items():
        scene, state = recorded(nodes, t, folder)
        step, guess = next_equations(scene, state)
        value, values = eqx.filter_jit(linearize)(scene, step, guess)
        drag_rate = float(jnp.mean(scene.drag.coefficient) / jnp.mean(scene.mass))
        sigma = (drag_rate + float(step.inertia) / float(step.beta_h)) / float(step.beta_h)
        random = jnp.asarray(np.random.default_rng(0).normal(size=3 * nodes))
        yield scene.sparsity, name, sigma, "random", values, random
        if "flat" not in name:
            yield scene.sparsity, name, sigma, "Newton", values, -value.reshape(-1)
            low = eqx.filter_jit(elastic_tangent)(scene, state.x, state.p, state.t, LOW_SIGMA)
            yield scene.sparsity, name, LOW_SIGMA, "random", low, random


def timed(pattern, values, rhs, rtol: float, blocks, repeats: int) -> dict[str, dict]:
    """Seconds and iterations of every solver on one matrix; a new matrix in every repeat."""
    solvers = {f"paper, m = {size}": BlockCG(block_size=size) for size in blocks}
    solvers["two-level"] = TwoLevel()
    if direct_available():
        solvers["direct"] = Direct()

    @eqx.filter_jit
    def factor(solver, pattern, values, start):
        return solver.factor(pattern, values, start)

    @eqx.filter_jit
    def solve(solver, pattern, factor, values, rhs):
        return solver.solve(pattern, factor, values, rhs, rtol)

    @eqx.filter_jit
    def whole(solver, pattern, values, start, rhs):
        return solve(solver, pattern, factor(solver, pattern, values, start), values, rhs)

    def changed():
        return values * (1.0 + 1e-12 * next(FRESH))

    calls = {}
    for name, solver in solvers.items():
        start = eqx.filter_jit(solver.start)(pattern)
        if name == "two-level":
            made = factor(solver, pattern, values, start)
            calls["set-up"] = lambda s=solver, b=start: factor(s, pattern, changed(), b)
            calls[name] = lambda s=solver, f=made: solve(s, pattern, f, values, rhs)
        else:
            calls[name] = lambda s=solver, b=start: whole(s, pattern, changed(), b, rhs)
    timings = paired(calls, repeats)
    seconds = {name: timing.seconds for name, timing in timings.items()}
    seconds["two-level"] += seconds.pop("set-up") / SHARED
    size = jnp.linalg.norm(rhs)
    return {
        name: {
            "seconds": seconds[name],
            "iterations": int(timings[name].output.iterations),
            "indefinite": bool(timings[name].output.indefinite),
            "residual": float(jnp.linalg.norm(pattern.product(values, timings[name].output.x) - rhs) / size),
        }
        for name in solvers
    }


def measure(nodes: int, folder: Path, repeats: int, log: Log) -> list[dict]:
    """All states, loads, tolerances and solvers at one size."""
    found = []
    blocks, tolerances = (BLOCKS, TOLERANCES) if nodes <= LARGEST_RUN else (BLOCKS[:1], TOLERANCES[:1])
    for pattern, state, sigma, load, values, rhs in matrices(nodes, folder):
        for rtol in tolerances:
            case = {"nodes": nodes, "state": state, "sigma": sigma, "load": load, "rtol": rtol}
            case["blocks"] = list(blocks)
            args = pattern, values, rhs, rtol, blocks, repeats
            found.append(log.result(case, lambda a=args: {"solvers": timed(*a)}))
            times = {k: f"{1e3 * value['seconds']:.1f} ms" for k, value in found[-1]["solvers"].items()}
            print(case, times, flush=True)
    return found


def best_paper(row: dict) -> float:
    """Seconds of the paper's method at its best block size."""
    return min(v["seconds"] for k, v in row["solvers"].items() if k.startswith("paper"))


def ratios(found: list[dict]) -> dict[str, float]:
    """Smallest speed-up over buckled and crumpled at 1e-2, by solver and size."""
    figures: dict[str, float] = {}
    for row in found:
        definite = not any(value["indefinite"] for value in row["solvers"].values())
        if row["rtol"] != TOLERANCES[0] or row["load"] != "random" or not definite or "flat" in row["state"]:
            continue
        for solver, name in (("direct", "direct"), ("two-level", "two_level")):
            if solver in row["solvers"]:
                low = "_low_sigma" if row["sigma"] == LOW_SIGMA else ""
                key = f"{name}_vs_paper_{row['nodes']}{low}"
                ratio = best_paper(row) / row["solvers"][solver]["seconds"]
                figures[key] = min(figures.get(key, np.inf), ratio)
    return figures | growth(found)


def growth(found: list[dict]) -> dict[str, float]:
    """Exponent of n in the cost of a solve of the crumpled state to 1e-2, from 3000 nodes up."""
    figures = {}
    for solver, name in (("direct", "direct"), ("two-level", "two_level")):
        points = [
            (row["nodes"], row["solvers"][solver]["seconds"])
            for row in crumpled(found)
            if row["nodes"] >= 3000 and solver in row["solvers"]
        ]
        if len(points) > 1:
            n, seconds = np.log(np.array(points)).T
            figures[f"{name}_growth_exponent"] = float(np.polyfit(n, seconds, 1)[0])
    return figures


def crumpled(found: list[dict]) -> list[dict]:
    """The cases of the growth and of the plot: crumpled, at its own sigma, random load, to 1e-2."""
    wanted = {"state": "crumpled", "load": "random", "rtol": TOLERANCES[0]}
    own = [row for row in found if row["sigma"] != LOW_SIGMA]
    return [row for row in own if all(row[key] == value for key, value in wanted.items())]


def table(found: list[dict]) -> str:
    """Times and iterations."""
    names = list(found[0]["solvers"])
    rows = []
    for row in found:
        cells = []
        for name in names:
            value = row["solvers"].get(name)
            if value is None:
                cells.append("")
                continue
            text = f"{1e3 * value['seconds']:.1f} ({value['iterations']})"
            cells.append("indefinite" if value["indefinite"] else text)
        rows.append(
            [row["nodes"], row["state"], f"{row['sigma']:.1e}", row["load"], f"{row['rtol']:g}", *cells]
        )
    note = (
        "Milliseconds (iterations) for a new matrix and one right-hand side; two-level with "
        f"its share of a set-up that {SHARED} solves share. sigma is the shift of the stiffness by sigma "
        "times the mass."
    )
    return f"{note}\n\n{markdown(['n', 'state', 'sigma [1/s2]', 'load', 'to', *names], rows)}"


def draw(found: list[dict]) -> Figure:
    """Time of a solve to 1e-2 against n, crumpled state."""
    figure = Figure(figsize=(5.5, 4), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="nodes", ylabel="seconds to 1e-2")
    rows = crumpled(found)
    for name in rows[0]["solvers"]:
        mine = [r for r in rows if name in r["solvers"]]
        points = [(r["nodes"], r["solvers"][name]["seconds"]) for r in mine]
        axes.plot(*zip(*points, strict=True), "o-", label=name)
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = options(__doc__, (1000, 3000), resumable=True)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cores", type=int, default=2, help="of an otherwise idle machine")
    opts = parser.parse_args()
    confine(opts.cores)
    os.environ[threads.VARIABLE] = str(len(os.sched_getaffinity(0)))
    name = f"linear_{opts.cores}"
    log = Log(name, opts.resume)
    with threads.limited_blas():
        found = [row for nodes in opts.nodes for row in measure(nodes, opts.states, opts.repeats, log)]
    save(opts, name, table(found), draw(found), ratios(found), found)


if __name__ == "__main__":
    main()
