"""What damage and kills do to run folders.

    python scripts/fuzz_runs.py [--damages 10000] [--kills 200] [--seed 0]

Three small scenes are run: a phantom sheet that snaps and yields, an elastic arch on supports, and a sheet
that avoids itself. Then their folders, finished and cut off half way, are damaged: bits are flipped, files
are truncated, deleted or swapped. After each damage the run is read, verified, resumed and repaired. Each
of these must either give what the undamaged run gives, bit for bit, or refuse before anything is compiled,
naming the file and the cure.

A kill ends a run at one of its file operations, and does nothing after it, as SIGKILL would; half of an
appended block may be on the disk. The run that goes on from there must end as one left alone, bit for bit.
"""

import argparse
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import numpy as np
from kill_points import count_operations, killed

jax.config.update("jax_enable_x64", True)

from jaxcrumple.io import RunDirectory, RunDirectoryError, load  # noqa: E402
from jaxcrumple.io.lock import writing  # noqa: E402
from jaxcrumple.io.rundir import frame_name  # noqa: E402
from jaxcrumple.io.verify import damages  # noqa: E402
from jaxcrumple.run import run as runs  # noqa: E402
from jaxcrumple.run.config import RunConfig, configure  # noqa: E402

SNAP = ["contact=none", "sweeps=5", "frames=6", "yield_curvature=20", "plastic_time=1e-2", "rtol=1e-2"]
SCENES: dict[str, Callable[[], RunConfig]] = {
    "phantom": lambda: configure("radial", nodes=40, t_end=0.5, settings=SNAP),
    "arch": lambda: configure("arch", nodes=40, t_end=6e-3, settings=["frames=4"]),
    "self-avoiding": lambda: configure("radial", nodes=30, t_end=0.2, settings=["sweeps=5", "frames=4"]),
}
# Files that differ from run to run of one scene: times are in them.
TIMED = re.compile(r"(summary|manifest)\.json|checkpoints/.*|run\.vtkhdf|\.lock")
PERMITTED = re.compile(r"(is damaged|is cut short|does not exist|cannot be read|no part of|is not a run).*; ")


class Reached(BaseException):
    """A run that is about to simulate: from this state, with so many frames."""

    def __init__(self, state: Any, frames: int):
        self.state, self.frames = state, frames


class Reference(NamedTuple):
    """A scene's run: its `config`, its folder when `finished` and when cut off (`unfinished`), what is read
    from each, and the states that may be gone on from, by time and frames."""

    config: RunConfig
    finished: Path
    unfinished: Path
    read: dict[Path, dict[str, bytes]]
    states: dict[tuple[float, int], list[bytes]]


# What must be the same


def told(folder: Path) -> dict[str, bytes]:
    """What a reader is told of a run, in bytes."""
    run = load(folder)
    arrays = {name: getattr(run, name).tobytes() for name in ("t", "x", "v", "p")}
    words = {"config": run.config, "summary": run.summary, "faces": run.mesh.faces.tolist()}
    tables = {"history": run.history.to_csv(), "events": run.events.to_csv()}
    return arrays | {name: repr(value).encode() for name, value in (words | tables).items()}


def bits(state: Any) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state)]


def contents(folder: Path) -> dict[str, bytes]:
    """Files of a run without those that hold times."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in files.items() if not TIMED.fullmatch(name)}


def named(folder: Path) -> list[str]:
    """Files that belong to a run: others are left of writes that were cut off."""
    opened = RunDirectory.open(folder)
    frames = [frame_name(index) for index in opened.frames()]
    return [*opened.manifest.files, *opened.manifest.tables, *frames]


def same_end(one: Path, other: Path) -> bool:
    """Whether two finished runs are the same."""
    ends = []
    for folder in (one, other):
        opened = RunDirectory.open(folder)
        with np.load(folder / str(opened.manifest.checkpoint)) as file:
            ends.append({name: file[name].tobytes() for name in file.files if name != "header"})
    told_of = [told(folder) for folder in (one, other)]
    for found in told_of:
        found.pop("summary")
    return not damages(one) and ends[0] == ends[1] and told_of[0] == told_of[1]


# References


def reference(name: str, place: Path) -> Reference:
    """Run a scene once to its end, and once to be killed half way."""
    config, finished, unfinished = SCENES[name](), place / name / "finished", place / name / "unfinished"
    states: dict[tuple[float, int], list[bytes]] = {}
    commit = RunDirectory.commit

    def noted(self: RunDirectory, state: Any, metadata: Any, *, keep: bool = False) -> None:
        states[metadata["t"], self.counts.frames] = bits(state)
        commit(self, state, metadata, keep=keep)

    with mock.patch.object(RunDirectory, "commit", noted):
        operations = count_operations(lambda: runs.start_run(config, finished))
        assert killed(lambda: runs.start_run(config, unfinished), int(0.7 * operations))
    read = {folder: told(folder) for folder in (finished, unfinished)}
    return Reference(config, finished, unfinished, read, states)


# Damage


def damaged(rng: np.random.Generator, folder: Path, foreign: Path) -> str:
    """Damage one file of a folder, or two, with a file of `foreign` at hand; in words what was done.

    Hidden files are left alone: the lock, and what a write left half done. A manifest that was about to be
    put in its place tells a later moment of the same run.
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    path = files[rng.integers(len(files))]
    name, data = path.relative_to(folder), path.read_bytes()
    kind = rng.choice(["flip", "flip", "flip", "truncate", "delete", "swap", "foreign"])
    if kind == "flip" and data:
        where, bit = int(rng.integers(len(data))), int(rng.integers(8))
        path.write_bytes(data[:where] + bytes([data[where] ^ (1 << bit)]) + data[where + 1 :])
        return f"bit {bit} of byte {where} of {name} flipped"
    if kind == "truncate" and data:
        left = int(rng.integers(len(data)))
        path.write_bytes(data[:left])
        return f"{name} cut to {left} of {len(data)} bytes"
    if kind == "swap":
        other = files[rng.integers(len(files))]
        path.write_bytes(other.read_bytes())
        other.write_bytes(data)
        return f"{name} and {other.relative_to(folder)} swapped"
    if kind == "foreign" and (foreign / name).is_file():
        path.write_bytes((foreign / name).read_bytes())
        return f"{name} replaced by that of another run"
    path.unlink()
    return f"{name} deleted"


@contextmanager
def stopped_before_simulating(built: Any) -> Iterator[None]:
    """A run stops where it would begin to compile, and is not built again each time."""

    def stop(scene: Any, state: Any, times: Any, *, first_frame: int, **_: Any) -> None:
        raise Reached(state, first_frame)

    build = mock.patch.object(RunConfig, "build", return_value=built)
    with mock.patch.object(runs, "simulate", stop), build:
        yield


def judged(action: Callable[[], Any]) -> tuple[str, Any]:
    """What came of an action: "refused" with the message, "reached" with the run, or "done" with its result.

    A refusal that does not name a file and a cure, and any other exception, is a fault.
    """
    try:
        return "done", action()
    except RunDirectoryError as error:
        if not PERMITTED.search(str(error)):
            return "fault", f"refused without cause or cure: {error}"
        return "refused", str(error)
    except Reached as run:
        return "reached", run
    except Exception as error:
        return "fault", f"{type(error).__name__}: {error}"


def faults(folder: Path, whole: Reference, base: Path) -> Iterator[tuple[str, str]]:
    """What was done to a damaged folder, and "fault: ..." where something passed that must not."""
    outcome, found = judged(lambda: told(folder))
    if outcome == "done" and found != whole.read[base]:
        changed = [name for name in found if found[name] != whole.read[base][name]]
        found, outcome = f"read with other {', '.join(changed)}", "fault"
    yield f"load: {outcome}", found if outcome == "fault" else ""
    wrong = damages(folder)
    if not wrong and (lost := [name for name in named(base) if not (folder / name).exists()]):
        yield "verify: fault", f"{', '.join(lost)} is missing, and all is called sound"
    yield f"verify: {'damaged' if wrong else 'sound'}", ""
    yield _gone_on(folder, whole, "resume", lambda: runs.resume_run(folder))
    outcome, found = judged(lambda: runs.repair_run(folder))
    yield f"repair: {outcome}", found if outcome == "fault" else ""
    if outcome == "done":
        if left := damages(folder):
            yield "repair: fault", f"damage is left: {left}"
        yield _gone_on(folder, whole, "resume after repair", lambda: runs.resume_run(folder))


def _gone_on(folder: Path, whole: Reference, what: str, action: Callable[[], Any]) -> tuple[str, str]:
    """Whether a run goes on from a state that the undamaged run had, or ends as that did."""
    outcome, found = judged(action)
    if outcome == "reached":
        at = float(found.state.t), found.frames
        start = at == (0.0, 0)
        if not start and whole.states.get(at) != bits(found.state):
            return f"{what}: fault", f"goes on from another state at t = {at[0]}, frame {at[1]}"
        return f"{what}: goes on", ""
    if outcome == "done":
        old, new = told(whole.finished), told(folder)
        changed = [name for name in old if name != "summary" and old[name] != new[name]]
        if changed or found["result"] != "success":
            return f"{what}: fault", f"ends with other {', '.join(changed)} ({found['result']})"
    return f"{what}: {outcome}", found if outcome == "fault" else ""


def report(found: list[str], fault: str) -> None:
    """Print a fault at once and add it to those `found`."""
    print(fault, flush=True)
    found.append(fault)


def try_damages(references: dict[str, Reference], count: int, seed: int, place: Path) -> list[str]:
    """Damage folders `count` times; the faults in words."""
    rng, outcomes, found = np.random.default_rng(seed), Counter(), []
    names = list(references)
    folder, built = place / "damaged", {name: one.config.build() for name, one in references.items()}
    for index in range(count):
        name = names[index % len(names)]
        whole, other = references[name], references[names[(index + 1) % len(names)]]
        base = whole.finished if rng.random() < 0.5 else whole.unfinished
        shutil.copytree(base, folder)
        try:
            done = damaged(rng, folder, other.finished)
            with stopped_before_simulating(built[name]):
                for outcome, fault in faults(folder, whole, base):
                    outcomes[outcome] += 1
                    if fault:
                        report(found, f"{name}, {base.name}, {done}: {outcome}: {fault}")
        finally:
            shutil.rmtree(folder)
    for outcome, number in sorted(outcomes.items()):
        print(f"  {outcome}: {number}")
    return found


# Kills


def try_kills(references: dict[str, Reference], count: int, seed: int, place: Path) -> list[str]:
    """Kill runs `count` times, some of them again while they go on; the faults in words."""
    rng, found, kills = np.random.default_rng(seed), [], 0
    names = list(references)
    totals = {
        name: count_operations(lambda: runs.start_run(one.config, place / "counted" / name))  # noqa: B023
        for name, one in references.items()
    }
    while kills < count:
        name = names[kills % len(names)]
        whole, folder, at = references[name], place / "killed", []
        action: Callable[[], Any] = lambda: runs.start_run(whole.config, folder)  # noqa: B023, E731
        while len(at) < 3 and kills < count:
            point = int(rng.integers(totals[name]))
            if not killed(action, point):
                break
            kills += 1
            at.append(point)
            begun = folder.is_dir() and (folder / "manifest.json").exists()
            action = (lambda: runs.resume_run(folder)) if begun else action  # noqa: B023
            if rng.random() < 0.5:
                break
        try:
            if action is not None and not _finished(folder):
                action()
            if not same_end(folder, whole.finished):
                report(found, f"{name} killed at {at}: ends otherwise")
        except Exception as error:
            report(found, f"{name} killed at {at}: {type(error).__name__}: {error}")
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    print(f"  {kills} kills")
    return found


def _finished(folder: Path) -> bool:
    return (folder / "manifest.json").exists() and RunDirectory.open(folder).finished


def try_two_writers(whole: Reference) -> list[str]:
    """A second writer must be refused, and must change nothing."""
    before = contents(whole.unfinished)
    with writing(whole.unfinished):
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor() as pool:
            outcome = pool.submit(judged, lambda: runs.resume_run(whole.unfinished)).result()
    fault = "another run is writing into" not in str(outcome[1]) or contents(whole.unfinished) != before
    return [f"two writers: {outcome}"] if fault else []


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--damages", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place, start = Path(name), time.perf_counter()
        references = {scene: reference(scene, place) for scene in asked.scenes}
        print(f"{len(references)} scenes run in {time.perf_counter() - start:.0f} s", flush=True)
        found = []
        for what, trial in (("damages", try_damages), ("kills", try_kills)):
            start = time.perf_counter()
            found += trial(references, getattr(asked, what), asked.seed, place)
            print(
                f"{getattr(asked, what)} {what} in {time.perf_counter() - start:.0f} s, {len(found)} faults",
                flush=True,
            )
        writers = try_two_writers(next(iter(references.values())))
        print(f"two writers: {writers or 'one is refused'}")
        found += writers
    raise SystemExit(1 if found else 0)


if __name__ == "__main__":
    main()
