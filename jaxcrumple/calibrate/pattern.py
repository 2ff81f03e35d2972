"""Calibrate material parameters of a sheet from patterns of its plastic curvature."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real

from jaxcrumple._jax.arrays import ScalarLike
from jaxcrumple._jax.door import door
from jaxcrumple.calibrate.experiment import Experiment, Values
from jaxcrumple.calibrate.fit import Fit, Parameter, fit
from jaxcrumple.scene import Scene
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.simulation import Times, checked_times
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State, initial_state

# Root mean square of the residuals, in standard deviations, above which a minimum is not the global one.
WRONG = 2.0


@door
def calibrate_pattern(
    setup: Setup,
    times: Times,
    patterns: Real[ArrayLike, "times hinges"],
    parameters: Mapping[str, Parameter],
    *,
    std: Real[ArrayLike, "times hinges"] | ScalarLike,
    solver: Integrator | None = None,
    checkpoint: str | Path | None = None,
    tell: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> Fit:
    """Find the material parameters that reproduce observed rest curvatures.

    Include frames from a hold, during which nothing is driven: they separate the time scale of the flow from
    its threshold. If the simulated sheet buckles differently from the observed one, the fit may end without
    success; then start from other values.

    **Arguments:** `setup`: sheet, material, confinement and initial positions, e.g. from
    `radial(..., hold=)`; `times` (f,): frame times in s; `patterns` (f, h): rest curvatures observed at these
    times; `std`: their standard deviation, one number or an array (f, h); `parameters`: unknown fields of the
    material, by name, in SI units; all other fields stay fixed; `solver`, `checkpoint`, `tell` as in `fit`.

    **Raises:** ValueError for a setup without a material, an elastic sheet, patterns that are not finite or
    of another shape, a standard deviation that is not positive, a name that is no number of the material, and
    as `fit`.
    """
    material = setup.material if isinstance(setup, Setup) else None
    if material is None:
        raise ValueError(
            "setup must be a Setup with a material: that of a scene such as jaxcrumple.radial(...), "
            "or Setup(..., material=)."
        )
    seen, moments = np.asarray(patterns, float), checked_times(times)
    if setup.scene.plasticity is None:
        raise ValueError("an elastic sheet leaves no pattern; give its material a yield curvature.")
    shape = (len(moments), setup.scene.bending.rest_curvature.shape[0])
    if seen.shape != shape:
        raise ValueError(
            f"patterns have the shape {seen.shape} and must have {shape}: a row of hinges for each time."
        )
    if not np.all(np.isfinite(seen)):
        raise ValueError(
            "patterns must be finite numbers; for hinges that were not observed, give any number and a "
            "large std."
        )
    deviation = np.asarray(std, float)
    if not (np.all(np.isfinite(deviation) & (deviation > 0)) and deviation.shape in ((), shape)):
        raise ValueError(
            f"std must be positive and finite, one number for all patterns or an array {shape} like them, "
            f"not {std!r}."
        )
    for name in parameters:
        if not isinstance(getattr(material, name, None), float):
            raise ValueError(
                f"{name!r} is no number of this material; choose e.g. yield_curvature or thickness."
            )

    def run(values: Values) -> tuple[Scene, State]:
        scene = setup.made_of(replace(material, **values))
        return scene, initial_state(scene, setup.x)

    def residuals(frames: Any) -> Float[Array, " residuals"]:
        return ((frames.p - seen) / deviation).reshape(-1)

    experiment = Experiment(run, moments, residuals)
    found = fit(experiment, parameters, solver=solver, checkpoint=checkpoint, tell=tell)
    spread = np.sqrt(np.mean(found.residuals**2))
    if not spread < WRONG:
        told = f"the fit misses the patterns by {spread:.3g} standard deviations: choose another start."
        found = replace(found, success=False, message=told)
    return found
