"""Calibrate the yield curvature of a sheet from the residual angle of a fold (Fig. 3b)."""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float

from jaxcrumple._jax.door import door
from jaxcrumple.calibrate.experiment import Experiment, Values
from jaxcrumple.calibrate.fit import Fit, Parameter, fit
from jaxcrumple.material.material import Material
from jaxcrumple.replays.replay import Replay
from jaxcrumple.scene import Scene
from jaxcrumple.scenes.fold import SIZE, FoldTimes, default_gap, fold, fold_angle
from jaxcrumple.solvers.scheme import Integrator, integrator
from jaxcrumple.state import State, initial_state

YIELD = "yield_curvature"
# Initial guess of the yield curvature times the gap, at which a fold retains about 100 degrees; bounds of the
# yield curvature in 1/m.
START, BOUNDS = 0.67, (1.0, 5000.0)
# A larger deviation of the angle, in standard deviations, means that the fit stopped at a jump of the angle;
# WIDTH is the relative width to which the bracket of the root shrinks there.
MISSED, WIDTH = 0.1, 1e-5


class FoldCalibration(NamedTuple):
    """Result of `calibrate_fold`.

    - `yield_curvature`, `std`: yield curvature and its standard deviation in 1/m.
    - `c0`, `c0_std`: mean dimensionless yield curvature of the hinges, and its standard deviation.
    - `angle`: angle in rad that the fold retains at this yield curvature.
    - `success`: whether `angle` lies within one standard deviation of the requested angle.
    - `fit`: the underlying fit.
    """

    yield_curvature: float
    std: float
    c0: float
    c0_std: float
    angle: float
    success: bool
    fit: Fit


@door
def calibrate_fold(
    angle: float,
    *,
    nodes: int = 1000,
    seed: int = 0,
    std: float = np.deg2rad(1.0),
    start: Parameter | None = None,
    method: Literal["least-squares", "root"] = "least-squares",
    material: Material | None = None,
    options: Mapping[str, Any] | None = None,
    solver: Integrator | None = None,
    checkpoint: str | Path | None = None,
    tell: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> FoldCalibration:
    """Find the yield curvature at which the scene `fold` retains an `angle` in rad between its halves.

    Least squares come first. If the angle jumps because the fold snaps to another shape, bracketing ("root")
    follows.

    **Arguments:** `angle` and its standard deviation `std` in rad; `nodes`, `seed` of the mesh; `start`:
    initial guess and bounds of the yield curvature in 1/m, by default a guess that retains about 100 degrees;
    `method`: "least-squares", or "root" to bracket at once; `material`: all material parameters except the
    yield curvature, by default `Material()`; `options`: of the scene `fold`, such as gap, size, press and
    relax, as in the experiment; `solver`: by default `integrator(scheme="dynamic")`;
    `checkpoint`, `tell` as in `fit`.

    The sheet must be at rest at the end: its angle is that of the last frame. A thin or large sheet needs a
    longer `relax`, and a calibrated value belongs to the node distance over the gap, see the documentation.

    **Raises:** ValueError for an angle outside (0, pi) or options that `fold` refuses, and as `fit`.
    """
    if not 0 < angle < np.pi:
        raise ValueError(f"angle = {angle!r} rad must lie between 0 and pi; pi is a flat sheet.")
    if not (np.isfinite(std) and std > 0):
        raise ValueError(f"std = {std!r} rad must be a positive angle.")
    given = {"gap": default_gap(nodes, (options or {}).get("size", SIZE)), **(options or {})}
    gap, times = given["gap"], FoldTimes(**{name: given[name] for name in FoldTimes._fields if name in given})
    start = start or Parameter(START / gap, *BOUNDS)
    own = replace(material or Material(), yield_c0=None, yield_curvature=start.start)
    setup = fold(nodes, seed, **given, material=own)

    def run(values: Values) -> tuple[Scene, State]:
        scene = setup.made_of(replace(own, yield_curvature=values[YIELD]))
        return scene, initial_state(scene, setup.x)

    def residuals(frames: Replay) -> Float[Array, " 1"]:
        return jnp.atleast_1d((fold_angle(setup.mesh, frames.x[-1]) - angle) / std)

    experiment = Experiment(run, [times.release, times.end], residuals)
    with tempfile.TemporaryDirectory() as folder:
        # The motion is too slow for explicit steps to save time.
        settings: dict[str, Any] = {
            "solver": solver or integrator(scheme="dynamic"),
            "checkpoint": checkpoint or Path(folder) / "fit.jsonl",
            "tell": tell,
        }
        if method == "least-squares":
            found = fit(experiment, {YIELD: start}, **settings)
        if method == "root":
            found = fit(experiment, {YIELD: start}, method="root", rtol=WIDTH, **settings)
        elif abs(found.residuals[0]) > MISSED:
            second = fit(experiment, {YIELD: start}, method="root", rtol=WIDTH, **settings)
            found = _together(found, second)
    value, deviation = found.values[YIELD], found.std[YIELD]
    c0 = replace(own, yield_curvature=value).discretize(setup.mesh).c0
    assert c0 is not None
    mean, off = float(np.mean(c0)), float(found.residuals[0])
    return FoldCalibration(
        value, deviation, mean, mean * deviation / value, angle + std * off, abs(off) <= 1.0, found
    )


def _together(first: Fit, second: Fit) -> Fit:
    """Return the second of two fits that share evaluations, with the history of both."""
    history = pd.concat([first.history, second.history], ignore_index=True)
    return replace(second, history=history.drop_duplicates(["kind", YIELD], ignore_index=True))
