"""Yield curvature, thickness and time of flow of a hidden sheet from patterns of its plastic curvature.

The scene is `radial`, phantom, with a hold: a sheet in a sphere that shrinks for 1.2 s by 1 cm/s and then
stays. Its rest curvatures are seen at 0.6, 1.2, 1.8 and 2.4 s, with noise of 1 % of the largest plastic
curvature. The fit starts from each of STARTS, factors of the hidden numbers, for several meshes.

    python scripts/pattern_fit.py
"""

import jax
import numpy as np
from benchlib import markdown, options, save
from matplotlib.figure import Figure

import jaxcrumple as jc

HOLD, IMPERFECTION, NOISE, RTOL = 1.2, 5e-4, 0.01, 1e-3
TIMES = (0.5 * HOLD, HOLD, 1.5 * HOLD, 2.0 * HOLD)
HIDDEN = {"yield_curvature": 20.0, "thickness": 2.5e-4, "plastic_time": 0.1}
# Bounds are so many times less and more than the start.
WIDTH = 5.0
STARTS, SEEDS = ((1.5, 0.9, 2.0), (0.7, 1.15, 0.4)), (0, 1, 2)


def observed(nodes: int, seed: int):
    """The hidden sheet's scene, what is seen of it and the deviation of the noise."""
    material = jc.Material(**HIDDEN)
    setup = jc.radial(nodes, seed, contact=None, hold=HOLD, imperfection=IMPERFECTION, material=material)
    start = jc.initial_state(setup.scene, setup.x)
    seen = jc.simulate(setup.scene, start, TIMES, solver=jc.integrator(RTOL, scheme="dynamic"), throw=True).p
    std = NOISE * float(np.max(np.abs(seen - np.asarray(setup.mesh.rest_curvature))))
    return setup, seen + std * np.random.default_rng(seed).normal(size=seen.shape), std


def fitted(nodes: int, seed: int, factors: tuple[float, ...]) -> jc.Fit:
    """The fit from one start."""
    setup, seen, std = observed(nodes, seed)
    parameters = {}
    for (name, value), factor in zip(HIDDEN.items(), factors, strict=True):
        start = factor * value
        parameters[name] = jc.Parameter(start, start / WIDTH, start * WIDTH)
    return jc.calibrate_pattern(
        setup, TIMES, seen, parameters, std=std, solver=jc.integrator(RTOL, scheme="dynamic")
    )


def figure_of(rows: list[list[str]], errors: np.ndarray, spreads: np.ndarray) -> Figure:
    """Relative errors and their standard deviations by fit."""
    figure = Figure(figsize=(5.5, 3.4), layout="constrained")
    axes, places = figure.subplots(), np.arange(len(rows))
    for index, name in enumerate(HIDDEN):
        shifted = places + 0.15 * (index - 1)
        axes.errorbar(shifted, 100 * errors[:, index], 100 * spreads[:, index], fmt="o", label=name)
    axes.axhline(0.0, color="k", lw=0.5)
    axes.set(xticks=places, xticklabels=[f"{row[0]}\n{row[1]}" for row in rows])
    axes.set(xlabel="seed and start", ylabel="error, %")
    axes.legend()
    return figure


def main() -> None:
    """Fit from all starts; print and save."""
    parser = options(__doc__ or "", [300])
    opts = parser.parse_args()
    for nodes in opts.nodes:
        rows, errors, spreads = [], [], []
        for seed in SEEDS:
            for factors in STARTS:
                found = fitted(nodes, seed, factors)
                errors.append([found.values[name] / value - 1.0 for name, value in HIDDEN.items()])
                spreads.append([found.std[name] / value for name, value in HIDDEN.items()])
                pairs = zip(errors[-1], spreads[-1], strict=True)
                told = [f"{100 * error:+.2f} ({100 * spread:.2f})" for error, spread in pairs]
                counts = [str(found.evaluations), str(found.gradient_evaluations)]
                words = " x ".join(f"{factor:g}" for factor in factors)
                missed = f"{np.sqrt(np.mean(found.residuals**2)):.2f}"
                rows.append(
                    [str(seed), words, *told, f"{found.condition:.1f}", *counts, missed, found.success]
                )
                print(rows[-1], found.message, flush=True)
                jax.clear_caches()
        names = [f"{name}: error (deviation), %" for name in HIDDEN]
        head = ["seed", "start: factors", *names, "condition", "runs", "derivatives"]
        head += ["residual, deviations", "success"]
        hidden = ", ".join(f"{name} = {value:g}" for name, value in HIDDEN.items())
        text = f"{markdown(head, rows)}\n\nn = {nodes}, rtol = {RTOL:g}, hidden: {hidden} (SI)."
        figure = figure_of(rows, np.array(errors), np.array(spreads))
        good = np.array(errors)[[row[-1] for row in rows]]
        worst = dict(zip(HIDDEN, np.abs(good).max(axis=0).tolist(), strict=True))
        save(opts, f"pattern_fit_{nodes}", text, figure, worst, errors)


if __name__ == "__main__":
    main()
