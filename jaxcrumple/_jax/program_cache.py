"""Clear compiled programs before they exhaust the memory mappings or the memory of the process."""

import ctypes
import gc
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import psutil

from jaxcrumple._jax.memory import memory_limit
from jaxcrumple._jax.stored_programs import forget_programs

# Linux files with the memory mappings of this process, and with their maximum number.
MAPPINGS, LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
# Share of the mappings at which programs are cleared: the rest is enough for several more programs.
SHARE = 0.6
# Programs are cleared when FEW of them are compiled and memory has grown by more than GROWTH bytes since the
# last clearing. A user who switches between a few scenes thus compiles each once. Above the share MOST of all
# memory, one compiled program is enough.
FEW, GROWTH, MOST = 4, 300e6, 0.5


class _Memory:
    """Programs compiled since the last clearing, and the memory in use then."""

    def __init__(self) -> None:
        self.compiled: set[Hashable] = set()
        self.before: float | None = None

    def crowded(self, program: Hashable) -> bool:
        """Return whether to clear the programs before compiling `program`; update the memory baseline."""
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
    """Clear all compiled programs if memory or memory mappings run short.

    JAX keeps every program that it has compiled, also those for mesh and contact list sizes that do not
    recur. A program of a phantom sheet takes 0.1 GB, with contact 1 GB. XLA maps each kernel of a program
    separately: a run with contact takes 4300 of the 65 530 mappings that Linux allows by default. If LLVM
    gets no more mappings, it ends the process. JAX compiles a cleared program again on its next use, or reads
    it from the persistent cache. Mappings are checked on Linux only.

    **Arguments:** `arguments`: of the next call. If a program ran with such arguments since the last
    clearing, the call needs no more memory, and memory is not checked. `share`: of the mappings that may be
    in use.

    **Returns:** whether it cleared the programs.
    """
    program = _signature(arguments)
    crowded = _memory.crowded(program) or _out_of_mappings(share)
    if crowded:
        clear()
        _memory.forgotten()
    _memory.compiled.add(program)
    return crowded


def clear() -> None:
    """Clear all compiled programs."""
    eqx.clear_caches()
    jax.clear_caches()
    forget_programs()
    gc.collect()
    give_back()


def resident() -> float:
    """Return the resident memory of this process in bytes."""
    return float(psutil.Process().memory_info().rss)


def _signature(arguments: Any) -> Hashable:
    """Return a key that is equal for arguments that run the same compiled program."""
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(arrays))
    return shapes, jax.tree.structure(arrays), repr(jax.tree.leaves(rest))


def _out_of_mappings(share: float) -> bool:
    if not (MAPPINGS.exists() and LIMIT.exists()):
        return False
    with MAPPINGS.open("rb") as lines:
        used = sum(1 for _ in lines)
    return used >= share * int(LIMIT.read_text())


def give_back() -> None:
    """Return free memory to the system; the C library otherwise keeps half of what compiling took."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
