"""The lattice against closed forms; random meshes against the promises of their docstrings."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Voronoi

from jaxcrumple.mesh.generate import centroids, disc, hexagonal, rectangle


def angles(mesh):
    """Angles (f, 3) of the triangles [degrees]."""
    x = mesh.vertices[mesh.faces]
    u, v = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v), axis=2), (u * v).sum(axis=2)))


def normals(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)[:, 2]


@pytest.mark.parametrize(("nx", "ny"), [(2, 1), (3, 1), (7, 4), (6, 5)])
def test_lattice_counts_and_lengths(nx, ny):
    a = 0.013
    mesh = hexagonal(nx, ny, a)
    assert mesh.n_nodes == nx * (ny + 1)
    assert len(mesh.faces) == 2 * (nx - 1) * ny
    assert mesh.n_nodes - len(mesh.edges) + len(mesh.faces) == 1
    np.testing.assert_allclose(mesh.edge_length, a, rtol=1e-13)
    np.testing.assert_allclose(mesh.hinge_weight, 1, rtol=1e-12)
    np.testing.assert_allclose(mesh.hinge_height, np.sqrt(3) / 2 * a, rtol=1e-13)
    np.testing.assert_allclose(mesh.area, (nx - 1) * ny * np.sqrt(3) / 2 * a**2)
    np.testing.assert_allclose(mesh.vertices.min(axis=0), -mesh.vertices.max(axis=0), atol=1e-17)
    assert (normals(mesh) > 0).all()


def test_lattice_numbering_without_reordering():
    mesh = hexagonal(4, 2, 1.0, reorder=False)
    rows = mesh.vertices.reshape(3, 4, 3)
    np.testing.assert_allclose(np.diff(rows[:, :, 0], axis=1), 1)
    np.testing.assert_allclose(rows[:, 0, 0] - rows[0, 0, 0], [0, 0.5, 0])
    np.testing.assert_allclose(rows[:, 0, 1], [-np.sqrt(3) / 2, 0, np.sqrt(3) / 2], atol=1e-15)


@pytest.mark.parametrize("sweeps", [0, 1, 20])
@pytest.mark.parametrize("nodes", [5, 30, 301])
def test_rectangle_fills_its_domain(nodes, sweeps):
    mesh = (
        rectangle(0.2, 0.1, nodes, sweeps=sweeps) if nodes > 5 else rectangle(0.1, 0.1, nodes, sweeps=sweeps)
    )
    half = mesh.vertices[:, :2].max(axis=0)
    assert half.tolist() == ([0.1, 0.05] if nodes > 5 else [0.05, 0.05])
    assert mesh.n_nodes == nodes and (mesh.vertices[:, 2] == 0).all()
    np.testing.assert_allclose(mesh.area, 4 * half.prod(), rtol=1e-13)
    on_side = (np.abs(mesh.vertices[:, :2]) == half).any(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(on_side), mesh.boundary_nodes)
    corners = {(sx * half[0], sy * half[1]) for sx in (-1, 1) for sy in (-1, 1)}
    assert corners <= set(map(tuple, mesh.vertices[:, :2].tolist()))
    assert (normals(mesh) > 0).all()


@pytest.mark.parametrize("sweeps", [0, 1, 20])
@pytest.mark.parametrize("nodes", [5, 40, 301])
def test_disc_fills_its_polygon(nodes, sweeps):
    mesh = disc(0.05, nodes, sweeps=sweeps)
    b = len(mesh.boundary_nodes)
    r = np.linalg.norm(mesh.vertices, axis=1)
    np.testing.assert_allclose(r[mesh.boundary_nodes], 0.05, rtol=1e-15)
    assert mesh.n_nodes == nodes and (np.delete(r, mesh.boundary_nodes) < 0.05 * np.cos(np.pi / b)).all()
    np.testing.assert_allclose(mesh.area, b / 2 * 0.05**2 * np.sin(2 * np.pi / b), rtol=1e-13)
    np.testing.assert_allclose(mesh.edge_length[mesh.boundary_edges], 0.1 * np.sin(np.pi / b), rtol=1e-12)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "make", [lambda **k: rectangle(0.1, 0.1, 300, **k), lambda **k: disc(0.05, 300, **k)]
)
def test_lloyd_sweeps_even_the_triangles_up_to_the_boundary(make, seed):
    rough, smooth, even = (make(seed=seed, sweeps=s) for s in (0, 10, 100))
    spread = [np.std(m.edge_length) / np.mean(m.edge_length) for m in (rough, smooth, even)]
    assert spread[0] > 0.3 > 0.2 > spread[1] > 0.12 > spread[2]
    assert angles(smooth).min() > 20 and angles(even).min() > 28 and angles(even).max() < 112
    at_boundary = np.isin(even.faces, even.boundary_nodes).any(axis=1)
    ratio = even.face_area[at_boundary].mean() / even.face_area[~at_boundary].mean()
    assert 0.95 < ratio < 1.05


def test_a_sweep_moves_nodes_to_thecentroids_of_their_voronoi_cells():
    points = np.random.default_rng(0).uniform(-1, 1, size=(200, 2))
    inner = np.abs(points).max(axis=1) < 0.6
    free, others = points[inner], points[~inner]
    diagram = Voronoi(np.vstack([free, others]))
    for k, moved in enumerate(centroids(free, others)):
        cell = diagram.vertices[diagram.regions[diagram.point_region[k]]]
        a = cell[ConvexHull(cell).vertices]
        b = np.roll(a, -1, axis=0)
        area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        np.testing.assert_allclose(moved, (area[:, None] * (a + b)).sum(axis=0) / (3 * area.sum()), rtol=1e-9)


def test_most_interior_nodes_get_six_neighbours():
    mesh = rectangle(0.1, 0.1, 500)
    inner = np.setdiff1d(np.arange(500), mesh.boundary_nodes)
    assert np.mean(np.bincount(mesh.edges.ravel())[inner] == 6) > 0.7


def test_meshes_depend_on_the_seed_and_nothing_else():
    one, same, other = (rectangle(0.1, 0.1, 200, seed=s, sweeps=5) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.vertices, same.vertices)
    np.testing.assert_array_equal(one.faces, same.faces)
    assert not np.array_equal(one.vertices, other.vertices)


def test_meshes_scale_with_their_size():
    small, large = (disc(r, 100, sweeps=4) for r in (1e-6, 1e3))
    np.testing.assert_allclose(small.vertices * 1e9, large.vertices, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: hexagonal(1, 2, 1.0), "nx = 1 is too small; give at least 2"),
        (lambda: hexagonal(2, 0, 1.0), "ny = 0 is too small; give at least 1"),
        (lambda: hexagonal(2, 1.5, 1.0), r"ny = 1\.5 is not an integer; give a whole number"),
        (lambda: hexagonal(2, 1, 0.0), r"spacing = 0\.0 is not a length; give a positive"),
        (lambda: rectangle(-1.0, 1.0, 50), r"width = -1\.0 is not a length"),
        (lambda: rectangle(1.0, float("nan"), 50), "height = nan is not a length"),
        (lambda: rectangle(1.0, "wide", 50), "height = 'wide' is not a length"),
        (lambda: rectangle(1.0, 1.0, 4), "nodes = 4 is too small; give at least 5"),
        (lambda: rectangle(1.0, 1.0, 50.0), r"nodes = 50\.0 is not an integer"),
        (lambda: rectangle(1.0, 1.0, 50, sweeps=-1), "sweeps = -1 is too small; give at least 0"),
        (lambda: rectangle(1.0, 1.0, 50, seed=-1), "seed = -1 is too small"),
        (lambda: rectangle(1.0, 1e-9, 50), "nodes = 50 all lie on the boundary .* give more"),
        (lambda: disc(0.0, 50), r"radius = 0\.0 is not a length"),
        (lambda: disc(1.0, 2), "nodes = 2 is too small"),
    ],
)
def test_bad_input_is_refused_with_cause_and_cure(call, match):
    with pytest.raises(ValueError, match=match):
        call()
