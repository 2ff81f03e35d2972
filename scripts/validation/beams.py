"""Beams: narrow strips that bend, vibrate, buckle and twist: Euler-Bernoulli theory and the elastica."""

from collections.abc import Iterator

import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import jaxcrumple as jc

from .base import PLAIN, Outcome, Strip, at_rest, benchmark, critical_load, fixed, forces, modes, strip

WIDTH = 1.5e-3
# Columns and rows of a coarse and a fine strip.
SIZES = ((72, 2), (144, 4))
# A clamp is known to a quarter of the spacing, 0.4 % of the length of the coarse strip. It keeps the strip
# from bending across over about a width, 2.5 % of the length, where the strip is up to 9/8 as stiff. The bend
# of a strip far beyond buckling does the same. At twice the width the deviations are twice as large.
TOLERANCE = 0.015
FREE = "clamps and sharp bends keep the strip from bending across: it is up to 9/8 stiffer there"


def clamped_strips(both: bool) -> Iterator[tuple[Strip, np.ndarray, float]]:
    """Yield a coarse and a fine strip, nodes (n,) that clamp one end or `both`, and the free length in m."""
    for columns, layers in SIZES:
        band = strip(columns, layers, WIDTH)
        yield band, *band.clamp(both)


def elastica(load: float, where: float) -> np.ndarray:
    """Point (2,) of a heavy inextensible beam of unit length and stiffness that is clamped horizontally.

    `load`: weight; `where`: distance from the clamp along the beam.
    """
    s = np.linspace(0.0, 1.0, 101)

    def slopes(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.array([y[1], -load * (1.0 - s) * np.cos(y[0]), np.cos(y[0]), -np.sin(y[0])])

    def conditions(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.array([a[0], b[1], a[2], a[3]])

    found = solve_bvp(slopes, conditions, s, np.array([s, 1.0 - s, s, -s]), tol=1e-9)
    return found.sol(where)[2:]


@benchmark(
    "beams",
    "Planar elastica, Levien (2008) for its history; solved by scipy.integrate.solve_bvp",
    quick=False,
)
def heavy_cantilever() -> list[Outcome]:
    """Tip of a cantilever that bends far under its own weight."""
    rows = []
    for band, held, length in clamped_strips(both=False):
        gravity = 10.0 * band.bending / (band.mass * length**3)
        x = band.mesh.vertices
        scene = jc.sheet(band.mesh, PLAIN, gravity=(0.0, 0.0, -gravity), prescribed=fixed(held, x))
        end = at_rest(scene, x)
        tip = x[:, 0] > x[:, 0].max() - 0.6 * band.spacing
        start = x[:, 0].max() + 0.25 * band.spacing - length
        across, down = end[tip, 0].mean() - start, end[tip, 2].mean()
        expected = length * elastica(10.0, (x[tip, 0].mean() - start) / length)
        rows += [
            Outcome("tip along", "mm", 1e3 * expected[0], 1e3 * across, TOLERANCE, str(band), FREE),
            Outcome("tip up", "mm", 1e3 * expected[1], 1e3 * down, TOLERANCE, str(band), FREE),
        ]
    return rows


@benchmark("beams", "Euler-Bernoulli: 1.8751, 4.6941, 7.8548 (Blevins 1979, table 8-1)")
def cantilever_frequencies() -> list[Outcome]:
    """Lowest three bending frequencies of a cantilever."""
    rows = []
    for band, held, length in clamped_strips(both=False):
        scene = jc.sheet(band.mesh, PLAIN, prescribed=fixed(held, band.mesh.vertices))
        values, shapes = modes(scene, band.mesh.vertices, 10)
        heights = shapes.reshape(-1, 3, 10)[:, 2]
        # Bending moves both edges alike, twisting moves them to opposite sides.
        side = np.sign(band.mesh.vertices[:, 1])
        bends = np.abs(side @ heights) < 0.1 * np.abs(heights).sum(axis=0)
        bends &= np.sum(heights**2, axis=0) > 0.5 * np.sum(shapes**2, axis=0)
        found = np.sqrt(values[bends]) / (2.0 * np.pi)
        unit = np.sqrt(band.bending / band.mass) / length**2 / (2.0 * np.pi)
        for number, root in enumerate((1.8751041, 4.6940911, 7.8547574)):
            name = f"frequency {number + 1}"
            rows.append(Outcome(name, "Hz", root**2 * unit, found[number], TOLERANCE, str(band), FREE))
    return rows


@benchmark("beams", "Euler (1744): P = 4 pi^2 B/L^2 for clamped ends", quick=False)
def euler_strut() -> list[Outcome]:
    """Compression at which a strip with clamped ends buckles."""
    rows = []
    for band, held, length in clamped_strips(both=True):
        flat, unit = band.mesh.vertices, 1e-5
        scene = jc.sheet(band.mesh, PLAIN, prescribed=fixed(held, flat * [1.0 - unit, 1.0, 1.0]))
        squeezed = at_rest(scene, flat + (flat * [1.0 - unit, 1.0, 1.0] - flat) * held[:, None])
        push = forces(scene, squeezed)[held & (flat[:, 0] > 0), 0].sum()

        def loaded(load: float, band=band, held=held, step=(squeezed - flat) / push):
            x = band.mesh.vertices + load * step
            return jc.sheet(band.mesh, PLAIN, prescribed=fixed(held, x)), x

        expected = 4.0 * np.pi**2 * band.bending / length**2
        rows.append(
            Outcome("load", "N", expected, critical_load(loaded, expected), TOLERANCE, str(band), FREE)
        )
    return rows


@benchmark("beams", "Elastica with clamped ends by elliptic integrals (Love 1927, art. 263)")
def buckled_elastica() -> list[Outcome]:
    """Height and load of a strip far beyond buckling, its ends closer by 0.3 of its length."""
    rows = []
    for band, held, length in clamped_strips(both=True):
        flat, short = band.mesh.vertices, 0.3
        target = flat - np.sign(flat[:, :1]) * [0.5 * short * length, 0.0, 0.0]
        start = flat * [1.0 - short, 1.0, 1.0]
        start[:, 2] = 0.3 * length * np.cos(np.pi * np.clip(flat[:, 0] / length, -0.5, 0.5)) ** 2
        scene = jc.sheet(band.mesh, PLAIN, prescribed=fixed(held, target))
        end = at_rest(scene, np.where(held[:, None], target, start))
        # Each quarter is a half of a pinned elastica of half the length.
        k = brentq(lambda k, short=short: 2.0 * (1.0 - ellipe(k * k) / ellipk(k * k)) - short, 0.01, 0.99)
        height, load = length * k / ellipk(k * k), 16.0 * ellipk(k * k) ** 2 * band.bending / length**2
        push = forces(scene, end)[held & (flat[:, 0] > 0), 0].sum()
        rows += [
            Outcome("height", "mm", 1e3 * height, 1e3 * end[:, 2].max(), 2.0 * TOLERANCE, str(band), FREE),
            Outcome("load", "N", load, push, 2.0 * TOLERANCE, str(band), FREE),
        ]
    return rows


@benchmark(
    "beams", "Kirchhoff plate: torque 2 kappa (1 - nu) W per twist (Timoshenko & Woinowsky-Krieger 1959)"
)
def twisted_strip() -> list[Outcome]:
    """Torque of a strip whose ends are twisted by a small angle."""
    band, twist = strip(50, 3, WIDTH), 1.0
    x, y, _ = band.mesh.vertices.T
    turned = np.stack([x, y * np.cos(twist * x), y * np.sin(twist * x)], axis=1)
    held = np.abs(x) > x.max() - 1.1 * band.spacing
    scene = jc.sheet(band.mesh, PLAIN, prescribed=fixed(held, turned))
    end = at_rest(scene, turned)
    one = held & (x > 0)
    torque = -np.cross(end[one], forces(scene, end)[one])[:, 0].sum()
    # Tension along the edges adds to the torque with the square of the twist: 1e-4 here.
    return [Outcome("torque", "N m", band.twisting * twist, torque, 0.01, str(band))]
