"""What self-contact costs: CPU time of a step by component as a sheet is crumpled (Fig. 6d), the search for
candidates, and a sheet that nowhere touches itself.

For each n, from states of the self-avoiding `radial`: CPU seconds per attempt of a window, measured, and of
these what the sheet's own forces, tangents and linear systems take there: their times without contact, each
measured alone, times how often they were made. All the rest is put down to contact, so that its share is an
upper bound. Where nothing touches, windows with contact and without it are run in turn.

    python scripts/bench_contact.py [--nodes N ...] [--json FILE]
"""

from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from benchlib import markdown, options, paired, save, timed_run
from matplotlib.figure import Figure

from jaxcrumple import initial_state, integrator, radial, simulate
from jaxcrumple.model.intersections import intersections
from jaxcrumple.model.scene import Scene
from jaxcrumple.renewal import Renewal, with_contacts
from jaxcrumple.solvers.implicit import judge
from jaxcrumple.solvers.newton import NewtonSolution
from jaxcrumple.system import State, energies, linearize, residual
from jaxcrumple.threads import limited_blas

# Times of the states in s: R = 7.1 cm - 1 cm/s t.
TIMES = (0.05, 0.8, 1.6, 2.4, 3.1, 3.7)
# Attempts of a window.
STEPS = 64
PARTS = ("forces", "tangents", "linear systems", "checks and energies", "contact")


def recorded(nodes: int, t: float, folder: Path) -> tuple[Scene, State]:
    """The self-avoiding scene and its state at `t` s, run or read."""
    setup = radial(nodes)
    state = initial_state(setup.scene, setup.x)
    folder.mkdir(parents=True, exist_ok=True)
    for stop in (time for time in TIMES if time <= t):
        path = folder / f"radial_contact_{nodes}_{stop:g}.eqx"
        if path.exists():
            state = eqx.tree_deserialise_leaves(path, state)
            continue
        # Implicit throughout, so that a window measures implicit steps.
        state = simulate(setup.scene, state, stop, solver=integrator(scheme="dynamic"), throw=True).state
        eqx.tree_serialise_leaves(path, state)
    return setup.scene, state


def phantom(scene: Scene) -> Scene:
    """The scene without contact."""
    none = (None, None)
    return eqx.tree_at(lambda s: (s.contact, s.pattern.contact), scene, none)


def without_listing(state: State) -> State:
    """The state as one of a scene without contact."""
    return eqx.tree_at(lambda s: s.listing, state, None)


def own_parts(scene: Scene, state: State) -> dict[str, float]:
    """Seconds of the parts of a step of the sheet without contact, each alone."""
    scene = phantom(scene)
    implicit = integrator(scheme="dynamic").implicit
    linear = implicit.linear
    step, x = eqx.filter_jit(implicit.equations)(scene, state, state.h)
    value, values = eqx.filter_jit(linearize)(scene, step, x)
    start = eqx.filter_jit(linear.start)(scene.pattern)
    fresh = iter(range(1, 10**6))
    factor = eqx.filter_jit(lambda values: linear.factor(scene.pattern, values, start))
    made = factor(values)
    solve = eqx.filter_jit(lambda rhs: linear.solve(scene.pattern, made, made.values, rhs, 1e-3).x)
    tangent = eqx.filter_jit(lambda x: linearize(scene, step, x)[1])
    plain = eqx.filter_jit(lambda x: residual(scene, step, x))

    @eqx.filter_jit
    def check(x):
        end = NewtonSolution(x, made, None, *[jax.numpy.asarray(0)] * 3, *[jax.numpy.asarray(True)] * 2)
        return judge(scene, state, end, x, state.t, state.h), energies(scene, x, state.v, state.p, state.t)

    calls = {
        "residual": lambda: plain(x),
        "tangent": lambda: tangent(x),
        "factor": lambda: factor(values * (1.0 + 1e-12 * next(fresh))),
        "solve": lambda: solve(-value.reshape(-1)),
        "check": lambda: check(x),
    }
    return {name: timing.seconds for name, timing in paired(calls, 10).items()}


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
    per, own = window(scene, state), own_parts(scene, state)
    found = {
        "forces": own["residual"] * (per["newton"] + 1.0),
        "tangents": own["tangent"] * per["factors"],
        "linear systems": own["factor"] * per["factors"] + own["solve"] * per["newton"],
        "checks and energies": own["check"],
    }
    return found | {"contact": per["cpu"] - sum(found.values()), "all": per["cpu"]}


def search_cost(scene: Scene, state: State) -> float:
    """Seconds of a search on the host, and the structure of the matrix that goes with it."""
    renewal = Renewal(scene, merged=True)
    return paired({"search": lambda: renewal.searched(scene, state.listing)}, 5)["search"].seconds


def apart_cost(scene: Scene, state: State) -> float:
    """CPU time of a window of a sheet that nowhere touches itself, over that of the phantom's."""
    return window(scene, state)["cpu"] / window(phantom(scene), without_listing(state))["cpu"]


def measure(nodes: int, folder: Path) -> dict:
    """Everything at one size."""
    rows = []
    with limited_blas():
        for t in TIMES:
            scene, state = recorded(nodes, t, folder)
            near = with_contacts(scene, state.x).contact
            gap, contacts = near.gaps(state.x)
            row = {"t": t, "R_cm": 7.1 - t, "contacts": int(contacts), "gap_um": 1e6 * float(gap)}
            row |= components(scene, state)
            row["search"] = search_cost(scene, state)
            if len(intersections(state.x, scene.contact.faces, scene.membrane.nodes)):
                raise RuntimeError(f"the sheet of {nodes} nodes intersects itself at {t} s")
            rows.append(row)
            print(nodes, row, flush=True)
        scene, state = recorded(nodes, TIMES[0], folder)
        apart = apart_cost(scene, state)
    jax.clear_caches()
    return {"nodes": nodes, "rows": rows, "apart": apart}


def table(results: list[dict]) -> str:
    """Components and shares."""
    header = ["n", "R cm", "contacts", *(f"{part} ms" for part in PARTS), "all ms", "contact %", "search ms"]
    lines = [
        [
            result["nodes"], f"{row['R_cm']:.2f}", row["contacts"],
            *(f"{1e3 * row[part]:.1f}" for part in (*PARTS, "all")),
            f"{100 * row['contact'] / row['all']:.0f}", f"{1e3 * row['search']:.0f}",
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
