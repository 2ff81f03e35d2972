"""Plot statistics of crumpling, as in Fig. 9: facets, facet areas, growth of the crease length.

As in `jaxcrumple.plot.plot`, each function writes one picture to `path` and returns `path`; its extension
selects the format.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import ArrayLike, Float, Int, Real
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import hsv_to_rgb

from jaxcrumple._jax.arrays import HingeValuesLike
from jaxcrumple.measure import DAMAGE, area_density, damaged, fit_areas, fit_growth
from jaxcrumple.measure.growth import LAWS
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.plot.figure import new_figure, save_figure

MEASURED, THEORY, FAINT = "#1f6fb4", "black", "#999999"


def plot_facets(
    mesh: Mesh,
    label: Int[ArrayLike, " faces"],
    p: HingeValuesLike,
    *,
    threshold: float = DAMAGE,
    caption: str = "",
    path: str | Path,
) -> Path:
    """Plot facets in random colours on the flat sheet in mm, with damaged edges on top (Fig. 9d).

    **Arguments:** `label` (f,): facet of each triangle, from `segment_facets`; `p` (h,): rest curvature;
    edges whose rest curvature changed by more than `threshold` count as damaged; `caption`: text above the
    figure.

    **Raises:** ValueError for a wrong shape or an unknown extension of `path`, `RunDirectoryError` if `path`
    cannot be written.
    """
    label, count = np.asarray(label), len(mesh.faces)
    if label.shape != (count,):
        raise ValueError(f"label has shape {label.shape}; give a facet for each of {count} triangles")
    flat = 1e3 * mesh.vertices[:, :2]
    broken = damaged(mesh, p, threshold)
    figure = new_figure((6.2, 6.2), caption)
    axes = figure.add_subplot(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    colors = _random_colors(int(label.max()) + 1)[label]
    corners = list(flat[mesh.faces])
    axes.add_collection(PolyCollection(corners, facecolors=colors, edgecolors=colors, linewidths=0.2))
    lines = list(flat[mesh.hinges[broken, :2]])
    axes.add_collection(LineCollection(lines, colors="black", linewidths=0.9, capstyle="round"))
    axes.set_title(f"{len(np.unique(label))} facets, edges with $|\\Delta p| > {threshold:g}$", fontsize=10)
    axes.autoscale_view()
    return save_figure(figure, path)


def plot_areas(
    areas: Real[ArrayLike, " facets"] | Sequence[float],
    sheets: int = 1,
    *,
    bins: int = 8,
    caption: str = "",
    path: str | Path,
) -> Path:
    """Plot the density of areas over their mean, and the fragmentation law of this mean (Fig. 9d, bottom).

    Error bars are one standard deviation of the counts.

    **Arguments:** `areas` (k,): areas of all facets of all sheets, in any unit; `sheets`: number of sheets;
    `bins`: number of bins, of equal width on the logarithmic axis; `caption`: text above the figure.

    **Raises:** as `plot_facets`, and ValueError for areas that `fit_areas` refuses.
    """
    fit = fit_areas(areas, sheets)
    xi = np.asarray(areas, dtype=np.float64)
    xi = xi / xi.mean()
    edges = np.geomspace(xi.min() * (1 - 1e-9), xi.max() * (1 + 1e-9), bins + 1)
    count, _ = np.histogram(xi, edges)
    middle, unit = np.sqrt(edges[1:] * edges[:-1]), len(xi) * np.diff(edges)
    seen = count > 0
    figure = new_figure((5.6, 4.4), caption)
    axes = figure.add_subplot(xscale="log", yscale="log", ylabel=r"density $\phi(\xi)$ [-]")
    axes.set_xlabel(r"area over its mean, $\xi$ [-]")
    density, error = (values[seen] / unit[seen] for values in (count, np.sqrt(count)))
    axes.errorbar(
        middle[seen],
        density,
        np.minimum(error, 0.99 * density),
        fmt="o",
        color=MEASURED,
        label=f"{fit.facets} facets",
    )
    fine = np.geomspace(edges[0] / 2, 2 * edges[-1], 200)
    law = f"fragmentation, $a$ = {fit.a:.2f}, distance {fit.fragmentation:.2f}"
    axes.plot(fine, area_density(fine, fit.a), color=THEORY, label=law)
    axes.plot(fine, np.exp(-fine), ":", color=FAINT, label=f"exponential, distance {fit.exponential:.2f}")
    axes.set_ylim(bottom=density.min() / 10)
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return save_figure(figure, path)


def plot_growth(
    cycle: Real[ArrayLike, " cycles"] | Sequence[float],
    length: Real[ArrayLike, "... cycles"] | Sequence[float],
    *,
    caption: str = "",
    path: str | Path,
) -> Path:
    """Plot the crease length in m against the cycle number, and the laws fitted by `fit_growth` (Fig. 9b).

    **Arguments:** `cycle` (m,), `length` (m,): as for `fit_growth`, or `length` (k, m) of k sheets; the
    figure then shows all sheets, and the laws fit their mean; `caption`: text above the figure.

    **Raises:** as `plot_facets`, and ValueError for input that `fit_growth` refuses.
    """
    sheets = np.atleast_2d(length)
    mean = sheets.mean(axis=0)
    table = fit_growth(cycle, mean)
    n, fine = np.asarray(cycle), np.linspace(1, np.max(cycle), 200)
    figure = new_figure((5.6, 4.4), caption)
    axes = figure.add_subplot(xlabel="cycle $n$", ylabel="crease length [m]")
    if len(sheets) > 1:
        axes.plot(n, sheets.T, "o-", color=MEASURED, alpha=0.3, markersize=3)
    axes.plot(n, mean, "o", color=MEASURED, label="measured" if len(sheets) == 1 else "mean")
    styles = {"logarithmic": "--", "linear": ":", "power": "-."}
    for law, (c1, c2, rss, _) in zip(table.index, table.to_numpy(), strict=True):
        rms = 1e3 * np.sqrt(rss / len(n))
        color = THEORY if law == "logarithmic" else FAINT
        axes.plot(fine, LAWS[law](fine, c1, c2), styles[law], color=color, label=f"{law}, rms {rms:.3g} mm")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return save_figure(figure, path)


def _random_colors(count: int) -> Float[np.ndarray, "colors 3"]:
    """Return reproducible light colours (count, 3); consecutive ones differ strongly in hue."""
    rng = np.random.default_rng(0)
    hue = (0.618034 * np.arange(count)) % 1  # steps of the golden section
    saturation, value = rng.uniform(0.35, 0.6, count), rng.uniform(0.8, 1, count)
    return hsv_to_rgb(np.column_stack([hue, saturation, value]))
