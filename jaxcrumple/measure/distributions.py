"""Distributions over the sheet: fold angle weighted by crease length, mean curvature weighted by area."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Real

from jaxcrumple._jax.arrays import HingeValuesLike, NodeVectorsLike
from jaxcrumple._jax.memory import require
from jaxcrumple.measure.creases import DAMAGE, damaged, hinge_angles, mean_curvature
from jaxcrumple.mesh.mesh import Mesh


class Distribution(NamedTuple):
    """A histogram: bounds `edges` (b + 1,) of its bins, and `density` (b,) per unit of the variable.

    The integral of the density is 1.
    """

    edges: Float[np.ndarray, " bounds"]
    density: Float[np.ndarray, " bins"]


def fold_angle_distribution(
    mesh: Mesh,
    x: NodeVectorsLike,
    p: HingeValuesLike,
    *,
    threshold: float = DAMAGE,
    bins: int | Real[ArrayLike, " bounds"] | Sequence[float] = 36,
) -> Distribution:
    """Return the density per rad of the signed angle at damaged hinges, weighted by rest length.

    Mountains have positive angles.

    **Arguments:** `x` (n, 3) in m; `p` (h,) and `threshold` as in `damaged`; `bins`: number of bins between
    -pi and pi, or their bounds in rad.

    **Raises:** ValueError for wrong shapes, if no hinge is damaged, or if an angle lies outside the bounds.
    """
    creases = damaged(mesh, p, threshold)
    if not creases.any():
        raise ValueError(
            f"no rest curvature changed by more than {threshold}; lower the threshold or fold more"
        )
    _check_bins(bins)
    if np.ndim(bins) == 0:
        bins = np.linspace(-np.pi, np.pi, int(bins) + 1)  # type: ignore[arg-type]
    return _histogram(hinge_angles(mesh, x)[creases], mesh.hinge_length[creases], bins)


def curvature_distribution(
    mesh: Mesh, x: NodeVectorsLike, *, bins: int | Real[ArrayLike, " bounds"] | Sequence[float] = 100
) -> Distribution:
    """Return the density of the nodal `mean_curvature` (per 1/m), weighted by the rest area of the nodes.

    **Arguments:** `x` (n, 3) in m; `bins`: number of bins from the lowest to the highest curvature, or their
    bounds in 1/m. Sharp folds have very large curvature: use narrower bins near zero.

    **Raises:** ValueError for a wrong shape of `x`, or if a curvature lies outside the bounds.
    """
    return _histogram(mean_curvature(mesh, x), mesh.node_area, bins)


def _check_bins(bins: int | Real[ArrayLike, " bounds"] | Sequence[float]) -> None:
    if np.ndim(bins) == 0:
        count = float(bins)  # type: ignore[arg-type]
        require(24.0 * count, f"a distribution of {count:.4g} bins", "choose fewer")


def _histogram(
    values: Float[np.ndarray, " values"],
    weights: Float[np.ndarray, " values"],
    bins: int | Real[ArrayLike, " bounds"] | Sequence[float],
) -> Distribution:
    _check_bins(bins)
    edges = np.histogram_bin_edges(values, bins)
    if values.min() < edges[0] or values.max() > edges[-1]:
        raise ValueError(
            f"bins from {edges[0]:.4g} to {edges[-1]:.4g} leave out some values, which range from"
            f" {values.min():.4g} to {values.max():.4g}; give bounds that contain all values"
        )
    density, _ = np.histogram(values, edges, weights=weights, density=True)
    return Distribution(edges, density)
