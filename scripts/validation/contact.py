"""Contact: pressure between two layers, and the rebound of a sheet from a wall, in closed form."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

import jaxcrumple as jc

from .base import PLAIN, ROW, Outcome, benchmark, forces

RANGE = 0.5e-3


def folded(gap: float, columns: int, rows: int, step: float) -> tuple[jc.Mesh, np.ndarray]:
    """Mesh and positions of a strip of crossed rectangles whose two layers are `gap` m apart."""
    along = np.concatenate([np.arange(columns) - columns + 1.0, np.arange(columns)]) * step
    along[columns:] += gap
    across = step * (np.arange(rows) - 0.5 * (rows - 1))
    s, y = (grid.ravel() for grid in np.meshgrid(along, across, indexing="ij"))
    a = (rows * np.arange(2 * columns - 1)[:, None] + np.arange(rows - 1)).ravel()
    odd = np.add.outer(np.arange(2 * columns - 1), np.arange(rows - 1)).ravel() % 2 == 1
    b, c, d = a + rows, a + rows + 1, a + 1
    faces = np.concatenate(
        [np.stack([a, b, np.where(odd, c, d)], 1), np.stack([np.where(odd, a, b), c, d], 1)]
    )
    mesh = jc.Mesh.from_arrays(np.stack([s, y], axis=1), faces, reorder=False)
    upper = s > 0.0
    x = np.stack([np.where(upper, gap - s, s), y, np.where(upper, gap, 0.0)], axis=1)
    return mesh, x


@benchmark(
    "contact",
    "P = 2 pi n^2 g U(g) of two dense layers of sites with pair energy U (integral over one layer)",
    quick=False,
)
def layer_pressure() -> list[Outcome]:
    """Pressure between two parallel layers, for the paper's pair potential and the default one."""
    laws = {
        "penalty": lambda r: np.exp(1.0 / (r - 1.0)),
        "inverse-power": lambda r: 0.1 * (1.0 - r) ** 3 / r**4,
    }
    rows, density = [], 1.0 / (ROW * RANGE**2)
    for potential, law in laws.items():
        for share in (0.6, 0.75):
            mesh, x = folded(share * RANGE, 9, 5, 1.1e-3)
            contact = jc.SelfContact(potential, range=RANGE, level=7)
            scene = jc.with_contacts(jc.sheet(mesh, PLAIN, contact=contact), x)
            inner = (x[:, 0] > -7e-3) & (x[:, 0] < -2e-3) & (np.abs(x[:, 1]) < 1.2e-3) & (x[:, 2] > 0)
            found = forces(scene, x)[inner, 2].sum() / mesh.node_area[inner].sum()
            energy = PLAIN.spring_constant * RANGE**2 * law(share)
            expected = 2.0 * np.pi * density**2 * share * RANGE * energy
            name = f"pressure, {potential}, gap {share:g} ranges"
            # Each site meets 20 to 30 sites of the other layer, instead of a dense layer.
            why = "sites are 0.28 ranges apart, not dense"
            rows.append(Outcome(name, "kPa", 1e-3 * expected, 1e-3 * found, 0.04, "level 7", why))
    return rows


@benchmark(
    "contact",
    "Energy conservation: speed, and time of the bounce by quadrature of the wall's potential",
    quick=False,
)
def rebound() -> list[Outcome]:
    """Rebound of a flat sheet from a rigid wall."""
    speed, start, wall_range, stiffness = 1.0, 1.2e-3, 1e-3, 2e6
    material = replace(PLAIN, mass_lumping="area")
    mesh = jc.rectangle(0.02, 0.02, 60, seed=0)
    # The same stiffness per area everywhere, so that the sheet stays flat.
    wall = jc.Wall(jc.Plane(jnp.array([0.0, 0.0, 1.0]), 0.0), stiffness * mesh.node_area, wall_range)
    scene = jc.sheet(mesh, material, walls=[wall])
    mass = material.density * material.thickness

    def left(gap: float) -> float:
        """Square of the speed in m2/s2."""
        s = 1.0 - gap / wall_range
        return speed**2 - 2.0 / mass * stiffness * wall_range**2 * s**3 / (3.0 * (1.0 - s))

    closest = brentq(left, 1e-3 * wall_range, wall_range, xtol=1e-18)
    inside = quad(lambda s: 2.0 * s / np.sqrt(left(closest + s * s)), 0.0, np.sqrt(wall_range - closest))[0]
    duration = 2.0 * (inside + (start - wall_range) / speed)
    x, v = mesh.vertices + np.array([0.0, 0.0, start]), np.tile([0.0, 0.0, -speed], (mesh.n_nodes, 1))
    rows = []
    for rtol, tolerance in ((1e-3, 0.02), (1e-4, 0.005)):
        solver = jc.integrator(rtol, scheme="dynamic")
        run = jc.simulate(scene, jc.initial_state(scene, x, v), 1.1 * duration, solver=solver, throw=True)
        away, height = float(jnp.mean(run.state.v[:, 2])), float(jnp.mean(run.state.x[:, 2]))
        back = 1.1 * duration - (height - start) / away
        rows += [
            Outcome("speed after", "m/s", speed, away, tolerance, f"60 nodes, rtol {rtol:g}"),
            Outcome(
                "time until return", "ms", 1e3 * duration, 1e3 * back, tolerance, f"60 nodes, rtol {rtol:g}"
            ),
        ]
    return rows
