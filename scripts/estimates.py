"""What `check` estimates of runs of `radial` beside what they take: peak memory, and CPU time with compiling.

Each run and each build is a process of its own, whose programs are compiled without a cache. Large sheets are
built and not run.

    python scripts/estimates.py [--nodes N ...] [--built N ...] [--contacts C ...] [--t-end S] [--resume]
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchlib import Log, markdown, options, save

from jaxcrumple.contact.potentials import DEFAULT_POTENTIAL
from jaxcrumple.run.config import RunConfig, configure
from jaxcrumple.run.estimate import estimate
from jaxcrumple.run.pace import rounded
from jaxcrumple.run.run import start_run

NODES, BUILT, T_END = (300, 1000, 3000), (30_000, 100_000), 0.6
CONTACTS = ("none", DEFAULT_POTENTIAL)
# Lloyd sweeps of a sheet that is only built: they take time and no memory.
SWEEPS = 1


def main() -> None:
    """Measure what is missing, and write the table."""
    parser = options(__doc__, NODES, resumable=True)
    parser.add_argument("--built", type=int, nargs="*", default=BUILT)
    parser.add_argument("--contacts", nargs="+", default=CONTACTS)
    parser.add_argument("--t-end", type=float, default=T_END)
    parser.add_argument("--one", nargs=3, metavar=("KIND", "NODES", "CONTACT"), help=argparse.SUPPRESS)
    opts = parser.parse_args()
    if opts.one:
        kind, nodes, contact = opts.one
        asked = config(int(nodes), contact, opts.t_end, SWEEPS if kind == "build" else 100)
        print(json.dumps(ran(asked) if kind == "run" else built(asked)))
        return
    log = Log("estimates", opts.resume)
    sizes = [("run", n) for n in opts.nodes] + [("build", n) for n in opts.built]
    cases = [
        {"kind": kind, "nodes": n, "contact": contact, "t_end": opts.t_end}
        for contact in opts.contacts
        for kind, n in sizes
    ]
    results = [log.result(case, lambda case=case: alone(case)) for case in cases]
    save(opts, "estimates", tables(results), None, {}, results)


def config(nodes: int, contact: str, t_end: float, sweeps: int = 100) -> RunConfig:
    """The configuration of a run."""
    return configure("radial", nodes=nodes, t_end=t_end, settings={"contact": contact, "sweeps": sweeps})


def alone(case: dict) -> dict:
    """What a case takes, in a process of its own."""
    name = [case["kind"], str(case["nodes"]), case["contact"]]
    command = [sys.executable, __file__, "--t-end", str(case["t_end"]), "--one", *name]
    cold = {key: value for key, value in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=cold).stdout)


def ran(asked: RunConfig) -> dict:
    """Peak memory in bytes and seconds of a run."""
    with tempfile.TemporaryDirectory() as folder:
        summary = start_run(asked, Path(folder) / "run")
    spent = {key: summary[key] for key in ("result", "cpu_s")}
    return {"memory": summary["peak_memory_mb"] * 2**20} | spent


def built(asked: RunConfig) -> dict:
    """Peak memory in bytes and CPU seconds of building a scene."""
    start = time.process_time()
    asked.build()
    # ru_maxrss is in kB on Linux and in bytes on macOS.
    unit = 1 if sys.platform == "darwin" else 2**10
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    return {"memory": peak, "cpu_s": time.process_time() - start}


def tables(results: list[dict]) -> str:
    """Estimates beside what was measured."""
    rows, builds = [], []
    for result in results:
        n, contact = result["nodes"], result["contact"]
        memory = f"{result['memory'] * 1e-9:.2f}"
        if result["kind"] == "build":
            builds.append((n, contact, memory, f"{result['cpu_s']:.1f}"))
            continue
        guess = estimate(config(n, contact, result["t_end"]), n)
        seconds = [sum(both) for both in zip(guess.compiling, guess.run, strict=True)]
        cells = [between(*guess.memory, 1e-9), memory, between(*seconds), f"{result['cpu_s']:.0f}"]
        rows.append((n, contact, *cells))
    header = ["n", "contact", "memory in GB: estimate", "run", "CPU s with compiling: estimate", "run"]
    what = (
        f"`radial` to t = {results[0]['t_end']:g} s, rtol 0.01, each in a process of its own, without a "
        "cache of programs, on a machine with other work."
    )
    large = f"Sheets that are built and not run, {SWEEPS} Lloyd sweep."
    built_header = ["n", "contact", "memory in GB", "CPU s"]
    return f"{what}\n\n{markdown(header, rows)}\n\n{large}\n\n{markdown(built_header, builds)}"


def between(least: float, most: float, unit: float = 1.0) -> str:
    """A range in words."""
    return f"{rounded(least * unit)} to {rounded(most * unit)}"


if __name__ == "__main__":
    main()
