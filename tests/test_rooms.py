"""The order of the house: a room imports only from rooms above it, and no modules import each other."""

import ast
import graphlib
import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

import jaxcrumple

PACKAGE = Path(jaxcrumple.__file__).parent
#: From the top down; the modules `__init__` and `__main__` may import all of them.
ROOMS = (
    "_jax", "options", "geometry", "mesh", "material", "model", "contact", "assembly", "scene", "history",
    "state", "system", "solvers", "replays", "observers", "simulation", "measure", "io", "scenes",
    "calibrate", "run", "sweeps", "dataset", "plot", "viewer", "paper", "cli",
)  # fmt: skip


def imports(package=PACKAGE):
    """The modules of the package that each of its modules imports while it is loaded or called."""
    files = {_name(package, path): path for path in package.rglob("*.py")}
    return {
        name: {found for found in _imported(path) if found in files} - {name} for name, path in files.items()
    }


def _name(package, path):
    return ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")


def _imported(path):
    for node in _at_run_time(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def _at_run_time(node):
    """All nodes but those that only a type checker reads."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    yield node
    for child in ast.iter_child_nodes(node):
        yield from _at_run_time(child)


def room(module):
    return module.split(".")[1]


MODULES = {name: found for name, found in imports().items() if name.count(".") and "__main__" not in name}


def test_every_room_has_its_place():
    assert {room(module) for module in MODULES} == set(ROOMS)


@pytest.mark.parametrize("name", ROOMS)
def test_a_room_imports_from_rooms_above_it(name):
    below = set(ROOMS[ROOMS.index(name) + 1 :])
    wrong = {
        (module, other)
        for module, others in MODULES.items()
        if room(module) == name
        for other in others
        if other.count(".") and room(other) in below
    }
    assert wrong == set()


def test_no_modules_import_each_other():
    # Each package is loaded before its modules, so only modules count.
    packages = {module for module in MODULES if (PACKAGE.parent / Path(*module.split("."))).is_dir()}
    graph = {name: others - packages for name, others in MODULES.items()}
    assert len(list(graphlib.TopologicalSorter(graph).static_order())) >= len(MODULES)


def test_a_wrong_import_is_found(tmp_path):
    package = tmp_path / "jaxcrumple"
    package.mkdir()
    (package / "scene.py").write_text("def f():\n    from jaxcrumple.state import g\n")
    (package / "state.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import jaxcrumple.scene\n"
    )
    assert imports(package) == {"jaxcrumple.scene": {"jaxcrumple.state"}, "jaxcrumple.state": set()}


def test_every_room_has_its_tests():
    """In a folder of its name; what concerns all rooms stands above."""
    rooms = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    tests = {path.parent.name for path in Path(__file__).parent.glob("*/test_*.py")}
    # The tangent's structure is tested by what is solved with it.
    assert rooms - tests == {"assembly"} and not tests - rooms


def test_no_module_hides_behind_a_function_of_its_name():
    """A package that imports `radial` from its module `radial` leaves no way to the module."""
    for name in MODULES:
        place, _, leaf = name.rpartition(".")
        importlib.import_module(name)
        assert isinstance(getattr(sys.modules[place], leaf), ModuleType), name
