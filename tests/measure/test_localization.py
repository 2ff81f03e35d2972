"""Concentration of energy, and distributions of angles and curvature, of shapes whose answers are known."""

import numpy as np
import pytest
from shapes import RADIUS, icosphere, rolled

from jaxcrumple import measure
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import hexagonal
from jaxcrumple.mesh.mesh import Mesh

SPACING, ROWS = 1e-3, 12
ROW = np.sqrt(3) / 2 * SPACING


@pytest.fixture(scope="module")
def lattice():
    return hexagonal(20, ROWS, SPACING)


def pleated(mesh, angles):
    """The lattice bent along its rows of nodes by signed `angles` (ROWS - 1,), mountains positive."""
    slope = np.concatenate([[0.0], -np.cumsum(angles)])
    y, z = (np.concatenate([[0.0], np.cumsum(ROW * f(slope))]) for f in (np.cos, np.sin))
    row = np.rint(mesh.vertices[:, 1] / ROW + 0.5 * ROWS).astype(int)
    return np.column_stack([mesh.vertices[:, 0], y[row], z[row]])


def bending(mesh, x):
    stiffness = Material().discretize(mesh).kb * mesh.hinge_weight
    return measure.face_bending_density(mesh, x, mesh.rest_curvature, stiffness)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_uniform_energy_is_everywhere(lattice, share):
    density = measure.face_stretch_density(lattice, lattice.vertices, 1.0) + 3.0
    assert measure.localization(lattice, density, share) == pytest.approx(share)
    assert measure.participation_ratio(lattice, density) == pytest.approx(1)


def test_energy_of_a_fold_is_on_its_faces(lattice):
    angles = np.zeros(ROWS - 1)
    angles[4] = 1.2
    density = bending(lattice, pleated(lattice, angles))
    # A row of nodes has 19 edges, each with a face on either side, of 38 faces a row.
    part = 2 * 19 / (38 * ROWS)
    assert measure.localization(lattice, density) == pytest.approx(0.5 * part)
    assert measure.localization(lattice, density, 0.9) == pytest.approx(0.9 * part)
    assert measure.participation_ratio(lattice, density) == pytest.approx(part)


def test_energy_of_a_cylinder_is_almost_everywhere():
    mesh = hexagonal(60, 60, 1e-3)
    density = bending(mesh, rolled(mesh))
    # Faces at the boundary lack hinges: they hold less, and are 4 of 60 rows and columns.
    assert 0.5 > measure.localization(mesh, density) > 0.5 * (1 - 4 / 60)
    assert 1 > measure.participation_ratio(mesh, density) > 1 - 4 / 60


def test_linear_density():
    """On a part s of the area lies s (2 - s) of the energy of a density that falls to zero as a line."""
    mesh = hexagonal(40, 40, 1e-3)
    density = np.random.default_rng(0).permutation(np.arange(len(mesh.faces)) + 0.5)
    for share in (0.3, 0.5, 0.8):
        assert measure.localization(mesh, density, share) == pytest.approx(1 - np.sqrt(1 - share), abs=1e-4)
    assert measure.participation_ratio(mesh, density) == pytest.approx(3 / 4, abs=1e-4)


def test_areas_weigh():
    mesh = Mesh.from_arrays([[0, 0], [1, 0], [0, 1], [3, 3]], [[0, 1, 2], [1, 3, 2]], reorder=False)
    small, large = mesh.face_area
    part = small / (small + large)
    dense = np.where(mesh.face_area == small, 1.0, 0.0)
    assert measure.localization(mesh, dense) == pytest.approx(0.5 * part)
    assert measure.participation_ratio(mesh, dense) == pytest.approx(part)
    assert measure.localization(mesh, 1 - dense) == pytest.approx(0.5 * (1 - part))


def test_a_sheet_without_energy(lattice):
    assert np.isnan(measure.localization(lattice, np.zeros(len(lattice.faces))))
    assert np.isnan(measure.participation_ratio(lattice, np.zeros(len(lattice.faces))))


def integral(distribution):
    return np.sum(distribution.density * np.diff(distribution.edges))


def at(distribution, value):
    """Share in the bin that holds a value."""
    k = np.searchsorted(distribution.edges, value) - 1
    return distribution.density[k] * np.diff(distribution.edges)[k]


def test_angles_of_pleats(lattice):
    angles = np.zeros(ROWS - 1)
    angles[[2, 5, 9]] = [1.2, -0.8, 1.2]
    x = pleated(lattice, angles)
    p = measure.hinge_curvature(lattice, x)
    found = measure.fold_angle_distribution(lattice, x, p, bins=90)
    assert (found.edges[0], found.edges[-1], len(found.density)) == pytest.approx((-np.pi, np.pi, 90))
    assert integral(found) == pytest.approx(1)
    up = np.sign(np.cross(*np.diff(lattice.vertices[lattice.faces[0]], axis=0))[2])
    assert at(found, 1.2 * up) == pytest.approx(2 / 3)
    assert at(found, -0.8 * up) == pytest.approx(1 / 3)
    deep = measure.fold_angle_distribution(lattice, x, p, threshold=1.0, bins=90)
    assert at(deep, 1.2 * up) == pytest.approx(1)


def test_angles_are_weighted_by_length():
    corners = [[0, 0], [1, 0], [0.5, 1], [0.5, -1], [4, 1]]
    mesh = Mesh.from_arrays(corners, [[0, 1, 2], [1, 0, 3], [2, 1, 4]], reorder=False)
    x = mesh.vertices.copy()
    x[3, 2], x[4, 2] = -0.4, 1.1
    theta, length = measure.hinge_angles(mesh, x), mesh.hinge_length
    assert length.max() > 1.1 * length.min()
    found = measure.fold_angle_distribution(mesh, x, mesh.rest_curvature + 1.0, bins=[-2, 0, 2])
    assert theta.min() < 0 < theta.max()
    assert found.density == pytest.approx(length[np.argsort(theta)] / length.sum() / 2)


def test_curvature_of_a_sphere_and_a_half_rolled_sheet():
    mesh = icosphere(3)
    outward = np.sign(np.linalg.det(mesh.vertices[mesh.faces]).sum())
    bounds = np.array([-2.2, -1.8, 0, 1.8, 2.2]) / RADIUS
    sphere = measure.curvature_distribution(mesh, mesh.vertices, bins=bounds)
    assert sphere.density == pytest.approx(np.array([0, 0, 0, RADIUS / 0.4])[:: int(outward)])

    sheet = hexagonal(41, 40, 1e-3)
    x = rolled(sheet)
    flat = sheet.vertices[:, 0] < 0
    x[flat] = sheet.vertices[flat] + [0, 0, RADIUS]  # goes on along the tangent
    found = measure.curvature_distribution(sheet, x, bins=np.array([-1, -0.1, 0.1, 0.9, 1.1, 2]) / RADIUS)
    assert integral(found) == pytest.approx(1)
    assert at(found, 0) == pytest.approx(0.5, abs=0.05)
    assert at(found, 1 / RADIUS) == pytest.approx(0.5, abs=0.05)


def test_what_is_refused(lattice):
    x, rest = lattice.vertices, lattice.rest_curvature
    good = np.ones(len(lattice.faces))
    for share in (0.0, 1.0, np.nan):
        with pytest.raises(ValueError, match="a fraction of the energy between 0 and 1"):
            measure.localization(lattice, good, share)
    with pytest.raises(ValueError, match=r"density has shape \(3,\)"):
        measure.localization(lattice, good[:3])
    for bad in (-1.0, np.nan):
        with pytest.raises(ValueError, match="negative or nan"):
            measure.participation_ratio(lattice, np.append(good[1:], bad))
    with pytest.raises(ValueError, match=r"changed by more than 0\.05; lower the threshold"):
        measure.fold_angle_distribution(lattice, x, rest)
    with pytest.raises(ValueError, match=r"bins from 1 to 2 leave out some values"):
        measure.curvature_distribution(lattice, x, bins=[1.0, 2.0])
