"""Kill an action at one of the file operations by which a run changes its folder, as SIGKILL would."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax

from jaxcrumple import simulation
from jaxcrumple.io.table import TableFile


class Killed(BaseException):
    """The process is gone."""


@contextmanager
def file_operations(before: Callable[[str], None]) -> Iterator[None]:
    """`before` is called ahead of each operation by which a run changes its folder."""
    append = TableFile._write

    def around(name: str, operation: Callable) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            if not _of_compiled_programs(arguments[0]):
                before(name)
            return operation(*arguments, **options)

        return call

    def half_appended(self: TableFile, data: bytes) -> None:
        try:
            before("append")
        except Killed:
            with self.path.open("ab") as file:
                file.write(data[: len(data) // 2])
            raise
        append(self, data)

    with ExitStack() as stack:
        for owner, name in ((os, "fsync"), (os, "replace"), (Path, "unlink"), (Path, "mkdir")):
            stack.enter_context(mock.patch.object(owner, name, around(name, getattr(owner, name))))
        stack.enter_context(mock.patch.object(TableFile, "_write", half_appended))
        stack.enter_context(mock.patch.object(simulation, "CHUNK", 0.0))
        yield


def _of_compiled_programs(file: Any) -> bool:
    """Whether a path lies in the folder of compiled programs, which JAX locks: no file of a run."""
    folder = jax.config.jax_compilation_cache_dir
    return bool(folder) and isinstance(file, str | Path) and Path(file).is_relative_to(folder)


def count_operations(action: Callable[[], Any]) -> int:
    """File operations of an action."""
    names: list[str] = []
    with file_operations(names.append):
        action()
    return len(names)


def killed(action: Callable[[], Any], at: int) -> bool:
    """Kill an action at its file operation number `at`; False if it came to its end before."""
    made = 0

    def before(name: str) -> None:
        nonlocal made
        made += 1
        if made > at:  # whatever would still be tried, a dead process does not do
            raise Killed

    with file_operations(before):
        try:
            action()
        except Killed:
            return True
    return False
