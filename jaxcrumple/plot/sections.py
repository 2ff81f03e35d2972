"""Plot the inside of a crumple (Fig. 8b): cross-sections and volume fraction; also distributions.

Each function writes one picture to `path` as in `jaxcrumple.plot.plot`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple.measure import (
    Distribution,
    VolumeFraction,
    center_of_mass,
    cross_section,
    thick_section,
)
from jaxcrumple.measure.sections import Vector
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.plot.figure import new_figure, save_figure

SHEET = "#1f3b5c"


def plot_section(
    mesh: Mesh,
    x: NodeVectorsLike,
    thickness: float,
    *,
    normal: Vector = (0.0, 0.0, 1.0),
    point: Vector | None = None,
    caption: str = "",
    path: str | Path,
) -> Path:
    """Plot a cross-section of the sheet in mm, with the thickness to scale (Fig. 8b).

    **Arguments:** `x` (n, 3): positions in m; `thickness` in m.

    The plane contains `point` (3,) in m, by default the centre of mass, and has the normal vector `normal`
    (3,) of any length. A thin line along the midsurface closes the wedges at folds.

    **Raises:** as `cross_section` and `save_figure`, and ValueError if the plane misses the sheet.
    """
    point = center_of_mass(mesh, x) if point is None else point
    section = cross_section(mesh, x, point, normal)
    if len(section.faces) == 0:
        raise ValueError("the plane does not cut the sheet; give a point inside it")
    figure = new_figure((6.4, 6.0), caption)
    axes = figure.add_subplot(aspect="equal", xlabel="[mm]", ylabel="[mm]")
    outlines = list(1e3 * thick_section(mesh, x, thickness, point, normal))
    axes.add_collection(PolyCollection(outlines, facecolors=SHEET, edgecolors="none"))
    axes.add_collection(LineCollection(list(1e3 * section.ends), colors=SHEET, linewidths=0.4))
    axes.autoscale_view()
    return save_figure(figure, path)


def plot_volume_fraction(
    fractions: Mapping[str, VolumeFraction], *, caption: str = "", path: str | Path
) -> Path:
    """Plot scaled volume fractions $\\phi(r)/\\phi_0$ against $r/r_0$ (Fig. 8b), one line for each name.

    **Raises:** as `save_figure`, and ValueError without a fraction.
    """
    if not fractions:
        raise ValueError("there is no volume fraction to plot; give one by name")
    figure = new_figure((6.0, 4.4), caption)
    axes = figure.add_subplot(xlabel="$r/r_0$ [-]", ylabel=r"$\phi(r)/\phi_0$ [-]")
    for name, found in fractions.items():
        middles = 0.5 * (found.radii[1:] + found.radii[:-1]) / found.r0
        label = f"{name}: $\\phi_0$ = {found.phi0:.3g}, $r_0$ = {1e3 * found.r0:.3g} mm"
        axes.plot(middles, found.phi / found.phi0, "o-", markersize=3, linewidth=1.2, label=label)
    axes.axhline(1.0, color="black", linewidth=0.6, linestyle="--")
    axes.set(xlim=(0.0, 1.0))
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", frameon=False)
    return save_figure(figure, path)


def plot_distributions(
    distributions: Mapping[str, Distribution], *, label: str, caption: str = "", path: str | Path
) -> Path:
    """Plot probability densities on a logarithmic axis, one stepped line for each name.

    `label`: name and unit of the quantity.

    **Raises:** as `save_figure`, and ValueError without a distribution.
    """
    if not distributions:
        raise ValueError("there is no distribution to plot; give one by name")
    figure = new_figure((6.0, 4.4), caption)
    axes = figure.add_subplot(xlabel=label, ylabel="probability density", yscale="log")
    for name, found in distributions.items():
        shown = np.where(found.density > 0, found.density, np.nan)  # a logarithmic axis cannot show it
        axes.stairs(shown, found.edges, baseline=None, label=name, linewidth=1.2)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return save_figure(figure, path)
