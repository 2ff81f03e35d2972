"""Folds: plastic flow of a hinge and of a strip, and two parts of a crumple, the ridge and the d-cone."""

import numpy as np
from scipy.optimize import brentq

import jaxcrumple as jc
from jaxcrumple.measure import hinge_curvature

from .base import ROW, Outcome, at_rest, benchmark, fixed

# Nodes of ridge and d-cone.
NODES, DCONE_NODES = 2000, 3000


def excess_time(u: float) -> float:
    """Integral of 1/S over u, S the smoothstep: the time for an excess curvature to decay, in units of T."""
    log = 11.0 * np.log(u) - 5.5 * np.log(u * u - 2.5 * u + 5.0 / 3.0)
    arc = 3.0 * np.sqrt(15.0) * np.arctan((4.0 * u - 5.0) * np.sqrt(15.0) / 5.0)
    return 0.015 * (log + arc) - 3.0 / (20.0 * u) - 1.0 / (20.0 * u * u)


def plastic_curvature(c: float, c0: float, time: float) -> float:
    """Rest curvature of a hinge held at curvature `c` for a `time` in units of T (1 + gamma)."""
    start, elapsed = (c - c0) / (2.0 - c0), time / (2.0 - c0)
    u = brentq(lambda u: excess_time(start) - excess_time(u) - elapsed, 1e-6, start, xtol=1e-15)
    return c - c0 - (2.0 - c0) * u


@benchmark("folds", "Andrejevic & Rycroft (2022), eqs. 34-36, integrated in closed form by partial fractions")
def held_hinge() -> list[Outcome]:
    """Rest curvature of a hinge that is held bent."""
    side, angle, times = 1e-2, 2.0 * np.arcsin(0.75), [1.0, 5.0, 20.0]
    flat = side * np.array([[0.0, 0.0], [1.0, 0.0], [0.5, ROW], [0.5, -ROW]])
    mesh = jc.Mesh.from_arrays(flat, [[0, 1, 2], [1, 0, 3]], reorder=False)
    x = mesh.vertices.copy()
    x[3] = side * np.array([0.5, -ROW * np.cos(angle), ROW * np.sin(angle)])
    material = jc.Material(yield_c0=0.3, gamma=1.0, plastic_time=1.0)
    scene = jc.sheet(mesh, material, prescribed=fixed(np.ones(4, bool), x))
    run = jc.simulate(scene, jc.initial_state(scene, x), times, solver=jc.integrator(1e-4), throw=True)
    return [
        Outcome(f"rest curvature after {t:g} T", "1", plastic_curvature(1.5, 0.3, 0.5 * t), abs(p[0]), 1e-3,
                "one hinge, rtol 1e-4")
        for t, p in zip(times, run.p, strict=True)
    ]  # fmt: skip


@benchmark(
    "folds",
    "1/R' = 1/R - K_y for slow flow (Gardiner, Trans. ASME 79, 1, 1957), with the flow of eqs. 34-36",
    quick=False,
)
def springback() -> list[Outcome]:
    """Curvature that a strip keeps that was held on a mandrel and let go."""
    spacing, radius, least, holds = 1e-3, 10e-3, 40.0, (0.2, 100.0)
    mesh = jc.hexagonal(30, 2, spacing, reorder=False)
    x, y, _ = mesh.vertices.T
    bent = np.stack([radius * np.sin(x / radius), y, radius * np.cos(x / radius) - radius], axis=1)
    material = jc.Material(yield_curvature=least, plastic_time=1e-3)
    held = jc.sheet(mesh, material, prescribed=fixed(np.ones(mesh.n_nodes, bool), bent))
    run = jc.simulate(held, jc.initial_state(held, bent), holds, solver=jc.integrator(1e-5), throw=True)
    # Bonds at 60 degrees to the strip yield, all alike. Bonds along it bend by less, and do not. They are
    # flat again where the free strip also bends across by a third. That stretches a wide strip: one of four
    # rows keeps 2 % less.
    across = np.abs(np.diff(mesh.vertices[mesh.hinges[:, :2]], axis=1)[:, 0, 1]) > 0.1 * spacing
    c, rows = hinge_curvature(mesh, bent)[across], []
    for hold, p in zip(holds, run.p, strict=True):
        end = at_rest(jc.sheet(mesh, material), bent, p)
        kept = plastic_curvature(np.abs(c).mean(), least * ROW * spacing, hold / material.plastic_time)
        expected = kept / np.abs(c).mean() / radius
        found = np.sum(hinge_curvature(mesh, end)[across]) / np.sum(c) / radius
        name = f"curvature, held for {hold:g} s"
        rows.append(Outcome(name, "1/m", expected, found, 0.01, f"lattice, {mesh.n_nodes} nodes, rtol 1e-5"))
    return rows


THIN = "the law is that of vanishing thickness; here it is 1/200 to 1/800 of the length"


@benchmark("folds", "Lobkovsky et al., Science 270, 1482 (1995): curvature X ~ (h/X)^(-1/3)", quick=False)
def ridge_exponent() -> list[Outcome]:
    """Curvature across the middle of an elastic ridge, for three thicknesses."""
    length, thickness = 0.1, np.array([0.5e-3, 0.25e-3, 0.125e-3])
    scaled = []
    for h in thickness:
        setup = jc.ridge(NODES, contact=None, material=jc.Material(thickness=h, yield_curvature=None))
        state = jc.initial_state(setup.scene, setup.x)
        # The corners close within 0.2 s; each part of the way is relaxed.
        for t in np.linspace(0.0, 0.2, 9)[1:]:
            state = jc.relax(setup.scene, state, t=t).state
        scaled.append(length * jc.ridge_curvature(setup.mesh, state.x))
    slope = np.polyfit(np.log(thickness / length), np.log(scaled), 1)[0]
    return [Outcome("exponent", "1", -1.0 / 3.0, slope, 0.05, f"{NODES} nodes", THIN)]


@benchmark(
    "folds", "Cerda & Mahadevan, Proc. R. Soc. A 461, 671 (2005): 139 degrees for thin sheets", quick=False
)
def dcone_sector() -> list[Outcome]:
    """Free sector of a developable cone, extrapolated to a thickness of zero from two depths."""
    sectors = []
    for slope in (0.1, 0.2):
        material = jc.Material(thickness=0.125e-3, yield_curvature=None)
        setup = jc.dcone(DCONE_NODES, slope=slope, contact=None, material=material)
        state = jc.initial_state(setup.scene, setup.x)
        # The cone rises by slope times radius at 2 cm/s; then the sheet comes to rest.
        solver = jc.integrator(scheme="dynamic")
        end = jc.simulate(setup.scene, state, 1.5 * slope * 0.05 / 0.02, solver=solver, throw=True).state
        sectors.append(np.rad2deg(jc.free_sector(setup, np.asarray(end.x), float(end.t))))
    # The deviation is proportional to the thickness over the depth, which halves. The first sector deviates
    # by 15 %; the square of that is left.
    why = "the extrapolation is linear in thickness over depth"
    limit = 2.0 * sectors[1] - sectors[0]
    return [Outcome("free sector", "degrees", 139.0, limit, 0.04, f"{DCONE_NODES} nodes, rtol 1e-2", why)]
