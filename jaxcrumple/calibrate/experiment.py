"""What is run at trial parameters: checked before it runs, and told from others."""

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from jaxcrumple.io.sketch import alike, sketch
from jaxcrumple.replay import Replay
from jaxcrumple.scene import Scene
from jaxcrumple.simulate import checked_times
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State

Values = dict[str, Any]


class Experiment(NamedTuple):
    """What is run at trial parameters.

    - `setup`: `setup(values)` -> (scene, state) for values by name, which JAX may trace: build the scene by
      `Setup.made_of`, by `sheet(..., like=)`, or by `eqx.tree_at` from one with plain numbers.
    - `times`: frame times in s.
    - `residuals`: `residuals(frames)` -> (m,), for frames as in `Replay`: what is measured less what was
      observed, over its uncertainty.
    """

    setup: Callable[[Values], tuple[Scene, State]]
    times: ArrayLike
    residuals: Callable[[Replay], Array]

    def start(self, values: Values) -> tuple[Scene, State]:
        """Scene and state at values of the parameters.

        **Raises:** ValueError for a parameter that is none, or what is no scene with its state.
        """
        try:
            made = self.setup(values)
        except KeyError as error:
            if error.args[0] in values:
                raise
            raise ValueError(
                f"setup asks for {error}, which is none of the parameters: {', '.join(values)}."
            ) from error
        pair = isinstance(made, tuple) and len(made) == 2
        if not (pair and isinstance(made[0], Scene) and isinstance(made[1], State)):
            raise ValueError(
                f"setup must return a scene and a state, such as (setup.made_of(material), "
                f"initial_state(scene, x)), not {type(made).__name__}."
            )
        return made

    def at_start(self, values: Values) -> Array:
        """Residuals (m,) of a sheet that stays where it starts."""
        _, state = self.start(values)
        times = jnp.asarray(checked_times(self.times))
        x, v, p = (
            None if a is None else jnp.broadcast_to(a, (len(times), *a.shape))
            for a in (state.x, state.v, state.p)
        )
        assert x is not None and v is not None
        return self.residuals(Replay(times, x, v, p, jnp.zeros(())))


def count_residuals(experiment: Experiment, values: Values) -> int:
    """How many residuals there are, from a look at how they are computed.

    **Raises:** ValueError for what is no experiment, a setup or residuals that JAX cannot trace, or residuals
    of another shape.
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
            "setup or residuals make a plain number of one that JAX traces: build the scene by "
            f"Setup.made_of, sheet(..., like=) or eqx.tree_at, and compute with jax.numpy ({told})."
        ) from error
    shape = getattr(found, "shape", type(found).__name__)
    if not (isinstance(shape, tuple) and len(shape) == 1 and shape[0]):
        raise ValueError(f"residuals must return an array (m,) of at least one number, not {shape}.")
    return shape[0]


def fingerprint(experiment: Experiment, values: Values, solver: Integrator | None) -> dict[str, Any]:
    """What tells an experiment from others: its parts in words, each with some of its numbers."""
    return {
        "times": _sketch(checked_times(experiment.times)),
        "a solver": _sketch(solver),
        "a scene or start": _sketch(experiment.start(values)),
        "residuals": _sketch(experiment.at_start(values)),
    }


def difference(one: dict[str, Any], other: dict[str, Any]) -> str:
    """The first part in which fingerprints differ; empty where they are the same."""
    for name, (kind, numbers) in one.items():
        its_kind, its_numbers = other[name]
        if not (alike(numbers, its_numbers) and kind == its_kind):
            return name
    return ""


def _sketch(tree: Any) -> tuple[str, list[float]]:
    """What kind of tree it is, and a sketch of its numbers."""
    static = eqx.partition(tree, eqx.is_array)[1]
    return hashlib.sha256(eqx.tree_pformat(static).encode()).hexdigest(), sketch(tree)
