"""How much memory there is, and the refusal of what would exceed it."""

import math
import resource
import warnings
from collections.abc import Iterator
from pathlib import Path

import psutil

# Where Linux shows control groups, by which containers and job schedulers limit memory. The limits that
# `distributed.system` reads leave out those of a group below the root, which a scheduler's job is in, and
# take in those that are no bounds.
GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# Of one array whose size is known: what it takes with its temporary copies, at most.
COPIES = 2.0
# Largest number of entries that 32-bit indices reach.
MOST_ENTRIES = 2**31 - 1
# Bytes of a run, least and most: of the process with its program, of what contact adds to that, and of a node
# in a sheet of SIZE nodes, which grows as the factor of a direct solver does, with the logarithm of their
# number (`scripts/results/estimates.md`).
PROCESS, CONTACT, NODE, SIZE = (0.5e9, 1.3e9), (0.3e9, 2.9e9), (1.5e4, 4e4), 1000
# Bytes of a node in a frame: positions, velocities and the rest curvature of three hinges, once more where
# they are put together at the end.
FRAME = 2.0 * 72.0


def memory_limit() -> int:
    """Bytes that this process may hold: the machine's memory, or less by limits of a container, a job or the
    process."""
    limits = [psutil.virtual_memory().total, *group_limits()]
    for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA):
        soft, _ = resource.getrlimit(kind)
        if soft != resource.RLIM_INFINITY:
            limits.append(soft)
    return min(limits)


def group_limits(root: Path = GROUPS, own: Path = OWN_GROUPS) -> Iterator[int]:
    """Limits in bytes of the control groups of this process and of those around them, versions 1 and 2."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            top, name = root, "memory.max"
        elif "memory" in controllers.split(","):
            top, name = root / "memory", "memory.limit_in_bytes"
        else:
            continue
        group = top / path.lstrip("/")
        for place in (group, *group.parents[: len(group.parts) - len(top.parts)]):
            try:
                yield int((place / name).read_text())
            except (OSError, ValueError):  # not visible from here, or "max"
                continue


def times_that_fit(size: float) -> float:
    """How many times `size` bytes fit into the memory."""
    return memory_limit() / size


def require(least: float, what: str, cure: str, most: float | None = None) -> None:
    """Refuse what takes more memory than there is, before it is allocated; warn of what may take more.

    **Arguments:** `least`: bytes that it surely takes; `what` takes them, in words; `cure`: what makes it
    smaller; `most`: bytes that it may take, by default `COPIES` times the least.

    **Raises:** ValueError with the estimate, the limit and the cure.
    """
    limit = memory_limit()
    rest = f"of memory, and the limit here is {gigabytes(limit)}; {cure}."
    if not least <= limit:
        raise ValueError(f"{what} takes at least {gigabytes(least)} {rest}")
    most = COPIES * least if most is None else most
    if most > limit:
        warnings.warn(f"{what} may take up to {gigabytes(most)} {rest}", stacklevel=3)


def require_indices(count: float, what: str, cure: str) -> None:
    """Refuse more entries than 32-bit indices reach.

    **Raises:** ValueError with the count and the cure.
    """
    if count > MOST_ENTRIES:
        raise ValueError(f"{what} has {count:.3g} entries, more than 32-bit indices reach; {cure}.")


def gigabytes(size: float) -> str:
    """A size in bytes in words."""
    return f"{size * 1e-9:.3g} GB"


def run_bytes(nodes: int, frames: int, contact: bool) -> tuple[float, float]:
    """Peak memory of a run in bytes, least and most, with its frames in memory."""
    growth = math.log(max(nodes, SIZE)) / math.log(SIZE)
    least, most = (
        process + (touching if contact else 0.0) + nodes * (node * growth + FRAME * frames)
        for process, touching, node in zip(PROCESS, CONTACT, NODE, strict=True)
    )
    return least, most


def require_run(nodes: int, frames: int, contact: bool, runs: int = 1) -> None:
    """Refuse `runs` side by side that surely exceed the memory.

    **Raises:** ValueError with the estimate and the cure.
    """
    least, most = run_bytes(nodes, frames, contact)
    each = "a run" if runs == 1 else f"{runs} runs at a time, each"
    what, cure = f"{each} of {nodes} nodes with {frames} frames", "choose fewer nodes or frames"
    if runs > 1:
        cure += ", or a cluster of fewer workers"
    require(runs * least, what, cure, runs * most)
