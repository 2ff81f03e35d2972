"""Kernels that a compiled program launches, loop by loop, counted in its optimised HLO.

Each fusion, library call, copy and other instruction that computes counts as one kernel. A library may
launch several for one call, and a GPU waits for the host in each round of a loop; neither is counted. Of the
branches of a conditional the largest counts.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

# Instructions that launch nothing, and those whose kernels are in other computations.
NOTHING = {
    "parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "copy-done", "async-done",
    "add-dependency", "opt-barrier", "partition-id", "replica-id",
}  # fmt: skip
ELSEWHERE = {"while", "conditional", "call"}
_HEAD = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\{$")
_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?[\w.\-]+ = .*? ([a-z][a-z0-9\-]*)\(")


class Loop(NamedTuple):
    """The `kernels` of one round of a loop without its inner loops, and these; of the program at the top.

    `scope`: names of the scopes around it in the program, as JAX writes them."""

    scope: str
    kernels: int
    inner: list["Loop"]

    def walk(self) -> Iterator["Loop"]:
        """The loop and all loops in it."""
        yield self
        for loop in self.inner:
            yield from loop.walk()


def program(text: str) -> Loop:
    """The kernels of a compiled program, given its HLO (`compiled.as_text()`)."""
    computations: dict[str, list[str]] = {}
    entry = name = ""
    for line in text.splitlines():
        if head := _HEAD.match(line):
            name = head[2]
            computations[name] = []
            entry = name if head[1] else entry
        elif name:
            computations[name].append(line)
    return _counted(computations, [entry], "")


def _counted(computations: dict[str, list[str]], names: list[str], scope: str) -> Loop:
    kernels, inner = 0, []
    for line in (line for name in names for line in computations[name]):
        found = _INSTRUCTION.match(line)
        if found is None or found[1] in NOTHING:
            continue
        if found[1] not in ELSEWHERE:
            kernels += 1
        elif found[1] == "while":
            origin = re.search(r'op_name="([^"]*)"', line)
            inner.append(_counted(computations, _called(line), origin[1] if origin else ""))
        else:
            branches = [_counted(computations, [name], scope) for name in _called(line)]
            kernels += max(branch.kernels for branch in branches)
            inner += [loop for branch in branches for loop in branch.inner]
    return Loop(scope, kernels, inner)


def _called(line: str) -> list[str]:
    """Names of the computations that an instruction calls."""
    several = re.findall(r"branch_computations=\{([^}]*)\}", line)
    word = r"(?:condition|body|to_apply|true_computation|false_computation)=%?([\w.\-]+)"
    return re.findall(r"[\w.\-]+", several[0]) if several else re.findall(word, line)
