"""Maps of sheets whose shape and creases are known in closed form."""

import numpy as np
import pytest
from shapes import RADIUS, rolled

import jaxcrumple as jc
from jaxcrumple.dataset.maps import CHANNELS, SheetMaps
from jaxcrumple.measure.raster import Raster

SIDE, COUNT = 0.06, 65


def named(mesh, x, p, count=COUNT):
    """The grid, and the maps by name."""
    corners = mesh.vertices[:, :2]
    raster = Raster.square(corners.min(axis=0), corners.max(axis=0), count, "a map")
    return raster, dict(zip(CHANNELS, SheetMaps(mesh, raster).of(x, p), strict=True))


@pytest.fixture(scope="module")
def square():
    """A square with edges along x = 0."""
    columns = 24
    s = SIDE * (np.arange(columns + 1) / columns - 0.5)
    points = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = np.indices((columns, columns)).reshape(2, -1)
    a = i * (columns + 1) + j
    b, c, d = a + columns + 1, a + columns + 2, a + 1
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return jc.Mesh.from_arrays(points, faces)


def bent(mesh, angle):
    """The sheet bent along x = 0 by an angle, convex from above."""
    x = mesh.vertices.copy()
    right = x[:, 0] > 0
    x[right, 2] = -np.sin(angle) * x[right, 0]
    x[right, 0] = np.cos(angle) * x[right, 0]
    return x


def on_fold(mesh):
    """Hinges along x = 0."""
    return np.all(np.abs(mesh.vertices[mesh.hinges[:, :2], 0]) < 1e-12, axis=1)


def test_one_fold(square):
    """Positions are those of the fold; the crease is nonzero exactly along it; its plastic curvature is that
    of the plastic angle, and what the fold has sprung open by is elastic."""
    angle, plastic = 0.8, 1.1
    p = np.where(on_fold(square), 2 * np.sin(plastic / 2), 0.0)
    raster, maps = named(square, bent(square, angle), p)
    x, y = np.moveaxis(raster.centres(), -1, 0)
    assert np.all(maps["mask"] == 1)
    np.testing.assert_allclose(maps["x"], np.where(x > 0, np.cos(angle), 1) * x, atol=1e-8)
    np.testing.assert_allclose(maps["y"], y, atol=1e-8)
    np.testing.assert_allclose(maps["z"], -np.sin(angle) * np.maximum(x, 0), atol=1e-8)
    middle = np.zeros((COUNT, COUNT))
    middle[:, COUNT // 2] = 1
    np.testing.assert_array_equal(maps["crease"], middle)
    # The angle over the edge at the crease, and zero from the next nodes on: across it, that is the angle.
    edge, inner = SIDE / 24, slice(5, -5)
    hat = np.maximum(1 - np.abs(x) / edge, 0)[inner] / edge
    np.testing.assert_allclose(maps["plastic_curvature"][inner], plastic * hat, atol=1e-4)
    np.testing.assert_allclose(maps["elastic_curvature"][inner], (angle - plastic) * hat, atol=1e-4)


def test_a_valley_has_the_other_sign(square):
    maps = named(square, bent(square, -0.8), np.where(on_fold(square), -1.0, 0.0))[1]
    assert np.all(maps["crease"][:, COUNT // 2] == -1) and np.count_nonzero(maps["crease"]) == COUNT
    assert maps["plastic_curvature"].max() == 0 and maps["z"].max() > 0.01


def test_a_pixel_shows_its_strongest_hinge(square):
    """A mountain meets a deeper valley in the middle."""
    mountain = np.all(np.abs(square.vertices[square.hinges[:, :2], 1]) < 1e-12, axis=1)
    p = np.where(on_fold(square), -1.0, np.where(mountain, 0.5, 0.0))
    crease = named(square, square.vertices, p)[1]["crease"]
    middle = np.zeros((COUNT, COUNT))
    middle[COUNT // 2], middle[:, COUNT // 2] = 1, -1
    np.testing.assert_array_equal(crease, middle)


@pytest.mark.parametrize("plastic", [False, True])
def test_a_cylinder(plastic):
    """Its height is exact to second order in the edges, its curvature 1/R, elastic or plastic."""
    mesh = jc.rectangle(SIDE, SIDE, 600, sweeps=30)
    x = rolled(mesh)
    p = jc.measure.hinge_curvature(mesh, x) if plastic else np.zeros(len(mesh.hinges))
    raster, maps = named(mesh, x, p)
    u = raster.centres()[..., 0]
    on = maps["mask"] > 0
    edge = mesh.edge_length.max()
    exact = RADIUS * np.cos(u / RADIUS)
    # A chord is below its arc by at most edge^2 / (8 R).
    assert np.abs(maps["z"] - exact)[on].max() < edge**2 / (8 * RADIUS)
    full, none = ("plastic_curvature", "elastic_curvature")[:: 1 if plastic else -1]
    centre = slice(15, -15)
    np.testing.assert_allclose(maps[full][centre, centre].mean(), 1 / RADIUS, rtol=0.01)
    assert np.abs(maps[none]).max() < 1e-4


def test_the_mask_of_a_disc_with_a_hole():
    """The area of its pixels is that of the mesh; nothing is outside."""
    disc = jc.disc(0.05, 800, sweeps=10)
    middle = disc.vertices[disc.faces].mean(axis=1)
    mesh = jc.Mesh.from_arrays(disc.vertices, disc.faces[np.hypot(*middle[:, :2].T) > 0.02])
    raster, maps = named(mesh, mesh.vertices + 1.0, np.ones(len(mesh.hinges)), 128)
    on = maps["mask"] > 0
    assert np.count_nonzero(on) * raster.pixel**2 == pytest.approx(mesh.area, rel=5e-3)
    assert not on[64, 64] and not on[0, 0] and on[64, 2]
    for image in maps.values():
        assert np.all(image[~on] == 0)
    np.testing.assert_allclose(maps["x"][on], raster.centres()[on][:, 0] + 1.0, rtol=1e-6)
