"""Properties of a sheet from patterns of its plastic curvature."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcrumple._jax.door import door
from jaxcrumple.calibrate.experiment import Experiment
from jaxcrumple.calibrate.fit import Fit, Parameter, fit
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.simulate import checked_times
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import initial_state

# Root mean square of the residuals in standard deviations from which a minimum is not the one that is sought.
WRONG = 2.0


@door
def calibrate_pattern(
    setup: Setup,
    times: ArrayLike,
    patterns: ArrayLike,
    parameters: Mapping[str, Parameter],
    *,
    std: ArrayLike,
    solver: Integrator | None = None,
    checkpoint: str | Path | None = None,
    tell: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> Fit:
    """Numbers of a sheet's material for which its rest curvatures develop as observed.

    Moments of a hold, in which nothing is driven, tell the time scale of the flow from its threshold. A sheet
    that buckles another way than the observed one tells nothing, and a fit may end there, without
    success: start elsewhere then.

    **Arguments:** `setup`: the sheet and its material, what confines it and where it starts, e.g. of
    `radial(..., hold=)`; `times` (f,) of the frames in s, and the rest curvatures seen there, `patterns`
    (f, h), with the standard deviation `std`, one for all or an array like them; `parameters`: fields of
    the setup's material to be found, by name, in SI units; all others stay; `solver`, `checkpoint`, `tell`
    as in `fit`.

    **Raises:** ValueError for a setup that does not say its material, an elastic sheet, patterns of another
    shape or not finite, a deviation that is not positive, a name that is no number of the material, or as
    `fit` does.
    """
    material = setup.material if isinstance(setup, Setup) else None
    if material is None:
        raise ValueError(
            "setup must be a Setup that says its material: that of a scene such as jaxcrumple.radial(...), "
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
            "patterns hold what is no finite number; give hinges that were not seen a large std."
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

    def run(values):
        scene = setup.made_of(replace(material, **values))
        return scene, initial_state(scene, setup.x)

    def residuals(frames):
        return ((frames.p - seen) / deviation).reshape(-1)

    experiment = Experiment(run, moments, residuals)
    found = fit(experiment, parameters, solver=solver, checkpoint=checkpoint, tell=tell)
    spread = np.sqrt(np.mean(found.residuals**2))
    if not spread < WRONG:
        told = f"the patterns are missed by {spread:.3g} standard deviations: start from another place."
        found = replace(found, success=False, message=told)
    return found
