"""Measured error against tolerance on `radial`, up to just before its first snap.

python scripts/bench_tolerance.py [--nodes N ...] [--seed S] [--json FILE]
"""

import time

import numpy as np
from benchlib import options, save
from matplotlib.figure import Figure

from jaxcrumple import hybrid, initial_state, radial, simulate

RTOLS = (1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
REFERENCE = 1e-7
FRAMES = 40


def run(setup, rtol: float, times: np.ndarray):
    """Positions at `times`, and what they cost."""
    state = initial_state(setup.scene, setup.x)
    start = time.process_time()
    solution = simulate(setup.scene, state, times, solver=hybrid(rtol), throw=True)
    return solution, time.process_time() - start


def measure(nodes: int, seed: int) -> dict:
    """Errors of one mesh: the largest over all nodes and all frames before the first event, over sqrt(A)."""
    setup = radial(nodes, seed)
    end = first_event(setup)
    times = np.linspace(0.0, 0.98 * end, FRAMES + 1)[1:]
    reference, _ = run(setup, REFERENCE, times)
    size = float(np.sqrt(setup.mesh.area))
    rows = []
    for rtol in RTOLS:
        solution, cpu = run(setup, rtol, times)
        error = np.abs(solution.x - reference.x).max(axis=(1, 2)) / size
        counters = solution.state.counters
        rows.append(
            {
                "rtol": rtol,
                "error": float(error.max()),
                "error_at_end": float(error[-1]),
                "steps": int(np.sum(counters.steps)),
                "rejected": int(np.sum(counters.rejected)),
                "newton": int(counters.newton),
                "cpu_s": cpu,
            }
        )
        print(rows[-1], flush=True)
    logs = np.log([[row["rtol"], row["error"], row["error_at_end"]] for row in rows]).T
    return {
        "nodes": nodes,
        "seed": seed,
        "first_event_s": end,
        "slope": float(np.polyfit(logs[0], logs[1], 1)[0]),
        "slope_at_end": float(np.polyfit(logs[0], logs[2], 1)[0]),
        "rows": rows,
    }


def first_event(setup, step: float = 0.1, end: float = 2.6) -> float:
    """End in s of the first quasistatic stage, found with a run ten times looser than the reference."""
    state = initial_state(setup.scene, setup.x)
    times = np.arange(1, round(end / step) + 1) * step
    solution = simulate(setup.scene, state, times, solver=hybrid(10 * REFERENCE), throw=True)
    ended = solution.events.loc[solution.events["origin"] == "quasistatic", "t"]
    return float(ended.min()) if len(ended) else end


def table(results: list[dict]) -> str:
    """The figures as Markdown."""
    lines = ["| n | rtol | largest error / sqrt(A) | steps | rejected | Newton per step | CPU s |"]
    lines.append("|---|---|---|---|---|---|---|")
    for result in results:
        for row in result["rows"]:
            newton = row["newton"] / row["steps"]
            lines.append(
                f"| {result['nodes']} | {row['rtol']:.0e} | {row['error']:.1e} | {row['steps']} | "
                f"{row['rejected']} | {newton:.1f} | {row['cpu_s']:.1f} |"
            )
        lines.append(f"| {result['nodes']} | log-log slope | {result['slope']:.2f} | | | | |")
    return "\n".join(lines)


def draw(results: list[dict]) -> Figure:
    """Error against tolerance, with the diagonal."""
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.add_subplot()
    for result in results:
        rtol, error = zip(*((row["rtol"], row["error"]) for row in result["rows"]), strict=True)
        axes.loglog(rtol, error, "o-", label=f"n = {result['nodes']}, slope {result['slope']:.2f}")
    axes.loglog(RTOLS, RTOLS, "k:", label="error = rtol")
    axes.set(xlabel="rtol", ylabel="largest position error / sqrt(A)")
    axes.legend()
    return figure


def main() -> None:
    """Run the study."""
    parser = options(__doc__, (500,))
    parser.add_argument("--seed", type=int, default=0)
    opts = parser.parse_args()
    results = [measure(nodes, opts.seed) for nodes in opts.nodes]
    ratios = {f"slope_{result['nodes']}": result["slope"] for result in results}
    text = f"{table(results)}\n\nReference: rtol {REFERENCE:g}."
    save(opts, "tolerance", text, draw(results), ratios, results)


if __name__ == "__main__":
    main()
