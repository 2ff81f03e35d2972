"""The cases of a sweep: what is asked for, as a grid, checked before any work."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from jaxcrumple.config import RunConfig, configure
from jaxcrumple.scenes import Setup
from jaxcrumple.solvers.scheme import Integrator, integrator

Scenes = str | Callable[..., Setup]
Grid = dict[str, list[Any]]


class Case(NamedTuple):
    """One member of a sweep: its `values` by name, the `scene`, a function of `arguments` or the
    configuration of a named one, and the `solver`."""

    values: dict[str, Any]
    scene: Callable[..., Setup] | RunConfig
    arguments: dict[str, Any]
    solver: Integrator

    def build(self) -> Setup:
        """Mesh, scene and start.

        **Raises:** ValueError that names the case.
        """
        with self.blamed():
            if isinstance(self.scene, RunConfig):
                return self.scene.build()
            setup = self.scene(**self.arguments)
            if not isinstance(setup, Setup):
                raise ValueError(f"the scene's function must return a jaxcrumple.Setup, not {setup!r}.")
            return setup

    @contextmanager
    def blamed(self) -> Iterator[None]:
        """Say of a ValueError raised inside whose it is."""
        try:
            yield
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from error

    @property
    def name(self) -> str:
        """The case in words, e.g. "thickness=0.0001,yield_curvature=200"."""
        return named(self.values)


def named(values: Mapping[str, Any]) -> str:
    """Names and values in words."""
    words = (
        f"{key}={value:g}" if isinstance(value, float) else f"{key}={value}" for key, value in values.items()
    )
    return ",".join(words)


def checked_grid(over: Mapping[str, Iterable[Any]]) -> Grid:
    """Values by name as lists.

    **Raises:** ValueError for no name, no value, one given twice, or what is neither a number nor a word.
    """
    grid = {key: list(np.asarray(values, object).ravel()) for key, values in over.items()}
    if not grid:
        raise ValueError("over = {} names nothing to vary; give e.g. over={'thickness': [1e-4, 2e-4]}.")
    for key, values in grid.items():
        if not values:
            raise ValueError(f"over[{key!r}] has no value; give at least one.")
        for value in values:
            if not (value is None or isinstance(value, str | int | float | np.number)):
                raise ValueError(
                    f"over[{key!r}] holds {value!r}; values must be numbers or words. Vary an index, and "
                    "look up what it stands for in the scene's function."
                )
        if len(set(values)) < len(values):
            raise ValueError(f"over[{key!r}] = {values} has a value twice; leave one out.")
    return grid


def product(grid: Grid) -> list[dict[str, Any]]:
    """All combinations of a grid, the last name's values in turn first."""
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]


def configured(scene: str, values: Mapping[str, Any], *, t_end: float | None = None) -> RunConfig:
    """Configuration of a named scene, with `nodes` and `seed` among the values of its options.

    **Raises:** `ConfigError` for an unknown name or an impossible value.
    """
    settings = dict(values)
    top = {key: settings.pop(key) for key in ("nodes", "seed") if key in settings}
    return configure(scene, t_end=t_end, settings=settings, **top)


def cases_of(
    scene: Scenes,
    over: Mapping[str, Iterable[Any]],
    settings: Mapping[str, Any],
    t_end: float,
    solver: Integrator | None,
    linear: str,
) -> list[Case]:
    """The cases of a sweep; `linear`: the linear solver of those that do not say which.

    **Raises:** ValueError for an impossible grid or value, and for what is given twice.
    """
    grid = checked_grid(over)
    twice = [key for key in grid if key in settings]
    if twice:
        raise ValueError(f"{twice[0]!r} is given in over and in settings; leave one out.")
    combinations = product(grid)
    if not isinstance(scene, str):
        solver = integrator(linear=linear) if solver is None else solver
        return [Case(values, scene, {**settings, **values}, solver) for values in combinations]
    if solver is not None:
        raise ValueError(
            "a named scene has its solver in settings, e.g. settings={'rtol': 1e-3}; leave solver out."
        )
    cases = []
    for values in combinations:
        config = configured(scene, {"linear": linear, **settings, **values}, t_end=t_end)
        cases.append(Case(values, config, {}, config.solver.build()))
    return cases
