"""Scenes from functions of the user, named "module:function" or "file.py:function"."""

import importlib
import importlib.util
import inspect
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, create_model

from jaxcrumple.material.material import Material
from jaxcrumple.options.suggest import nearest
from jaxcrumple.options.units import si_of_any
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.scenes.catalogue import SCENES, SceneEntry
from jaxcrumple.scenes.options import GIVEN, option_fields
from jaxcrumple.scenes.setup import Setup


def scene_entry(name: Any) -> SceneEntry:
    """Return the entry of a scene by its name in the catalogue, or of a function "module:function".

    A module is looked up as Python does, and in the working directory; "file.py:function" names a file.

    **Raises:** `ConfigError` for an unknown scene, module or function, or a function of another signature.
    """
    if isinstance(name, str) and name in SCENES:
        return SCENES[name]
    if is_function(name):
        return _entry_of(_function(name), name)
    if isinstance(name, str) and name.endswith(".py"):
        raise ConfigError(f"scene {name!r} names a file: name a function in it, {name}:FUNCTION.", ("scene",))
    known = nearest(str(name), SCENES) if isinstance(name, str) else f"; give one of {', '.join(SCENES)}."
    raise ConfigError(f"scene {name!r} is unknown{known}", ("scene",))


def is_function(name: Any) -> bool:
    """Return whether the name of a scene names a function of the user."""
    return isinstance(name, str) and ":" in name


def absolute(name: str) -> str:
    """Return the name with the absolute path of its file, so that it holds in any working directory."""
    if not is_function(name):
        return name
    place, _, function = name.rpartition(":")
    return f"{Path(place).resolve()}:{function}" if place.endswith(".py") else name


def _function(name: str) -> Callable[..., Setup]:
    place, _, attribute = name.rpartition(":")
    with _users_code(name):
        module = _from_file(Path(place)) if place.endswith(".py") else _imported(place)
    function = getattr(module, attribute, None)
    if not callable(function):
        functions = [key for key, value in vars(module).items() if inspect.isfunction(value)]
        raise ConfigError(
            f"scene {name!r}: {place} has no function {attribute!r}{nearest(attribute, functions)}"
        )
    return function


@contextmanager
def _users_code(name: str) -> Iterator[None]:
    """Tell an error in the user's own code from one of this package.

    **Raises:** `ConfigError` with file and line of the user's code.
    """
    try:
        yield
    except Exception as error:
        if not (place := _users_line(error)):
            raise
        raise ConfigError(f"scene {name!r}: {place}: {type(error).__name__}: {error}", ("scene",)) from error


def _users_line(error: Exception) -> str:
    """Return file and line of the user's code that raised an error, or that called a library which did; empty
    if it called this package."""
    standard = {sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib")}
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        name, file = str(frame.f_globals.get("__name__")), frame.f_code.co_filename
        if name.partition(".")[0] == "jaxcrumple":
            return ""
        library = {"site-packages", "dist-packages"} & set(Path(file).parts)
        if Path(file).is_file() and not library and not any(map(Path(file).is_relative_to, standard)):
            return f"{file}, line {line}"
    return ""


def _imported(name: str) -> ModuleType:
    here = str(Path.cwd())
    # As `python -m` does; workers and later imports of the same module need it too.
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise
        raise ConfigError(
            f"scene: there is no module {name!r} in {here} or on Python's path; give MODULE:FUNCTION or "
            "FILE.py:FUNCTION.",
            ("scene",),
        ) from error


def _from_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise ConfigError(f"scene: there is no file {str(path)!r}; give FILE.py:FUNCTION.", ("scene",))
    name, folder = str(path.resolve()), str(path.resolve().parent)
    # As `python FILE.py` does.
    if folder not in sys.path:
        sys.path.insert(0, folder)
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


def _entry_of(function: Callable[..., Setup], name: str) -> SceneEntry:
    """Return the entry of a function; its keyword parameters with their annotations are the options."""
    parameters = inspect.signature(function).parameters
    missing = [given for given in GIVEN if given not in parameters]
    kinds = {parameter.kind for parameter in parameters.values()}
    if missing or inspect.Parameter.VAR_KEYWORD in kinds or inspect.Parameter.VAR_POSITIONAL in kinds:
        raise ConfigError(
            f"scene {name!r} must be a function of nodes, seed and material, and of its options by name: "
            "def scene(nodes, seed, *, material, width=0.1) -> Setup.",
            ("scene",),
        )
    options = option_fields({key: _with_unit(parameter) for key, parameter in parameters.items()})
    model = create_model(f"Options of {name}", __base__=_FunctionOptions, **options)
    summary = (inspect.getdoc(function) or "scene of the user").splitlines()[0].rstrip(".")
    material = parameters["material"].default
    own = material if isinstance(material, Material) else None
    return SceneEntry(_checked(function, name), model, _no_end, summary, own=True, material=own)


class _FunctionOptions(BaseModel):
    """Base of the options of a function: unknown names are errors; values of any type are kept."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


def _with_unit(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return an option whose type is stated; a number may carry a unit of any dimension."""
    kind = parameter.annotation
    if kind is parameter.empty:
        kind = float if isinstance(parameter.default, float) else Any
    if kind in (float, "float"):
        kind = Annotated[float, BeforeValidator(si_of_any)]
    return parameter.replace(annotation=kind)


def _checked(function: Callable[..., Setup], name: str) -> Callable[..., Setup]:
    def build(nodes: int, seed: int, **options: Any) -> Setup:
        with _users_code(name):
            setup = function(nodes=nodes, seed=seed, **options)
        if not isinstance(setup, Setup):
            raise ConfigError(f"scene {name!r} must return a jaxcrumple.Setup, not {type(setup).__name__}.")
        return setup

    return build


def _no_end(options: Mapping[str, Any]) -> float:
    """Say that the end time of a function is that of its `Setup`."""
    raise ConfigError("t_end is missing: give it, or return a Setup with t_end.", ("t_end",))
