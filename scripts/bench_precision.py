"""Run time against error: schemes and linear solvers at many tolerances, against a tight reference.

Four stretches: `radial` from its start through the first buckling, windows of 50 steps from recorded states,
the snap of a spherical cap, and a window in dense contact. The reference is `dynamic`, inertia throughout, at
a tolerance below those compared: what quasistatic steps leave out counts as error.

    python scripts/bench_precision.py [--nodes N ...] [--stretch radial windows snap] [--resume] [--json FILE]
    python scripts/bench_precision.py --nodes 3000 --stretch contact
"""

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from benchlib import RTOLS, STATES, Log, markdown, options, recorded, save, timed_run
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from jaxcrumple import cap, frame_times, initial_state, integrator, radial, simulate
from jaxcrumple.scene import Scene
from jaxcrumple.state import State

# Schemes with their linear solvers; None is the scheme's own.
COMPARED = (
    ("hybrid", "direct"),
    ("hybrid", "two-level"),
    ("hybrid", "block-cg"),
    ("dynamic", "direct"),
    ("alternating", "direct"),
    ("explicit", None),
    ("paper", None),
)
# Those that are compared with the paper's, each at its own tolerance.
OURS = ("hybrid", "dynamic", "alternating")
# Tolerance of the reference, and those compared.
TIGHTEST = 3e-7
LADDER = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
# The same in dense contact, where steps are shorter, and what is compared there: others take hours.
TIGHTEST_IN_CONTACT = 3e-5
LADDER_IN_CONTACT = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3)
COMPARED_IN_CONTACT = (("hybrid", "direct"),)
# A window is as long as this many steps of the default scheme.
WINDOW_STEPS = 50
# Start and length in s of the window in dense contact (R = 3.15 cm).
CONTACT_START, CONTACT_LENGTH = 3.95, 0.02
# Seconds after which a run gives up.
PATIENCE = 240.0


class Stretch(NamedTuple):
    """A piece of motion: its start, and the times at which positions are compared."""

    scene: Scene
    state: State
    times: np.ndarray


class Comparison(NamedTuple):
    """What makes a stretch, the schemes and tolerances to compare on it, and that of the reference."""

    make: Callable[[], Stretch]
    compared: tuple[tuple[str, str | None], ...] = COMPARED
    ladder: tuple[float, ...] = LADDER
    tightest: float = TIGHTEST


def smooth(nodes: int) -> Stretch:
    """`radial` from its start through the first buckling."""
    setup = radial(nodes, contact=None)
    state = initial_state(setup.scene, setup.x)
    return Stretch(setup.scene, state, frame_times(0.6, 24)[1:])


def snap(nodes: int) -> Stretch:
    """The cap, through its limit point and to rest."""
    setup = cap(nodes)
    state = initial_state(setup.scene, setup.x)
    return Stretch(setup.scene, state, np.array([0.005, 0.01, 0.015, 0.05]))


def window(name: str, nodes: int, folder: Path) -> Stretch:
    """From a recorded state, as long as 50 steps of the default scheme take."""
    t = STATES[name]
    scene, state = recorded(nodes, t, folder)
    trial = simulate(scene, state, t + 1.0, solver=integrator(), max_attempts=WINDOW_STEPS)
    steps = trial.history[trial.history["kind"] == 0]
    times = np.linspace(t, float(steps["t"].iloc[-1]), 6)[1:]
    return Stretch(scene, state, times)


def contact(nodes: int, folder: Path) -> Stretch:
    """A window in dense contact, of the self-avoiding sheet."""
    scene, state = recorded(nodes, CONTACT_START, folder, "inverse-power", (CONTACT_START,))
    times = CONTACT_START + np.linspace(0.0, CONTACT_LENGTH, 6)[1:]
    return Stretch(scene, state, times)


def comparisons(kinds: list[str], nodes: int, folder: Path) -> dict[str, Comparison]:
    """The comparison on each stretch of the `kinds`, by name."""
    found: dict[str, Comparison] = {}
    if "radial" in kinds:
        found["radial"] = Comparison(functools.partial(smooth, nodes))
    if "windows" in kinds:
        makers = {f"window {name}": functools.partial(window, name, nodes, folder) for name in STATES}
        found |= {name: Comparison(make) for name, make in makers.items()}
    if "snap" in kinds:
        found["cap"] = Comparison(functools.partial(snap, nodes))
    if "contact" in kinds:
        make = functools.partial(contact, nodes, folder)
        own = COMPARED_IN_CONTACT, LADDER_IN_CONTACT, TIGHTEST_IN_CONTACT
        found["dense contact"] = Comparison(make, *own)
    return found


def run(stretch: Stretch, scheme: str, linear: str | None, rtol: float, patience: float = PATIENCE):
    """Positions at the stretch's times, CPU seconds, steps and result of one run; compiling apart."""
    solver = integrator(rtol, scheme=scheme, linear=linear)
    timed = timed_run(stretch.scene, stretch.state, stretch.times, solver, max_seconds=patience)
    before = stretch.state.counters
    steps = np.asarray(timed.solution.state.counters.steps) - np.asarray(before.steps)
    return timed.solution, timed.cpu_s, steps


def compare(comparison: Comparison, name: str, nodes: int, log: Log) -> list[dict]:
    """All runs of one stretch, tolerances in the outer loop so that schemes run in turn.

    The stretch and its reference are made only where a run is missing from the log.
    """
    made = functools.cache(comparison.make)

    @functools.cache
    def reference() -> np.ndarray:
        return run(made(), "dynamic", None, comparison.tightest, np.inf)[0].x

    rows: list[dict] = []
    for rtol in comparison.ladder:
        for scheme, linear in comparison.compared:
            if _done(r for r in rows if (r["scheme"], r["linear"]) == (scheme, linear)):
                continue
            case = {"stretch": name, "nodes": nodes, "scheme": scheme, "linear": linear, "rtol": rtol}
            rows.append(log.result(case, lambda c=case: measured(made(), reference(), c)))
            print(rows[-1], flush=True)
    return rows


def _done(rows: Iterable[dict]) -> bool:
    """Whether a scheme's runs so far leave nothing to learn from a smaller tolerance.

    It ran out of time, or two tolerances gave the same run: stability limits its steps, not the error.
    """
    mine = list(rows)
    stuck = len(mine) > 1 and all(mine[-1][key] == mine[-2][key] for key in ("steps", "error"))
    return stuck or any(row["result"] == "budget" for row in mine)


def measured(stretch: Stretch, reference: np.ndarray, case: dict) -> dict:
    """Error, cost and result of one run."""
    solution, spent, steps = run(stretch, case["scheme"], case["linear"], case["rtol"])
    error = np.nan
    if solution.result == "success":
        error = np.abs(solution.x - reference).max() / float(stretch.scene.length_scale)
    after, before = solution.state.counters, stretch.state.counters
    return {
        "error": float(error), "cpu_s": spent, "wall_s": solution.run_s, "steps": [int(s) for s in steps],
        "newton": int(after.newton - before.newton), "factors": int(after.factors - before.factors),
        "result": solution.result,
    }  # fmt: skip


def speed_up(rows: list[dict]) -> dict[str, float]:
    """CPU seconds of the paper's scheme over ours at equal error, by our scheme, stretch and size.

    The paper's cost is that of its cheapest run with at most twice our error, or, where none is as accurate,
    of its cheapest run: the figure is a lower bound then. Of the windows there is a geometric mean, too.
    """
    figures = {}
    sound = [row for row in rows if np.isfinite(row["error"])]
    for scheme in OURS:
        windows: dict[int, list[float]] = {}
        for stretch, nodes in dict.fromkeys((row["stretch"], row["nodes"]) for row in sound):
            mine = [r for r in sound if (r["stretch"], r["nodes"]) == (stretch, nodes)]
            own = (scheme, "direct", RTOLS[scheme])
            ours = [r for r in mine if (r["scheme"], r["linear"], r["rtol"]) == own]
            theirs = [r for r in mine if r["scheme"] == "paper"]
            if not (ours and theirs):
                continue
            as_good = [r for r in theirs if r["error"] <= 2.0 * ours[0]["error"]]
            ratio = min(r["cpu_s"] for r in as_good or theirs) / ours[0]["cpu_s"]
            figures[f"{scheme}_vs_paper_{stretch.replace(' ', '_')}_{nodes}"] = ratio
            if stretch.startswith("window"):
                windows.setdefault(nodes, []).append(ratio)
        for nodes, found in windows.items():
            figures[f"{scheme}_vs_paper_windows_{nodes}"] = float(np.exp(np.mean(np.log(found))))
    return figures


def table(rows: list[dict]) -> str:
    """One line per run."""
    cells = [
        [
            r["stretch"], r["nodes"], r["scheme"], r["linear"] or "own", f"{r['rtol']:.0e}",
            f"{r['error']:.1e}",
            f"{r['cpu_s']:.1f}", " + ".join(map(str, r["steps"])), r["newton"], r["factors"], r["result"],
        ]
        for r in rows
    ]  # fmt: skip
    header = ["stretch", "n", "scheme", "solver", "rtol", "error / sqrt(A)", "CPU s"]
    steps = "steps (quasistatic + implicit + explicit)"
    return markdown([*header, steps, "Newton iterations", "factorisations", "result"], cells)


def draw(rows: list[dict]) -> Figure:
    """CPU time against error, a panel per stretch and size."""
    panels = sorted({(row["stretch"], row["nodes"]) for row in rows})
    figure = Figure(figsize=(4.2 * len(panels), 4), layout="constrained")
    for axes, key in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
        mine = [r for r in rows if (r["stretch"], r["nodes"]) == key and np.isfinite(r["error"])]
        for number, scheme in enumerate(COMPARED):
            line = [(r["error"], r["cpu_s"]) for r in mine if (r["scheme"], r["linear"]) == scheme]
            if line:
                label = " ".join(filter(None, scheme))
                axes.loglog(*np.array(line).T, "o-", color=f"C{number}", label=label)
        # Where an axis spans a decade or so, powers of ten label too little, and its other ticks overlap.
        for axis, span in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            if span[1] < 30.0 * span[0]:
                axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.set(title=f"{key[0]}, n = {key[1]}", xlabel="error / sqrt(A)", ylabel="CPU s")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=7)
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = options(__doc__, (500,), resumable=True)
    kinds = ["radial", "windows", "snap"]
    parser.add_argument("--stretch", nargs="+", choices=[*kinds, "contact"], default=kinds)
    parser.add_argument("--rtols", type=float, nargs="+")
    schemes = sorted({scheme for scheme, _ in COMPARED})
    parser.add_argument("--schemes", nargs="+", choices=schemes, default=schemes)
    opts = parser.parse_args()
    name = "precision_" + "_".join(opts.stretch)
    log, rows = Log(name, opts.resume), []
    for nodes in opts.nodes:
        for key, every in comparisons(opts.stretch, nodes, opts.states).items():
            compared = tuple(pair for pair in every.compared if pair[0] in opts.schemes)
            ladder = tuple(opts.rtols or every.ladder)
            rows += compare(every._replace(compared=compared, ladder=ladder), key, nodes, log)
            jax.clear_caches()
    save(opts, name, table(rows), draw(rows), speed_up(rows), rows)


if __name__ == "__main__":
    main()
