"""What the benchmarks share: options, recorded states, paired timing, and where results go."""

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.figure import Figure
from scipy.interpolate import CloughTocher2DInterpolator

jax.config.update("jax_enable_x64", True)

from jaxcrumple import Integrator, Solution, initial_state, integrator, radial, simulate  # noqa: E402
from jaxcrumple.history import ImplicitStep  # noqa: E402
from jaxcrumple.scene import Scene  # noqa: E402
from jaxcrumple.state import State  # noqa: E402
from jaxcrumple.system import energies, linearize, residual  # noqa: E402

RESULTS = Path(__file__).parent / "results"
# Moments of `radial`: before the first buckling, once buckled, and crumpled (R = 7.05, 6.3 and 4.5 cm).
STATES = {"near flat": 0.05, "buckled": 0.8, "crumpled": 2.6}
# Each scheme at the tolerance at which it is used: errors are of the same size.
RTOLS = {
    "hybrid": 1e-2,
    "dynamic": 1e-2,
    "alternating": 1e-4,
    "quasistatic": 1e-4,
    "explicit": 1e-4,
    "paper": 1e-4,
}


def options(description: str, nodes: Sequence[int], *, resumable: bool = False) -> argparse.ArgumentParser:
    """The options every benchmark has; a `resumable` one keeps its results in a `Log`."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nodes", type=int, nargs="+", default=list(nodes))
    parser.add_argument("--json", type=Path, help="write the figures by name to this file")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of table and plot")
    parser.add_argument(
        "--states", type=Path, default=Path("runs/states"), help="folder in which recorded states are kept"
    )
    if resumable:
        parser.add_argument("--resume", action="store_true", help="go on where it was stopped")
    return parser


def confine(cores: int) -> None:
    """Start this process again confined to so many cores, where it has more: JAX counts them on import."""
    allowed = sorted(os.sched_getaffinity(0))
    if len(allowed) > cores:
        os.sched_setaffinity(0, allowed[:cores])
        os.execv(sys.executable, [sys.executable, *sys.argv])


class Log:
    """Results of a benchmark, kept line by line as they come, so that a stopped one can go on.

    Without `resume` those of an earlier one go as soon as there is a new one.
    """

    def __init__(self, name: str, resume: bool):
        self.path = Path("runs/bench") / f"{name}.jsonl"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        lines = self.path.read_text().splitlines() if resume and self.path.exists() else []
        self.known = {json.dumps(line["case"]): line["result"] for line in map(json.loads, lines)}

    def result(self, case: dict, make: Callable[[], dict]) -> dict:
        """The `case` with its result: the one kept, or what `make` returns now."""
        key = json.dumps(case)
        if key not in self.known:
            result = make()
            with self.path.open("a" if self.known else "w") as file:
                print(json.dumps({"case": case, "result": result}), file=file, flush=True)
            self.known[key] = result
        return case | self.known[key]


def stamp() -> str:
    """Date, versions and machine."""
    names = ("jaxcrumple", "jax", "jaxlib")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    return f"{datetime.date.today()}, {versions}, {cpu_name()}, {os.cpu_count()} cores"


def cpu_name() -> str:
    """The processor in words."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def save(opts, name: str, text: str, figure: Figure | None, ratios: dict[str, float], results: Any) -> None:
    """Write NAME.md, NAME.png and, if asked, the JSON file; print the table."""
    opts.out.mkdir(parents=True, exist_ok=True)
    text = f"{text}\n\n{stamp()}\n"
    (opts.out / f"{name}.md").write_text(text)
    if figure is not None:
        figure.savefig(opts.out / f"{name}.png", dpi=130)
    if opts.json:
        opts.json.write_text(json.dumps({"ratios": ratios, "results": results, "stamp": stamp()}, indent=1))
    print(text)
    for key, value in ratios.items():
        print(f"{key}: {value:.3g}")


def markdown(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


# Larger meshes are not run to each state: they take over the shape of this one, and settle for as many
# seconds into an equilibrium of their own.
LARGEST_RUN = 12000
SETTLE = 5e-3


class Recorded(NamedTuple):
    """A scene and a state of it that a run went through."""

    scene: Scene
    state: State


def recorded(
    nodes: int, t: float, folder: Path, contact: str | None = None, times: Sequence[float] = ()
) -> Recorded:
    """State of `radial` at time `t` s, run with implicit steps at the default tolerance, or read if it was.

    `dynamic`, because `hybrid` may be amid explicit steps then, and have no implicit step to take. The run
    also records its states at other `times`, by default those of `STATES`.
    """
    setup = radial(nodes, contact=contact)
    kind = "radial" if contact is None else "radial_contact"
    state = initial_state(setup.scene, setup.x)
    folder.mkdir(parents=True, exist_ok=True)
    earlier = sorted(u for u in times or STATES.values() if u <= t)
    for stop in earlier if t in earlier else [*earlier, t]:
        path = folder / f"{kind}_{nodes}_{stop:g}.eqx"
        if path.exists():
            state = eqx.tree_deserialise_leaves(path, state)
            continue
        if nodes > LARGEST_RUN and contact is None:
            state = refined(nodes, stop, folder)
            end = stop + SETTLE
        else:
            end = stop
        state = simulate(setup.scene, state, end, solver=integrator(scheme="dynamic"), throw=True).state
        eqx.tree_serialise_leaves(path, state)
    return Recorded(setup.scene, state)


def refined(nodes: int, t: float, folder: Path) -> State:
    """The shape of the largest run at time `t` on a finer mesh, at rest, by a smooth (C1) interpolant.

    Each hinge carries the rest curvature that leaves it just at yield.
    """
    _, state = recorded(LARGEST_RUN, t, folder)
    start, setup = (radial(n, contact=None) for n in (LARGEST_RUN, nodes))
    inner = 1.0 - 1e-9
    shape = CloughTocher2DInterpolator(start.mesh.vertices[:, :2], np.asarray(state.x))
    x = jnp.asarray(shape(inner * setup.mesh.vertices[:, :2]))
    scene = setup.scene
    c = scene.bending.hinges(x).curvature
    p = jnp.sign(c) * jnp.maximum(jnp.abs(c) - scene.plasticity.yield_threshold, 0.0)
    fine = initial_state(scene, x)
    rest = jnp.broadcast_to(p, fine.history.p.shape)
    return eqx.tree_at(lambda s: (s.t, s.p, s.history.p), fine, (state.t, p, rest))


def next_equations(scene: Scene, state: State) -> tuple[ImplicitStep, Array]:
    """The implicit step that the recorded run takes next, and its predicted positions (n, 3)."""
    return eqx.filter_jit(integrator().implicit.equations)(scene, state, state.h)


class Timed(NamedTuple):
    """A run, what it took in CPU and wall seconds, and the wall seconds that compiling took besides."""

    solution: Solution
    cpu_s: float
    wall_s: float
    compile_s: float


def timed_run(scene: Scene, state: State, times, solver: Integrator, **options) -> Timed:
    """`simulate` with `options`, compiling apart, also that for longer lists."""
    compiled = simulate(scene, state, times, solver=solver, max_attempts=0)
    wall, cpu = time.perf_counter(), time.process_time()
    solution = simulate(scene, state, times, solver=solver, **options)
    # Compiling takes one thread most of the time, so that its wall seconds are its CPU seconds.
    again = solution.compile_s
    spent, took = time.process_time() - cpu - again, time.perf_counter() - wall - again
    return Timed(solution, spent, took, compiled.compile_s + again)


# A call of so many seconds is timed once.
SLOW = 3.0


class Timing(NamedTuple):
    """Smallest wall `seconds` of a function, and what it returned last."""

    seconds: float
    output: Any


def paired(functions: dict[str, Callable[[], Any]], repeats: int) -> dict[str, Timing]:
    """Timing of each function, called in turn (A B A B ...) after one call to warm up."""
    timings = {name: Timing(np.inf, jax.block_until_ready(call())) for name, call in functions.items()}
    for repeat in range(repeats):
        for name, function in functions.items():
            if repeat and timings[name].seconds > SLOW:
                continue
            start = time.perf_counter()
            output = jax.block_until_ready(function())
            seconds = time.perf_counter() - start
            timings[name] = Timing(min(timings[name].seconds, seconds), output)
    return timings


def parts_of_a_step(scene: Scene, state: State) -> dict[str, float]:
    """Seconds that the parts of an implicit step of a phantom sheet take, each alone."""
    step, x = next_equations(scene, state)
    linear = integrator().implicit.linear
    value, values = eqx.filter_jit(linearize)(scene, step, x)
    fresh = iter(range(1, 10**6))

    @eqx.filter_jit
    def factor(values, last):
        return linear.factor(scene.sparsity, values, last)

    @eqx.filter_jit
    def solve(last, rhs):
        return linear.solve(scene.sparsity, last, None, rhs, 1e-3).x

    # As in a run: each factor from the last one, which the library makes over.
    made = [eqx.filter_jit(linear.start)(scene.sparsity)]

    def factored():
        made[0] = factor(values * (1.0 + 1e-12 * next(fresh)), made[0])
        return made[0].negative

    tangent, plain, parts = (eqx.filter_jit(f) for f in (linearize, residual, energies))
    calls = {
        "tangent": lambda: tangent(scene, step, x),
        "factor": factored,
        "solve": lambda: solve(made[0], -value.reshape(-1)),
        "residual": lambda: plain(scene, step, x),
        "energies": lambda: parts(scene, state.x, state.v, state.p, state.t),
    }
    return {name: timing.seconds for name, timing in paired(calls, 10).items()}
