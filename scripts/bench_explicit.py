"""What a stretch of snapping costs the two explicit methods, in turn, and how far off each ends.

A rolled sheet under axial compression, phantom and self-avoiding, from where it has snapped for a while. Both
methods take their longest stable steps for the same time. Errors are distances from a Runge-Kutta run with
an eighth of the steps, over the size of the sheet.

    python scripts/bench_explicit.py [--nodes N ...] [--json FILE]
"""

import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from benchlib import confine, markdown, options, save
from matplotlib.figure import Figure

from jaxcrumple import cylindrical, initial_state, integrator, simulate
from jaxcrumple.contact.potentials import DEFAULT_POTENTIAL
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.solvers.explicit.runge_kutta import RungeKutta
from jaxcrumple.solvers.explicit.verlet import Verlet
from jaxcrumple.state import EXPLICIT, State

METHODS = {"RK 4(3)": RungeKutta, "Verlet": Verlet}
# Time of a compression in s, that until a state is taken, and that of the stretch; how often it is run.
COMPRESS, BEFORE, STRETCH, ROUNDS = 0.5, 0.015, 2e-3, 3


def explicit_by(method: str, max_step: float = np.inf):
    """An integrator of explicit steps by a method."""
    solver = integrator(scheme="explicit", max_step=max_step)
    return eqx.tree_at(lambda s: s.explicit, solver, METHODS[method](jnp.asarray(1e-2)))


def stretch(setup: Setup, start: State, solver) -> tuple[State, float]:
    """The state after the stretch, and the CPU seconds it took."""
    begin = time.process_time()
    solution = simulate(setup.scene, start, float(start.t) + STRETCH, solver=solver, throw=True)
    return solution.state, time.process_time() - begin


def measure(nodes: int, contact: str | None) -> list[dict]:
    """Both methods on one sheet."""
    setup = cylindrical(nodes, compress=COMPRESS, contact=contact)
    there = simulate(setup.scene, initial_state(setup.scene, setup.x), BEFORE, throw=True).state
    fresh = initial_state(setup.scene, there.x, there.v)
    start = eqx.tree_at(lambda s: (s.p, s.t), fresh, (there.p, there.t))
    solvers = {name: explicit_by(name) for name in METHODS}
    for solver in solvers.values():
        simulate(setup.scene, start, float(start.t) + STRETCH, solver=solver, max_attempts=1)
    seconds: dict[str, list[float]] = {name: [] for name in METHODS}
    ends = {}
    for _ in range(ROUNDS):
        for name, solver in solvers.items():
            ends[name], spent = stretch(setup, start, solver)
            seconds[name].append(spent)
    steps = {name: int(end.counters.steps[EXPLICIT]) for name, end in ends.items()}
    exact, _ = stretch(setup, start, explicit_by("RK 4(3)", STRETCH / steps["RK 4(3)"] / 8.0))
    size = float(setup.scene.length_scale)
    rows = []
    for name, end in ends.items():
        row = {"sheet": "phantom" if contact is None else "self-avoiding", "nodes": setup.scene.n_nodes}
        row |= {"method": name, "steps": steps[name], "cpu_s": float(np.median(seconds[name]))}
        row["error"] = float(jnp.max(jnp.abs(end.x - exact.x))) / size
        rows.append(row)
        print(row, flush=True)
    return rows


def table(rows: list[dict]) -> str:
    """One line per sheet and method."""
    header = ["sheet", "n", "method", "steps", "CPU s", "ms a step", "error / size"]
    cells = [
        [
            r["sheet"], r["nodes"], r["method"], r["steps"], f"{r['cpu_s']:.2f}",
            f"{1e3 * r['cpu_s'] / r['steps']:.2f}", f"{r['error']:.1e}",
        ]
        for r in rows
    ]  # fmt: skip
    return f"{1e3 * STRETCH:g} ms, median of {ROUNDS} runs in turn.\n\n{markdown(header, cells)}"


def ratios(rows: list[dict]) -> dict[str, float]:
    """CPU seconds of Runge-Kutta over Verlet's."""
    spent = {(r["sheet"], r["nodes"], r["method"]): r["cpu_s"] for r in rows}
    return {
        f"runge_kutta_vs_verlet_{sheet}_{nodes}": value / spent[sheet, nodes, "Verlet"]
        for (sheet, nodes, method), value in spent.items()
        if method != "Verlet"
    }


def draw(rows: list[dict]) -> Figure:
    """CPU seconds by size."""
    figure = Figure(figsize=(5.5, 3.5), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="nodes", ylabel="CPU s")
    for sheet, line in (("phantom", "--"), ("self-avoiding", "-")):
        for method, mark in zip(METHODS, "os", strict=True):
            own = [r for r in rows if (r["sheet"], r["method"]) == (sheet, method)]
            axes.plot(
                [r["nodes"] for r in own],
                [r["cpu_s"] for r in own],
                line + mark,
                label=f"{method}, {sheet}",
            )
    axes.legend(frameon=False)
    return figure


def main() -> None:
    """Run the benchmark."""
    opts = options(__doc__, (500, 1000, 3000)).parse_args()
    confine(1)
    rows = [
        row
        for nodes in opts.nodes
        for contact in (None, DEFAULT_POTENTIAL)
        for row in measure(nodes, contact)
    ]
    save(opts, "explicit", table(rows), draw(rows), ratios(rows), rows)


if __name__ == "__main__":
    main()
