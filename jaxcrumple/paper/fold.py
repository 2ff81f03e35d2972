"""Fig. 3b: residual angle of a fold against the yield curvature for several meshes, and their collapse.

With the residual angle phi and theta = pi - phi, c_f = 2 sin(theta/2). c0 is the mean dimensionless yield
curvature of the hinges, and lambda = sqrt(n / A). One linear map fits all meshes: c_f = a - b lambda c0 +
d lambda. The fit uses folds that yield and whose halves do not touch.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple.io import Run
from jaxcrumple.paper.base import Figure, Runs, save_table
from jaxcrumple.plot.figure import new_figure, save_figure
from jaxcrumple.run.config import MaterialOptions, RunConfig, configure
from jaxcrumple.scenes.fold import TIMES, fold_angle

# Gap in m for all meshes, and yield curvatures in 1/m.
GAP, YIELDS = 0.01, np.geomspace(25.0, 150.0, 12)
# Range of c_f in which a fold has yielded and remains open.
FITTED = (0.3, 1.9)
# With this number of frames, one frame coincides with the release, so that a step ends there.
FRAMES = round(TIMES.end / 0.05)


def _runs(full: bool) -> dict[str, RunConfig]:
    sizes = (500, 1000, 3000) if full else (300, 500)
    common = {"gap": GAP, "scheme": "dynamic", "frames": FRAMES}
    return {
        f"n{nodes}_{value:.1f}": configure(
            "fold", nodes=nodes, settings={**common, "yield_curvature": float(value)}
        )
        for nodes in sizes
        for value in YIELDS
    }


def folded(run: Run) -> dict[str, float]:
    """Return nodes, lambda and yield curvature in 1/m, c0, angle in degrees and c_f of a released fold."""
    material = MaterialOptions(**run.config["material"]).build()
    angle = float(fold_angle(run.mesh, jnp.asarray(run.x[-1])))
    c0 = material.discretize(run.mesh).c0
    assert c0 is not None
    return {
        "nodes": run.mesh.n_nodes,
        "lambda": run.mesh.linear_density,
        "yield_curvature": run.config["material"]["yield_curvature"],
        "c0": float(np.mean(c0)),
        "angle_deg": float(np.rad2deg(angle)),
        "c_f": float(2.0 * np.cos(0.5 * angle)),
    }


def collapse(table: pd.DataFrame) -> tuple[Float[np.ndarray, " 3"], float, float]:
    """Fit the coefficients a, b, d of the map; return them and the rms residuals with and without d.

    **Arguments:** `table`: rows from `folded`.
    """
    used = table[table["c_f"].between(*FITTED, inclusive="neither")]
    density, c0, left = (used[name].to_numpy() for name in ("lambda", "c0", "c_f"))
    columns = np.stack([np.ones(len(used)), -density * c0, density], axis=1)
    found = np.linalg.lstsq(columns, left)[0]
    plain = np.linalg.lstsq(columns[:, :2], left)[0]
    with_, without = (
        float(np.sqrt(np.mean((m @ a - left) ** 2))) for m, a in ((columns, found), (columns[:, :2], plain))
    )
    return found, with_, without


def _draw(runs: Runs, folder: Path) -> list[Path]:
    table = pd.DataFrame([folded(run) for run in runs.values()])
    (a, b, d), rms, plain = collapse(table)
    first = next(iter(runs.values())).config
    law = f"$c_f$ = {a:.3f} - {b:.4g} m $\\lambda c_0$ {d:+.3g} m $\\lambda$"
    caption = (
        f"fold, gap {1e3 * GAP:g} mm, seed {first['seed']}, rtol {first['solver']['rtol']:g}: {law}, "
        f"rms {rms:.3f}, without offset {plain:.3f}"
    )
    figure = new_figure((8.2, 3.9), caption)
    raw, line = figure.subplots(1, 2, sharey=True)
    for nodes, own in table.groupby("nodes"):
        raw.plot(own["c0"], own["c_f"], "o-", label=f"n = {nodes}")
        line.plot(own["lambda"] * (b * own["c0"] - d), own["c_f"], "o")
    ends = np.array(line.get_xlim())
    line.plot(ends, a - ends, "k:", lw=1.0)
    raw.set(xlabel="$c_0$", ylabel="$c_f = 2 \\sin(\\theta_f / 2)$")
    line.set(xlabel="$\\lambda (b\\, c_0 - d)$", ylim=(0.0, 2.0))
    raw.legend()
    return [save_figure(figure, folder / "figure_3b.png"), save_table(table, folder / "figure_3b.csv")]


FIGURE = Figure("angles that folds keep against the yield curvature, and their collapse", _runs, _draw)
