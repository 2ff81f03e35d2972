"""The whole of `radial`, phantom and elastoplastic, from R = 7.1 to 3.4 cm: what it takes.

Newton iterations of a rejected attempt count with the next accepted step.

    python scripts/bench_radial.py [--nodes N ...] [--schemes S ...] [--resume] [--json FILE]
"""

import functools
import itertools
import resource

import numpy as np
from benchlib import RTOLS, Log, markdown, options, save, timed_run
from matplotlib.figure import Figure

from jaxcrumple import frame_times, initial_state, integrator, radial
from jaxcrumple.state import CAUSES

T_END, FRAMES = 3.7, 37
SCHEMES = ("hybrid", "alternating")


def measure(nodes: int, scheme: str) -> dict:
    """One run; compiling apart."""
    setup, solver = radial(nodes, contact=None), integrator(RTOLS[scheme], scheme=scheme)
    state = initial_state(setup.scene, setup.x)
    timed = timed_run(setup.scene, state, frame_times(T_END, FRAMES)[1:], solver, throw=True)
    run = timed.solution
    history, counters = run.history[run.history["kind"] == 0], run.state.counters
    stages = {}
    newton = np.diff(history["newton_iterations"], prepend=0)
    for name, place in (("quasistatic", 0), ("implicit", 1)):
        mine = (history["stage"] == name).to_numpy()
        steps = int(counters.steps[place])
        stages[name] = {
            "steps": steps,
            "newton_per_step": float(newton[mine].sum() / max(steps, 1)),
            "h_s": np.quantile(history["h"][mine], [0.1, 0.5, 0.9]).tolist() if steps else [],
        }
    last = history.iloc[-1]
    row = {
        "cpu_s": timed.cpu_s, "wall_s": timed.wall_s, "compile_s": timed.compile_s, "stages": stages,
        "explicit_steps": int(counters.steps[2]),
        "rejected": dict(zip(CAUSES, np.asarray(counters.rejected).tolist(), strict=True)),
        "newton": int(counters.newton), "factors": int(counters.factors), "linear": int(counters.linear),
        "switches": int(counters.switches), "stretch_mj": float(1e3 * last["stretch"]),
        "bending_mj": float(1e3 * last["bending"]),
        "largest_strain": float(np.abs(setup.scene.membrane.strain(run.state.x)).max()),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10,
    }  # fmt: skip
    print(nodes, scheme, row, flush=True)
    return row


def rejected_share(row: dict) -> float:
    """Rejected over all attempts of the implicit stages."""
    steps = sum(stage["steps"] for stage in row["stages"].values())
    rejected = sum(row["rejected"].values())
    return rejected / (steps + rejected)


def table(rows: list[dict]) -> str:
    """A column for each size."""

    def quantiles(row: dict, stage: str) -> str:
        return " / ".join(f"{h:.0e}" for h in row["stages"][stage]["h_s"]) + " s"

    lines = {
        "run, CPU / wall s (+ compiling, once)": lambda r: (
            f"{r['cpu_s']:.0f} / {r['wall_s']:.0f} (+ {r['compile_s']:.0f})"
        ),
        "steps: quasistatic + implicit + explicit": lambda r: " + ".join(
            map(str, [*(s["steps"] for s in r["stages"].values()), r["explicit_steps"]])
        ),
        "rejected, share of attempts": lambda r: (
            f"{sum(r['rejected'].values())} ({100 * rejected_share(r):.0f} %)"
        ),
        "of these for error / Newton / instability / fold": lambda r: " / ".join(
            str(r["rejected"][cause]) for cause in ("error", "newton", "unstable", "fold")
        ),
        "Newton per quasistatic / implicit step": lambda r: " / ".join(
            f"{s['newton_per_step']:.2f}" for s in r["stages"].values()
        ),
        "Newton iterations, linear solves' iterations, factors": lambda r: (
            f"{r['newton']}, {r['linear']}, {r['factors']}"
        ),
        "quasistatic step at 10 / 50 / 90 %": lambda r: quantiles(r, "quasistatic"),
        "implicit step with inertia at 10 / 50 / 90 %": lambda r: quantiles(r, "implicit"),
        "changes of stage": lambda r: r["switches"],
        "energy, bending + stretch": lambda r: f"{r['bending_mj']:.1f} + {r['stretch_mj']:.1f} mJ",
        "largest edge strain": lambda r: f"{100 * r['largest_strain']:.2f} %",
        "peak memory so far": lambda r: f"{r['peak_mb'] / 1024:.1f} GB",
    }
    header = ["", *(f"`{row['scheme']}`, n = {row['nodes']}" for row in rows)]
    cells = [[name, *(value(row) for row in rows)] for name, value in lines.items()]
    rtols = ", ".join(dict.fromkeys(f"{row['scheme']} {row['rtol']:g}" for row in rows))
    return f"rtol: {rtols}; R = 7.1 to 3.4 cm ({T_END} s), {FRAMES} frames.\n\n{markdown(header, cells)}"


def ratios(rows: list[dict]) -> dict[str, float]:
    """The figures by size."""
    figures = {}
    for row in rows:
        n = f"{row['scheme']}_{row['nodes']}"
        figures[f"wall_s_{n}"], figures[f"cpu_s_{n}"] = row["wall_s"], row["cpu_s"]
        for stage, found in row["stages"].items():
            figures[f"newton_per_{stage}_step_{n}"] = found["newton_per_step"]
        figures[f"rejected_share_{n}"] = rejected_share(row)
    return figures


def draw(rows: list[dict]) -> Figure:
    """CPU seconds against n."""
    figure = Figure(figsize=(4.5, 3.5), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="nodes", ylabel="CPU s")
    for scheme in dict.fromkeys(row["scheme"] for row in rows):
        mine = [row for row in rows if row["scheme"] == scheme]
        axes.plot([row["nodes"] for row in mine], [row["cpu_s"] for row in mine], "o-", label=scheme)
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = options(__doc__, (1000, 3000), resumable=True)
    parser.add_argument("--schemes", nargs="+", choices=SCHEMES, default=list(SCHEMES))
    opts = parser.parse_args()
    log, rows = Log("radial", opts.resume), []
    for nodes, scheme in itertools.product(opts.nodes, opts.schemes):
        case = {"nodes": nodes, "scheme": scheme, "rtol": RTOLS[scheme]}
        rows.append(log.result(case, functools.partial(measure, nodes, scheme)))
    save(opts, "radial", table(rows), draw(rows), ratios(rows), rows)


if __name__ == "__main__":
    main()
