"""Peak memory of a process that runs many meshes, one after another, against one that runs few.

Each mesh has another number of nodes, so that each run compiles programs of its own. Each count of meshes has
a process of its own, without a persistent cache. Prints both peaks (`VmHWM`) and their ratio, which must be
below 1.3. Linux only. Example: `python scripts/memory_meshes.py --counts 5 50`
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

# Nodes of the first mesh, and how many more each further one has.
FIRST, MORE = 60, 5
MOST_RATIO = 1.3


def run(count: int, settings: list[str]) -> None:
    """Run `count` meshes in this process and print its peak memory in MB."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxcrumple import initial_state, simulate
    from jaxcrumple._jax.program_cache import resident
    from jaxcrumple.run.config import configure

    for index in range(count):
        config = configure("radial", nodes=FIRST + MORE * index, settings=settings)
        setup = config.build()
        solution = simulate(
            setup.scene, initial_state(setup.scene, setup.x), 0.02, solver=config.solver.build()
        )
        assert solution.result == "success", solution.result
        told = (
            f"  {index + 1}: {setup.scene.n_nodes} nodes, now {resident() / 1e6:.0f} MB, peak {peak():.0f} MB"
        )
        print(told, file=sys.stderr, flush=True)
    print(peak())


def peak() -> float:
    """Peak memory of this process in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e6


def measured(count: int, settings: list[str]) -> float:
    """Peak memory in MB of a fresh process that runs `count` meshes."""
    environment = dict(os.environ, XLA_FLAGS="--xla_backend_optimization_level=0")
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, __file__, "--here", str(count), "--set", *settings]
    return float(subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--counts", type=int, nargs=2, default=[5, 50], metavar=("FEW", "MANY"))
    parser.add_argument(
        "--set", nargs="*", default=["contact=none"], help="settings of `radial`; by default phantom sheets"
    )
    parser.add_argument("--here", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        run(options.here, options.set)
        return
    few, many = (measured(count, options.set) for count in options.counts)
    fewer, more = options.counts
    print(f"{fewer} meshes: {few:.0f} MB, {more} meshes: {many:.0f} MB, ratio {many / few:.2f}")
    if many > MOST_RATIO * few:
        raise SystemExit(f"more than {MOST_RATIO} times as much")


if __name__ == "__main__":
    main()
