"""What steps and lanes take on the device that JAX computes on, and how many kernels they launch.

Two parts, each planned for four minutes on a GPU, compiling included; a case that no longer fits is left out.

- `sheet`: `radial`, phantom and self-avoiding, two-level solver. Implicit steps from t = 0, explicit steps
  from there, and the time that a self-avoiding run reaches in a minute. Kernels are counted in the compiled
  programs (`hlo_kernels`). On a GPU also the time by kernel, from a profile.
- `lanes`: phantom sheets as lanes of one program, by `sweep`: seconds before the first step, once compiled,
  and the time of a lane and step.

On a CPU both parts are small. "before" is an H100 with jax 0.11.2 on 2026-11-26.

    python scripts/bench_device.py sheet|lanes [--nodes N ...] [--lanes L ...] [--minutes M] [--json FILE]
"""

import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import hlo_kernels
import jax
import jax.numpy as jnp
import numpy as np
from benchlib import markdown, options, save

import jaxcrumple as jc
from jaxcrumple import simulation
from jaxcrumple.state import EXPLICIT, IMPLICIT

# Step attempts that are timed, and the same of a lane.
ATTEMPTS, LANE_ATTEMPTS = 60, 32
EXPLICIT_ATTEMPTS = 150
# An end time in s that no timed run reaches, and wall seconds of the whole run.
FAR, WHOLE = 4.5, 60.0
# Share of the time that must be left for a case to start.
NEEDED = 0.35
# Milliseconds of an implicit and an explicit step, phantom, and of a lane's step, by nodes, before.
BEFORE = {"implicit": {3000: 7.9, 12000: 14.8}, "explicit": {3000: 0.54, 12000: 0.61}}
BEFORE_LANES = {16: 8.8e3 / 16 / 197, 64: 31.7e3 / 64 / 197}
BEFORE_CG = 36


class Clock:
    """How much of the time of a part is left."""

    def __init__(self, minutes: float):
        self.start, self.seconds = time.perf_counter(), 60.0 * minutes

    @property
    def left(self) -> float:
        """Seconds."""
        return self.seconds - (time.perf_counter() - self.start)

    def has_room(self) -> bool:
        """Whether another case may start."""
        return self.left > NEEDED * self.seconds


class OutOfTimeError(Exception):
    """The time of a part is over."""


class Deadline:
    """Stop a run at the end of the time; keep the last state."""

    def __init__(self, clock: Clock):
        self.clock, self.t = clock, 0.0

    def frame(self, index: int, state: jc.State) -> None:
        pass

    def chunk(self, state: jc.State, *_: Any) -> None:
        self.t = float(state.t)
        if self.clock.left < 0:
            raise OutOfTimeError


class Steps(NamedTuple):
    """Steps of one kind: `ms` and kernels (`launches`) of each, and where these are."""

    ms: float
    launches: float
    counts: dict[str, int]
    iterations: dict[str, float]


def steps_of(
    before: jc.State, solution: jc.Solution, stage: int, loops: dict[str, hlo_kernels.Loop]
) -> Steps:
    """What the attempts of a run took, all of one stage."""
    old, new = before.counters, solution.state.counters
    made = int(new.steps[stage] - old.steps[stage])
    attempts = max(made + int(jnp.sum(new.rejected - old.rejected)), 1)
    rounds = {
        "newton": int(new.newton - old.newton) / attempts,
        "conjugate-gradients": int(new.linear - old.linear) / attempts,
    }
    name = "explicit-steps" if stage == EXPLICIT else "implicit-steps"
    counts = {loop: loops[loop].kernels for loop in (name, *rounds) if loop in loops}
    launches = counts.get(name, 0) + sum(rounds[loop] * counts.get(loop, 0) for loop in rounds)
    return Steps(1e3 * solution.run_s / attempts, launches, counts, rounds)


def named_loops(text: str) -> dict[str, hlo_kernels.Loop]:
    """The loops of a program whose scopes have names, each by its last one; of several the largest."""
    found: dict[str, hlo_kernels.Loop] = {}
    for loop in hlo_kernels.program(text).walk():
        name = loop.scope.removesuffix("/while").rpartition("/")[2]
        if name not in found or loop.kernels > found[name].kernels:
            found[name] = loop
    return found


def longest(programs: dict[str, Any]) -> str:
    """HLO of the longest of compiled programs."""
    return max((program.compiled.as_text() for program in programs.values()), key=len)


def sheet(nodes: int, contact: bool, clock: Clock) -> dict[str, Any]:
    """Implicit and explicit steps of one sheet, and a whole run of a self-avoiding one."""
    setup = jc.radial(nodes, **({} if contact else {"contact": None}))
    start = jc.initial_state(setup.scene, setup.x)
    # The whole run is by the default scheme, and near the flat start its steps are implicit.
    solver = jc.integrator(scheme="hybrid" if contact else "dynamic", linear="two-level")
    implicit, last = steps(setup, start, solver, IMPLICIT, ATTEMPTS)
    kernels = profiled(setup.scene, last, solver) if jax.default_backend() != "cpu" else []
    farthest = reached(setup, start, solver, clock) if contact and clock.has_room() else None
    explicit = None
    if clock.has_room():
        explicit, _ = steps(setup, start, jc.integrator(scheme="explicit"), EXPLICIT, EXPLICIT_ATTEMPTS)
    found = {"implicit": implicit, "explicit": explicit, "kernels": kernels, "reached": farthest}
    return {"nodes": nodes, "contact": contact} | found


def steps(
    setup: jc.Setup, start: jc.State, solver: jc.Integrator, stage: int, attempts: int
) -> tuple[dict[str, Any], jc.State]:
    """Time so many attempts of one stage after some that compile; return their figures and the last state."""
    simulation._integrate.programs.clear()
    first = jc.simulate(setup.scene, start, FAR, solver=solver, max_attempts=4)
    loops = named_loops(longest(simulation._integrate.programs))
    run = jc.simulate(setup.scene, first.state, FAR, solver=solver, max_attempts=attempts)
    figures = steps_of(first.state, run, stage, loops)._asdict()
    return figures | {"compile_s": first.compile_s}, run.state


def reached(setup: jc.Setup, start: jc.State, solver: jc.Integrator, clock: Clock) -> float:
    """The time in s that a run from t = 0 reaches in WHOLE s of wall, or until the part's time is over."""
    deadline = Deadline(clock)
    try:
        seconds = min(WHOLE, max(clock.left, 1.0))
        run = jc.simulate(setup.scene, start, FAR, solver=solver, observers=[deadline], max_seconds=seconds)
        return float(run.state.t)
    except OutOfTimeError:
        return deadline.t


def profiled(scene: jc.Scene, state: jc.State, solver: jc.Integrator) -> list[tuple[str, float, int]]:
    """Kernels of a few implicit steps: name, ms and launches, those of most time first."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jc.simulate(scene, state, FAR, solver=solver, max_attempts=8)
        return times_by_kernel(Path(folder))


def times_by_kernel(folder: Path) -> list[tuple[str, float, int]]:
    """Name, ms and launches of the kernels in a profile, those of most time first."""
    spent: Counter[str] = Counter()
    launches: Counter[str] = Counter()
    for path in folder.rglob("*.xplane.pb"):
        for plane in jax.profiler.ProfileData.from_file(str(path)).planes:
            for event in (event for line in plane.lines for event in line.events):
                if any(key == "hlo_op" for key, _ in event.stats):
                    name = event.name.rstrip("0123456789.")
                    # Loops and branches last as long as what is in them.
                    if name not in ("while", "cond", "conditional", "call"):
                        spent[name] += event.duration_ns
                        launches[name] += 1
    return [(name, 1e-6 * ns, launches[name]) for name, ns in spent.most_common(12)]


def sheets(nodes: list[int], clock: Clock) -> tuple[str, list[dict]]:
    """The table of the part `sheet`, and its numbers."""
    found = []
    for count in nodes:
        for contact in (False, True):
            if found and not clock.has_room():
                print(f"left out for lack of time: n = {count}, contact: {contact}", flush=True)
                continue
            found.append(sheet(count, contact, clock))
            print(found[-1], flush=True)
    rows = []
    for row in found:
        for kind in (kind for kind in ("implicit", "explicit") if row[kind]):
            steps, counts = row[kind], row[kind]["counts"]
            known = not row["contact"] and BEFORE[kind].get(row["nodes"])
            cg = steps["iterations"]["conjugate-gradients"]
            rows.append([
                row["nodes"], "self-avoiding" if row["contact"] else "phantom", kind, f"{steps['ms']:.2f}",
                known or "", f"{cg:.0f}" if kind == "implicit" else "",
                counts.get("conjugate-gradients", "") if kind == "implicit" else "",
                BEFORE_CG if known and kind == "implicit" else "", f"{steps['launches']:.0f}",
            ])  # fmt: skip
    head = ["n", "sheet", "steps", "ms", "before", "CG iterations", "kernels of one", "before", "of a step"]
    text = markdown(head, rows)
    for row in found:
        if row["reached"] is not None:
            text += (
                f"\n\nn = {row['nodes']}, self-avoiding: t = {row['reached']:.3f} s in {WHOLE:g} s of wall."
            )
        if row["kernels"]:
            lines = [[name, f"{ms:.2f}", many] for name, ms, many in row["kernels"]]
            text += f"\n\nn = {row['nodes']}:\n\n{markdown(['kernel', 'ms', 'launches'], lines)}"
    return text, found


def lanes(nodes: int, counts: list[int], clock: Clock) -> tuple[str, list[dict]]:
    """The table of the part `lanes`, and its numbers."""
    found: list[dict] = []
    settings = {"nodes": nodes, "contact": None, "rtol": 1e-2, "linear": "two-level"}

    def seconds(count: int, attempts: int) -> float:
        start = time.perf_counter()
        over = {"yield_curvature": np.linspace(100.0, 300.0, count).tolist()}
        jc.sweep("radial", over, FAR, settings=settings, backend="batch", max_attempts=attempts)
        return time.perf_counter() - start

    for count in counts:
        if found and not clock.has_room():
            print(f"left out for lack of time: {count} lanes", flush=True)
            continue
        first, ready = seconds(count, 1), seconds(count, 1)
        ms = 1e3 * (seconds(count, 1 + LANE_ATTEMPTS) - ready) / (count * LANE_ATTEMPTS)
        found.append({"lanes": count, "first_s": first, "ready_s": ready, "ms": ms})
        print(found[-1], flush=True)
    rows = [
        [row["lanes"], f"{row['first_s']:.1f}", f"{row['ready_s']:.1f}", f"{row['ms']:.3f}",
         f"{BEFORE_LANES[row['lanes']]:.2f}" if row["lanes"] in BEFORE_LANES and nodes == 500 else ""]
        for row in found
    ]  # fmt: skip
    head = ["lanes", "s, compiling", "s, compiled", "ms of a lane and step", "before, set-up included"]
    return f"n = {nodes}, phantom.\n\n{markdown(head, rows)}", found


def main() -> None:
    """Run one part; print and save."""
    parser = options(__doc__ or "", [])
    parser.add_argument("part", choices=("sheet", "lanes"))
    parser.add_argument("--lanes", type=int, nargs="+")
    parser.add_argument("--minutes", type=float, default=4.0, help="time of the part")
    opts = parser.parse_args()
    small = jax.default_backend() == "cpu"
    clock = Clock(opts.minutes)
    with tempfile.TemporaryDirectory() as folder:
        # Programs whose HLO can be read are those that are stored.
        jc.enable_compilation_cache(folder)
        if opts.part == "sheet":
            text, found = sheets(opts.nodes or ([200] if small else [3000, 12000]), clock)
        else:
            nodes = (opts.nodes or [200 if small else 500])[0]
            text, found = lanes(nodes, opts.lanes or ([4] if small else [16, 64, 256]), clock)
    device = jax.devices()[0].device_kind
    save(opts, f"device_{opts.part}_{jax.default_backend()}", f"{device}\n\n{text}", None, {}, found)


if __name__ == "__main__":
    main()
