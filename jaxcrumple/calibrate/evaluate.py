"""Evaluate runs at trial parameters: residuals from the run, derivatives from its replay."""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, ArrayLike, Float

from jaxcrumple.calibrate.experiment import Experiment, Values, count_residuals, difference, fingerprint
from jaxcrumple.io.atomic import refusal, write_bytes
from jaxcrumple.replays.record import Record
from jaxcrumple.replays.replay import Replay, replay
from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.scheme import Integrator

# Result of a run that ended at its budget. The file does not store it: a larger budget may continue the run.
BUDGET = "budget"

# A trial within NEAR of the last one in all encoded parameters, whose residuals differ by more than TELLING
# in all, contradicts derivatives that are wrong by more than the share WRONG of the larger change.
NEAR, TELLING, WRONG = 0.1, 0.1, 0.7

_Residuals = Callable[[Record, Float[Array, " parameters"]], Float[Array, " residuals"]]


class Evaluations:
    """Evaluate experiments, each point once, and append every evaluation to a file.

    The first line of the file identifies the fit; each further line holds one evaluation.

    **Raises:** ValueError if an experiment cannot be evaluated, if the file belongs to another fit or is no
    file of a fit, or if the path is a folder.
    """

    def __init__(
        self,
        experiments: Sequence[Experiment],
        decoded: Callable[[Any], Values],
        start: Float[np.ndarray, " parameters"],
        scales: Mapping[str, bool],
        solver: Integrator | None,
        max_attempts: int | None,
        path: Path | None,
        tell: Callable[[Mapping[str, Any]], None],
    ):
        self.experiments, self.decoded, self.scales = experiments, decoded, dict(scales)
        self.solver, self.max_attempts, self.path, self.tell = solver, max_attempts, path, tell
        self.size = sum(count_residuals(own, decoded(start)) for own in experiments)
        # Functions of a record and parameters; programs are compiled once for each.
        self.frozen = [_Frozen(own, decoded) for own in experiments]
        self.rows: list[dict[str, Any]] = []
        self.told: set[tuple[str, str]] = set()
        self.known: dict[tuple[str, str], Float[np.ndarray, " ..."]] = {}
        self.last: tuple[str, list[Record]] = ("", [])
        self.failures: dict[str, str] = {}
        self._snaps: dict[str, int] = {}
        if path is not None:
            self._open(path, start)

    def residuals(self, u: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " residuals"]:
        """Return the residuals (m,) at encoded parameters; all are infinite if the run fails."""
        return self._once("residuals", u, self._run)

    def jacobian(self, u: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, "residuals parameters"]:
        """Return the Jacobian (m, k) of the residuals with respect to encoded parameters, in forward mode."""
        return self._once("jacobian", u, lambda u: np.concatenate(self._derivatives(_jacobian, u)))

    def gradient(self, u: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"]:
        """Return the gradient (k,) of half the sum of squares, in reverse mode."""
        return self._once("gradient", u, lambda u: np.sum(self._derivatives(_gradient, u), axis=0))

    def trouble(self, u: Float[np.ndarray, " parameters"]) -> str:
        """Describe where and how the run at encoded parameters failed."""
        return f"the run at {self._told(u)} fails: {self.failures[_key(u)]}"

    def nearest_failure(self, u: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"] | None:
        """Return the encoded parameters of the failed run nearest to `u`; None if no run failed."""
        failed = [np.frombuffer(bytes.fromhex(key)) for key in self.failures]
        return min(failed, key=lambda other: float(np.linalg.norm(other - u)), default=None)

    def snaps(self, u: Float[np.ndarray, " parameters"]) -> int:
        """Return the number of snaps in the runs at encoded parameters."""
        return self._snaps[_key(u)]

    def contradiction(self, u: Float[np.ndarray, " parameters"]) -> str:
        """Tell whether the Jacobian at encoded parameters contradicts the nearest other run; else return "".

        Runs nearer than `TELLING` standard deviations in all residuals tell nothing, and runs beyond `NEAR`
        may differ because the residuals are not linear.
        """
        key, jacobian = _key(u), self.known.get(("jacobian", _key(u)))
        if jacobian is None:
            return ""
        away = []
        for kind, other in self.known:
            step = np.frombuffer(bytes.fromhex(other)) - u
            if kind != "residuals" or other == key or other in self.failures or np.abs(step).max() > NEAR:
                continue
            changes = self.known[kind, other] - self.known[kind, key], jacobian @ step
            sizes = [float(np.linalg.norm(change)) for change in changes]
            if max(sizes) > TELLING:
                error = float(np.linalg.norm(changes[0] - changes[1])) / max(sizes)
                away.append((float(np.linalg.norm(step)), error, *sizes))
        if not away or min(away)[1] < WRONG:
            return ""
        _, _, seen, expected = min(away)
        return (
            f"the derivatives of the run at {self._told(u)} contradict its neighbour: the residuals changed "
            f"by {seen:.2g}, where the derivatives give {expected:.2g}. The standard deviations mean nothing "
            "then. Runs that snap, or too loose an rtol, make the residuals rough: take a smaller rtol, or "
            "differences of runs far apart."
        )

    @property
    def history(self) -> pd.DataFrame:
        """One row for each requested evaluation: kind, parameters, half the sum of squares, number of snaps,
        seconds."""
        return pd.DataFrame(self.rows, columns=["kind", *self.scales, "loss", "snaps", "seconds"])

    def _run(self, u: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " residuals"]:
        """Return the residuals (m,). If the run fails, record the cause and return infinite residuals."""
        self.last = (_key(u), [])
        found, failure = np.empty(0), ""
        try:
            for own in self.experiments:
                residuals, failure = self._residuals(own, u)
                found = np.append(found, residuals)
                if failure:
                    break
        except ValueError as error:
            failure = str(error).rstrip(".")
        except Exception as error:
            error.add_note(f"in the run at {self._told(u)}")
            raise
        if not failure and not np.all(np.isfinite(found)):
            failure = "its residuals are not finite"
        if failure:
            self.failures[_key(u)] = failure
            return np.full(self.size, np.inf)
        return found

    def _residuals(
        self, experiment: Experiment, u: Float[np.ndarray, " parameters"]
    ) -> tuple[Float[np.ndarray, " residuals"], str]:
        """Return the residuals (m,) and an empty text, or no residuals and the cause of the failure."""
        scene, state = experiment.start(self.decoded(u))
        times, attempts = experiment.times, self.max_attempts
        solution = simulate(scene, state, times, solver=self.solver, max_attempts=attempts, record=True)
        if solution.result != "success":
            reached = f"{solution.result} at t = {float(solution.state.t):.4g} s"
            over = f"its max_attempts = {attempts} are used up"
            return np.empty(0), f"{reached} ({over if solution.result == BUDGET else solution.message})"
        x, v, p = (None if a is None else jnp.asarray(a) for a in (solution.x, solution.v, solution.p))
        assert x is not None and v is not None and solution.record is not None
        self.last[1].append(solution.record)
        found = experiment.residuals(Replay(jnp.asarray(solution.t), x, v, p, jnp.zeros(())))
        return np.asarray(found), ""

    def _derivatives(
        self, derivative: Callable[..., Float[Array, " ..."]], u: Float[np.ndarray, " parameters"]
    ) -> list[Float[np.ndarray, " ..."]]:
        """Return the `derivative` of the residuals of each experiment at encoded parameters."""
        if self.last[0] != _key(u):
            self._run(u)
        pairs = zip(self.last[1], self.frozen, strict=True)
        return [np.asarray(derivative(record, jnp.asarray(u), frozen)) for record, frozen in pairs]

    def _once(
        self,
        kind: str,
        u: Float[np.ndarray, " parameters"],
        evaluate: Callable[[Float[np.ndarray, " parameters"]], Float[ArrayLike, " ..."]],
    ) -> Float[np.ndarray, " ..."]:
        known = self.known.get((kind, _key(u)))
        if known is not None:
            self._tell(kind, u, known, 0.0)
            return known
        start = time.perf_counter()
        value = np.asarray(evaluate(np.asarray(u)))
        if kind != "residuals" and not np.all(np.isfinite(value)):
            raise ValueError(
                f"the run at {self._told(u)} has no derivatives: the derivatives of a step are not finite. "
                "Choose another start, or a smaller rtol."
            )
        snaps = sum(int(np.sum(np.isfinite(record.snaps))) for record in self.last[1])
        self.known[kind, _key(u)], self._snaps[_key(u)] = value, snaps
        self._tell(kind, u, value, time.perf_counter() - start)
        if self.path is not None and not self.failures.get(_key(u), "").startswith(BUDGET):
            line = {"kind": kind, "u": list(u), "value": value.tolist(), "snaps": snaps}
            line["failure"] = self.failures.get(_key(u), "")
            with self.path.open("a") as file:
                file.write(_sealed(line))
        return value

    def _fingerprint(self, u: Float[np.ndarray, " parameters"]) -> dict[str, Any]:
        """Return the fingerprint of all experiments at encoded parameters."""
        values, found = self.decoded(u), {}
        for index, own in enumerate(self.experiments):
            suffix = f" of experiment {index}" if index else ""
            for name, part in fingerprint(own, values, self.solver).items():
                found[name + suffix] = part
        return found

    def _tell(
        self, kind: str, u: Float[np.ndarray, " parameters"], value: Float[np.ndarray, " ..."], seconds: float
    ) -> None:
        """Add an evaluation to the history unless it is already there."""
        if (kind, _key(u)) in self.told:
            return
        self.told.add((kind, _key(u)))
        loss = 0.5 * float(value @ value) if kind == "residuals" else np.nan
        values = {name: float(number) for name, number in self.decoded(u).items()}
        spent = {"loss": loss, "snaps": self._snaps[_key(u)], "seconds": seconds}
        self.rows.append({"kind": kind, **values, **spent})
        self.tell(self.rows[-1])

    def _told(self, u: Float[np.ndarray, " parameters"]) -> str:
        """Format the parameters as text."""
        return ", ".join(f"{name} = {float(value):.6g}" for name, value in self.decoded(u).items())

    def _open(self, path: Path, start: Float[np.ndarray, " parameters"]) -> None:
        """Read the evaluations of an existing file, or create the file."""
        if path.is_dir():
            raise ValueError(f"{path} is a folder; a fit is kept in a file.")
        text = path.read_text(errors="replace") if path.exists() else ""
        if not text:
            mark = self._fingerprint(start)
            header: dict[str, Any] = {"fit": self.scales, "u": list(start), "fingerprint": mark}
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise refusal(path, error) from error
            write_bytes(path, _sealed(header).encode())
            return
        # An incomplete last line comes from a fit that was killed.
        whole = text[: text.rfind("\n") + 1]
        try:
            found = [_unsealed(path, *numbered) for numbered in enumerate(whole.splitlines(), 1)]
            header, lines = found[0], found[1:]
            scales, probe, known = header["fit"], np.array(header["u"]), header["fingerprint"]
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{path} is not the file of a fit; give another file, or remove it.") from error
        if scales != self.scales:
            raise ValueError(
                f"{path} holds a fit of {', '.join(scales)}, not of {', '.join(self.scales)}, or one on "
                "another scale; give another file."
            )
        here = self._fingerprint(probe)
        if len(known) != len(here):
            raise ValueError(f"{path} holds a fit of another number of experiments; give another file.")
        other = difference(known, here)
        if other:
            raise ValueError(f"{path} holds a fit that differs in {other}; give another file.")
        if whole != text:
            path.write_text(whole)
        for line in lines:
            if line["failure"]:
                self.failures[_key(np.array(line["u"]))] = line["failure"]
            key = _key(np.array(line["u"]))
            self.known[line["kind"], key], self._snaps[key] = np.array(line["value"]), line["snaps"]


class _Frozen:
    """The residuals of an experiment as a function of the record of a run and of encoded parameters."""

    def __init__(self, experiment: Experiment, decoded: Callable[[Any], Values]):
        self.experiment, self.decoded = experiment, decoded

    def __call__(self, record: Record, u: Float[Array, " parameters"]) -> Float[Array, " residuals"]:
        scene, state = self.experiment.start(self.decoded(u))
        return self.experiment.residuals(replay(scene, record, state, solve=False))


def _sealed(contents: Mapping[str, Any]) -> str:
    """Return a line of the file with its checksum. Residuals of a failed run are infinite."""
    text = json.dumps(contents)
    return json.dumps({"contents": contents, "sha256": hashlib.sha256(text.encode()).hexdigest()}) + "\n"


def _unsealed(path: Path, number: int, line: str) -> dict[str, Any]:
    """Return the contents of a line. **Raises:** ValueError if `_sealed` did not write the line."""
    try:
        whole = json.loads(line)
        text, sha256 = json.dumps(whole["contents"]), whole["sha256"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is not the file of a fit: cannot read line {number}. Remove the line, or give another "
            "file."
        ) from error
    if hashlib.sha256(text.encode()).hexdigest() != sha256:
        raise ValueError(
            f"line {number} of {path} is damaged: its checksum does not match. Remove the line; the fit "
            "then computes this evaluation again."
        )
    return whole["contents"]


def _key(u: Float[np.ndarray, " parameters"]) -> str:
    return np.asarray(u, float).tobytes().hex()


@eqx.filter_jit
def _jacobian(
    record: Record, u: Float[Array, " parameters"], residuals: _Residuals
) -> Float[Array, "residuals parameters"]:
    return jax.jacfwd(lambda u: residuals(record, u))(u)


@eqx.filter_jit
def _gradient(
    record: Record, u: Float[Array, " parameters"], residuals: _Residuals
) -> Float[Array, " parameters"]:
    return jax.grad(lambda u: 0.5 * jnp.sum(residuals(record, u) ** 2))(u)
