"""Build the cases of a sweep from a grid, and check them before any run."""

import inspect
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from jaxcrumple._jax.memory import require
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.run.config import RunConfig, configure
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.solvers.scheme import Integrator, integrator

Scenes = str | Callable[..., Setup]
Grid = dict[str, list[Any]]
# Bytes of a case: values, configuration and solver.
CASE = 2e4


class Limits(NamedTuple):
    """Limits of a case: step attempts, and wall time in s; infinite without a limit."""

    attempts: float
    seconds: float


class Case(NamedTuple):
    """One case of a sweep: its `values` by name, the `scene` (a function of `arguments`, or the configuration
    of a named scene), and the `solver`."""

    values: dict[str, Any]
    scene: Callable[..., Setup] | RunConfig
    arguments: dict[str, Any]
    solver: Integrator

    def build(self) -> Setup:
        """Build mesh, scene and start.

        **Raises:** ValueError that names the case.
        """
        with blamed(self.name):
            if isinstance(self.scene, RunConfig):
                return self.scene.build()
            setup = self.scene(**self.arguments)
            if not isinstance(setup, Setup):
                raise ValueError(
                    f"the scene's function must return a jaxcrumple.Setup, not {type(setup).__name__}."
                )
            return setup

    @property
    def name(self) -> str:
        """The case as text, e.g. "thickness=0.0001,yield_curvature=200"."""
        return named(self.values)


@contextmanager
def blamed(name: str) -> Iterator[None]:
    """Prefix the message of a ValueError raised inside with the name of the case."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def named(values: Mapping[str, Any]) -> str:
    """Format names and values as text."""
    return ",".join(f"{key}={'none' if value is None else value}" for key, value in values.items())


# Seeds of the random meshes: how many, from 0 on, or which ones.
Seeds = Any


def with_seeds(over: Mapping[str, Iterable[Any]], seeds: Seeds) -> Mapping[str, Iterable[Any]]:
    """Return a grid that also varies the seed, over `seeds`.

    **Raises:** ValueError for a number of seeds below 1, or seeds that are in `over`, too.
    """
    if seeds is None or not isinstance(over, Mapping):
        return over
    if "seed" in over:
        raise ValueError("the seed is given in over and by seeds; leave one out.")
    if isinstance(seeds, Iterable):
        return {**over, "seed": seeds}
    if not isinstance(seeds, int | np.integer) or isinstance(seeds, bool) or seeds < 1:
        raise ValueError(f"seeds = {seeds!r} must be a number of seeds, at least 1, or a list of them.")
    return {**over, "seed": range(seeds)}


def checked_grid(over: Mapping[str, Iterable[Any]], settings: Mapping[str, Any], seeds: Seeds = None) -> Grid:
    """Return the values of each name as a list.

    **Raises:** ValueError for a grid without names, a name that is also in `settings`, a name without values,
    a repeated value, or a value that is neither a number nor a word.
    """
    over = with_seeds(over, seeds)
    for name, given in (("over", over), ("settings", settings)):
        if not isinstance(given, Mapping):
            raise ValueError(f"{name} must be a dictionary by name, not {type(given).__name__}.")
    if not over:
        raise ValueError("over = {} names nothing to vary; give e.g. over={'thickness': [1e-4, 2e-4]}.")
    found = {key: _listed(values) for key, values in over.items()}
    for key, values in found.items():
        if key in settings:
            raise ValueError(f"{key!r} is given in over and in settings; leave one out.")
        if not values:
            raise ValueError(f"over[{key!r}] has no value; give at least one.")
        for value in values:
            if not (value is None or isinstance(value, str | int | float)) or value != value:
                raise ValueError(
                    f"over[{key!r}] holds {value!r}; values must be numbers or words. Vary an index, and "
                    "let the scene's function look up its meaning."
                )
        if len(set(values)) < len(values):
            raise ValueError(f"over[{key!r}] = {values} has a value twice; leave one out.")
    count = math.prod(map(len, found.values()))
    require(CASE * count, f"a grid of {count:.3g} cases", "give fewer values to vary")
    return found


def _listed(values: Any) -> list[Any]:
    """Convert one value, several values or an array to a list of Python numbers."""
    if hasattr(values, "ndim"):
        return np.atleast_1d(np.asarray(values)).tolist()
    several = isinstance(values, Iterable) and not isinstance(values, str)
    found = list(values) if several else [values]
    return [value.tolist() if hasattr(value, "ndim") else value for value in found]


def product(grid_: Grid) -> list[dict[str, Any]]:
    """Return all combinations of a grid; the last name varies fastest."""
    return [dict(zip(grid_, values, strict=True)) for values in itertools.product(*grid_.values())]


def grid(
    scene: str,
    over: Mapping[str, Iterable[Any]],
    settings: Mapping[str, Any] | None = None,
    *,
    seeds: Seeds = None,
    t_end: float | None = None,
) -> dict[str, RunConfig]:
    """Configure a named scene for every combination of option values; return configurations for `campaign`.

    **Arguments:** `over`: lists of values by name, of any option of scene, material or solver, of `frames`,
    `nodes` and `seed`; `settings`: common values of all runs; `seeds`: number of seeds, from 0 on, or a list
    of them; `t_end`: end time in s, by default that of the scene.

    **Raises:** ValueError for an unknown name or an impossible value.

    >>> runs = jc.grid("radial", {"thickness": ["0.1 mm", "0.2 mm"]}, {"nodes": 100}, seeds=2)
    >>> len(runs), next(iter(runs))
    (4, 'thickness=0.1 mm,seed=0')
    """
    if not isinstance(scene, str):
        raise ValueError(
            f"scene must be the name of a scene, not {type(scene).__name__}; `sweep` accepts functions."
        )
    settings = {} if settings is None else settings
    combinations = product(checked_grid(over, settings, seeds))
    configs = _configurations(scene, combinations, settings, t_end)
    return {named(values): config for values, config in zip(combinations, configs, strict=True)}


def _configurations(
    scene: str, combinations: list[dict[str, Any]], settings: Mapping[str, Any], t_end: float | None
) -> list[RunConfig]:
    """Configure all combinations of a named scene.

    **Raises:** ConfigError, which names the case unless the common settings cause the error.
    """
    try:
        _configured(scene, settings, t_end)
        common = ""
    except ConfigError as error:
        common = str(error)
    configs = []
    for values in combinations:
        try:
            configs.append(_configured(scene, {**settings, **values}, t_end))
        except ConfigError as error:
            raise error if str(error) == common else ConfigError(f"{named(values)}: {error}") from error
    return configs


def _configured(scene: str, values: Mapping[str, Any], t_end: float | None) -> RunConfig:
    settings = dict(values)
    top = {key: settings.pop(key) for key in ("nodes", "seed") if key in settings}
    return configure(scene, t_end=t_end, settings=settings, **top)


def cases_of(
    scene: Scenes,
    grid: Grid,
    settings: Mapping[str, Any],
    t_end: float,
    solver: Integrator | None,
    linear: str,
) -> list[Case]:
    """Build the cases of a sweep; `linear`: linear solver of cases that do not specify one.

    **Raises:** ValueError for an impossible value, an invalid scene, or a solver given with a named scene.
    """
    combinations = product(grid)
    if not isinstance(scene, str):
        solver = integrator(linear=linear) if solver is None else solver
        cases = [Case(values, scene, {**settings, **values}, solver) for values in combinations]
        _check_callable(scene, cases[0].arguments)
        return cases
    if solver is not None:
        raise ValueError("a named scene takes rtol, scheme and linear from settings; leave solver out.")
    if "frames" in grid or "frames" in settings:
        raise ConfigError("only campaigns save frames; a sweep measures at its times, so leave frames out.")
    configs = _configurations(scene, combinations, {"linear": linear, **settings}, t_end)
    solvers = {options: options.build() for options in {config.solver for config in configs}}
    return [
        Case(values, config, {}, solvers[config.solver])
        for values, config in zip(combinations, configs, strict=True)
    ]


def _check_callable(scene: Any, arguments: Mapping[str, Any]) -> None:
    """Refuse an object that cannot be called with the arguments of a case."""
    if not callable(scene):
        raise ValueError(
            f"scene must be a scene's name or a function that returns a Setup, not {type(scene).__name__}."
        )
    try:
        inspect.signature(scene).bind(**arguments)
    except TypeError as error:
        raise ValueError(
            f"the scene's function takes other arguments than {', '.join(arguments)}, the names in over and "
            f"settings: {error}."
        ) from error
