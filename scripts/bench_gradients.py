"""What the gradient of a run costs: time over that of the run, and memory against the number of steps.

`radial`, self-avoiding, from crumpled (t = 2.6 s): what 300 attempts come to, some 200 steps. All are timed
in turn in one process, warm: the run, its replay, a gradient in reverse mode and one direction in forward
mode, with steps solved again and as recorded. Memory is what XLA plans for the gradient's temporary arrays.

    python scripts/bench_gradients.py [--nodes N ...]
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchlib import Timing, markdown, options, paired, save
from matplotlib.figure import Figure

import jaxcrumple as jc
from jaxcrumple.replays.record import STRETCH, Record

RTOL, BEGIN, ATTEMPTS, REPEATS = 1e-2, 2.6, 300, 3
# Stretches of steps for which memory is planned, and ways to differentiate.
STRETCHES = (4, 16, 64)
WAYS: dict[str, dict[str, bool]] = {
    "solved again": {},
    "as recorded": {"solve": False},
    "as recorded, checkpoint": {"solve": False, "checkpoint": True},
}


def loss(scene, record: Record, **way) -> jax.Array:
    """Mean square of the heights at the end."""
    return jnp.mean(jc.replay(scene, record, **way).x[-1, :, 2] ** 2)


def recorded_run(nodes: int):
    """Scene, start, end and record of a run of about ATTEMPTS attempts."""
    setup, solver = jc.radial(nodes), jc.integrator(RTOL)
    start = jc.simulate(setup.scene, jc.initial_state(setup.scene, setup.x), BEGIN, solver=solver).state
    first = jc.simulate(setup.scene, start, BEGIN + 1.0, solver=solver, max_attempts=ATTEMPTS).state
    solution = jc.simulate(setup.scene, start, float(first.t), solver=solver, record=True)
    return setup.scene, start, solution


def timings(nodes: int) -> tuple[dict[str, Timing], object, jc.Solution]:
    """Seconds of the run and of what is made of its record."""
    scene, start, solution = recorded_run(nodes)
    record, end = solution.record, float(solution.t[-1])

    def stiffened(factor, record):
        here = eqx.tree_at(lambda s: s.bending.stiffness, scene, scene.bending.stiffness * factor)
        return loss(here, record, solve=False)

    def prepared(function):
        compiled = eqx.filter_jit(function)
        return lambda: jax.block_until_ready(compiled(record))

    functions = {"run": lambda: jc.simulate(scene, start, end)}
    functions["run, recorded"] = lambda: jc.simulate(scene, start, end, record=True)
    functions["replay"] = prepared(lambda record: loss(scene, record))
    for name, way in WAYS.items():
        functions[f"gradient, {name}"] = prepared(
            lambda record, way=way: eqx.filter_grad(lambda scene: loss(scene, record, **way))(scene)
        )
    functions["one direction, as recorded"] = prepared(
        lambda record: jax.jvp(lambda factor: stiffened(factor, record), (1.0,), (1.0,))[1]
    )
    return paired(functions, REPEATS), scene, solution


def planned_memory(scene, record: Record, stretches: int, way: dict[str, bool]) -> float:
    """MB of temporary arrays that the gradient of so many stretches takes."""

    def longer(leaf):
        return jax.ShapeDtypeStruct((stretches, *leaf.shape[1:]), leaf.dtype)

    def gradient(parts):
        here = eqx.tree_at(lambda r: (r.steps, r.lists), record, parts)
        return eqx.filter_grad(lambda scene: loss(scene, here, **way))(scene)

    plan = jax.jit(gradient).lower(jax.tree.map(longer, (record.steps, record.lists))).compile()
    return plan.memory_analysis().temp_size_in_bytes / 1e6


def figure_of(memory: dict[str, list[float]], state_mb: float, nodes: int) -> Figure:
    """Memory against steps."""
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes, steps = figure.subplots(), STRETCH * np.array(STRETCHES)
    for name, values in memory.items():
        axes.loglog(steps, values, "o-", label=name)
    axes.loglog(steps, steps * state_mb, "k:", label="a state (x, v, p) for each step")
    axes.set(xlabel="steps", ylabel="temporary arrays [MB]", title=f"n = {nodes}")
    axes.legend()
    return figure


def main() -> None:
    """Measure, and write table and figure."""
    opts = options(__doc__, (1000,)).parse_args()
    for nodes in opts.nodes:
        times, scene, solution = timings(nodes)
        record = solution.record
        assert record is not None
        steps = int(np.sum(record.steps.valid))
        whole = times["run"].seconds
        print({name: round(t.seconds, 2) for name, t in times.items()}, steps, flush=True)
        rows = [[name, f"{t.seconds:.2f}", f"{t.seconds / whole:.2f}"] for name, t in times.items()]
        memory = {
            name: [planned_memory(scene, record, g, way) for g in STRETCHES] for name, way in WAYS.items()
        }
        plans = [[name, *(f"{mb:.0f}" for mb in values)] for name, values in memory.items()]
        state_mb = (6 * nodes + np.shape(solution.p)[1]) * 8e-6
        text = markdown(["", "s", "times the run"], rows)
        text += (
            f"\n\nn = {nodes}, {steps} steps, rtol = {RTOL:g}. Temporary arrays in MB for so many steps:\n\n"
        )
        text += markdown(["steps", *(str(STRETCH * g) for g in STRETCHES)], plans)
        text += f"\n\nA state takes {state_mb:.3f} MB; a record has {3 * nodes * 8e-6:.3f} MB a step more."
        ratios = {name: t.seconds / whole for name, t in times.items()}
        save(opts, f"gradients_{nodes}", text, figure_of(memory, state_mb, nodes), ratios, memory)


if __name__ == "__main__":
    main()
