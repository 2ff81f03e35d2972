"""Crumpling: growth of creases, facet areas, volume fraction and avalanches on data whose law is known."""

import numpy as np

import jaxcrumple as jc
from jaxcrumple.measure import (
    area_cdf,
    crease_length,
    fit_growth,
    power_law_exponent,
    segment_facets,
    volume_fraction,
)

from .base import ROW, Outcome, benchmark


@benchmark("crumpling", "Gottesman et al., Commun. Phys. 1, 70 (2018): l/L = 52 (1 - D) ln(1 + 0.1 n/D)")
def crease_growth() -> list[Outcome]:
    """Constants of the logarithmic growth of creases, from published lengths."""
    cycle, length = [1, 2, 3, 10, 24], [11.96, 21.04, 28.36, 58.8, 87.0]
    table = fit_growth(cycle, length)
    if table.index[0] != "logarithmic":
        raise RuntimeError(f"the lengths fit the {table.index[0]} law better")
    c1, c2 = table.loc["logarithmic", ["c1", "c2"]]
    # Lengths have three digits; c2 is the worse determined.
    return [
        Outcome("c1", "1", 52.0 * (1.0 - 0.27), c1, 0.01, "five cycles"),
        Outcome("c2", "1", 0.1 / 0.27, c2, 0.02, "five cycles"),
    ]


def fragments(time: float, sheets: int) -> np.ndarray:
    """Areas at a `time` of unit `sheets` whose pieces of area A split in three at the rate sqrt(A)."""
    rng = np.random.default_rng(1)
    area, now, done = np.ones(sheets), np.zeros(sheets), []
    while len(area):
        now = now + rng.exponential(1.0 / np.sqrt(area))
        done.append(area[now >= time])
        area, now = area[now < time], now[now < time]
        # Shares of three pieces have the density of Dirichlet's law with parameters 1/2.
        area = (area[:, None] * rng.dirichlet([0.5, 0.5, 0.5], len(area))).ravel()
        now = np.repeat(now, 3)
    return np.concatenate(done)


@benchmark(
    "crumpling", "Andrejevic et al., Nat. Commun. 12, 1470 (2021): fragmentation at the rate sqrt(A), a = 1"
)
def facet_areas() -> list[Outcome]:
    """Areas that a simulated fragmentation leaves, against the law that facets are compared with."""
    areas = fragments(60.0, 100)
    share, rows = areas / areas.mean(), []
    for xi in (0.1, 1.0, 3.0):
        found = float(area_cdf(xi, 1.0))
        about = f"{len(areas)} areas"
        # Standard error 0.1 %; the law holds for late times, to 1/t.
        rows.append(
            Outcome(f"share of areas below {xi:g} means", "1", (share < xi).mean(), found, 0.02, about)
        )
    return rows


@benchmark("crumpling", "Geometry: a disc of thickness h has phi = h/(2 r) at the radius r")
def volume_of_a_disc() -> list[Outcome]:
    """Volume fraction of a flat disc in spherical shells."""
    thickness = 1e-4
    mesh = jc.disc(0.05, 2000, seed=0)
    found, rows = volume_fraction(mesh, mesh.vertices, thickness, shells=10), []
    for k in (0, 4, 8):
        inner, outer = found.radii[k : k + 2]
        expected = 0.75 * thickness * (outer**2 - inner**2) / (outer**3 - inner**3)
        name = f"volume fraction, r = {1e3 * inner:g} to {1e3 * outer:g} mm"
        # The centre of mass is off the centre by a thousandth of the radius.
        rows.append(Outcome(name, "1", expected, float(found.phi[k]), 0.003, "disc, 2000 nodes"))
    return rows


@benchmark("crumpling", "Clauset et al., SIAM Rev. 51, 661 (2009): maximum likelihood")
def avalanche_exponent() -> list[Outcome]:
    """Exponent of a power law, from samples by inversion of its distribution."""
    values = (1.0 - np.random.default_rng(0).uniform(size=20000)) ** (-1.0 / 1.5)
    found = power_law_exponent(values, 1.0)
    # Standard error (alpha - 1)/sqrt(N), 0.4 % of alpha.
    return [Outcome("exponent", "1", 2.5, float(found[0]), 0.015, "20000 values")]


@benchmark("crumpling", "Geometry: parallel creases w apart cut a sheet of side L into facets of area w L")
def creased_square() -> list[Outcome]:
    """Crease length and facets of a square with four straight creases."""
    side, rows, columns = 0.1, 35, 30
    mesh = jc.hexagonal(columns, rows, side / columns)
    height = mesh.vertices[:, 1]
    levels = np.unique(np.round(height, 9))
    p = np.zeros(len(mesh.hinges))
    ends = np.round(height[mesh.hinges[:, :2]], 9)
    for level in levels[7:-1:7]:
        p[np.all(ends == level, axis=1)] = 0.5
    facets = segment_facets(mesh, p)
    length, width = (columns - 1) * side / columns, 7 * ROW * side / columns
    about = f"lattice, {mesh.n_nodes} nodes"
    return [
        Outcome("crease length", "m", 4.0 * length, crease_length(mesh, p), 1e-9, about),
        Outcome("facets", "1", 5.0, len(facets.area), 1e-9, about),
        Outcome("smallest facet", "cm2", 1e4 * length * width, 1e4 * facets.area.min(), 1e-9, about),
    ]
