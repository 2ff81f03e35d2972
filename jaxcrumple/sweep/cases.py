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
        with blamed(self.name):
            if isinstance(self.scene, RunConfig):
                return self.scene.build()
            setup = self.scene(**self.arguments)
            if not isinstance(setup, Setup):
                raise ValueError(f"the scene's function must return a jaxcrumple.Setup, not {setup!r}.")
            return setup

    @property
    def name(self) -> str:
        """The case in words, e.g. "thickness=0.0001,yield_curvature=200"."""
        return named(self.values)


@contextmanager
def blamed(name: str) -> Iterator[None]:
    """Say of a ValueError raised inside which case it is of."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def named(values: Mapping[str, Any]) -> str:
    """Names and values in words."""
    return ",".join(f"{key}={value}" for key, value in values.items())


def checked_grid(over: Mapping[str, Iterable[Any]], settings: Mapping[str, Any]) -> Grid:
    """Values by name as lists.

    **Raises:** ValueError for no name, one that is among the `settings` as well, no value, one given twice,
    or what is neither a number nor a word.
    """
    if not over:
        raise ValueError("over = {} names nothing to vary; give e.g. over={'thickness': [1e-4, 2e-4]}.")
    found = {key: np.asarray(values, object).ravel().tolist() for key, values in over.items()}
    for key, values in found.items():
        if key in settings:
            raise ValueError(f"{key!r} is given in over and in settings; leave one out.")
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
    return found


def product(grid_: Grid) -> list[dict[str, Any]]:
    """All combinations of a grid, the last name's values in turn first."""
    return [dict(zip(grid_, values, strict=True)) for values in itertools.product(*grid_.values())]


def grid(
    scene: str,
    over: Mapping[str, Iterable[Any]],
    settings: Mapping[str, Any] | None = None,
    *,
    t_end: float | None = None,
) -> dict[str, RunConfig]:
    """Configurations of a named scene for every combination of some of its numbers, by name, for `campaign`.

    **Arguments:** `over`: values by name, of any option of scene, material or solver, `frames`, `nodes` and
    `seed`; `settings`: what all have in common; `t_end` in s, by default the scene's own.

    **Raises:** ValueError for an unknown name or an impossible value.
    """
    combinations = product(checked_grid(over, settings or {}))
    return {
        named(values): _configured(scene, {**(settings or {}), **values}, t_end) for values in combinations
    }


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
    """The cases of a sweep; `linear`: the linear solver of those that do not say which.

    **Raises:** ValueError for an impossible value, or a solver that is given beside a scene's name.
    """
    combinations = product(grid)
    if not isinstance(scene, str):
        solver = integrator(linear=linear) if solver is None else solver
        return [Case(values, scene, {**settings, **values}, solver) for values in combinations]
    if solver is not None:
        raise ValueError("a named scene has rtol, scheme and linear among its settings; leave solver out.")
    cases = []
    for values in combinations:
        with blamed(named(values)):
            config = _configured(scene, {"linear": linear, **settings, **values}, t_end)
        cases.append(Case(values, config, {}, config.solver.build()))
    return cases
