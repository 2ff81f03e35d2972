"""Patch tests of meshes against closed forms, and new meshes within an outline."""

import numpy as np
import pytest
from mesh_dialects import QUADS, obj

import jaxcrumple as jc
from jaxcrumple import Mesh, MeshError, MeshWarning, patch_test, remeshed
from jaxcrumple.mesh.remesh import boundary_loops


def lattice(count, one=(1.0, 0.0), two=(0.0, 1.0), keep=lambda i, j: True):
    """`count` cells of a lattice in each direction, each cut along the sum of its sides."""
    i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
    points = i.reshape(-1, 1) * np.array(one) + j.reshape(-1, 1) * np.array(two)
    faces = []
    for row in range(count):
        for column in range(count):
            if keep(row, column):
                a = row * (count + 1) + column
                b, c, d = a + count + 1, a + count + 2, a + 1
                faces += [[a, b, c], [a, c, d]]
    return Mesh.from_arrays(points, faces, reorder=True)


def turned(mesh):
    tilt = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    return Mesh.from_arrays(mesh.vertices @ tilt + [1, 2, 3], mesh.faces)


def test_equilateral_triangles_are_isotropic_with_the_moduli_of_the_paper():
    for mesh in (jc.hexagonal(12, 10, 0.01), turned(jc.hexagonal(9, 9, 2.0)), jc.hexagonal(90, 40, 0.01)):
        found = patch_test(mesh)
        assert [found.young, found.bending, found.poisson] == pytest.approx([1, 1, 1 / 3], rel=1e-9)
        assert max(found.young_anisotropy, found.bending_anisotropy) < 1e-9


def test_split_squares_have_the_moduli_of_their_springs():
    """Springs along x, y and the diagonal of a square of side 1 with ks = 1: C = ks sum s^2 n n n n / A.

    With v = (n1^2, n2^2, n1 n2) that is diag(1, 1, 0) + (1, 1, 1) (1, 1, 1)^T / 2 against (xx, yy, 2 xy).
    Its inverse gives E = 1 along x, 2 along the diagonal, and 2/5 across it.
    """
    stiffness = np.diag([1.0, 1, 0]) + 0.5
    angles = np.pi * np.arange(36) / 36
    c, s = np.cos(angles), np.sin(angles)
    stress = np.stack([c**2, s**2, c * s])
    young = 1 / (stress * np.linalg.solve(stiffness, stress)).sum(axis=0)
    assert young[[0, 9, 27]] == pytest.approx([1, 2, 0.4])
    found = patch_test(lattice(10))
    assert found.young == pytest.approx(young.mean() / (2 / np.sqrt(3)), rel=1e-9)
    assert found.young_anisotropy == pytest.approx(np.abs(young / young.mean() - 1).max(), rel=1e-4)
    assert patch_test(turned(lattice(10))).young_anisotropy == pytest.approx(found.young_anisotropy, rel=0.01)


def test_split_squares_bend_with_the_moduli_of_their_hinges():
    """Angles of the hinges of a square with side 1 over w = (kxx x^2 + kyy y^2 + 2 kxy x y) / 2.

    Over the diagonal, with K = sqrt(3): theta = (k_nn - k_tt) / sqrt(2) = -sqrt(2) kxy. Over a side along x,
    with K = sqrt(3) / 2, from apices at (1, 1) and (0, -1): theta = kyy + kxy; along y alike.
    """

    def density(kxx, kyy, kxy):
        return np.sqrt(3) * 2 * kxy**2 + np.sqrt(3) / 2 * ((kyy + kxy) ** 2 + (kxx + kxy) ** 2)

    angles = np.pi * np.arange(36) / 36
    c, s = np.cos(angles), np.sin(angles)
    bending = density(c**2, s**2, c * s) / (np.sqrt(3) / 2)
    found = patch_test(lattice(12))
    assert found.bending == pytest.approx(bending.mean(), rel=1e-9)
    assert found.bending_anisotropy == pytest.approx(np.abs(bending / bending.mean() - 1).max(), rel=1e-4)


def test_relaxation_softens_a_random_mesh():
    """The affine estimate of Young's modulus is an upper bound; the relaxed one is near the lattice's."""
    mesh = jc.rectangle(0.1, 0.1, 700, sweeps=5)
    found = patch_test(mesh)
    d = mesh.vertices[mesh.edges[:, 1], :2] - mesh.vertices[mesh.edges[:, 0], :2]
    # Isotropic affine network: E / E_hex = (sum of s^2 ks / A) / (2 sqrt(3) ks), boundary springs half.
    half = np.isin(np.arange(len(mesh.edges)), mesh.boundary_edges)
    affine = ((1 - half / 2) * (d**2).sum(axis=1)).sum() / mesh.area / (2 * np.sqrt(3))
    assert 0.95 < found.young < affine < 1.2 and affine - found.young > 0.01


@pytest.mark.parametrize(
    "mesh", [jc.rectangle(0.1, 0.08, 1000), jc.disc(0.05, 1000)], ids=["rectangle", "disc"]
)
def test_our_own_meshes_are_isotropic(mesh):
    found = patch_test(mesh)
    assert found.worst < 0.05 and found.poisson == pytest.approx(1 / 3, abs=0.02)
    # Rolled up the sheet has the same springs and hinges.
    angle = mesh.vertices[:, 0] / 0.03
    rolled = np.column_stack([0.03 * np.sin(angle), mesh.vertices[:, 1], 0.03 * np.cos(angle)])
    curved = patch_test(Mesh.from_arrays(rolled, mesh.faces))
    assert curved.young == pytest.approx(found.young, abs=0.03)
    assert curved.bending == pytest.approx(found.bending, abs=0.06)


def test_a_curved_sheet_of_split_squares_is_not_isotropic():
    flat = lattice(20)
    rolled = np.column_stack(
        [np.sin(flat.vertices[:, 0] / 9), flat.vertices[:, 1] / 9, np.cos(flat.vertices[:, 0] / 9)]
    )
    found = patch_test(Mesh.from_arrays(rolled, flat.faces))
    assert found.young_anisotropy == pytest.approx(patch_test(flat).young_anisotropy, rel=0.1)


def test_a_single_triangle_has_no_bending_stiffness():
    found = patch_test(Mesh.from_arrays([[0, 0], [1, 0], [0.5, np.sqrt(3) / 2]], [[0, 1, 2]]))
    assert found.young == pytest.approx(1.0) and np.isnan(found.bending) and found.worst < 1e-9


# Remeshing


def outline(mesh):
    return sorted(len(loop) for loop in boundary_loops(mesh))


@pytest.mark.parametrize(
    ("keep", "holes"),
    [
        (lambda i, j: True, 0),
        (lambda i, j: i < 4 or j < 4, 0),
        (lambda i, j: not (3 <= i < 6 and 3 <= j < 6), 1),
        (lambda i, j: j != 4 or i not in (1, 2, 5, 6), 2),
    ],
    ids=["square", "L", "hole", "slots"],
)
def test_remeshing_keeps_the_outline_and_is_isotropic(keep, holes):
    coarse = turned(lattice(8, keep=keep))
    assert patch_test(coarse).worst > 0.5
    mesh = remeshed(coarse, 1000, seed=1)
    assert mesh.n_nodes == 1000 and mesh.area == pytest.approx(coarse.area, rel=1e-12)
    assert mesh.n_nodes - len(mesh.edges) + len(mesh.faces) == 1 - holes and len(outline(mesh)) == 1 + holes
    assert patch_test(mesh).worst < 0.05
    # The same plane, the same side up, and nodes on all corners of the outline.
    for one, other in ((mesh, coarse), (coarse, mesh)):
        assert np.ptp(one.vertices @ _normal(other)) < 1e-9
    np.testing.assert_allclose(_normal(mesh), _normal(coarse), atol=1e-9)
    corner = coarse.vertices[
        np.argmax(np.linalg.norm(coarse.vertices - coarse.vertices.mean(axis=0), axis=1))
    ]
    assert np.linalg.norm(mesh.vertices - corner, axis=1).min() < 1e-9
    again = remeshed(coarse, 1000, seed=1)
    np.testing.assert_array_equal(again.vertices, mesh.vertices)


def _normal(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    total = np.cross(b - a, c - a).sum(axis=0)
    return total / np.linalg.norm(total)


def test_a_disc_is_remeshed_to_a_disc():
    mesh = remeshed(jc.disc(0.05, 200, sweeps=1), 400, seed=3)
    assert mesh.n_nodes == 400 and mesh.area == pytest.approx(np.pi * 0.05**2, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices[mesh.boundary_nodes], axis=1), 0.05, rtol=0.01)


def test_refuses_what_cannot_be_remeshed():
    flat = lattice(8)
    with pytest.raises(MeshError, match="a curved sheet cannot be remeshed; remesh it in the program"):
        remeshed(flat.with_rest_shape(flat.vertices + [0, 0, 1] * flat.vertices[:, :1] ** 2), 300)
    with pytest.raises(ValueError, match="nodes = 3 is too small; give at least 5"):
        remeshed(flat, 3)
    with pytest.raises(MeshError, match=r"nodes = .* give more"):
        remeshed(lattice(8, keep=lambda i, j: j != 4 or i not in (1, 2, 5, 6)), 20)


# Scenes


def test_a_scene_of_a_file_warns_and_remeshes(tmp_path):
    (tmp_path / "a.obj").write_bytes(obj(QUADS))
    sheet = {"shape": "file", "path": str(tmp_path / "a.obj")}
    with pytest.warns(
        MeshWarning, match=r"a\.obj' makes a sheet that is not isotropic: Young's modulus .* set remesh"
    ):
        jc.custom(sheet=sheet, contact=None)
    setup = jc.custom(150, seed=2, sheet={**sheet, "remesh": True}, contact=None)
    assert setup.mesh.n_nodes == 150 and setup.mesh.area == pytest.approx(12e-4, rel=1e-12)
    with pytest.raises(jc.ConfigError, match="remesh replaces the nodes that have the thickness"):
        jc.custom(sheet={**sheet, "remesh": True, "thickness": "h"})


def test_check_says_how_stiff_the_mesh_of_a_file_is(tmp_path):
    from jaxcrumple.run.check import described

    lattice(6, one=(0.01, 0), two=(0, 0.01)).save(tmp_path / "a.ply")
    options = {"sheet": {"shape": "file", "path": str(tmp_path / "a.ply")}}
    scene = tmp_path / "a.toml"
    text = f'scene = "custom"\n[options.sheet]\nshape = "file"\npath = "{options["sheet"]["path"]}"\n'
    scene.write_text(text)
    lines = described(jc.read_scene_file(scene))
    assert "nodes: 49, seed 0" in lines
    assert any(
        line.startswith("mesh: Young's modulus 98.5% of the material's value (+-75.8% with the direction)")
        for line in lines
    )
    scene.write_text(text + "remesh = true\n")
    assert "nodes: 1000, seed 0" in described(jc.read_scene_file(scene))
