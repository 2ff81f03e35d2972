"""Measured error against tolerance on `radial`, from its start through the first buckling.

`quasistatic` is held against itself at a far smaller tolerance, the others against `dynamic` at such a one:
the error of solving their equations, with `alternating` also the inertia that quasistatic steps leave out.

    python scripts/bench_tolerance.py [--nodes N ...] [--seed S] [--json FILE]
"""

import numpy as np
from benchlib import markdown, options, save, timed_run
from matplotlib.figure import Figure

from jaxcrumple import initial_state, integrator, radial

LADDER = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6)
# Each scheme's reference: scheme and tolerance.
REFERENCES = {
    "quasistatic": ("quasistatic", 1e-8),
    "dynamic": ("dynamic", 1e-7),
    "hybrid": ("dynamic", 1e-7),
    "alternating": ("dynamic", 1e-7),
}
END, FRAMES = 0.6, 40


def run(setup, scheme: str, rtol: float, times: np.ndarray):
    """Positions at `times`, and what they cost; compiling apart."""
    state, solver = initial_state(setup.scene, setup.x), integrator(rtol, scheme=scheme)
    timed = timed_run(setup.scene, state, times, solver, throw=True)
    return timed.solution, timed.cpu_s


def measure(nodes: int, seed: int) -> list[dict]:
    """Errors of one mesh, largest over all nodes and frames, over sqrt(A)."""
    setup = radial(nodes, seed, contact=None)
    times = np.linspace(0.0, END, FRAMES + 1)[1:]
    references = {key: run(setup, *key, times)[0].x for key in dict.fromkeys(REFERENCES.values())}
    rows = []
    for scheme, reference in REFERENCES.items():
        for rtol in LADDER:
            solution, cpu = run(setup, scheme, rtol, times)
            error = np.abs(solution.x - references[reference]).max(axis=(1, 2)) / np.sqrt(setup.mesh.area)
            counters = solution.state.counters
            row = {"nodes": nodes, "seed": seed, "scheme": scheme, "rtol": rtol, "cpu_s": cpu}
            row |= {"error": float(error.max()), "median": float(np.median(error))}
            row |= {"steps": int(np.sum(counters.steps)), "rejected": int(np.sum(counters.rejected))}
            rows.append(row)
            print(row, flush=True)
    return rows


def slopes(rows: list[dict]) -> dict[str, float]:
    """Log-log slope of the largest error against rtol, by scheme and size."""
    figures = {}
    for scheme, nodes in dict.fromkeys((row["scheme"], row["nodes"]) for row in rows):
        points = [(r["rtol"], r["error"]) for r in rows if (r["scheme"], r["nodes"]) == (scheme, nodes)]
        rtol, error = np.log(np.array(points)).T
        figures[f"slope_{scheme}_{nodes}"] = float(np.polyfit(rtol, error, 1)[0])
    return figures


def table(rows: list[dict]) -> str:
    """The figures as Markdown."""
    lines = [
        [
            row["nodes"], row["scheme"], f"{row['rtol']:.0e}", f"{row['error']:.1e}", f"{row['median']:.1e}",
            row["steps"], row["rejected"], f"{row['cpu_s']:.1f}",
        ]
        for row in rows
    ]  # fmt: skip
    header = [
        "n",
        "scheme",
        "rtol",
        "largest error / sqrt(A)",
        "median over time",
        "steps",
        "rejected",
        "CPU s",
    ]
    found = ", ".join(f"{name} {value:.2f}" for name, value in slopes(rows).items())
    return f"{markdown(header, lines)}\n\n{found}. References: {REFERENCES}."


def draw(rows: list[dict]) -> Figure:
    """Error against tolerance, with the diagonal."""
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.add_subplot()
    for scheme, nodes in dict.fromkeys((row["scheme"], row["nodes"]) for row in rows):
        points = [(r["rtol"], r["error"]) for r in rows if (r["scheme"], r["nodes"]) == (scheme, nodes)]
        axes.loglog(*zip(*points, strict=True), "o-", label=f"{scheme}, n = {nodes}")
    axes.loglog(LADDER, LADDER, "k:", label="error = rtol")
    axes.set(xlabel="rtol", ylabel="largest position error / sqrt(A)")
    axes.legend(frameon=False)
    return figure


def main() -> None:
    """Run the study."""
    parser = options(__doc__, (500,))
    parser.add_argument("--seed", type=int, default=0)
    opts = parser.parse_args()
    rows = [row for nodes in opts.nodes for row in measure(nodes, opts.seed)]
    save(opts, "tolerance", table(rows), draw(rows), slopes(rows), rows)


if __name__ == "__main__":
    main()
