"""What self-contact costs: CPU time of a step by component as a sheet is crumpled (Fig. 6d), the search for
candidates, and a sheet that nowhere touches itself.

For each n, from states of the self-avoiding `radial`: CPU seconds per attempt of a window, measured, and of
these what the sheet's own forces, tangents and linear systems take there: their times without contact, each
measured alone, times how often they were made. All the rest is put down to contact, so that its share is an
upper bound. Where nothing touches, windows with contact and without it are run in turn, and the least of each
counts. Iterations of the two-level solver: for the residual of a step of 0.1 ms, with contact and without.

    python scripts/bench_contact.py [--nodes N ...] [--json FILE]
"""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchlib import markdown, options, paired, parts_of_a_step, recorded, save, timed_run
from matplotlib.figure import Figure

from jaxcrumple import integrator
from jaxcrumple._jax.threads import limited_blas
from jaxcrumple.contact.broad_phase import find_candidates
from jaxcrumple.contact.narrow_phase import find_pairs
from jaxcrumple.contact.potentials import DEFAULT_POTENTIAL
from jaxcrumple.geometry.intersections import intersections
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.reallocate import Reallocation, with_contacts
from jaxcrumple.solvers.contact.report import contact_report
from jaxcrumple.solvers.implicit.newton import FORCING
from jaxcrumple.state import State
from jaxcrumple.system import linearize

# Times of the states in s: R = 7.1 cm - 1 cm/s t.
TIMES = (0.05, 0.8, 1.6, 2.4, 3.1, 3.7)
# Attempts of a window.
STEPS = 64
PARTS = ("forces", "tangents", "linear systems", "energies", "contact")
LISTS = ("search", "sites", "places")
# Rounds of windows in turn, and the step in s whose equations the two-level solver gets.
ROUNDS, STEP = 5, 1e-4


def phantom(scene: Scene) -> Scene:
    """The scene without contact."""
    return dataclasses.replace(scene, contact=None, lists=None)


def without_listing(state: State) -> State:
    """The state as one of a scene without contact."""
    return eqx.tree_at(lambda s: s.listing, state, None)


def window(scene: Scene, state: State) -> dict[str, float]:
    """CPU seconds, Newton iterations and factors per attempt from a state on."""
    solver = integrator(scheme="dynamic")
    timed = timed_run(scene, state, float(state.t) + 1.0, solver, max_attempts=STEPS)
    before, after = state.counters, timed.solution.state.counters
    counts = {name: int(getattr(after, name) - getattr(before, name)) for name in ("newton", "factors")}
    # The run looks for intersections of its start and makes lists that hold from then on.
    cost = {"cpu": timed.cpu_s - start_cost(scene, state), **counts}
    return {name: value / STEPS for name, value in cost.items()}


def start_cost(scene: Scene, state: State) -> float:
    """CPU seconds that a run with contact takes before its first step."""
    solver = integrator(scheme="dynamic")
    return timed_run(scene, state, float(state.t) + 1.0, solver, max_attempts=0).cpu_s


def components(scene: Scene, state: State) -> dict[str, float]:
    """CPU seconds of an attempt by component, and their sum."""
    per, own = window(scene, state), parts_of_a_step(phantom(scene), without_listing(state))
    found = {
        "forces": own["residual"] * (per["newton"] + 1.0),
        "tangents": own["tangent"] * per["factors"],
        "linear systems": own["factor"] * per["factors"] + own["solve"] * per["newton"],
        "energies": own["energies"],
    }
    return found | {"contact": per["cpu"] - sum(found.values()), "all": per["cpu"]}


def list_costs(scene: Scene, state: State) -> dict[str, float]:
    """Seconds of a search for candidates, of a list of sites, and of giving pairs a place in the matrix."""
    contact, listing, lists = scene.contact, state.listing, scene.lists
    own, half = Reallocation(scene, merged=True), scene.bending.hinges(listing.candidates.x).half
    search, sites = eqx.filter_jit(find_candidates), eqx.filter_jit(find_pairs)
    room, capacity = lists.candidates.triangles.shape[0], lists.pairs.capacity
    calls = {
        "search": lambda: search(contact, half, listing.candidates, room),
        "sites": lambda: sites(contact, lists.candidates, listing.pairs, capacity),
        "places": lambda: own.placed(lists, listing.matrix).matrix,
    }
    return {name: timing.seconds for name, timing in paired(calls, 10).items()}


def apart_cost(scene: Scene, state: State) -> float:
    """CPU time of a window of a sheet that nowhere touches itself, over that of the phantom's."""
    sheets = (scene, state), (phantom(scene), without_listing(state))
    rounds = [[window(*sheet)["cpu"] for sheet in sheets] for _ in range(ROUNDS)]
    mine, other = np.min(rounds, axis=0)
    return mine / other


@eqx.filter_jit
def iterations(scene: Scene, state: State) -> jax.Array:
    """Iterations of the two-level solver for a step's first residual; 0: the matrix is called indefinite."""
    solver = integrator(scheme="dynamic", linear="two-level").implicit
    step, _ = solver.equations(scene, state, jnp.asarray(STEP))
    value, values = linearize(scene, step, state.x)
    factor = solver.linear.factor(scene.sparsity, values, solver.linear.start(scene.sparsity))
    solution = solver.linear.solve(scene.sparsity, factor, values, -value.reshape(-1), FORCING)
    return jnp.where(solution.indefinite, 0, solution.iterations)


def measure(nodes: int, folder: Path) -> dict:
    """Everything at one size."""
    rows = []
    with limited_blas():
        for t in TIMES:
            scene, state = recorded(nodes, t, folder, DEFAULT_POTENTIAL, TIMES)
            listed = with_contacts(scene, state.x)
            report = contact_report(listed, state.x)
            row = {"t": t, "R_cm": 7.1 - t, "contacts": report.interacting, "gap_um": 1e6 * report.gap}
            row |= components(scene, state)
            row |= list_costs(listed, state)
            row["two-level"] = int(iterations(listed, state))
            row["phantom"] = int(iterations(phantom(scene), without_listing(state)))
            if len(intersections(state.x, scene.contact.faces, scene.membrane.nodes)):
                raise RuntimeError(f"the sheet of {nodes} nodes intersects itself at {t} s")
            rows.append(row)
            print(nodes, row, flush=True)
        scene, state = recorded(nodes, TIMES[0], folder, DEFAULT_POTENTIAL, TIMES)
        apart = apart_cost(scene, state)
    jax.clear_caches()
    return {"nodes": nodes, "rows": rows, "apart": apart}


def table(results: list[dict]) -> str:
    """Components and shares."""
    header = ["n", "R cm", "contacts", *(f"{part} ms" for part in PARTS), "all ms", "contact %"]
    header += [f"{name} ms" for name in LISTS] + ["two-level iterations (phantom)"]
    lines = [
        [
            result["nodes"], f"{row['R_cm']:.2f}", row["contacts"],
            *(f"{1e3 * row[part]:.1f}" for part in (*PARTS, "all")),
            f"{100 * row['contact'] / row['all']:.0f}", *(f"{1e3 * row[name]:.0f}" for name in LISTS),
            f"{row['two-level']} ({row['phantom']})",
        ]
        for result in results
        for row in result["rows"]
    ]  # fmt: skip
    apart = [[result["nodes"], f"{100 * (result['apart'] - 1):.1f} %"] for result in results]
    return (
        f"CPU time of an attempt with inertia, rtol 1e-2, {STEPS} attempts\n\n"
        + markdown(header, lines)
        + "\n\nWhat contact adds where nothing touches\n\n"
        + markdown(["n", "of a step"], apart)
    )


def plot(results: list[dict]) -> Figure:
    """Fig. 6d: components against R."""
    figure = Figure(figsize=(5 * len(results), 3.6), layout="constrained")
    for axes, result in zip(np.atleast_1d(figure.subplots(1, len(results))), results, strict=True):
        radius = [row["R_cm"] for row in result["rows"]]
        axes.stackplot(radius, [[1e3 * row[part] for row in result["rows"]] for part in PARTS], labels=PARTS)
        axes.invert_xaxis()
        axes.set(xlabel="R (cm)", ylabel="CPU time of an attempt (ms)", title=f"n = {result['nodes']}")
    axes.legend(loc="upper left", fontsize="small")
    return figure


def main() -> None:
    """Measure, and write table and plot."""
    opts = options(__doc__, (1000, 3000)).parse_args()
    results = [measure(nodes, opts.states) for nodes in opts.nodes]
    ratios = {}
    for result in results:
        last, n = result["rows"][-1], result["nodes"]
        ratios[f"contact's share, n = {n}"] = last["contact"] / last["all"]
        ratios[f"search ms, n = {n}"] = 1e3 * max(row["search"] for row in result["rows"])
        ratios[f"contact where nothing touches, n = {n}"] = result["apart"] - 1.0
    save(opts, "contact", table(results), plot(results), ratios, results)


if __name__ == "__main__":
    main()
