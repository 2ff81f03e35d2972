"""How the cost of a step grows with the mesh, what it is made of, and what threads, options and starts cost.

For each n, from recorded states of `radial`: wall and CPU seconds per accepted implicit step, with inertia
and without, with one and with two threads (the process is confined to that many cores), its components, peak
memory, the extra cost of plasticity and of the wall, and the time from a cold start to the first accepted
step, with an empty and with a warm compilation cache.

    python scripts/bench_scaling.py [--nodes N ...] [--json FILE]
"""

import itertools
import json
import subprocess
import sys
import tempfile
import time

import equinox as eqx
import jax
import numpy as np
from benchlib import (
    RTOLS,
    STATES,
    confine,
    markdown,
    next_equations,
    options,
    paired,
    parts_of_a_step,
    recorded,
    save,
    timed_run,
)
from matplotlib.figure import Figure

from jaxcrumple import integrator
from jaxcrumple._jax.threads import limited_blas
from jaxcrumple.scene import Scene
from jaxcrumple.state import State
from jaxcrumple.system import linearize, residual

STEPS = 50
# Those whose steps are implicit, with inertia and without.
SCHEMES = ("dynamic", "quasistatic")
# The steps whose growth with n is fitted and drawn.
PLOTTED = "crumpled, dynamic"


def steps_from(nodes: int, folder) -> dict[str, dict[str, float]]:
    """Seconds per accepted step over 50 attempts from the buckled and the crumpled state, by scheme."""
    found = {}
    for name, scheme in itertools.product(("buckled", "crumpled"), SCHEMES):
        scene, state = recorded(nodes, STATES[name], folder)
        solver = integrator(RTOLS[scheme], scheme=scheme)
        timed = timed_run(scene, state, float(state.t) + 1.0, solver, max_attempts=STEPS)
        end = timed.solution.state
        steps = int(np.sum(end.counters.steps - state.counters.steps))
        newton = int(end.counters.newton - state.counters.newton)
        cost = {"wall_s": timed.wall_s / steps, "cpu_s": timed.cpu_s / steps, "newton": newton / steps}
        found[f"{name}, {scheme}"] = cost
    return found


def option_costs(nodes: int, folder) -> dict[str, float]:
    """Extra cost of plasticity and of the wall, as shares of two Newton iterations without them.

    All variants do the same iterations from the same state; its step is so short that the tangent stays
    definite without the wall.
    """
    scene, state = recorded(nodes, STATES["crumpled"], folder)
    state = eqx.tree_at(lambda s: s.h, state, 1e-3 * state.h)
    rest = eqx.tree_at(lambda s: s.bending.rest_curvature, scene, state.p)
    variants = {
        "all": (scene, state),
        "wall": (eqx.tree_at(lambda s: s.walls, scene, ()), state),
        "plasticity": (
            eqx.tree_at(lambda s: s.plasticity, rest, None),
            eqx.tree_at(lambda s: (s.p, s.history.p), state, (None, None)),
        ),
    }
    linear = integrator().implicit.linear

    @eqx.filter_jit
    def iterations(scene: Scene, state: State):
        step, x = next_equations(scene, state)
        value, values = linearize(scene, step, x)
        factor = linear.factor(scene.sparsity, values, linear.start(scene.sparsity))
        x = x + linear.solve(scene.sparsity, factor, values, -value.reshape(-1), 1e-3).x.reshape(x.shape)
        value, p = residual(scene, step, x)
        last = linear.solve(scene.sparsity, factor, values, -value.reshape(-1), 1e-3)
        return x, p, last.x, factor.negative

    fresh = iter(range(1, 10**6))

    def changed(scene: Scene, state: State):
        # A new step size each time: a factor is kept for as long as the values are the same.
        return scene, eqx.tree_at(lambda s: s.h, state, state.h * (1.0 + 1e-9 * next(fresh)))

    for name, built in variants.items():
        if int(iterations(*built)[3]) > 0:
            raise RuntimeError(f"the tangent without {name} is indefinite; its solves would cost nothing")
    timings = paired({name: lambda b=b: iterations(*changed(*b)) for name, b in variants.items()}, 20)
    seconds = {name: timing.seconds for name, timing in timings.items()}
    return {name: seconds["all"] / seconds[name] - 1.0 for name in ("plasticity", "wall")}


def start_up(nodes: int, cache: str) -> float:
    """Seconds of a new process from its start to the first accepted step."""
    program = (
        "import jax; jax.config.update('jax_enable_x64', True);"
        f"jax.config.update('jax_compilation_cache_dir', {cache!r});"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0);"
        "import jaxcrumple as jc; s = jc.radial(%d, contact=None);"
        "jc.simulate(s.scene, jc.initial_state(s.scene, s.x), 1e-6, throw=True)"
    )
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", program % nodes], check=True)
    return time.perf_counter() - begin


def confined(nodes: int, folder, cores: int) -> dict:
    """`steps_from` and peak memory in a process confined to so many cores."""
    command = [sys.executable, __file__, "--child", str(cores)]
    command += ["--nodes", str(nodes), "--states", str(folder)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def child(nodes: int, folder) -> None:
    """What the confined process does."""
    import resource

    found = steps_from(nodes, folder)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(json.dumps({"steps": found, "peak_mb": peak}))


def measure(nodes: int, folder) -> dict:
    """Everything at one size."""
    for t in STATES.values():
        recorded(nodes, t, folder)
    result = {"nodes": nodes, "threads": {cores: confined(nodes, folder, cores) for cores in (1, 2)}}
    with limited_blas():
        result["components"] = parts_of_a_step(*recorded(nodes, STATES["crumpled"], folder))
        result["options"] = option_costs(nodes, folder)
    with tempfile.TemporaryDirectory() as cache:
        result["cold_s"], result["warm_s"] = start_up(nodes, cache), start_up(nodes, cache)
    print(result, flush=True)
    jax.clear_caches()
    return result


def table(results: list[dict]) -> str:
    """Steps, components and starts."""
    steps, parts = [], []
    for result in results:
        for cores, run in result["threads"].items():
            cells = [
                f"{one['wall_s']:.3f} / {one['cpu_s']:.3f} ({one['newton']:.1f})"
                for one in run["steps"].values()
            ]
            steps.append([result["nodes"], cores, *cells, f"{run['peak_mb']:.0f}"])
        times = [f"{1e3 * seconds:.1f}" for seconds in result["components"].values()]
        shares = [f"{100 * share:.1f} %" for share in result["options"].values()]
        parts.append([result["nodes"], *times, *shares, f"{result['cold_s']:.1f}", f"{result['warm_s']:.1f}"])
    first = ["n", "cores", *results[0]["threads"][1]["steps"], "peak MB"]
    second = ["n", *(f"{name} ms" for name in results[0]["components"])]
    second += ["plasticity costs", "wall costs", "cold start s", "warm start s"]
    return (
        f"Wall / CPU s (Newton iterations) per accepted step, {STEPS} attempts from each state:"
        f"\n\n{markdown(first, steps)}\n\n"
        f"Parts of a step, costs of options, first accepted step:\n\n{markdown(second, parts)}"
    )


def ratios(results: list[dict]) -> dict[str, float]:
    """Thread efficiency, step seconds, options and starts by size; growth with n."""
    figures = {}
    for result in results:
        n, one, two = result["nodes"], *(result["threads"][cores]["steps"] for cores in (1, 2))
        figures[f"thread_efficiency_{n}"] = one[PLOTTED]["wall_s"] / (2.0 * two[PLOTTED]["wall_s"])
        for scheme in SCHEMES:
            figures[f"{scheme}_step_s_{n}"] = max(two[name]["wall_s"] for name in two if scheme in name)
        figures[f"plasticity_cost_{n}"] = result["options"]["plasticity"]
        figures[f"wall_cost_{n}"] = result["options"]["wall"]
        figures[f"cold_start_s_{n}"], figures[f"warm_start_s_{n}"] = result["cold_s"], result["warm_s"]
        figures[f"peak_mb_{n}"] = result["threads"][2]["peak_mb"]
    if len(results) > 1:
        points = np.log([(r["nodes"], r["threads"][2]["steps"][PLOTTED]["wall_s"]) for r in results])
        figures["step_growth_exponent"] = float(np.polyfit(*points.T, 1)[0])
    return figures


def draw(results: list[dict]) -> Figure:
    """Components and whole steps against n."""
    figure = Figure(figsize=(5.5, 4), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="nodes", ylabel="seconds")
    nodes = [result["nodes"] for result in results]
    for name in results[0]["components"]:
        axes.plot(nodes, [result["components"][name] for result in results], "o-", label=name)
    for cores in (1, 2):
        walls = [result["threads"][cores]["steps"][PLOTTED]["wall_s"] for result in results]
        axes.plot(nodes, walls, "s--", label=f"step, cores: {cores}")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return figure


def main() -> None:
    """Run the benchmark."""
    parser = options(__doc__, (1000, 3000))
    parser.add_argument("--child", type=int, metavar="CORES", help="measure steps only, on so many cores")
    opts = parser.parse_args()
    if opts.child:
        confine(opts.child)
        child(opts.nodes[0], opts.states)
        return
    results = [measure(nodes, opts.states) for nodes in opts.nodes]
    save(opts, "scaling", table(results), draw(results), ratios(results), results)


if __name__ == "__main__":
    main()
