"""Plot a run: sheet, creases, steps and energies, similar to Figs. 5a and 6a.

Every function writes one picture to `path` and returns `path`; its extension selects the format (.png, .pdf,
.svg, ...). The functions need no display and change no global setting of matplotlib.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D
from matplotlib.tri import Triangulation

from jaxcrumple._jax.arrays import HingeValuesLike, NodeVectorsLike
from jaxcrumple.io.run import Run, load
from jaxcrumple.measure import DAMAGE, crease_pattern, mean_curvature, mountain_valley_length
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.plot.draw import draw_sheet
from jaxcrumple.plot.figure import new_figure, save_figure
from jaxcrumple.plot.sheet import CURVATURE_LABEL, Walls, color_scale
from jaxcrumple.plot.surroundings import wall_shapes
from jaxcrumple.run.config import MaterialOptions, SolverOptions
from jaxcrumple.solvers.log import AFTER, STEP
from jaxcrumple.state import STAGES

PALE = LinearSegmentedColormap.from_list("pale", ["#7fb2dc", "#f7f7f7", "#efa184"])  # lines stay visible
MOUNTAIN, VALLEY = "#8e0012", "#0a2a6b"
# Part of each edge that is drawn of a valley, so that it differs from a mountain without colours too.
DASH = 0.55
STAGE_COLORS = {"quasistatic": "#1f6fb4", "implicit": "#e8a33d", "explicit": "#d9541e"}
ENERGY_COLORS = {
    "stretch": "#1f6fb4",
    "bending": "#d9541e",
    "contact": "#c2a500",
    "walls": "#5b8c3a",
    "gravity": "#8c564b",
    "extra": "#7f5ab0",
    "kinetic": "#777777",
}


def plot_creases(
    mesh: Mesh,
    x: NodeVectorsLike,
    p: HingeValuesLike,
    *,
    threshold: float = DAMAGE,
    caption: str = "",
    path: str | Path,
) -> Path:
    """Plot the crease pattern: mean curvature of `x` (n, 3) on the flat sheet, and damaged edges (Fig. 5a).

    The figure shows the x-y plane of the rest shape in mm. Edges whose rest curvature `p` (h,) changed by
    more than `threshold` appear as mountains (convex as seen from the side of the face normals) or valleys.
    Colours span the curvatures of all but the sharpest 2 % of the nodes.

    **Raises:** ValueError for a wrong shape, and as `save_figure`.
    """
    flat = 1e3 * mesh.vertices[:, :2]
    curvature = mean_curvature(mesh, x)
    scale = color_scale(curvature, signed=True)
    scale.set_cmap(PALE)
    figure = new_figure((7.2, 6.2), caption)
    axes = figure.add_subplot(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    draw_flat(axes, mesh, scale, curvature)
    pattern, lengths = crease_pattern(mesh, p, threshold), mountain_valley_length(mesh, p, threshold)
    handles = []
    kinds: tuple[tuple[str, int, str, float, Any], ...] = (
        ("mountain", 1, MOUNTAIN, 1.0, "-"),
        ("valley", -1, VALLEY, DASH, "--"),
    )
    for (name, sign, color, part, style), length in zip(kinds, lengths, strict=True):
        ends = flat[mesh.hinges[pattern == sign, :2]]
        middle = ends.mean(axis=1, keepdims=True)
        lines = list(middle + part * (ends - middle))
        axes.add_collection(LineCollection(lines, colors=color, linewidths=0.9, capstyle="round"))
        handles.append(Line2D([], [], color=color, linestyle=style, label=f"{name}, {1e2 * length:.3g} cm"))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=2,
        frameon=False,
        title=f"edges with $|\\Delta p| > {threshold:g}$, $p = 2 \\sin(\\theta_{{rest}} / 2)$",
    )
    figure.colorbar(scale, ax=axes, label=CURVATURE_LABEL, extend="both")
    axes.autoscale_view()
    return save_figure(figure, path)


def plot_steps(
    history: pd.DataFrame,
    events: pd.DataFrame | None = None,
    *,
    thresholds: Sequence[float] = (),
    caption: str = "",
    path: str | Path,
) -> Path:
    """Plot step size and mean scaled acceleration over time, coloured by stage, with the switches (Fig. 6a).

    **Arguments:** `history`, `events`: as returned by `jaxcrumple.io.load`; without events that lead `to` a
    stage, the switches come from the history. `thresholds`: values of $a_{max}/a_{ref}$ for dashed lines.

    **Raises:** ValueError if the history has no steps, and as `save_figure`.
    """
    steps = history[history["kind"] == STEP] if len(history) else history
    if len(steps) == 0:
        raise ValueError("the history has no steps to plot; run longer")
    figure = new_figure((8.0, 5.6), caption)
    top, bottom = figure.subplots(2, 1, sharex=True)
    labels = ("step $h$ [s]", r"mean $a_{\max}/a_{\mathrm{ref}}$ [-]")
    for axes, column, label in zip((top, bottom), ("h", "acceleration_mean"), labels, strict=True):
        _stage_lines(axes, steps, column)
        axes.set(yscale="log", ylabel=label)
        axes.grid(alpha=0.3)
    for value in thresholds:
        bottom.axhline(value, color="black", linestyle="--", linewidth=0.9)
    switches = _switch_times(history, events)
    for axes in (top, bottom):
        for t in switches:
            axes.axvline(t, color="black", linewidth=0.5, alpha=0.25, zorder=0)
    handles = [Line2D([], [], color=color, label=name) for name, color in STAGE_COLORS.items()]
    handles.append(Line2D([], [], color="black", alpha=0.4, linewidth=0.7, label=f"{len(switches)} switches"))
    if len(thresholds):
        handles.append(Line2D([], [], color="black", linestyle="--", label="switching thresholds"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    bottom.set_xlabel("time $t$ [s]")
    return save_figure(figure, path)


def plot_energies(history: pd.DataFrame, *, caption: str = "", path: str | Path) -> Path:
    """Plot energies by term in J over time; negative energies (loads) appear dashed, with their magnitude.

    **Raises:** ValueError if the history is empty, and as `save_figure`.
    """
    if len(history) == 0:
        raise ValueError("the history has no rows to plot; run longer")
    figure = new_figure((8.0, 4.4), caption)
    axes = figure.add_subplot(yscale="log", xlabel="time $t$ [s]", ylabel="energy [J]")
    largest = 0.0
    for name, color in ENERGY_COLORS.items():
        energy = history[name].to_numpy(dtype=float)
        for sign, label, style in ((1.0, name, "-"), (-1.0, f"-{name}", "--")):
            if np.any(sign * energy > 0):
                shown = np.where(sign * energy > 0, sign * energy, np.nan)
                axes.plot(history["t"], shown, style, color=color, label=label, linewidth=1.2)
                largest = max(largest, float(np.nanmax(shown)))
    if largest > 0:
        axes.set_ylim(bottom=max(1e-9 * largest, axes.get_ylim()[0]), top=3 * largest)
        axes.legend(frameon=False, ncols=3)
    axes.grid(alpha=0.3)
    return save_figure(figure, path)


def plot_run(folder: str | Path) -> list[Path]:
    """Plot last frame, steps and energies of a run, finished or not, and write the pictures to its `folder`.

    **Raises:** `RunDirectoryError` as `jaxcrumple.io.load`, or if a picture cannot be written.
    """
    folder = Path(folder)
    run = load(folder)
    caption, last, now = about(run), run.x[-1], about(run, t=run.t[-1])
    walls = Walls(wall_shapes(run), float(run.t[-1]))
    pictures = [
        draw_sheet(run.mesh, last, walls=walls, caption=now).save(folder / "sheet.png"),
        plot_creases(run.mesh, last, run.p[-1], caption=now, path=folder / "creases.png"),
    ]
    if len(run.history) and (run.history["kind"] == STEP).any():
        limits = _thresholds(run)
        path = folder / "steps.png"
        pictures.append(plot_steps(run.history, run.events, thresholds=limits, caption=caption, path=path))
        pictures.append(plot_energies(run.history, caption=caption, path=folder / "energies.png"))
    return pictures


def about(*runs: Run, t: float | None = None) -> str:
    """Describe scene, size, seed, tolerance and time in s of a run, or of several that differ in their seeds,
    as far as their configurations contain them."""
    first, seeds = runs[0], [run.config["seed"] for run in runs if "seed" in run.config]
    config, solver = first.config, first.config.get("solver", {})
    words = [config["scene"]] if "scene" in config else []
    words.append(f"n = {first.mesh.n_nodes}")
    words += [f"seed{'s' if len(seeds) > 1 else ''} {' '.join(spans(seeds))}"] if seeds else []
    words += [f"rtol {solver['rtol']:g}"] if "rtol" in solver else []
    return ", ".join(words + ([] if t is None else [f"t = {t:.4g} s"]))


def spans(seeds: Sequence[int]) -> Iterator[str]:
    """Yield numbers as text; three or more in succession as one, such as "4-7"."""
    for _, found in itertools.groupby(enumerate(seeds), lambda pair: pair[1] - pair[0]):
        numbers = [str(number) for _, number in found]
        yield from numbers if len(numbers) < 3 else [f"{numbers[0]}-{numbers[-1]}"]


# Parts


def draw_flat(axes: Axes, mesh: Mesh, scale: ScalarMappable, values: Float[np.ndarray, " nodes"]) -> None:
    """Draw node `values` (n,) as colours on the flat sheet into axes in mm."""
    flat = 1e3 * mesh.vertices
    sheet = Triangulation(flat[:, 0], flat[:, 1], mesh.faces)
    axes.tripcolor(sheet, values, shading="gouraud").set(cmap=scale.cmap, norm=scale.norm)


def _thresholds(run: Run) -> list[float]:
    """Return the thresholds of the switch as values of a_max/a_ref; empty if the scheme has no switch."""
    options = SolverOptions(**run.config.get("solver", {}))
    if options.scheme not in ("alternating", "paper"):
        return []
    switch, material = options.switch(), MaterialOptions(**run.config.get("material", {})).build()
    inertial_time = 1.0 / material.drag_rate if material.drag_rate else np.inf
    unit = switch.value(1.0, material.discretize(run.mesh).a_ref, inertial_time, np.sqrt(run.mesh.area))
    if np.isinf(unit):
        return []
    return [float(switch.down / unit), float(switch.up / unit)]


def _stage_lines(axes: Axes, steps: pd.DataFrame, column: str) -> None:
    """Draw a column over time; the stage of the step at the end of a segment sets its colour."""
    t, y = steps["t"].to_numpy(dtype=float), steps[column].to_numpy(dtype=float)
    y = np.where(y > 0, y, np.nan)  # a logarithmic axis cannot show it
    stage = steps["stage"].to_numpy()
    for name in STAGES:
        into = stage[1:] == name
        segments = np.stack([np.column_stack([t, y])[:-1], np.column_stack([t, y])[1:]], axis=1)[into]
        axes.add_collection(LineCollection(list(segments), colors=STAGE_COLORS[name], linewidths=1.1))
        axes.plot(t[stage == name], y[stage == name], ".", color=STAGE_COLORS[name], markersize=2)


def _switch_times(history: pd.DataFrame, events: pd.DataFrame | None) -> Float[np.ndarray, " switches"]:
    if events is not None and {"t", "to"} <= set(events.columns):
        chosen = events[events["to"].isin(STAGES)]
        if len(chosen):
            return chosen["t"].to_numpy(dtype=float)
    return history.loc[history["kind"] == AFTER, "t"].to_numpy(dtype=float)
