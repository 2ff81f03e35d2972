"""The yield curvature of a sheet from the angle that a fold keeps (Fig. 3b)."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxcrumple.calibrate.evaluate import Experiment
from jaxcrumple.calibrate.fit import Fit, Parameter, fit
from jaxcrumple.material import Material
from jaxcrumple.scenes.fold import TIMES, fold, fold_angle
from jaxcrumple.solvers.scheme import Integrator, integrator
from jaxcrumple.state import initial_state

# The yield curvature to start from, and its bounds, in 1/m.
YIELD = Parameter(100.0, 1.0, 2000.0)


class FoldCalibration(NamedTuple):
    """What a fold tells: `yield_curvature` in 1/m and its standard deviation `std`, the mean dimensionless
    yield curvature `c0` of the mesh's hinges, the `angle` in rad that the fold then keeps, and the `fit`."""

    yield_curvature: float
    std: float
    c0: float
    angle: float
    fit: Fit


def calibrate_fold(
    angle: float,
    *,
    nodes: int = 1000,
    seed: int = 0,
    std: float = np.deg2rad(1.0),
    start: Parameter = YIELD,
    material: Material | None = None,
    solver: Integrator | None = None,
    checkpoint: str | Path | None = None,
    tell: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> FoldCalibration:
    """The yield curvature for which the scene `fold` keeps an `angle` in rad between its halves.

    **Arguments:** `angle` and its standard deviation `std` in rad; `nodes`, `seed` of the mesh; `start`: the
    yield curvature to start from and its bounds, in 1/m; `material`: all but the yield point, by default
    `Material()`; `solver`: by default `integrator(scheme="dynamic")`; `checkpoint`, `tell` as in `fit`.

    **Raises:** ValueError for an angle outside (0, pi), or as `fit` does.
    """
    if not 0 < angle < np.pi:
        raise ValueError(f"angle = {angle!r} rad must lie between 0 and pi; 180 degrees are a flat sheet.")
    if not (np.isfinite(std) and std > 0):
        raise ValueError(f"std = {std!r} rad must be a positive angle.")
    own = replace(material or Material(), yield_c0=None, yield_curvature=start.start)
    setup = fold(nodes, seed, material=own)

    def run(values):
        scene = setup.made_of(replace(own, yield_curvature=values["yield_curvature"]))
        return scene, initial_state(scene, setup.x)

    def residuals(frames):
        return jnp.atleast_1d((fold_angle(setup.mesh, frames.x[-1]) - angle) / std)

    # Nothing in it is so fast that explicit steps would pay.
    solver = solver or integrator(scheme="dynamic")
    experiment = Experiment(run, [TIMES.release, TIMES.end], residuals)
    found = fit(
        experiment,
        {"yield_curvature": start},
        solver=solver,
        scaled=False,
        checkpoint=checkpoint,
        tell=tell,
    )
    value = found.values["yield_curvature"]
    c0 = replace(own, yield_curvature=value).discretize(setup.mesh).c0
    assert c0 is not None
    return FoldCalibration(
        value,
        found.std["yield_curvature"],
        float(np.mean(c0)),
        angle + std * float(found.residuals[0]),
        found,
    )
