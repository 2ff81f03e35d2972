"""The yield curvature of a fold from its angle, from starts twofold off, beside a search without derivatives.

A fold of known yield curvature gives the angle; `calibrate_fold` looks for the yield curvature again, and so
does Brent's method with brackets that grow from the same start (`fit(..., method="root")`).

    python scripts/fold_inverse.py
"""

import time

import numpy as np
from benchlib import markdown, options, save

import jaxcrumple as jc
from jaxcrumple.calibrate import fold
from jaxcrumple.scenes.fold import TIMES, default_gap

RTOL, FACTORS = 1e-2, (2.0, 0.5)


def angle_of(nodes: int, yields: float) -> float:
    """Angle in rad that the fold keeps."""
    setup = jc.fold(nodes, material=jc.Material(yield_curvature=yields))
    start, solver = jc.initial_state(setup.scene, setup.x), jc.integrator(RTOL, scheme="dynamic")
    times = [TIMES.release, TIMES.end]
    end = jc.simulate(setup.scene, start, times, solver=solver, throw=True).x[-1]
    return float(jc.fold_angle(setup.mesh, end))


def main() -> None:
    """Look for it from all starts by both; print and save."""
    opts = options(__doc__ or "", [1000]).parse_args()
    for nodes in opts.nodes:
        hidden = fold.START / default_gap(nodes)
        angle, rows, ratios = angle_of(nodes, hidden), [], {}
        for factor in FACTORS:
            start = jc.Parameter(factor * hidden, *fold.BOUNDS)
            for method in ("least-squares", "root"):
                begun = time.perf_counter()
                solver = jc.integrator(RTOL, scheme="dynamic")
                found = jc.calibrate_fold(angle, nodes=nodes, start=start, method=method, solver=solver)
                seconds, fit = time.perf_counter() - begun, found.fit
                error = found.yield_curvature / hidden - 1.0
                ratios[f"{method} from {factor:g}: relative error"] = error
                counts = [fit.evaluations, fit.gradient_evaluations]
                rows.append([f"{factor:g}", method, f"{error:.1e}", *counts, f"{seconds:.0f}"])
                print(rows[-1], fit.message, flush=True)
        text = markdown(["start: factor", "method", "relative error", "runs", "derivatives", "seconds"], rows)
        degrees = np.rad2deg(angle)
        text += f"\n\nn = {nodes}, rtol = {RTOL:g}, hidden {hidden:.4g} 1/m, angle {degrees:.1f} degrees."
        save(opts, f"fold_inverse_{nodes}", text, None, ratios, rows)


if __name__ == "__main__":
    main()
