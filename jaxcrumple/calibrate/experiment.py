"""Define the experiment that a fit runs; check it before the first run, and compute its fingerprint."""

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxcrumple.io.sketch import alike, sketch
from jaxcrumple.replays.replay import Replay
from jaxcrumple.scene import Scene
from jaxcrumple.simulation import Times, checked_times
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State

Values = dict[str, Any]


class Experiment(NamedTuple):
    """Define a run that depends on parameters, and its residuals.

    - `setup`: `setup(values)` -> (scene, state), where `values` maps names to numbers that JAX may trace.
      Build the scene with `Setup.made_of` or `sheet(..., like=)`, or with `eqx.tree_at` from a scene of plain
      numbers.
    - `times`: frame times in s.
    - `residuals`: `residuals(frames)` -> (m,), with `frames` as in `Replay`: simulated value minus observed
      value, divided by the uncertainty.
    """

    setup: Callable[[Values], tuple[Scene, State]]
    times: Times
    residuals: Callable[[Replay], Float[Array, " residuals"]]

    def start(self, values: Values) -> tuple[Scene, State]:
        """Return the scene and the initial state at parameter `values`, by name.

        **Raises:** ValueError if `setup` asks for an unknown parameter, or does not return a scene and a
        state.
        """
        try:
            made = self.setup(values)
        except KeyError as error:
            if error.args[0] in values:
                raise
            raise ValueError(
                f"setup asks for {error}, which is not one of the parameters: {', '.join(values)}."
            ) from error
        pair = isinstance(made, tuple) and len(made) == 2
        if not (pair and isinstance(made[0], Scene) and isinstance(made[1], State)):
            raise ValueError(
                f"setup must return a scene and a state, such as (setup.made_of(material), "
                f"initial_state(scene, x)), not {type(made).__name__}."
            )
        return made

    def at_start(self, values: Values) -> Float[ArrayLike, " residuals"]:
        """Return the residuals (m,) at parameter `values` of a sheet that does not move from its start.

        It runs nothing, so it checks setup and residuals quickly.

        **Raises:** ValueError as `start`, or for times that do not increase.
        """
        _, state = self.start(values)
        times = jnp.asarray(checked_times(self.times))
        x, v, p = (
            None if a is None else jnp.broadcast_to(a, (len(times), *a.shape))
            for a in (state.x, state.v, state.p)
        )
        assert x is not None and v is not None
        return self.residuals(Replay(times, x, v, p, jnp.zeros(())))


def count_residuals(experiment: Experiment, values: Values) -> int:
    """Return the number of residuals, from a trace without a run.

    **Raises:** ValueError if `experiment` is no `Experiment`, if JAX cannot trace its setup or residuals, or
    if the residuals do not have the shape (m,).
    """
    if not isinstance(experiment, Experiment):
        raise ValueError(
            f"experiment must be an Experiment(setup, times, residuals), not {type(experiment).__name__}."
        )
    try:
        found = jax.eval_shape(experiment.at_start, values)
    except jax.errors.JAXTypeError as error:
        told = str(error).partition("\n")[0]
        raise ValueError(
            "setup or residuals convert a number that JAX traces to a plain number: build the scene with "
            f"Setup.made_of, sheet(..., like=) or eqx.tree_at, and compute with jax.numpy ({told})."
        ) from error
    shape = getattr(found, "shape", type(found).__name__)
    if not (isinstance(shape, tuple) and len(shape) == 1 and shape[0]):
        raise ValueError(f"residuals must return an array (m,) of at least one number, not {shape}.")
    return shape[0]


def fingerprint(experiment: Experiment, values: Values, solver: Integrator | None) -> dict[str, Any]:
    """Return a fingerprint of an experiment: for each named part a hash of its structure and some numbers."""
    return {
        "times": _sketch(checked_times(experiment.times)),
        "a solver": _sketch(solver),
        "a scene or start": _sketch(experiment.start(values)),
        "residuals": _sketch(experiment.at_start(values)),
    }


def difference(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Return the first part in which two fingerprints differ; empty if they agree."""
    for name, (kind, numbers) in one.items():
        its_kind, its_numbers = other[name]
        if not (alike(numbers, its_numbers) and kind == its_kind):
            return name
    return ""


def _sketch(tree: Any) -> tuple[str, list[float]]:
    """Return a hash of the static structure of a tree, and a sketch of its numbers."""
    static = eqx.partition(tree, eqx.is_array)[1]
    return hashlib.sha256(eqx.tree_pformat(static).encode()).hexdigest(), sketch(tree)
