"""Areas in spheres and the volume fraction against closed forms, subdivision and random points."""

import numpy as np
import pytest
from elements import rotations
from shapes import RADIUS, icosphere

from jaxcrumple import measure
from jaxcrumple.measure.shells import area_within
from jaxcrumple.mesh.generate import disc, rectangle

H = 0.25e-3


def ball(rng, count, radius=1.0):
    """Points (count, 3), evenly spread in a ball."""
    points = rng.normal(size=(count, 3))
    points *= (radius * rng.uniform(size=count) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    return points


def subdivided(corners, levels):
    """Triangles (f, 3, 3), each cut into 4^levels."""
    for _ in range(levels):
        a, b, c = np.moveaxis(corners, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
    return corners


def test_area_of_a_triangle_in_spheres():
    # A corner at the foot of the centre, 0.3 off the plane: a sector of 90 degrees while the legs last.
    right = np.array([[[0, 0, 0.3], [1.0, 0, 0.3], [0, 2.0, 0.3]]])
    radii = np.array([0.2, 0.5, 0.9, 5.0])
    quarter = np.pi / 4 * (radii[1:3] ** 2 - 0.3**2)
    assert area_within(right, radii)[0] == pytest.approx([0, *quarter, 1.0], rel=1e-14)
    around = np.array([[[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]]])
    assert area_within(around, np.array([0.0, 1.0, 2.0]))[0] == pytest.approx(
        [0, np.pi, 4 * np.pi], rel=1e-14
    )
    # One side passes the centre at distance 0.6: a disc less a segment.
    side = around + np.array([0, 8.4, 0])
    segment = np.arccos(0.6) - 0.6 * 0.8
    assert area_within(side, np.array([1.0]))[0] == pytest.approx(np.pi - segment, rel=1e-14)


def test_area_without_triangle_is_zero():
    line = np.array([[[-1.0, 0, 0], [0.5, 0, 0], [2, 0, 0]], [[1.0, 1, 1]] * 3])
    assert area_within(line, np.array([0.3, 5.0])).tolist() == [[0, 0], [0, 0]]


def test_area_equals_that_of_small_triangles_inside():
    rng = np.random.default_rng(0)
    corners, radii = rng.normal(size=(40, 3, 3)), np.linspace(0.3, 2.0, 8)
    exact = area_within(corners, radii)
    small = subdivided(corners, 7)
    distance = np.linalg.norm(small.mean(axis=1), axis=1).reshape(4**7, 40)
    area = 0.5 * np.linalg.norm(np.cross(*(corners[:, k] - corners[:, 0] for k in (1, 2))), axis=1)
    counted = area[:, None] * np.mean(distance[..., None] < radii, axis=0)
    assert (0.1 * area[:, None] < exact).any() and (exact < 0.9 * area[:, None]).any()
    assert np.abs(counted - exact).max() < 1e-3 * area.max()


def test_areas_of_a_sphere_around_one_of_its_points():
    """A sphere has the area pi r^2 within r of a point of it, whatever its radius (Archimedes)."""
    radii = np.linspace(0.2, 1.8, 9) * RADIUS
    errors = []
    for levels in (2, 3, 4):
        mesh = icosphere(levels)
        corners = (mesh.vertices - mesh.vertices[0])[mesh.faces]
        errors.append(np.abs(area_within(corners, radii).sum(axis=0) / (np.pi * radii**2) - 1).max())
    assert errors[-1] < 3e-3
    assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3  # second order in the size of triangles


def test_disc():
    mesh = disc(0.05, 300, sweeps=20)
    turn = rotations(np.random.default_rng(1), 1)[0]
    found = measure.volume_fraction(mesh, mesh.vertices @ turn + [1, -2, 3], H, shells=10)
    r = found.radii
    expected = H * np.pi * np.diff(r**2) / np.diff(4 / 3 * np.pi * r**3)
    assert found.phi[:9] == pytest.approx(expected[:9], rel=1e-9)
    assert found.r0 == pytest.approx(0.05, rel=2e-3)  # the centre of mass is not quite that of the circle
    assert found.phi0 == pytest.approx(H * mesh.area / (4 / 3 * np.pi * found.r0**3))


def test_sphere_is_in_the_outermost_shell():
    mesh = icosphere(3)
    found = measure.volume_fraction(mesh, mesh.vertices, H, shells=20)
    assert found.r0 == pytest.approx(RADIUS)
    assert np.all(found.phi[:-1] == 0)
    closed = 3 * H / RADIUS
    assert found.phi0 == pytest.approx(closed, rel=6e-3)
    assert found.phi[-1] == pytest.approx(closed / (1 - 0.95**3), rel=6e-3)


def test_ball_of_random_triangles_is_evenly_filled():
    rng = np.random.default_rng(2)
    small = 0.02 * (np.array([[1, 0, 0], [-0.5, 0.8, 0], [-0.5, -0.8, 0]]) @ rotations(rng, 20_000))
    radii = np.linspace(0, 0.9, 10)
    areas = np.diff(area_within(ball(rng, 20_000)[:, None] + small, radii).sum(axis=0))
    volume = np.diff(radii**3)  # of the ball's
    total = 20_000 * 0.02**2 * 1.5 * 0.8
    deviation = np.sqrt(20_000 * volume)  # of the number of triangles in a shell
    assert np.all(np.abs(areas / total - volume) * 20_000 < 3.5 * deviation)


def test_crumple_equals_random_points_on_it():
    mesh = rectangle(1.0, 1.0, 100, sweeps=5)
    rng = np.random.default_rng(3)
    x = ball(rng, mesh.n_nodes, 0.03)
    found = measure.volume_fraction(mesh, x, H, shells=8)
    corners = x[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(*(corners[:, k] - corners[:, 0] for k in (1, 2))), axis=1)
    faces = rng.choice(len(area), size=400_000, p=area / area.sum())
    points = np.einsum("pk,pki->pi", rng.dirichlet([1, 1, 1], size=len(faces)), corners[faces])
    distance = np.linalg.norm(points - measure.center_of_mass(mesh, x), axis=1)
    count, _ = np.histogram(distance, found.radii)
    filled = found.phi * np.diff(4 / 3 * np.pi * found.radii**3)
    expected = filled / (H * area.sum()) * len(faces)
    assert expected.sum() == pytest.approx(len(faces))
    assert np.all(np.abs(count - expected) < 4 * np.sqrt(expected))


def test_center_of_mass_is_that_of_the_area():
    mesh = rectangle(0.1, 0.1, 200, sweeps=3)
    centroids = mesh.vertices[mesh.faces].mean(axis=1)
    expected = mesh.face_area @ centroids / mesh.area
    assert measure.center_of_mass(mesh, mesh.vertices) == pytest.approx(expected, abs=1e-15)


def test_radial_profile():
    mesh = icosphere(2)
    rng = np.random.default_rng(4)
    x, radii = mesh.vertices * rng.uniform(0.3, 1.0, size=(mesh.n_nodes, 1)), np.linspace(0, 0.05, 6)
    areas = measure.shell_areas(mesh, x, radii)
    corners = x[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(*(corners[:, k] - corners[:, 0] for k in (1, 2))), axis=1)
    assert areas.sum(axis=1) == pytest.approx(area)
    values = rng.normal(size=len(mesh.faces))
    profile = measure.radial_profile(mesh, x, values, radii)
    assert np.isnan(profile[-1])  # nothing is beyond 0.04
    assert np.nansum(profile * areas.sum(axis=0)) == pytest.approx(values @ area)


def test_what_is_refused():
    mesh = icosphere(0)
    x = mesh.vertices
    for thickness in (0.0, np.nan, [1e-4, 1e-4]):
        with pytest.raises(ValueError, match="one positive number in metres"):
            measure.volume_fraction(mesh, x, thickness)
    with pytest.raises(ValueError, match="number of shells, 1 or more"):
        measure.volume_fraction(mesh, x, H, shells=0)
    for radii in ([0.1], [0.2, 0.1], [-1, 1], [0, np.nan]):
        with pytest.raises(ValueError, match="radii do not bound shells"):
            measure.shell_areas(mesh, x, radii)
    with pytest.raises(ValueError, match="one for each of 20 faces"):
        measure.radial_profile(mesh, x, np.zeros(12), [0, 1])
