"""Compiled programs: forgotten before they use up the mappings that the system grants a process."""

from pathlib import Path

import jax

# Where Linux lists the mappings of this process, and how many it may have.
MAPPINGS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Share of them from which on programs are forgotten: what is left is enough for several more.
SHARE = 0.6


def make_room(share: float = SHARE) -> bool:
    """Forget all compiled programs if this process has used a `share` of its mappings; whether it did.

    XLA maps each kernel of a program by itself: a run with contact takes 4300 of the 65 530 that Linux
    grants by default, and where LLVM gets no more it ends the process. JAX keeps every program that it ever
    compiled, also those for lists of contact that have grown since. What is needed again is compiled again,
    or read from the persistent cache. Elsewhere than on Linux nothing is known, and nothing done.
    """
    if not (MAPPINGS.exists() and LIMIT.exists()):
        return False
    with MAPPINGS.open("rb") as lines:
        used = sum(1 for _ in lines)
    crowded = used >= share * int(LIMIT.read_text())
    if crowded:
        jax.clear_caches()
    return crowded
