"""Kernels against the memory bandwidth of the machine: forces, residual, tangent, products with it.

Each kernel runs `ITERATIONS` times inside one compiled loop on the crumpled state of `radial`, as a solver
runs it; its input hangs on its last output. A kernel must at least read each of its arguments once and
write its results once (memory that the compiler reports); what it keeps between is not counted. Two triads
a = b + s c set the limit: one far larger than the caches, and one that moves as many bytes as the kernel,
which may thus live in them. Shares of the first can therefore exceed 1 on small meshes.

    python scripts/bench_kernels.py [--nodes N ...] [--json FILE]
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchlib import STATES, markdown, next_equations, options, paired, recorded, save
from jax import Array
from matplotlib.figure import Figure

from jaxcrumple.system import linearize, rates, residual

ITERATIONS = 10
REPEATS = 15
# Bytes of the large triad's three arrays together: several times any last-level cache.
LARGE = 3 * 2**28
# So little of the last output goes into the next input that no number changes.
TINY = 1e-200


class Kernel(NamedTuple):
    """A function of `data` and of the array `x` that its loop changes."""

    function: Callable[[Any, Array], Any]
    data: Any
    x: Array


def kernels(nodes: int, folder) -> dict[str, Kernel]:
    """What is timed, on the crumpled state."""
    scene, state = recorded(nodes, STATES["crumpled"], folder)
    step, x = next_equations(scene, state)
    value, values = eqx.filter_jit(linearize)(scene, step, x)
    rows = eqx.filter_jit(scene.sparsity.expand)(values)
    direction = value / jnp.max(jnp.abs(value))

    def matrix_free(data, y):
        scene, step, x = data
        return jax.jvp(lambda x: residual(scene, step, x)[0], (x,), (y,))[1]

    return {
        "force": Kernel(lambda d, x: rates(d[0], x, *d[1:])[1:], (scene, state.v, state.p, state.t), x),
        "residual": Kernel(lambda d, x: residual(*d, x), (scene, step), x),
        "hinge_hessians": Kernel(lambda d, x: d[0].blocks(x, d[1], None), (scene.bending, state.p), x),
        "tangent": Kernel(lambda d, x: linearize(*d, x), (scene, step), x),
        "expansion": Kernel(lambda d, values: d.expand(values), scene.sparsity, values),
        "product": Kernel(
            lambda d, y: d[0].expanded_product(d[1], y), (scene.sparsity, rows), -direction.ravel()
        ),
        "matrix_free": Kernel(matrix_free, (scene, step, x), direction),
    }


def least_bytes(kernel: Kernel) -> int:
    """Size of the arguments that the compiled kernel uses and of its results."""
    memory = jax.jit(kernel.function).lower(kernel.data, kernel.x).compile().memory_analysis()
    return memory.argument_size_in_bytes + memory.output_size_in_bytes


def looped(kernel: Kernel) -> Callable[[], Any]:
    """The kernel `ITERATIONS` times in one program, which writes into the results of its last run."""

    @partial(jax.jit, donate_argnums=0)
    def run(last, data, x):
        def body(_, carry):
            results = kernel.function(data, carry[0])
            return carry[0] + TINY * sum(jnp.ravel(a)[0] for a in jax.tree.leaves(results)), results

        # Carrying whole results keeps the compiler from computing only what the next input takes.
        return jax.lax.fori_loop(0, ITERATIONS, body, (x, last))[1]

    shapes = jax.eval_shape(kernel.function, kernel.data, kernel.x)
    last = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def call():
        nonlocal last
        last = run(last, kernel.data, kernel.x)
        return last

    return call


def triad(size: int) -> Kernel:
    """a = b + s c with arrays of `size` bytes together."""
    b = jnp.arange(max(size // 24, 1), dtype=float)

    def function(data, s):
        return data[0] + s * data[1]

    return Kernel(function, (b, b + 1.0), jnp.asarray(0.5))


def measure(nodes: int, folder) -> dict[str, dict[str, float]]:
    """Seconds per call, least bytes, and shares of both limits, of every kernel."""
    found = kernels(nodes, folder)
    sizes = {name: least_bytes(kernel) for name, kernel in found.items()}
    limits = {f"triad {name}": triad(size) for name, size in sizes.items()} | {"triad": triad(LARGE)}
    total = paired({name: looped(kernel) for name, kernel in (found | limits).items()}, REPEATS)
    seconds = {name: timing.seconds / ITERATIONS for name, timing in total.items()}
    stream = LARGE / seconds["triad"]
    rows = {
        name: {
            "seconds": seconds[name],
            "bytes": size,
            "of_bandwidth": size / stream / seconds[name],
            "of_cached": seconds[f"triad {name}"] / seconds[name],
        }
        for name, size in sizes.items()
    }
    print({name: f"{1e3 * row['seconds']:.3f} ms" for name, row in rows.items()}, flush=True)
    return {"nodes": nodes, "stream": stream, "kernels": rows}


def ratios(results: list[dict]) -> dict[str, float]:
    """Times in products with the assembled tangent, and shares of the memory bandwidth."""
    figures = {}
    for result in results:
        n, rows = result["nodes"], result["kernels"]
        product = rows["product"]["seconds"]
        figures[f"tangent_vs_product_{n}"] = rows["tangent"]["seconds"] / product
        figures[f"assembled_vs_matrix_free_{n}"] = product / rows["matrix_free"]["seconds"]
        figures[f"tangent_vs_residual_{n}"] = rows["tangent"]["seconds"] / rows["residual"]["seconds"]
        for name, row in rows.items():
            figures[f"{name}_of_bandwidth_{n}"] = row["of_bandwidth"]
            figures[f"{name}_of_cached_{n}"] = row["of_cached"]
    return figures


def table(results: list[dict]) -> str:
    """Times, bytes and shares."""
    lines = []
    for result in results:
        product = result["kernels"]["product"]["seconds"]
        for name, row in result["kernels"].items():
            seconds, size = row["seconds"], row["bytes"]
            shares = [f"{100 * row[key]:.0f} %" for key in ("of_bandwidth", "of_cached")]
            lines.append(
                [result["nodes"], name.replace("_", " "), f"{1e3 * seconds:.3f}", f"{seconds / product:.1f}",
                 f"{size / 1e6:.2f}", f"{size / seconds / 1e9:.1f}", *shares]
            )  # fmt: skip
    streams = ", ".join(f"{result['stream'] / 1e9:.1f}" for result in results)
    header = ["n", "kernel", "ms", "in products", "least MB", "GB/s", "of memory", "of a triad as large"]
    return f"{markdown(header, lines)}\n\nTriad of {LARGE / 2**20:.0f} MB: {streams} GB/s."


def draw(results: list[dict]) -> Figure:
    """Time of each kernel, and the time in which memory could move its bytes."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.add_subplot(yscale="log", ylabel="ms")
    names = list(results[0]["kernels"])
    width = 0.8 / len(results)
    for k, result in enumerate(results):
        place = np.arange(len(names)) + (k - 0.5 * (len(results) - 1)) * width
        rows = [result["kernels"][name] for name in names]
        axes.bar(place, [1e3 * row["seconds"] for row in rows], 0.9 * width, label=f"n = {result['nodes']}")
        axes.plot(place, [1e3 * row["bytes"] / result["stream"] for row in rows], "k_", markersize=12)
    axes.plot([], [], "k_", markersize=12, label="least bytes at memory bandwidth")
    axes.set_xticks(np.arange(len(names)), [name.replace("_", "\n") for name in names])
    axes.legend(frameon=False)
    return figure


def main() -> None:
    """Run the benchmark."""
    opts = options(__doc__, (1000, 3000, 12000)).parse_args()
    results = [measure(nodes, opts.states) for nodes in opts.nodes]
    save(opts, "kernels", table(results), draw(results), ratios(results), results)


if __name__ == "__main__":
    main()
