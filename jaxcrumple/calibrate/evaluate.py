"""Runs at trial parameters: residuals from the run, their derivatives from its replay."""

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax import Array
from numpy.typing import ArrayLike

from jaxcrumple.model.scene import Scene
from jaxcrumple.replay import Record, Replay, replay
from jaxcrumple.simulate import simulate
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State

Values = dict[str, Any]


class Experiment(NamedTuple):
    """What is run at trial parameters.

    - `setup`: `setup(values)` -> (scene, state) for values by name, which JAX may trace: build the scene by
      `sheet(..., like=)`, or by `eqx.tree_at` from one with plain numbers.
    - `times`: frame times in s.
    - `residuals`: `residuals(frames)` -> (m,), for frames as in `Replay`: what is measured less what was
      observed, over its uncertainty.
    """

    setup: Callable[[Values], tuple[Scene, State]]
    times: ArrayLike
    residuals: Callable[[Replay], Array]


class Evaluations:
    """Evaluations of one experiment, each made once, and kept in a file as they come.

    **Raises:** ValueError for a file of another fit, or a place that is a folder.
    """

    def __init__(
        self,
        experiment: Experiment,
        decoded: Callable[[Any], Values],
        names: tuple[str, ...],
        solver: Integrator | None,
        path: Path | None,
        tell: Callable[[Mapping[str, Any]], None],
    ):
        self.experiment, self.decoded, self.names = experiment, decoded, names
        self.solver, self.path, self.tell = solver, path, tell
        self.rows: list[dict[str, Any]] = []
        self.known: dict[tuple[str, str], np.ndarray] = {}
        self.last: tuple[str, Record | None] = ("", None)
        self.failures: dict[str, str] = {}
        self._snaps: dict[str, int] = {}
        if path is not None:
            self._read(path)

    def residuals(self, u: np.ndarray) -> np.ndarray:
        """Residuals (m,) at encoded parameters; infinite where the run fails."""
        return self._once("residuals", u, self._run)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Derivatives (m, k) of the residuals by encoded parameters, in forward mode."""
        return self._once("jacobian", u, lambda u: _jacobian(self._recorded(u), jnp.asarray(u), self._frozen))

    def gradient(self, u: np.ndarray) -> np.ndarray:
        """Derivatives (k,) of half the sum of squares, in reverse mode."""
        return self._once("gradient", u, lambda u: _gradient(self._recorded(u), jnp.asarray(u), self._frozen))

    def trouble(self, u: np.ndarray) -> str:
        """In words, where and how the run at encoded parameters failed."""
        return f"the run at {self._told(u)} fails: {self.failures.get(_key(u), 'nothing else is known')}"

    def snaps(self, u: np.ndarray) -> int:
        """How many snaps the run at encoded parameters goes through."""
        return self._snaps[_key(u)]

    @property
    def history(self) -> pd.DataFrame:
        """A line for each evaluation: its kind, the parameters, half the sum of squares, how many snaps the
        run goes through, seconds."""
        return pd.DataFrame(self.rows, columns=["kind", *self.names, "loss", "snaps", "seconds"])

    def _run(self, u: np.ndarray) -> np.ndarray:
        scene, state = self.experiment.setup(self.decoded(u))
        solution = simulate(scene, state, self.experiment.times, solver=self.solver, record=True)
        self.last = (_key(u), solution.record)
        if solution.result != "success":
            reached = f"{solution.result} at t = {float(solution.state.t):.4g} s"
            self.failures[_key(u)] = f"{reached} ({solution.message})"
            return np.full(self._size, np.inf)
        x, v, p = (None if a is None else jnp.asarray(a) for a in (solution.x, solution.v, solution.p))
        assert x is not None and v is not None
        found = self.experiment.residuals(Replay(jnp.asarray(solution.t), x, v, p, jnp.zeros(())))
        return np.asarray(found)

    @property
    def _size(self) -> int:
        """Number of residuals, known from the first run that went well; one before."""
        sizes = [len(value) for (kind, _), value in self.known.items() if kind == "residuals"]
        return sizes[0] if sizes else 1

    def _recorded(self, u: np.ndarray) -> Record:
        if self.last[0] != _key(u):
            self._run(u)
        record = self.last[1]
        assert record is not None
        return record

    def _frozen(self, record: Record, u: Array) -> Array:
        scene, state = self.experiment.setup(self.decoded(u))
        return self.experiment.residuals(replay(scene, record, state, solve=False))

    def _once(self, kind: str, u: np.ndarray, evaluate: Callable[[np.ndarray], ArrayLike]) -> np.ndarray:
        known = self.known.get((kind, _key(u)))
        if known is not None:
            return known
        start = time.perf_counter()
        value = np.asarray(evaluate(np.asarray(u)))
        if kind != "residuals" and not np.all(np.isfinite(value)):
            raise ValueError(
                f"the run at {self._told(u)} has no derivatives: those of a step are not finite. "
                "Choose another start, or a smaller rtol."
            )
        record = self.last[1]
        snaps = 0 if record is None else int(np.sum(np.isfinite(record.snaps)))
        self._keep(kind, u, value, snaps, time.perf_counter() - start)
        if self.path is not None:
            line = {"kind": kind, "names": self.names, "u": list(u), "value": value.tolist(), "snaps": snaps}
            line["failure"] = self.failures.get(_key(u), "")
            with self.path.open("a") as file:
                file.write(json.dumps(line) + "\n")
        return value

    def _keep(self, kind: str, u: np.ndarray, value: np.ndarray, snaps: int, seconds: float) -> None:
        self.known[kind, _key(u)], self._snaps[_key(u)] = value, snaps
        loss = 0.5 * float(value @ value) if kind == "residuals" else np.nan
        values = {name: float(number) for name, number in self.decoded(u).items()}
        self.rows.append({"kind": kind, **values, "loss": loss, "snaps": snaps, "seconds": seconds})
        self.tell(self.rows[-1])

    def _told(self, u: np.ndarray) -> str:
        """The parameters in words."""
        return ", ".join(f"{name} = {float(value):.6g}" for name, value in self.decoded(u).items())

    def _read(self, path: Path) -> None:
        if path.is_dir():
            raise ValueError(f"{path} is a folder; a fit is kept in a file.")
        path.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_text() if path.exists() else ""
        # What follows the last end of a line is from a fit that was killed.
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            path.write_text(whole)
        try:
            lines = [json.loads(line) for line in whole.splitlines()]
        except ValueError as error:
            raise ValueError(f"{path} is no file of a fit ({error}); give another one.") from error
        for line in lines:
            if tuple(line["names"]) != self.names:
                raise ValueError(f"{path} holds a fit of {line['names']}; this one is of {list(self.names)}.")
            if line["failure"]:
                self.failures[_key(np.array(line["u"]))] = line["failure"]
            self._keep(line["kind"], np.array(line["u"]), np.array(line["value"]), line["snaps"], 0.0)


def _key(u: np.ndarray) -> str:
    return np.asarray(u, float).tobytes().hex()


@eqx.filter_jit
def _jacobian(record: Record, u: Array, residuals: Callable[[Record, Array], Array]) -> Array:
    return jax.jacfwd(lambda u: residuals(record, u))(u)


@eqx.filter_jit
def _gradient(record: Record, u: Array, residuals: Callable[[Record, Array], Array]) -> Array:
    return jax.grad(lambda u: 0.5 * jnp.sum(residuals(record, u) ** 2))(u)
