"""Strain, creases, curvature maps and energy densities against shapes whose answers are known."""

import jax.numpy as jnp
import numpy as np
import pytest
from shapes import RADIUS, icosphere, rolled, single_hinge

from jaxcrumple import measure
from jaxcrumple.geometry.hinge import gather, hinge_angle
from jaxcrumple.mesh.generate import hexagonal, rectangle
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.bending import Bending
from jaxcrumple.model.membrane import Membrane


@pytest.fixture(scope="module")
def mesh():
    return rectangle(0.1, 0.1, 1000, sweeps=60)


@pytest.fixture(scope="module")
def crumpled(mesh):
    """Positions with smooth waves and small noise, and a rest curvature that moved here and there."""
    rng = np.random.default_rng(3)
    x = mesh.vertices + 2e-5 * rng.normal(size=mesh.vertices.shape)
    x[:, 2] += 2e-3 * np.sin(150 * x[:, 0]) * np.cos(90 * x[:, 1])
    p = mesh.rest_curvature + 0.1 * rng.normal(size=len(mesh.hinges)) ** 3
    return x, p


def test_what_is_not_finite_is_not_measured(mesh, crumpled):
    x, p = (np.where(np.arange(len(a)).reshape(-1, *[1] * (a.ndim - 1)) == 7, np.nan, a) for a in crumpled)
    for what in (measure.mean_curvature, measure.edge_strain):
        with pytest.raises(ValueError, match=r"x\[7\] is \[nan nan nan\]; it must be finite"):
            what(mesh, x)
    for what in (measure.crease_length, measure.segment_facets):
        with pytest.raises(ValueError, match=r"p\[7\] is nan; it must be finite"):
            what(mesh, p)
        with pytest.raises(ValueError, match="threshold = -1 must be zero or positive"):
            what(mesh, crumpled[1], threshold=-1)


def interior(mesh):
    return np.setdiff1d(np.arange(mesh.n_nodes), mesh.boundary_nodes)


@pytest.mark.parametrize("angle", [0.4, -1.3, 3.0])
def test_single_hinge(angle):
    mesh, x = single_hinge(angle)
    assert measure.hinge_angles(mesh, x) == pytest.approx([angle], rel=1e-14)
    assert measure.hinge_curvature(mesh, x) == pytest.approx([2 * np.sin(angle / 2)], rel=1e-14)
    share = np.sqrt(3) / 12  # of both triangles, at each end of the shared edge
    expected = [0.5 * angle / share, 0.5 * angle / share, 0, 0]
    assert measure.mean_curvature(mesh, x) == pytest.approx(expected)
    assert measure.folded_hinges(mesh, x) == int(abs(angle) > np.deg2rad(170))


def test_angles_equal_those_of_the_model(mesh, crumpled):
    x, _ = crumpled
    expected = hinge_angle(*gather(jnp.asarray(x), jnp.asarray(mesh.hinges)))
    assert np.abs(measure.hinge_angles(mesh, x) - np.asarray(expected)).max() < 1e-13


def test_uniform_stretch(mesh):
    assert measure.edge_strain(mesh, 1.02 * mesh.vertices) == pytest.approx(0.02)
    assert measure.rms_strain(mesh, 0.97 * mesh.vertices) == pytest.approx(0.03)
    assert measure.max_strain(mesh, 0.97 * mesh.vertices) == pytest.approx(0.03)


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 2])
def test_cylinder(mesh, angle):
    hexagons = hexagonal(30, 34, 2.5e-3)
    lattice = RADIUS * measure.mean_curvature(hexagons, rolled(hexagons, angle))[interior(hexagons)]
    assert np.abs(lattice - 1).max() < 2e-3
    irregular = RADIUS * measure.mean_curvature(mesh, rolled(mesh, angle))
    inside = irregular[interior(mesh)]
    assert abs(inside.mean() - 1) < 2e-3
    assert inside.std() < 0.04
    assert abs(irregular[mesh.boundary_nodes].mean() - 1) < 0.15


def test_sign_follows_the_face_normals(mesh):
    x = rolled(mesh)
    down = x * [1, 1, -1]
    assert measure.mean_curvature(mesh, x).mean() > 0
    assert measure.mean_curvature(mesh, down) == pytest.approx(-measure.mean_curvature(mesh, x))


def test_sphere():
    mesh = icosphere(3)
    corners = mesh.vertices[mesh.faces]
    outward = np.sign(np.linalg.det(corners).sum())
    curvature = outward * RADIUS * measure.mean_curvature(mesh, mesh.vertices)
    assert np.abs(curvature / 2 - 1).max() < 5e-3


def test_slender_triangles_do_not_blow_up_the_curvature():
    obtuse = Mesh.from_arrays(
        [[0, 0], [1, 0], [0.5, 0.05], [0.5, -0.05]], [[0, 1, 2], [1, 0, 3]], reorder=False
    )
    x = obtuse.vertices.copy()
    x[:2, 2] = 0.01
    theta = measure.hinge_angles(obtuse, x)[0]
    expected = theta / 2 / (0.05 / 6 / 4)  # half of |e0| theta over a quarter of a third of half the area
    assert measure.mean_curvature(obtuse, x)[:2] == pytest.approx([expected, expected])


def test_creases(mesh):
    p = mesh.rest_curvature.copy()
    p[[3, 17]] += [0.06, -0.2]
    p[5] += 0.04
    assert np.flatnonzero(measure.damaged(mesh, p)).tolist() == [3, 17]
    assert measure.crease_length(mesh, p) == pytest.approx(mesh.hinge_length[[3, 17]].sum())
    assert measure.crease_length(mesh, p, threshold=0.1) == pytest.approx(mesh.hinge_length[17])
    assert measure.crease_length(mesh, mesh.rest_curvature) == 0
    damage = measure.node_damage(mesh, p)
    assert damage.max() == pytest.approx(0.2)
    assert set(np.flatnonzero(damage)) == set(mesh.hinges[[3, 5, 17], :2].ravel())


def test_crease_pattern(mesh):
    p = mesh.rest_curvature.copy()
    p[[3, 5, 17, 20]] += [0.06, 0.04, -0.2, 0.3]
    pattern = measure.crease_pattern(mesh, p)
    assert pattern.dtype == np.int8
    assert {k: int(pattern[k]) for k in np.flatnonzero(pattern)} == {3: 1, 17: -1, 20: 1}
    mountain, valley = measure.mountain_valley_length(mesh, p)
    assert mountain == pytest.approx(mesh.hinge_length[[3, 20]].sum())
    assert valley == pytest.approx(mesh.hinge_length[17])
    assert measure.mountain_valley_length(mesh, p, threshold=0.25)[1] == 0


def test_a_mountain_is_convex_seen_from_the_normals():
    mesh, x = single_hinge(1.0)
    assert measure.crease_pattern(mesh, measure.hinge_curvature(mesh, x)).tolist() == [1]


def test_damage_counts_from_the_rest_shape(mesh):
    bent = mesh.with_rest_shape(rolled(mesh))
    assert measure.crease_length(bent, bent.rest_curvature) == 0


def test_densities_sum_to_the_energies_of_the_model(mesh, crumpled):
    x, p = crumpled
    rng = np.random.default_rng(0)
    ks, stiffness = rng.uniform(1, 2, len(mesh.edges)), rng.uniform(1e-3, 2e-3, len(mesh.hinges))
    membrane = Membrane(jnp.asarray(mesh.edges), jnp.asarray(ks), jnp.asarray(mesh.edge_length))
    bending = Bending(jnp.asarray(mesh.hinges), jnp.asarray(stiffness), jnp.asarray(mesh.rest_curvature))
    stretch = measure.face_stretch_density(mesh, x, ks) @ mesh.face_area
    bend = measure.face_bending_density(mesh, x, p, stiffness) @ mesh.face_area
    assert stretch == pytest.approx(float(membrane.energy(jnp.asarray(x))), rel=1e-12)
    assert bend == pytest.approx(float(bending.energy(jnp.asarray(x), jnp.asarray(p))), rel=1e-12)


def test_uniform_stretch_has_uniform_density():
    mesh = hexagonal(12, 12, 1e-3)
    density = measure.face_stretch_density(mesh, 1.01 * mesh.vertices, 2.0)
    inside = ~np.isin(mesh.faces, mesh.boundary_nodes).any(axis=1)
    # Each triangle owns half of three springs: (3/2) (ks/2) (0.01 a)^2 / (sqrt(3)/4 a^2).
    assert density[inside] == pytest.approx(1.5 * 1e-4 / (np.sqrt(3) / 4))


def test_plastic_curvature_of_faces():
    mesh, _ = single_hinge(0.0)
    assert measure.face_plastic_curvature(mesh, np.array([-0.3])) == pytest.approx([0.3, 0.3])
    alone = Mesh.from_arrays([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    assert measure.face_plastic_curvature(alone, np.zeros(0)).tolist() == [0]


def test_wrong_shapes_are_refused(mesh):
    with pytest.raises(ValueError, match=r"x has shape \(5, 3\)"):
        measure.edge_strain(mesh, np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"p has shape \(2,\)"):
        measure.crease_length(mesh, np.zeros(2))
