"""Figs. 5a, 6a, 8a, 8b and 8d: a sheet in a shrinking sphere."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxcrumple.io import Run
from jaxcrumple.measure import center_of_mass, cross_section, mean_curvature, stacked_layers, volume_fraction
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.paper.base import Figure, Runs, save_table
from jaxcrumple.paper.panels import frames_at, moments, plot_moments, table_of
from jaxcrumple.plot.plot import about, plot_steps
from jaxcrumple.plot.sections import plot_section, plot_volume_fraction
from jaxcrumple.run.config import RunConfig, configure

# Times of the panels, as shares of the end time.
SHARES = (0.25, 0.5, 0.75, 1.0)
# Distance in m along the normals within which layers count.
REACH = 2e-3
NONE: Mapping[str, Any] = MappingProxyType({})
# Settings at full size. The paper's runs end at 5 s (Fig. 5) and 6 s (Fig. 8).
FAST = {"rtol": 3e-2}
THIN, THIN_END = {**FAST, "thickness": 0.125e-3}, 5.5


def _one(
    nodes: tuple[int, int],
    t_end: tuple[float, float],
    at_full_size: Mapping[str, Any] = NONE,
    **settings: Any,
) -> Callable[[bool], dict[str, RunConfig]]:
    """Return a function that configures one run of `radial`, for a laptop or at full size.

    `settings`: of both; `at_full_size`: of that one besides."""

    def runs(full: bool) -> dict[str, RunConfig]:
        chosen = {**settings, **(at_full_size if full else {})}
        return {"radial": configure("radial", nodes=nodes[full], t_end=t_end[full], settings=chosen)}

    return runs


def _panels(number: str, shares: Sequence[float] = SHARES) -> Callable[[Runs, Path], list[Path]]:
    """Return a function that draws a run at several times."""

    def draw(runs: Runs, folder: Path) -> list[Path]:
        run = runs["radial"]
        shown = moments(run, frames_at(run, shares))
        picture = plot_moments(shown, about(run), folder / f"figure_{number}.png")
        return [picture, save_table(table_of(shown), folder / f"figure_{number}.csv")]

    return draw


def _draw_steps(runs: Runs, folder: Path) -> list[Path]:
    run = runs["radial"]
    picture = plot_steps(run.history, run.events, caption=about(run), path=folder / "figure_6.png")
    columns = ["t", "kind", "stage", "h", "acceleration_mean"]
    return [picture, save_table(run.history[columns], folder / "figure_6.csv")]


def _draw_inside(runs: Runs, folder: Path) -> list[Path]:
    run, mesh = runs["radial"], runs["radial"].mesh
    thickness = run.config["material"]["thickness"]
    frames = frames_at(run, (0.9, 1.0))
    fractions = {f"t = {run.t[k]:.3g} s": volume_fraction(mesh, run.x[k], thickness) for k in frames}
    paths = []
    for place, k in enumerate(frames, 1):
        path, caption = folder / f"figure_8b_{place}.png", about(run, t=run.t[k])
        paths.append(plot_section(mesh, run.x[k], thickness, caption=caption, path=path))
        paths.append(save_table(_cut(mesh, run.x[k]), path.with_suffix(".csv")))
    paths.append(plot_volume_fraction(fractions, caption=about(run), path=folder / "figure_8b.png"))
    rows = [
        pd.DataFrame(
            {
                "t": run.t[k],
                "r": 0.5 * (found.radii[1:] + found.radii[:-1]),
                "phi": found.phi,
                "phi0": found.phi0,
                "r0": found.r0,
                "layers": float(np.average(stacked_layers(mesh, run.x[k], REACH), weights=mesh.face_area)),
            }
        )
        for k, found in zip(frames, fractions.values(), strict=True)
    ]
    return [*paths, save_table(pd.concat(rows), folder / "figure_8b.csv")]


def _cut(mesh: Mesh, x: Float[np.ndarray, "nodes 3"]) -> pd.DataFrame:
    """Return both ends in m of the lines in which the plane of (b) cuts the triangles at `x` (n, 3)."""
    section = cross_section(mesh, x, center_of_mass(mesh, x), (0.0, 0.0, 1.0))
    ends = pd.DataFrame(section.ends.reshape(-1, 4), columns=["u0", "w0", "u1", "w1"])
    return ends.assign(face=section.faces)


def rearrangement(run: Run) -> int:
    """Return the index of the frame, in the second half, before which the mean curvature changes most.

    The change is the mean square difference of the mean curvatures, divided by the sum of their mean squares.
    """
    maps = np.array([mean_curvature(run.mesh, x) for x in run.x])
    squares = (maps**2) @ run.mesh.node_area
    change = (
        (np.diff(maps, axis=0) ** 2) @ run.mesh.node_area / np.maximum(squares[1:] + squares[:-1], 1e-300)
    )
    late = len(change) // 2
    return late + 1 + int(np.argmax(change[late:]))


def _draw_rearrangement(runs: Runs, folder: Path) -> list[Path]:
    run = runs["radial"]
    after = rearrangement(run)
    frames = [max(after - 2, 0), after - 1, after, min(after + 1, len(run.t) - 1)]
    shown = moments(run, frames)
    picture = plot_moments(shown, f"{about(run)}, elastic", folder / "figure_8d.png")
    return [picture, save_table(table_of(shown), folder / "figure_8d.csv")]


SNAPSHOTS = Figure(
    "a sheet in a sphere that shrinks, and its maps of mean curvature",
    _one((1000, 12000), (2.6, 5.0), FAST),
    _panels("5"),
)
STEPS = Figure(
    "step sizes, accelerations and stages of a crumple by alternating stages",
    _one((500, 12000), (2.2, 3.7), scheme="alternating", rtol=1e-3),
    _draw_steps,
)
MORPHOLOGY = Figure(
    "a crumple and its crease pattern as it is confined",
    _one((1000, 3000), (3.4, THIN_END), THIN),
    _panels("8a"),
)
INSIDE = Figure(
    "cross-sections of a crumple, and its volume fraction",
    _one((1000, 3000), (3.4, THIN_END), THIN),
    _draw_inside,
)
REARRANGEMENT = Figure(
    "an elastic sheet whose ridges and vertices rearrange",
    _one((1000, 3000), (2.6, 3.7), yield_curvature=None, frames=104),
    _draw_rearrangement,
)
