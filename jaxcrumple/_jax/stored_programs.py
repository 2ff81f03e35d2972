"""Compiled programs in the folder of the compilation cache, which later processes call without tracing.

JAX's own cache spares compiling. A program must still be traced and lowered to be found there, which takes
several times as long as to read it. Here its name tells all that it depends on: the function, the arguments
up to the numbers in their arrays, the sources of this package, versions, settings of JAX, and the processor.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import io
import os
import pickle
import platform
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.experimental import serialize_executable

from jaxcrumple._jax.tree import is_known

# Files of this package in the folder, and how many of them stay: those used last. One takes up to 2 MB.
SUFFIX, KEPT = ".jaxcrumple", 512
# Programs that are compiled in less than this time in s are not kept.
LONG = 0.1
# Packages whose versions are in the name. Only their classes and functions, and those of this package and of
# Python, may occur in arguments.
PACKAGES = ("jax", "jaxlib", "equinox", "numpy", "diffrax", "pardiso-mkl-jax")
KNOWN = {"jaxcrumple", "builtins", "copyreg", *(name.replace("-", "_") for name in PACKAGES)}
# Words in the names of settings of JAX that do not change a program.
OTHER = ("cache", "log", "traceback", "dump", "locations", "color", "guard", "distributed", "leaked")
# Settings with which a program is not kept.
CHECKS = ("debug_nans", "debug_infs", "disable_jit", "check_tracer_leaks", "default_device")
# File with the abilities of the processor on Linux.
PROCESSOR = Path("/proc/cpuinfo")


class _Array(NamedTuple):
    """Stand for an array in the description of arguments."""

    shape: tuple[int, ...]
    dtype: str
    weak: bool


class _Other(NamedTuple):
    """Hold an argument that is not an array."""

    type: type
    value: Any


class _Program(NamedTuple):
    """Hold a `compiled` program of the arrays in its arguments, and its result: a tree of places in its
    outputs, and a tree of what is not an array."""

    compiled: jax.stages.Compiled
    places: Any
    rest: Any

    def __call__(self, arrays: list[jax.Array]) -> Any:
        outputs = self.compiled(*arrays)
        return eqx.combine(jax.tree.map(lambda place: outputs[place], self.places), self.rest)


Given = ParamSpec("Given")
Made = TypeVar("Made")


class StoredJit(Generic[Given, Made]):
    """Compile a function like `equinox.filter_jit`, and keep its programs if there is a compilation cache.

    **Arguments:** `function`: pure, of this package; `prepare`: called with the arguments before a program is
    read, to load the libraries that it calls.
    """

    def __init__(self, function: Callable[Given, Made], prepare: Callable[..., None] = lambda *_: None):
        functools.update_wrapper(self, function)
        self.function, self.prepare = function, prepare
        self.jitted: Callable[Given, Made] = eqx.filter_jit(function)
        self.programs: dict[str, _Program] = {}
        _all.append(self)

    def __call__(self, *args: Given.args, **kwargs: Given.kwargs) -> Made:
        """Return the result of the function, computed by a program."""
        folder = _folder()
        name = None if folder is None or kwargs else _name(self.function, args)
        if folder is None or name is None:
            return self.jitted(*args, **kwargs)
        arrays = jax.tree.leaves(eqx.filter(args, eqx.is_array))
        if name not in self.programs:
            path = folder / f"{self.function.__name__}-{name}{SUFFIX}"
            self.prepare(*args)
            program = _read(path)
            if program is not None:
                with contextlib.suppress(jax.errors.JaxRuntimeError):
                    result = jax.block_until_ready(program(arrays))
                    self.programs[name] = program
                    return result
            self.programs[name] = self._compiled(path, args)
        return self.programs[name](arrays)

    def _compiled(self, path: Path, args: Any) -> _Program:
        """Trace and compile the program for these arguments, and store it if that takes long."""
        start, hits = time.perf_counter(), _hits.count
        arrays, static = eqx.partition(args, eqx.is_array)
        leaves, tree = jax.tree.flatten(arrays)
        result: list[Any] = []

        def program(*leaves: jax.Array) -> list[jax.Array]:
            function: Callable[..., Made] = self.function
            out = function(*eqx.combine(jax.tree.unflatten(tree, leaves), static))
            arrays, rest = eqx.partition(out, eqx.is_array)
            outputs, out_tree = jax.tree.flatten(arrays)
            result[:] = jax.tree.unflatten(out_tree, range(len(outputs))), rest
            return outputs

        program.__name__ = self.function.__name__
        made = _Program(jax.jit(program).lower(*leaves).compile(), *result)
        long = time.perf_counter() - start > LONG
        # XLA cannot store a program again that it has read from a file.
        if long and hits == _hits.count:
            _write(path, made, len(leaves))
        return made


_all: list[StoredJit] = []


class _Hits:
    """Count the programs that JAX reads from its own cache."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, event: str, **_: Any) -> None:
        self.count += event == "/jax/compilation_cache/cache_hits"


_hits = _Hits()
jax.monitoring.register_event_listener(_hits)


def forget_programs() -> None:
    """Drop the programs in memory that were kept in files; the files stay."""
    for one in _all:
        one.programs.clear()


def _folder() -> Path | None:
    """Return the folder of the compilation cache; None without one on this machine, or for programs that
    are not to be kept."""
    folder = _setting("compilation_cache_dir")
    if not folder or "://" in folder or not _setting("enable_compilation_cache"):
        return None
    return None if any(map(_setting, CHECKS)) else Path(folder)


def _setting(name: str) -> Any:
    return getattr(jax.config, f"jax_{name}")


def _name(function: Callable[..., Any], args: Any) -> str | None:
    """Return the name of the program of a function for these arguments.

    None: for traced arguments, parts of other packages, or arrays on several devices."""
    if not is_known(args) or not _is_of_package(function.__module__):
        return None
    usual, (leaves, tree) = {jax.devices()[0]}, jax.tree.flatten(args)
    if any(isinstance(leaf, jax.Array) and leaf.devices() != usual for leaf in leaves):
        return None
    # The types tell 1 from 1.0 and True, which are equal.
    described = tuple(_described(leaf) if eqx.is_array(leaf) else _Other(type(leaf), leaf) for leaf in leaves)
    arguments = function, tree, described, _surroundings() + repr(list(_settings())).encode()
    try:
        return _digest(*arguments)
    except TypeError:
        # A part of the arguments has no hash.
        return _digest.__wrapped__(*arguments)


@functools.lru_cache(maxsize=KEPT)
def _digest(
    function: Callable[..., Any], tree: jax.tree_util.PyTreeDef, described: tuple[Any, ...], around: bytes
) -> str | None:
    """Return the name of a program with what is `around` it; None if the code of an argument may change
    unnoticed."""
    text = io.BytesIO()
    leaves = [leaf.value if isinstance(leaf, _Other) else leaf for leaf in described]
    try:
        known = function.__module__, function.__qualname__, jax.tree.unflatten(tree, leaves)
        _Pickler(text).dump(known)
    except (pickle.PicklingError, TypeError, AttributeError, ValueError, RecursionError):
        return None
    return hashlib.sha256(around + text.getvalue()).hexdigest()


def _is_of_package(module: str) -> bool:
    """Return whether the name of a program tells the code of a module."""
    return module.partition(".")[0] in KNOWN


def _described(array: jax.Array | np.ndarray) -> _Array:
    return _Array(array.shape, str(array.dtype), getattr(array, "weak_type", False))


class _Pickler(pickle.Pickler):
    """Describe arguments: equal ones in equal words, and none whose code may change unnoticed."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file, protocol=5)
        # Without this, equal objects are told as the same or as two, depending on how they came about.
        self.fast = True

    def reducer_override(self, value: Any) -> Any:
        module = getattr(value, "__module__", None) or type(value).__module__
        if not _is_of_package(module):
            raise pickle.PicklingError(f"{value!r} comes from {module}")
        return NotImplemented


def _settings() -> Iterator[tuple[str, str]]:
    for name in sorted(jax.config.values):
        if not any(word in name for word in OTHER):
            yield name, repr(getattr(jax.config, name, None))


@functools.cache
def _surroundings() -> bytes:
    """Return a digest of sources, versions, flags of XLA, and the processor."""
    text = hashlib.sha256(_sources)
    for package in PACKAGES:
        try:
            version = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            version = ""
        text.update(f"{package} {version} ".encode())
    device = jax.devices()[0]
    known = (platform.python_version(), platform.machine(), device.platform, device.device_kind)
    text.update(repr((known, len(jax.devices()), os.environ.get("XLA_FLAGS"))).encode())
    if PROCESSOR.exists():
        text.update("".join(sorted(_abilities())).encode())
    return text.digest()


def _abilities() -> set[str]:
    """Return the distinct lines of the processors' models and abilities."""
    lines = PROCESSOR.read_text(errors="replace").splitlines()
    return {line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))}


def _digest_of_sources() -> bytes:
    """Return a digest of the sources of this package."""
    root, text = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        text.update(f"{path.relative_to(root)} ".encode() + path.read_bytes())
    return text.digest()


# At the time of the import, when the other modules are read too.
_sources = _digest_of_sources()


def _read(path: Path) -> _Program | None:
    """Read a program; None if there is no file, or one that cannot be used."""
    try:
        executable, inputs, places, rest = pickle.loads(zlib.decompress(path.read_bytes()))
        ins = jax.tree.structure(((0,) * inputs, {}))
        outs = jax.tree.structure([0] * len(jax.tree.leaves(places)))
        compiled = serialize_executable.deserialize_and_load(
            executable, ins, outs, execution_devices=jax.devices()[:1]
        )
        os.utime(path)
    except Exception:
        # If anything is wrong with the file, or if there is none, the program is compiled and stored.
        return None
    return _Program(compiled, places, rest)


def _write(path: Path, program: _Program, inputs: int) -> None:
    """Store a program, unless it cannot be told or there is no space; drop the files not used for longest."""
    try:
        executable = serialize_executable.serialize(program.compiled)[0]
        content = pickle.dumps((executable, inputs, program.places, program.rest))
    except (ValueError, TypeError, AttributeError, pickle.PicklingError, jax.errors.JaxRuntimeError):
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A folder of its own, because several processes may write the same program.
        with tempfile.TemporaryDirectory(dir=path.parent) as place:
            begun = Path(place, path.name)
            begun.write_bytes(zlib.compress(content, 1))
            os.replace(begun, path)
        files = sorted(path.parent.glob(f"*{SUFFIX}"), key=lambda file: file.stat().st_mtime)
        for old in files[:-KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return
