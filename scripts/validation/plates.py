"""Plates: moduli, bending energy, and clamped plates under pressure, in vibration and in buckling."""

from functools import cache
from typing import NamedTuple

import numpy as np

import jaxcrumple as jc
from jaxcrumple.measure import face_bending_density

from .base import (
    BENDING_POISSON,
    KAPPA,
    PLAIN,
    POISSON,
    YOUNG,
    Outcome,
    at_rest,
    benchmark,
    critical_load,
    fixed,
    forces,
    modes,
    strip,
)


@benchmark("plates", "Seung & Nelson, Phys. Rev. A 38, 1005 (1988): Y = 2 ks/sqrt(3), nu = 1/3")
def uniaxial_stretch() -> list[Outcome]:
    """Tension and contraction of a strip.

    The end columns follow the uniform strain along the strip and are free across it, so that uniaxial stress
    is an equilibrium.
    """
    strain, columns = 1e-3, 12
    band = strip(columns, 6, 6e-3)
    column = np.arange(band.mesh.n_nodes) % columns
    target = band.mesh.vertices * [1.0 + strain, 1.0, 1.0]
    mask = np.zeros(target.shape, bool)
    mask[:, 2] = True
    mask[(column == 0) | (column == columns - 1), 0] = True
    mask[0, 1] = True
    scene = jc.sheet(band.mesh, PLAIN, prescribed=fixed(mask, target))
    x = at_rest(scene, np.where(mask, target, band.mesh.vertices))
    pull = -forces(scene, x)[column == columns - 1, 0].sum()
    across = x[-columns:, 1].mean() - x[:columns, 1].mean()
    contraction = (1.0 - across / band.width) / strain
    # Diagonals turn by an angle of the order of the strain.
    return [
        Outcome("tension", "N", band.stretching * strain, pull, 2e-3, str(band)),
        Outcome("Poisson ratio", "1", POISSON, contraction, 2e-3, str(band)),
    ]


def density_of(shape: np.ndarray, mesh: jc.Mesh) -> float:
    """Bending energy in J/m2 at positions `shape` (n, 3) far from the boundary."""
    inner = np.all(np.abs(mesh.vertices[mesh.faces, :2]) < 0.3 * np.ptp(mesh.vertices[:, 0]), axis=(1, 2))
    bending = jc.sheet(mesh, PLAIN).bending
    density = face_bending_density(mesh, shape, bending.rest_curvature, bending.stiffness)
    return float(density[inner].mean())


@benchmark("plates", "Helfrich energy kappa H^2/2 (Seung & Nelson 1988); a cylinder has H = 1/R")
def cylinder_energy() -> list[Outcome]:
    """Bending energy of a sheet on a cylinder.

    The axis lies along lattice rows. Chords are shorter than arcs: the energy is lower by (a/R)^2/16.
    """
    spacing, radius = 1e-3, 20e-3
    mesh = jc.hexagonal(25, 25, spacing)
    x, y, _ = mesh.vertices.T
    shape = np.stack([x, radius * np.sin(y / radius), radius * np.cos(y / radius)], axis=1)
    expected = KAPPA / (2.0 * radius**2)
    found = density_of(shape, mesh)
    return [Outcome("energy density", "J/m2", expected, found, 3e-3, "lattice, a/R = 1/20")]


@benchmark("plates", "kappa H^2/2 - (1 - nu) kappa K, nu = -1/3 (Schmidt & Fraternali, JMPS 60, 172, 2012)")
def curved_both_ways() -> list[Outcome]:
    """Bending energy of a shallow spherical cap and of a shallow saddle."""
    spacing, radius = 1e-3, 1.0
    mesh = jc.hexagonal(25, 25, spacing)
    rows = []
    for name, sign in (("cap", 1.0), ("saddle", -1.0)):
        x, y, _ = mesh.vertices.T
        shape = np.stack([x, y, 0.5 * (x**2 + sign * y**2) / radius], axis=1)
        mean, gauss = (1.0 + sign) / radius, sign / radius**2
        expected = KAPPA * (0.5 * mean**2 - (1.0 - BENDING_POISSON) * gauss)
        found = density_of(shape, mesh)
        # Slopes up to 0.017 change it by their square.
        rows.append(
            Outcome(f"energy density, {name}", "J/m2", expected, found, 1e-3, "lattice, a/R = 1/1000")
        )
    return rows


class Clamped(NamedTuple):
    """A flat sheet whose rim and second row of nodes are held.

    `inset` in m: distance of the clamp from the rim, half of that between the two rows. `rigidity` in J,
    `young` in N/m and `poisson` are those of the random mesh (`patch_test`).
    """

    mesh: jc.Mesh
    held: np.ndarray
    inset: float
    rigidity: float
    young: float
    poisson: float

    def tolerance(self, power: float, size: float = 0.05) -> float:
        """Accepted deviation of a quantity that varies with a `power` of the half `size` in m.

        The clamp is known to a quarter of the distance of the two rows.
        """
        return power * 0.5 * self.inset / size


def clamped(mesh: jc.Mesh) -> Clamped:
    """Clamp a disc or a rectangle."""
    rim = np.zeros(mesh.n_nodes, bool)
    rim[mesh.boundary_nodes] = True
    near = np.unique(mesh.edges[rim[mesh.edges].any(axis=1)])
    second = np.setdiff1d(near, mesh.boundary_nodes)
    starts, ends = mesh.vertices[mesh.edges[mesh.boundary_edges]].transpose(1, 0, 2)
    along = ends - starts
    away = mesh.vertices[second, None] - starts
    share = np.clip(np.sum(away * along, axis=2) / np.sum(along**2, axis=1), 0.0, 1.0)
    gap = np.linalg.norm(away - share[:, :, None] * along, axis=2).min(axis=1).mean()
    rim[second] = True
    found = jc.patch_test(mesh)
    return Clamped(mesh, rim, 0.5 * gap, KAPPA * found.bending, YOUNG * found.young, found.poisson)


@cache
def clamped_disc(nodes: int) -> Clamped:
    """A clamped disc of radius 5 cm."""
    return clamped(jc.disc(0.05, nodes, seed=1))


AREA_MASS = jc.Material(yield_curvature=None, drag_rate=0.0, internal_damping_time=0.0, mass_lumping="area")
RHO = PLAIN.density * PLAIN.thickness
MESHES = (500, 2000)
CLAMP = "the clamp lies somewhere between two irregular rows of nodes"


@benchmark("plates", "Timoshenko & Woinowsky-Krieger (1959), eq. 62: w = q a^4/(64 D)", quick=False)
def clamped_disc_pressure() -> list[Outcome]:
    """Deflection of a clamped disc under a uniform load."""
    rows = []
    for nodes in MESHES:
        plate = clamped_disc(nodes)
        radius = 0.05 - plate.inset
        # A deflection of a hundredth of the thickness is linear.
        load = 64.0 * plate.rigidity * 0.01 * PLAIN.thickness / radius**4
        scene = jc.sheet(
            plate.mesh,
            AREA_MASS,
            gravity=(0.0, 0.0, -load / RHO),
            prescribed=fixed(plate.held, plate.mesh.vertices),
        )
        x = at_rest(scene, plate.mesh.vertices)
        expected, found = 1e6 * 0.01 * PLAIN.thickness, -1e6 * x[:, 2].min()
        rows.append(
            Outcome("deflection", "um", expected, found, plate.tolerance(4), f"disc, {nodes} nodes", CLAMP)
        )
    return rows


@benchmark("plates", "Leissa, Vibration of plates, NASA SP-160 (1969), table 2.1: 10.2158, 21.26, 34.88")
def clamped_disc_frequencies() -> list[Outcome]:
    """Lowest frequencies of a clamped disc, with 0, 1 and 2 nodal diameters."""
    rows = []
    for nodes in MESHES:
        plate = clamped_disc(nodes)
        unit = np.sqrt(plate.rigidity / RHO) / (0.05 - plate.inset) ** 2 / (2.0 * np.pi)
        scene = jc.sheet(plate.mesh, AREA_MASS, prescribed=fixed(plate.held, plate.mesh.vertices))
        found = np.sqrt(modes(scene, plate.mesh.vertices, 5)[0]) / (2.0 * np.pi)
        for diameters, root, pair in ((0, 10.2158, [0]), (1, 21.26, [1, 2]), (2, 34.88, [3, 4])):
            name = f"frequency, {diameters} nodal diameters"
            mesh = f"disc, {nodes} nodes"
            rows.append(Outcome(name, "Hz", root * unit, found[pair].mean(), plate.tolerance(2), mesh, CLAMP))
    return rows


@benchmark("plates", "Leissa, Vibration of plates, NASA SP-160 (1969), clamped square: 35.99", quick=False)
def clamped_square_frequency() -> list[Outcome]:
    """Lowest frequency of a clamped square plate."""
    rows = []
    for nodes in MESHES:
        plate = clamped(jc.rectangle(0.1, 0.1, nodes, seed=1))
        side = 0.1 - 2.0 * plate.inset
        scene = jc.sheet(plate.mesh, AREA_MASS, prescribed=fixed(plate.held, plate.mesh.vertices))
        found = np.sqrt(modes(scene, plate.mesh.vertices, 2)[0][0]) / (2.0 * np.pi)
        expected = 35.99 * np.sqrt(plate.rigidity / RHO) / side**2 / (2.0 * np.pi)
        rows.append(
            Outcome("frequency", "Hz", expected, found, plate.tolerance(2), f"square, {nodes} nodes", CLAMP)
        )
    return rows


@benchmark(
    "plates", "Timoshenko & Gere, Theory of elastic stability (1961), chapter 9: N = 14.68 D/a^2", quick=False
)
def clamped_disc_buckling() -> list[Outcome]:
    """Radial compression at which a clamped disc buckles."""
    rows = []
    for nodes in MESHES:
        plate = clamped_disc(nodes)
        flat, unit = plate.mesh.vertices, 1e-5
        squeezed = jc.sheet(plate.mesh, PLAIN, prescribed=fixed(plate.held, (1.0 - unit) * flat))
        step = at_rest(squeezed, (1.0 - unit) * flat) - flat

        def loaded(compression: float, plate=plate, step=step / unit) -> tuple[jc.Scene, np.ndarray]:
            strain = compression * (1.0 - plate.poisson) / plate.young
            x = plate.mesh.vertices + strain * step
            return jc.sheet(plate.mesh, PLAIN, prescribed=fixed(plate.held, x)), x

        expected = 14.682 * plate.rigidity / (0.05 - plate.inset) ** 2
        found = critical_load(loaded, expected)
        rows.append(
            Outcome("compression", "N/m", expected, found, plate.tolerance(2), f"disc, {nodes} nodes", CLAMP)
        )
    return rows
