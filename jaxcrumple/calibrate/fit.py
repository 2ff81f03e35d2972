"""`fit`: estimate parameters of runs from measurements, by least squares, gradient descent or bracketing."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd
from jaxtyping import ArrayLike, Float
from scipy.optimize import brentq, least_squares

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import shown
from jaxcrumple.calibrate.evaluate import Evaluations
from jaxcrumple.calibrate.experiment import Experiment, Values
from jaxcrumple.solvers.scheme import Integrator

# Factor between successive parameter values in the search for a bracket.
GROWTH = 1.5
# Smallest relative change that exceeds rounding errors.
FINEST = 1e-14
# If a run failed, a fit whose loss could still fall by more than BARRED * rtol (relative) has not converged.
BARRED = 10.0
# Condition number of the Jacobian above which the data do not determine the parameters: its square, the
# condition of the normal equations, then reaches 1 over the rounding error.
UNDETERMINED = 1e8

# Encoded parameters, whether they are a minimum, and why the search ended.
_Found = tuple[Float[np.ndarray, " parameters"], bool, str]


class Parameter(NamedTuple):
    """An unknown parameter: initial guess `start`, bounds `lower` and `upper`, and `log`: fit its logarithm.

    Units are those of the quantity that `setup` of the `Experiment` receives.
    """

    start: float
    lower: float
    upper: float
    log: bool = True


@dataclass(frozen=True, repr=False)
class Fit:
    """Result of `fit`.

    - `values`, `std`: parameter values and their standard deviations, by name.
    - `covariance` (k, k), `condition`: covariance of the encoded parameters, and condition number of the
      Jacobian of the residuals with respect to them. A parameter on a logarithmic scale is encoded as its
      logarithm.
    - `residuals` (m,), `loss`: residuals at `values`, and half the sum of their squares.
    - `snaps`: number of snaps in the run at `values`. The derivatives hold the instants of the snaps fixed.
    - `history`: one row for each requested evaluation: `evaluations` runs and `gradient_evaluations`
      derivatives. An evaluation read from the file takes 0 s.
    - `success`, `message`: whether the fit reached a minimum within the bounds, and why it ended.
    """

    values: dict[str, float]
    std: dict[str, float]
    covariance: Float[np.ndarray, "parameters parameters"]
    condition: float
    loss: float
    residuals: Float[np.ndarray, " residuals"]
    snaps: int
    history: pd.DataFrame
    success: bool
    message: str

    @property
    def evaluations(self) -> int:
        """Number of requested runs, those read from the checkpoint file included."""
        return int((self.history["kind"] == "residuals").sum())

    @property
    def gradient_evaluations(self) -> int:
        """Number of requested derivatives, those read from the checkpoint file included."""
        return len(self.history) - self.evaluations

    def __repr__(self) -> str:
        found = ", ".join(
            f"{name} = {value:.5g} +- {self.std[name]:.2g}" for name, value in self.values.items()
        )
        spent = f"{self.evaluations} runs, {self.gradient_evaluations} derivatives"
        known = f"loss {self.loss:.3g}, condition {self.condition:.2g}"
        return f"Fit({found}, {known}, {spent}, {'success' if self.success else self.message})"


@door
def fit(
    experiment: Experiment | Sequence[Experiment],
    parameters: Mapping[str, Parameter],
    *,
    method: Literal["least-squares", "root"] | optax.GradientTransformation = "least-squares",
    solver: Integrator | None = None,
    max_steps: int = 30,
    rtol: float = 1e-4,
    max_attempts: int | None = None,
    scaled: bool = False,
    checkpoint: str | Path | None = None,
    tell: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> Fit:
    """Find the parameters that minimise the residuals of an experiment, or of several together.

    Each trial is a separate run with its own steps. Its derivatives come from its `replay`. A warning tells
    if they contradict the differences between trials, as near snaps: then `std` means nothing.

    **Arguments:**

    - `experiment`: the run, and the comparison of its frames with measurements; or a list of them, whose
      residuals are joined.
    - `parameters`: the unknown parameters, by name.
    - `method`: "least-squares": SciPy's trust-region method, with derivatives in forward mode. An Optax
      optimiser: gradient steps in reverse mode, clipped to the bounds. "root": Brent's method for one
      residual of one parameter; it needs no derivatives after its start and works across jumps.
    - `solver`: integrator of the runs, by default `integrator()`.
    - `max_steps`: largest number of runs, or of optimiser steps.
    - `rtol`: relative change of the loss or of the parameters at which the fit ends.
    - `max_attempts`: number of step attempts after which a run fails.
    - `scaled`: whether to estimate the scale of the residuals from the residuals at the minimum. Use it if
      the uncertainty is unknown; otherwise divide the residuals by their uncertainty, so that their standard
      deviation is 1. It requires more residuals than parameters.
    - `checkpoint`: file that stores all evaluations. A fit continues from an existing file to the same
      answer. A file belongs to one experiment and solver; start and bounds may change.
    - `tell`: callback, called with each new row of the history.

    A run fails if its setup raises ValueError or its result is not "success". The fit avoids failed runs
    where possible.

    **Raises:** ValueError if there is no parameter, if the start lies outside the bounds, if bounds on a
    logarithmic scale are not positive, if the method is unknown, if JAX cannot trace setup or residuals, if
    the file belongs to another fit, if the first run fails, or if a parameter does not affect the residuals.

    >>> mesh = jc.hexagonal(3, 2, 5e-3)
    >>> scene = jc.sheet(mesh, jc.Material(yield_curvature=None), gravity=(0, 0, -9.81))
    >>> def setup(values):  # a sheet that falls in air of unknown drag
    ...     material = jc.Material(yield_curvature=None, drag_rate=values["drag_rate"])
    ...     made = jc.sheet(mesh, material, gravity=(0, 0, -9.81), like=scene)
    ...     return made, jc.initial_state(made, mesh.vertices)
    >>> def residuals(frames):  # observed: 0.5 mm lower after 0.1 s, within 0.01 mm
    ...     return (frames.x[-1, :1, 2] + 0.5e-3) / 0.01e-3
    >>> found = jc.fit(jc.Experiment(setup, 0.1, residuals), {"drag_rate": jc.Parameter(1500, 100, 1e4)})
    >>> found.success, round(found.values["drag_rate"]), round(found.std["drag_rate"])  # 1/s
    (True, 1952, 39)
    """
    code = _Code(parameters)
    _check_options(method, len(parameters), max_steps, rtol)
    names, path = tuple(parameters), None if checkpoint is None else Path(checkpoint)
    scales = {name: own.log for name, own in parameters.items()}
    experiments = [experiment] if isinstance(experiment, Experiment) else experiment
    if not (isinstance(experiments, Sequence) and experiments):
        raise ValueError(
            "experiment must be an Experiment(setup, times, residuals) or a list of them, not "
            f"{shown(experiment)}."
        )
    evaluations = Evaluations(experiments, code.decoded, code.start, scales, solver, max_attempts, path, tell)
    if method == "root" and evaluations.size != 1:
        raise ValueError(f"'root' needs one residual for its one parameter, not {evaluations.size}.")
    if scaled and evaluations.size <= len(parameters):
        raise ValueError(
            f"scaled=True requires more residuals ({evaluations.size}) than parameters ({len(parameters)}): "
            "divide the residuals by their uncertainty and omit scaled."
        )
    first = evaluations.residuals(code.start)
    if not np.all(np.isfinite(first)):
        raise ValueError(f"{evaluations.trouble(code.start)}: choose another start.")
    idle = [
        name for name, own in zip(names, evaluations.jacobian(code.start).T, strict=True) if not own.any()
    ]
    if idle:
        raise ValueError(
            f"the residuals do not depend on {idle[0]} at the start: choose another start, or omit "
            "this parameter."
        )
    if method == "least-squares":
        u, success, message = _least_squares(evaluations, code, max_steps, rtol)
    elif method == "root":
        u, success, message = _root(evaluations, code, max_steps, rtol)
    else:
        u, success, message = _descent(evaluations, code, method, max_steps, rtol)
    bound = code.at_bound(u, rtol)
    if bound and success:
        success, message = False, f"{bound}; widen its bounds, or check the model."
    found = _result(evaluations, code, u, scaled, success, message)
    if told := evaluations.contradiction(u):
        warnings.warn(told, stacklevel=3)
    return found


def _check_options(method: Any, parameters: int, max_steps: int, rtol: float) -> None:
    """Refuse what a method cannot do with, before any run."""
    if not (isinstance(max_steps, int) and max_steps >= 1):
        raise ValueError(f"max_steps = {max_steps!r} must be a whole number, at least 1.")
    if not FINEST <= rtol < 1:
        raise ValueError(f"rtol = {rtol!r} must lie between {FINEST:g} and 1.")
    if method == "root" and parameters != 1:
        raise ValueError(f"'root' finds one parameter, not {parameters}; take 'least-squares'.")
    if method in ("least-squares", "root"):
        return
    if not isinstance(method, optax.GradientTransformation):
        raise ValueError(
            f"method = {method!r} must be 'least-squares', 'root' or an optimiser of Optax, such as "
            "optax.adam(0.1)."
        )
    still = jnp.zeros(parameters)
    try:
        method.update(still, method.init(still), still)
    except TypeError as error:
        raise ValueError(
            "this optimiser of Optax wants more than gradients, such as the values of a line search; take "
            "another one, such as optax.adam(0.1), or 'least-squares'."
        ) from error


class _Code:
    """Encode parameters: take the logarithm of each parameter on a logarithmic scale."""

    def __init__(self, parameters: Mapping[str, Parameter]):
        if not isinstance(parameters, Mapping) or not parameters:
            raise ValueError(
                "parameters must name what to find; give e.g. {name: Parameter(start, lower, upper)}."
            )
        for name, own in parameters.items():
            if not (isinstance(own, Parameter) and np.all(np.isfinite(own[:3]))):
                raise ValueError(
                    f"{name} = {own!r} must be a Parameter(start, lower, upper) of finite numbers."
                )
            if not own.lower < own.start < own.upper:
                raise ValueError(f"{name}: its start must lie between its bounds, but {own}.")
            if own.log and not own.lower > 0:
                raise ValueError(f"{name}: its bounds must be positive on a logarithmic scale, but {own}.")
        self.parameters = dict(parameters)
        self.log = np.array([own.log for own in parameters.values()])
        rows = np.array([own[:3] for own in parameters.values()], float)
        encoded = np.where(self.log[:, None], np.log(np.where(self.log[:, None], rows, 1.0)), rows)
        self.start, self.lower, self.upper = encoded.T

    def decoded(self, u: Float[ArrayLike, " parameters"]) -> Values:
        """Return the parameter values by name."""
        powers = jnp.exp(jnp.where(self.log, u, 0.0))
        return dict(zip(self.parameters, jnp.where(self.log, powers, u), strict=True))

    def at_bound(self, u: Float[np.ndarray, " parameters"], rtol: float) -> str:
        """Name a parameter that lies at a bound; empty if none does."""
        for index, (name, own) in enumerate(self.parameters.items()):
            near = rtol * (self.upper[index] - self.lower[index])
            for side, bound, value in (("lower", self.lower, own.lower), ("upper", self.upper, own.upper)):
                if abs(u[index] - bound[index]) <= near:
                    return f"{name} is at its {side} bound {value:g}"
        return ""


def _least_squares(evaluations: Evaluations, code: _Code, max_steps: int, rtol: float) -> _Found:
    found = least_squares(
        evaluations.residuals,
        code.start,
        jac=evaluations.jacobian,
        bounds=(code.lower, code.upper),
        x_scale="jac",
        max_nfev=max_steps,
        ftol=rtol,
        xtol=rtol,
        gtol=None,
    )
    failed = evaluations.nearest_failure(found.x)
    step = np.linalg.lstsq(found.jac, -found.fun)[0]
    moved = np.clip(found.x + step, code.lower, code.upper) - found.x
    ahead = 0.5 * float(np.sum((found.fun + found.jac @ moved) ** 2))
    if failed is not None and ahead < (1.0 - BARRED * rtol) * found.cost:
        return found.x, False, f"a failed run bars the way: {evaluations.trouble(failed)}"
    return found.x, bool(found.success), found.message


def _root(evaluations: Evaluations, code: _Code, max_steps: int, rtol: float) -> _Found:
    """Step by GROWTH from the start in the direction in which the residual falls, until it changes sign; then
    apply Brent's method."""

    def residual(u: float) -> float:
        return float(evaluations.residuals(np.array([u]))[0])

    (start,), (lower,), (upper,) = code.start, code.lower, code.upper
    falls = -np.sign(residual(start)) * np.sign(evaluations.jacobian(code.start)[0, 0])
    step = np.log(GROWTH) if code.log[0] else (GROWTH - 1.0) * max(abs(start), rtol)
    near, far = start, start
    for _ in range(max_steps):
        near, far = far, float(np.clip(far + falls * step, lower, upper))
        if near == far:
            return np.array([near]), False, "the residual does not change sign within the bounds."
        if residual(near) * residual(far) <= 0.0:
            u, told = brentq(residual, near, far, xtol=rtol, maxiter=max_steps, full_output=True, disp=False)
            return np.array([u]), bool(told.converged), f"bracketed to {rtol:g}."
    return np.array([far]), False, "the steps are used up."


def _descent(
    evaluations: Evaluations, code: _Code, method: optax.GradientTransformation, steps: int, rtol: float
) -> _Found:
    u = jnp.asarray(code.start)
    memory, best = method.init(u), (np.inf, code.start)
    for _ in range(steps):
        residuals = evaluations.residuals(np.asarray(u))
        loss = 0.5 * float(residuals @ residuals)
        best = min(best, (loss, np.asarray(u)), key=lambda pair: pair[0])
        if not np.isfinite(loss):
            return best[1], False, f"{evaluations.trouble(np.asarray(u))}: choose a smaller step size."
        change, memory = method.update(jnp.asarray(evaluations.gradient(np.asarray(u))), memory, u)
        moved = jnp.clip(optax.apply_updates(u, change), code.lower, code.upper)
        still, u = float(jnp.max(jnp.abs(moved - u))) < rtol, moved
        if still:
            return best[1], True, "the parameters no longer change."
    return best[1], False, "the steps are used up."


def _result(
    evaluations: Evaluations,
    code: _Code,
    u: Float[np.ndarray, " parameters"],
    scaled: bool,
    success: bool,
    message: str,
) -> Fit:
    residuals, jacobian = evaluations.residuals(u), evaluations.jacobian(u)
    spread = float(residuals @ residuals) / (len(residuals) - len(u)) if scaled else 1.0
    condition = float(np.linalg.cond(jacobian))
    covariance = np.full((len(u), len(u)), np.inf)
    if len(residuals) >= len(u) and condition < UNDETERMINED:
        covariance = spread * np.linalg.inv(jacobian.T @ jacobian)
    values = {name: float(value) for name, value in code.decoded(u).items()}
    rate = np.where(code.log, np.array(list(values.values())), 1.0)
    std = dict(zip(values, rate * np.sqrt(np.diag(covariance)), strict=True))
    return Fit(
        values=values,
        std={name: float(value) for name, value in std.items()},
        covariance=covariance,
        condition=condition,
        loss=0.5 * float(residuals @ residuals),
        residuals=residuals,
        snaps=evaluations.snaps(u),
        history=evaluations.history,
        success=success,
        message=message,
    )
