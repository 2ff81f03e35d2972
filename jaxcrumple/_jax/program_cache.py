"""Compiled programs: forgotten before they use up the mappings or the memory that a process may have."""

import ctypes
import gc
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import psutil

from jaxcrumple._jax.memory import memory_limit

# Where Linux lists the mappings of this process, and how many it may have.
MAPPINGS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Share of the mappings from which on programs are forgotten: what is left is enough for several more.
SHARE = 0.6
# Programs are kept for FEW scenes of other sizes, and while memory has grown by less than GROWTH bytes since
# programs were last forgotten: who changes between a few scenes compiles each once. Above MOST of all memory
# no number is kept.
FEW, GROWTH, MOST = 4, 300e6, 0.5


class _Memory:
    """What was compiled since programs were last forgotten, and the memory in use after that."""

    def __init__(self) -> None:
        self.compiled: set[Hashable] = set()
        self.before: float | None = None

    def crowded(self, program: Hashable) -> bool:
        """Whether to forget before another `program` is compiled, which is noted."""
        if program in self.compiled:
            return False
        used = resident()
        self.before = used if self.before is None else min(self.before, used)
        many = len(self.compiled) >= FEW or used > MOST * memory_limit()
        return bool(self.compiled) and many and used - self.before > GROWTH

    def forgotten(self) -> None:
        self.compiled, self.before = set(), resident()


_memory = _Memory()


def make_room(*arguments: Any, share: float = SHARE) -> bool:
    """Forget all compiled programs if memory or mappings run short; whether it did.

    JAX keeps every program that it ever compiled, also those for meshes and lists of contact of sizes that do
    not come again. One of a phantom sheet takes 0.1 GB, with contact 1 GB. XLA maps each kernel of a program
    by itself: a run with contact takes 4300 of the 65 530 that Linux grants by default, and where LLVM gets
    no more it ends the process. What is needed again is compiled again, or read from the persistent cache.
    Elsewhere than on Linux nothing is known of mappings.

    **Arguments:** `arguments` with which a program is called next. One that was called with such since
    programs were last forgotten needs no more memory, and none is made. `share` of the mappings that may be
    in use.
    """
    program = _signature(arguments)
    crowded = _memory.crowded(program) or _out_of_mappings(share)
    if crowded:
        eqx.clear_caches()
        jax.clear_caches()
        gc.collect()
        _give_back()
        _memory.forgotten()
    _memory.compiled.add(program)
    return crowded


def resident() -> float:
    """Memory in bytes that this process has in use."""
    return float(psutil.Process().memory_info().rss)


def _signature(arguments: Any) -> Hashable:
    """What is equal for arguments that run the same compiled program."""
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(arrays))
    return shapes, jax.tree.structure(arrays), repr(jax.tree.leaves(rest))


def _out_of_mappings(share: float) -> bool:
    if not (MAPPINGS.exists() and LIMIT.exists()):
        return False
    with MAPPINGS.open("rb") as lines:
        used = sum(1 for _ in lines)
    return used >= share * int(LIMIT.read_text())


def _give_back() -> None:
    """Hand free memory back to the system where the C library keeps it: half of what programs took."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
