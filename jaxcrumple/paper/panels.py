"""Plot panels of a run at several times: the sheet in space, and its mean curvature on the flat sheet."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxcrumple.io import Run
from jaxcrumple.measure import crease_length, mean_curvature
from jaxcrumple.plot.figure import new_figure, save_figure
from jaxcrumple.plot.picture import picture
from jaxcrumple.plot.plot import draw_flat
from jaxcrumple.plot.sheet import CURVATURE_LABEL, color_scale

# Longer side of a sheet in pixels.
PANEL = 500


class Moment(NamedTuple):
    """A frame of a run, by index, and its title."""

    title: str
    run: Run
    frame: int


def frames_at(run: Run, shares: Sequence[float]) -> list[int]:
    """Return the indices of the frames nearest to shares of a run's time, without repetition."""
    return list(dict.fromkeys(int(np.argmin(np.abs(run.t - share * run.t[-1]))) for share in shares))


def moments(run: Run, frames: Sequence[int]) -> list[Moment]:
    """Return frames of a run, by index, with their times as titles."""
    return [Moment(f"t = {run.t[frame]:.3g} s", run, frame) for frame in frames]


def plot_moments(shown: Sequence[Moment], caption: str, path: Path) -> Path:
    """Plot one column for each moment: the sheet in space, and its mean curvature on the flat sheet."""
    curvature = [mean_curvature(one.run.mesh, one.run.x[one.frame]) for one in shown]
    scale = color_scale(*curvature, signed=True)
    figure = new_figure((2.6 * len(shown) + 0.8, 5.4), caption)
    maps = []
    for column, (one, values) in enumerate(zip(shown, curvature, strict=True), 1):
        space = figure.add_subplot(2, len(shown), column, title=one.title, anchor="N")
        picture(one.run, one.frame, axes=space, scale=scale, pixels=PANEL)
        flat = figure.add_subplot(2, len(shown), len(shown) + column, aspect="equal", xticks=[], yticks=[])
        draw_flat(flat, one.run.mesh, scale, values)
        maps.append(flat)
    figure.colorbar(scale, ax=maps, label=CURVATURE_LABEL, extend="both", shrink=0.8)
    return save_figure(figure, path)


def table_of(shown: Sequence[Moment]) -> pd.DataFrame:
    """Return the data of the panels: one row for each moment, with energies in J and crease length in m."""
    return pd.DataFrame([_row(one) for one in shown])


def _row(one: Moment) -> Mapping[str, float | str]:
    run, frame = one.run, one.frame
    history = run.history[run.history["t"] <= run.t[frame] * (1.0 + 1e-9)]
    energies = {
        name: float(history[name].iloc[-1]) if len(history) else 0.0 for name in ("stretch", "bending")
    }
    curvature = mean_curvature(run.mesh, run.x[frame])
    return {
        "panel": one.title,
        "scene": run.config["scene"],
        "nodes": run.mesh.n_nodes,
        "t": float(run.t[frame]),
        **energies,
        "crease_length": crease_length(run.mesh, run.p[frame]),
        "rms_curvature": float(np.sqrt(np.average(curvature**2, weights=run.mesh.node_area))),
    }
