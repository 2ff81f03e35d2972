"""What a snap-through costs each scheme, and whether all come to rest in the same place.

Arch and cap under a load that grows past the limit point. Each scheme runs to a load that the first branch
still bears, then on until the inverted sheet is at rest; both states are relaxed under that load. Distances
are between the relaxed states beyond the snap, over the span. The reference is `relax` alone, which follows
both branches without an integrator.

    python scripts/bench_snap.py [--nodes N ...] [--json FILE]
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from benchlib import RTOLS, markdown, options, save
from matplotlib.figure import Figure

from jaxcrumple import initial_state, integrator, simulate
from jaxcrumple.scenes.arch import arch
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.snap import Drop, energy_drop, relaxed_drop

SCHEMES = ("hybrid", "dynamic", "alternating", "explicit", "paper")
END = 0.05


class Case(NamedTuple):
    """A scene, its span in m, and times in s whose loads the first branch bears, and no longer bears."""

    build: Callable[..., Setup]
    span: float
    borne: float
    too_much: float


# Loads grow for 0.03 s, to 0.2 N on the arch and 0.3 N on the cap.
CASES = {
    "arch": Case(arch, 0.03, 0.0172, 0.0192),
    "cap": Case(cap, 0.05, 0.018, 0.0202),
}


def run(case: Case, setup: Setup, scheme: str) -> tuple[Drop, dict]:
    """Energies set free by the snap as one scheme finds it, and what the scheme took."""
    solver, start = integrator(RTOLS[scheme], scheme=scheme), initial_state(setup.scene, setup.x)
    simulate(setup.scene, start, END, solver=solver, max_attempts=0)
    begin = time.process_time()
    before = simulate(setup.scene, start, case.borne, solver=solver, throw=True).state
    after = simulate(setup.scene, before, END, solver=solver, throw=True).state
    spent = time.process_time() - begin
    counters = after.counters
    cost = {
        "cpu_s": spent,
        "steps": np.asarray(counters.steps).tolist(),
        "snap_steps": (np.asarray(counters.steps) - np.asarray(before.counters.steps)).tolist(),
        "rejected": int(np.sum(counters.rejected)),
        "newton": int(counters.newton),
    }
    return energy_drop(setup.scene, before, after), cost


def measure(nodes: int) -> list[dict]:
    """All scenes and schemes at one size."""
    rows = []
    for name, case in CASES.items():
        setup = case.build(nodes)
        reference = relaxed_drop(setup, case.borne, case.too_much)
        for scheme in SCHEMES:
            drop, cost = run(case, setup, scheme)
            off = float(jnp.max(jnp.abs(drop.after.state.x - reference.after.state.x))) / case.span
            row = {"scene": name, "nodes": setup.scene.n_nodes, "scheme": scheme, "distance": off}
            row |= {"potential": drop.potential, "elastic": drop.elastic}
            row |= {"potential_error": drop.potential / reference.potential - 1.0} | cost
            row |= {"elastic_error": drop.elastic / reference.elastic - 1.0}
            rows.append(row)
            print(row, flush=True)
    return rows


def table(rows: list[dict]) -> str:
    """One line per scene and scheme."""
    cells = [
        [
            r["scene"], r["nodes"], r["scheme"], f"{RTOLS[r['scheme']]:g}", " + ".join(map(str, r["steps"])),
            " + ".join(map(str, r["snap_steps"])), r["rejected"], f"{r['cpu_s']:.1f}",
            f"{r['distance']:.0e}", f"{1e6 * r['elastic']:.3f}", f"{r['elastic_error']:.0e}",
            f"{1e6 * r['potential']:.3f}", f"{r['potential_error']:.0e}",
        ]
        for r in rows
    ]  # fmt: skip
    header = [
        "scene",
        "n",
        "scheme",
        "rtol",
        "steps (quasistatic + implicit + explicit)",
        "of these from the snap on",
    ]
    header += ["rejected", "CPU s", "distance / span", "elastic drop [uJ]", "error"]
    header += ["potential drop [uJ]", "error"]
    return f"{END} s; compiling not counted.\n\n{markdown(header, cells)}"


def ratios(rows: list[dict]) -> dict[str, float]:
    """Largest deviations, and CPU seconds of each scheme over the hybrid's."""
    figures = {
        "largest_distance": max(row["distance"] for row in rows),
        "largest_elastic_error": max(abs(row["elastic_error"]) for row in rows),
        "largest_potential_error": max(abs(row["potential_error"]) for row in rows),
    }
    ours = {(r["scene"], r["nodes"]): r["cpu_s"] for r in rows if r["scheme"] == "hybrid"}
    for row in rows:
        if row["scheme"] != "hybrid":
            name = f"{row['scheme']}_vs_hybrid_{row['scene']}_{row['nodes']}"
            figures[name] = row["cpu_s"] / ours[row["scene"], row["nodes"]]
    return figures


def draw(rows: list[dict]) -> Figure:
    """CPU seconds by scene and scheme."""
    figure = Figure(figsize=(5.5, 3.5), layout="constrained")
    axes = figure.add_subplot(yscale="log", ylabel="CPU s")
    names = sorted({(row["scene"], row["nodes"]) for row in rows})
    for place, scheme in enumerate(SCHEMES):
        seconds = [
            r["cpu_s"]
            for key in names
            for r in rows
            if (r["scene"], r["nodes"], r["scheme"]) == (*key, scheme)
        ]
        axes.bar(np.arange(len(names)) + 0.2 * place, seconds, 0.2, label=scheme)
    axes.set_xticks(np.arange(len(names)) + 0.3, [f"{scene}, n = {n}" for scene, n in names])
    axes.legend(frameon=False)
    return figure


def main() -> None:
    """Run the benchmark."""
    opts = options(__doc__, (200, 500)).parse_args()
    rows = [row for nodes in opts.nodes for row in measure(nodes)]
    save(opts, "snap", table(rows), draw(rows), ratios(rows), rows)


if __name__ == "__main__":
    main()
