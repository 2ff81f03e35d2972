"""Memory limit of the process, and refusal of requests that exceed it."""

import math
import resource
import warnings
from collections.abc import Iterator
from pathlib import Path

import psutil

# Linux paths of control groups, with which containers and job schedulers limit memory. `distributed.system`
# is not enough: it omits limits of groups below the root, where a scheduler puts its jobs, and it includes
# values that are not bounds.
GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# Largest memory of one array with its temporary copies, in units of its own size.
COPIES = 2.0
# Largest number of entries that 32-bit indices can address.
MOST_ENTRIES = 2**31 - 1
# Bytes of a run, (least, most): the process with its compiled program, the extra memory for contact, and one
# node in a sheet of SIZE nodes. The bytes per node grow with the logarithm of the number of nodes, as the
# factor of a direct solver does (`scripts/results/estimates.md`).
PROCESS, CONTACT, NODE, SIZE = (0.5e9, 1.3e9), (0.3e9, 2.9e9), (1.5e4, 4e4), 1000
# Bytes per node and frame: positions, velocities and the rest curvature of three hinges. The factor 2 counts
# the copy that concatenates the frames at the end.
FRAME = 2.0 * 72.0


def memory_limit() -> int:
    """Return the bytes that this process may use.

    This is the machine's memory, or the lower limit of a container, a job or the process.
    """
    limits = [psutil.virtual_memory().total, *group_limits()]
    for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA):
        soft, _ = resource.getrlimit(kind)
        if soft != resource.RLIM_INFINITY:
            limits.append(soft)
    return min(limits)


def group_limits(root: Path = GROUPS, own: Path = OWN_GROUPS) -> Iterator[int]:
    """Yield the limits in bytes of this process's control groups and their parents, versions 1 and 2."""
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
    """Return how many times `size` bytes fit into the memory limit."""
    return memory_limit() / size


def require(least: float, what: str, cure: str, most: float | None = None) -> None:
    """Refuse a request above the memory limit before it allocates; warn if it may exceed the limit.

    **Arguments:** `least`: lower bound of the request in bytes; `what`: the request in words; `cure`: how to
    reduce it; `most`: upper bound in bytes, by default `COPIES` times `least`.

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
    """Refuse more entries than 32-bit indices can address.

    **Raises:** ValueError with the count and the cure.
    """
    if count > MOST_ENTRIES:
        raise ValueError(f"{what} has {count:.3g} entries, more than 32-bit indices reach; {cure}.")


def gigabytes(size: float) -> str:
    """Format a size in bytes."""
    return f"{size * 1e-9:.3g} GB"


def run_bytes(nodes: int, frames: int, contact: bool) -> tuple[float, float]:
    """Estimate the peak memory of a run in bytes as (least, most), with all frames in memory."""
    growth = math.log(max(nodes, SIZE)) / math.log(SIZE)
    least, most = (
        process + (touching if contact else 0.0) + nodes * (node * growth + FRAME * frames)
        for process, touching, node in zip(PROCESS, CONTACT, NODE, strict=True)
    )
    return least, most


def require_run(nodes: int, frames: int, contact: bool, runs: int = 1) -> None:
    """Refuse `runs` concurrent runs if even their least estimate exceeds the memory limit.

    **Raises:** ValueError with the estimate and the cure.
    """
    least, most = run_bytes(nodes, frames, contact)
    each = "a run" if runs == 1 else f"{runs} runs at a time, each"
    what, cure = f"{each} of {nodes} nodes with {frames} frames", "choose fewer nodes or frames"
    if runs > 1:
        cure += ", or a cluster of fewer workers"
    require(runs * least, what, cure, runs * most)
