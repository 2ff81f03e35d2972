"""The mesh: connectivity, rest metric, numbering, files, and what it refuses."""

import copy
import dataclasses
import pickle

import meshio
import numpy as np
import pytest

from jaxcrumple.mesh.generate import hexagonal, rectangle
from jaxcrumple.mesh.hilbert import hilbert_index
from jaxcrumple.mesh.mesh import FILE_FORMATS, Mesh, MeshError

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
OUTWARD = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def band(count, twist):
    """A band of `count` quads, each cut in two, closed with or without a half twist."""
    s = np.linspace(0, 2 * np.pi, count, endpoint=False)
    half = s / 2 if twist else 0 * s
    across = np.column_stack([np.cos(half) * np.cos(s), np.cos(half) * np.sin(s), np.sin(half)])
    ring = np.column_stack([np.cos(s), np.sin(s), 0 * s])
    vertices = np.stack([ring - 0.2 * across, ring + 0.2 * across], axis=1).reshape(-1, 3)
    low, high = 2 * np.arange(count), 2 * np.arange(count) + 1
    low2, high2 = np.roll(low, -1), np.roll(high, -1)
    if twist:
        low2[-1], high2[-1] = high2[-1], low2[-1]
    faces = np.vstack([np.column_stack([low, low2, high2]), np.column_stack([low, high2, high])])
    return vertices, faces


def refused(match, vertices, faces):
    with pytest.raises(MeshError, match=match):
        Mesh.from_arrays(vertices, faces)


def test_two_triangles_by_hand():
    mesh = Mesh.from_arrays(SQUARE, TWO, reorder=False)
    assert mesh.edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert mesh.hinges.tolist() == [[0, 2, 3, 1]]
    assert mesh.hinge_edges.tolist() == [1]
    assert mesh.hinge_faces.tolist() == [[1, 0]]
    assert mesh.faces.dtype == mesh.edges.dtype == mesh.hinges.dtype == np.int32
    np.testing.assert_allclose(mesh.edge_length, [1, np.sqrt(2), 1, 1, 1])
    np.testing.assert_allclose(mesh.hinge_length, np.sqrt(2))
    np.testing.assert_allclose(mesh.hinge_area, 1)
    np.testing.assert_allclose(mesh.hinge_weight, np.sqrt(3))
    np.testing.assert_allclose(mesh.hinge_height, np.sqrt(0.5))
    np.testing.assert_allclose(mesh.node_area, [1 / 3, 1 / 6, 1 / 3, 1 / 6])
    assert mesh.rest_curvature.tolist() == [0]
    assert mesh.boundary_nodes.tolist() == [0, 1, 2, 3]
    assert (mesh.area, mesh.linear_density, mesh.n_nodes) == (1.0, 2.0, 4)


def test_two_columns_mean_flat():
    assert (Mesh.from_arrays(SQUARE[:, :2], TWO).vertices[:, 2] == 0).all()


def test_a_single_triangle_has_no_hinge():
    mesh = Mesh.from_arrays(SQUARE[:3], [[0, 1, 2]])
    assert mesh.hinges.shape == (0, 4) and mesh.hinge_weight.shape == (0,)


def test_arrays_are_read_only_and_leave_the_input_alone():
    vertices, faces = SQUARE.copy(), TWO.copy()
    mesh = Mesh.from_arrays(vertices, faces, reorder=False)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 1.0
    vertices[0, 0], faces[0, 0] = -1.0, 3
    assert mesh.vertices[0, 0] == 0 and mesh.faces[0, 0] == 0


@pytest.mark.parametrize(
    "copied",
    [
        lambda mesh: pickle.loads(pickle.dumps(mesh)),
        lambda mesh: pickle.loads(pickle.dumps(mesh, protocol=2)),
        copy.copy,
        copy.deepcopy,
        lambda mesh: dataclasses.replace(mesh, vertices=mesh.vertices.copy()),
        lambda mesh: mesh.with_rest_shape(mesh.vertices.copy()),
    ],
)
def test_copies_of_a_mesh_are_read_only_and_equal(copied):
    mesh = Mesh.from_arrays(*perturbed())
    other = copied(mesh)
    for field in dataclasses.fields(Mesh):
        values = getattr(other, field.name)
        np.testing.assert_array_equal(values, getattr(mesh, field.name))
        assert not values.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0


def test_no_view_of_a_writeable_array_is_kept():
    mesh = hexagonal(3, 2, 1.0)
    mine = mesh.vertices.copy()
    view = mine[:]
    view.flags.writeable = False
    other = dataclasses.replace(mesh, vertices=view)
    mine[0] = 7.0
    np.testing.assert_array_equal(other.vertices, mesh.vertices)


def test_nodes_without_faces_are_dropped_and_source_nodes_leads_back():
    vertices = np.vstack([[9.0, 9, 9], SQUARE[:2], [8, 8, 8], SQUARE[2:]])
    for reorder in (True, False):
        mesh = Mesh.from_arrays(vertices, [[1, 2, 4], [1, 4, 5]], reorder=reorder)
        assert sorted(mesh.source_nodes) == [1, 2, 4, 5]
        np.testing.assert_array_equal(mesh.vertices, vertices[mesh.source_nodes])
        assert mesh.area == 1.0
    assert mesh.source_nodes.tolist() == [1, 2, 4, 5] and mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    refused(r"edge \(1, 4\) belongs to 3 faces", vertices, [[1, 2, 4], [1, 4, 5], [1, 4, 0]])


@pytest.mark.parametrize("reorder", [True, False])
def test_hinges_follow_the_convention_of_the_paper(reorder):
    mesh = Mesh.from_arrays(*perturbed(), reorder=reorder)
    x0, x1, x2, x3 = mesh.hinges.T
    np.testing.assert_array_equal(mesh.hinges[:, :2], mesh.edges[mesh.hinge_edges])
    for columns, k in (((x0, x1, x2), 0), ((x1, x0, x3), 1)):
        given = mesh.faces[mesh.hinge_faces[:, k]]
        turns = [np.roll(given, r, axis=1) for r in range(3)]
        assert np.any([(t == np.column_stack(columns)).all(axis=1) for t in turns], axis=0).all()


def perturbed():
    flat = rectangle(2.0, 1.0, 120, sweeps=3)
    rng = np.random.default_rng(1)
    return flat.vertices + [0, 0, 1] * rng.normal(scale=0.05, size=(120, 1)), flat.faces


def test_counts_obey_euler_and_areas_add_up():
    mesh = rectangle(2.0, 1.0, 200, sweeps=5)
    boundary = len(mesh.boundary_nodes)
    assert mesh.n_nodes - len(mesh.edges) + len(mesh.faces) == 1
    assert len(mesh.edges) == len(mesh.hinges) + boundary
    assert len(mesh.boundary_edges) == boundary
    np.testing.assert_allclose([mesh.area, mesh.node_area.sum()], 2.0)
    np.testing.assert_allclose(mesh.hinge_area, mesh.face_area[mesh.hinge_faces].sum(axis=1))


def test_closed_surface():
    mesh = Mesh.from_arrays(TETRAHEDRON, OUTWARD)
    assert mesh.n_nodes - len(mesh.edges) + len(mesh.faces) == 2
    assert len(mesh.hinges) == 6 and len(mesh.boundary_nodes) == 0
    # The normals of a regular tetrahedron make the angle arccos(-1/3), and the solid is convex.
    np.testing.assert_allclose(mesh.rest_curvature, 2 * np.sin(np.arccos(-1 / 3) / 2))
    inward = Mesh.from_arrays(TETRAHEDRON, OUTWARD[:, ::-1])
    np.testing.assert_allclose(inward.rest_curvature, -mesh.rest_curvature)


def test_curvature_of_a_fold_against_its_angle():
    for angle in (-3.0, -1.0, -1e-9, 0.0, 1e-9, 0.5, 3.0):
        # Face 1 lies at y > 0 with normal z; face 2 is turned down by `angle`, which is convex seen from z.
        folded = [0.3, -np.cos(angle), -np.sin(angle)]
        mesh = Mesh.from_arrays(
            [[0, 0, 0], [1, 0, 0], [0.4, 0.8, 0], folded], [[0, 1, 2], [1, 0, 3]], reorder=False
        )
        np.testing.assert_allclose(mesh.rest_curvature, [2 * np.sin(angle / 2)], rtol=1e-12, atol=1e-25)


def test_curvature_of_a_cylinder_against_its_dihedral_angles():
    mesh, radius = hexagonal(13, 6, 0.1), 0.7
    x, y = mesh.vertices[:, 0] / radius, mesh.vertices[:, 1]
    cylinder = mesh.with_rest_shape(np.column_stack([radius * np.sin(x), y, radius * np.cos(x)]))
    a, b, c, d = cylinder.vertices[cylinder.hinges.T]
    n1, n2 = np.cross(b - a, c - a), np.cross(a - b, d - b)
    cosine = (n1 * n2).sum(axis=1) / np.linalg.norm(n1, axis=1) / np.linalg.norm(n2, axis=1)
    np.testing.assert_allclose(cylinder.rest_curvature**2, 2 - 2 * cosine, atol=1e-14)
    along = np.isclose(y[cylinder.hinges[:, 0]], y[cylinder.hinges[:, 1]])
    assert (cylinder.rest_curvature[~along] > 1e-3).all()
    # Over a chord of the arc both triangles rise to apices on the arc: a valley, bent against the cylinder.
    rise = radius * (1 - np.cos(0.05 / radius)) / (0.1 * np.sqrt(3) / 2)
    np.testing.assert_allclose(cylinder.rest_curvature[along], -2 * np.sin(np.arctan(rise)), rtol=1e-10)
    turned = Mesh.from_arrays(cylinder.vertices, cylinder.faces[:, ::-1], reorder=False)
    np.testing.assert_allclose(turned.rest_curvature, -cylinder.rest_curvature, atol=1e-15)


def test_with_rest_shape_keeps_the_connectivity():
    mesh = hexagonal(6, 4, 0.01)
    large = mesh.with_rest_shape(3 * mesh.vertices)
    assert large.hinges is mesh.hinges and large.source_nodes is mesh.source_nodes
    np.testing.assert_allclose(large.edge_length, 3 * mesh.edge_length)
    np.testing.assert_allclose(large.face_area, 9 * mesh.face_area)
    np.testing.assert_allclose(large.hinge_weight, mesh.hinge_weight)
    with pytest.raises(MeshError, match="29 nodes for a mesh of 30"):
        mesh.with_rest_shape(mesh.vertices[1:])
    with pytest.raises(MeshError, match="no area"):
        mesh.with_rest_shape(mesh.vertices * [1, 0, 0])


# Orientation


def test_faces_are_turned_to_agree_with_the_majority():
    mesh = rectangle(1.0, 1.0, 60, sweeps=3)
    mixed = mesh.faces.copy()
    mixed[::5] = mixed[::5, ::-1]
    fixed = Mesh.from_arrays(mesh.vertices, mixed, reorder=False)
    a, b, c = (fixed.vertices[fixed.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    np.testing.assert_array_equal(
        fixed.hinges, Mesh.from_arrays(mesh.vertices, mesh.faces, reorder=False).hinges
    )


def test_moebius_band_is_refused_and_an_untwisted_band_is_not():
    refused("one side.*cut it open", *band(12, twist=True))
    untwisted = Mesh.from_arrays(*band(12, twist=False))
    assert untwisted.n_nodes - len(untwisted.edges) + len(untwisted.faces) == 0


# Refusals


def test_refuses_malformed_arrays():
    refused(r"vertices have shape \(4,\)", SQUARE[:, 0], TWO)
    refused(r"vertices have shape \(4, 1\)", SQUARE[:, :1], TWO)
    refused("vertices have type complex128", SQUARE.astype(complex), TWO)
    refused(r"faces have shape \(2, 2\)", SQUARE, TWO[:, :2])
    refused(r"faces have shape \(0, 3\)", SQUARE, np.zeros((0, 3), int))
    refused("faces have type float64; give integer", SQUARE, TWO.astype(float))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_refuses_a_position_that_is_not_finite(value):
    bad = SQUARE.copy()
    bad[2, 1] = value
    refused(rf"vertex 2 is at \(1, {value}, 0\); make", bad, TWO)


def test_refuses_bad_node_numbers():
    refused(r"face 1 is \(0, 2, 4\), outside 0..3; count nodes from 0", SQUARE, [[0, 1, 2], [0, 2, 4]])
    refused(r"face 0 is \(-1, 1, 2\) \(and 1 more\), outside", SQUARE, [[-1, 1, 2], [0, 2, 4]])
    refused(r"face 1 repeats a vertex: \(0, 2, 0\); remove it", SQUARE, [[0, 1, 2], [0, 2, 0]])


def test_refuses_duplicate_faces():
    refused(
        r"faces \(0, 2\) have the same nodes \(0, 1, 2\); keep one", SQUARE, [[0, 1, 2], [0, 2, 3], [2, 1, 0]]
    )


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_refuses_a_triangle_without_area_at_any_scale(scale):
    line = np.vstack([SQUARE, [2, 2, 0]]) * scale
    refused(r"face 2 with nodes \(0, 2, 4\) near \(.*\) has no area; move", line, [*TWO.tolist(), [0, 2, 4]])
    thin = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]]) * scale
    assert Mesh.from_arrays(thin, [[0, 1, 2]]).area > 0


def test_refuses_an_edge_with_three_faces():
    fin = np.vstack([SQUARE, [0.5, 0.5, 1]])
    refused(r"edge \(0, 2\) belongs to 3 faces \(0, 1, 2\); at most two", fin, [*TWO.tolist(), [0, 2, 4]])


def test_refuses_separate_pieces():
    apart = np.vstack([SQUARE, SQUARE[:3] + 5])
    refused("2 separate pieces of 4, 3 nodes; keep one, or merge", apart, [*TWO.tolist(), [4, 5, 6]])


def test_refuses_two_fans_that_touch_at_a_node():
    bow = np.vstack([SQUARE, [2, 1, 0], [2, 2, 0]])
    refused("node 2 joins 2 fans of faces.*give each fan a node", bow, [*TWO.tolist(), [2, 4, 5]])


def test_a_node_may_lie_on_a_full_fan_and_on_a_closed_one():
    assert len(hexagonal(3, 2, 1.0).faces) == 8
    # Two tetrahedra joined at a node: each fan is closed, so counting boundary edges would miss them.
    other = -TETRAHEDRON[1:] + 2 * TETRAHEDRON[0]
    number = np.array([0, 4, 5, 6])
    refused("node 0 joins 2 fans", np.vstack([TETRAHEDRON, other]), np.vstack([OUTWARD, number[OUTWARD]]))


# Numbering


def test_hilbert_curve_visits_each_cell_once_and_steps_to_a_neighbour():
    cells = np.argwhere(np.ones((16, 16), bool))
    index = hilbert_index(cells, 4)
    assert sorted(index) == list(range(256))
    steps = np.abs(np.diff(cells[np.argsort(index)], axis=0)).sum(axis=1)
    assert (steps == 1).all()


def test_reordering_brings_neighbours_together_and_changes_nothing_else():
    mesh = rectangle(1.0, 1.0, 400, sweeps=3)
    rng = np.random.default_rng(0)
    shuffle = rng.permutation(400)
    vertices, faces = (
        mesh.vertices[np.argsort(shuffle)],
        shuffle[mesh.faces][rng.permutation(len(mesh.faces))],
    )
    tilt = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    shuffled = Mesh.from_arrays(vertices @ tilt, faces, reorder=False)
    ordered = Mesh.from_arrays(vertices @ tilt, faces, reorder=True)

    def gap(m):
        return np.median(np.abs(np.diff(m.edges, axis=1)))

    assert gap(ordered) < 12 < 60 < gap(shuffled)
    assert np.median(np.abs(np.diff(ordered.faces[:, 0]))) < 12
    np.testing.assert_array_equal(ordered.vertices, shuffled.vertices[ordered.source_nodes])
    for name in ("edge_length", "face_area", "hinge_weight", "hinge_height", "node_area"):
        np.testing.assert_allclose(np.sort(getattr(ordered, name)), np.sort(getattr(shuffled, name)))


def test_reordering_twice_is_reordering_once():
    mesh = rectangle(1.0, 1.0, 300, sweeps=3)
    again = Mesh.from_arrays(mesh.vertices, mesh.faces, reorder=True)
    np.testing.assert_array_equal(again.source_nodes, np.arange(300))
    np.testing.assert_array_equal(again.faces, mesh.faces)


# Files


@pytest.mark.parametrize("ending", FILE_FORMATS)
def test_round_trip_through_files(tmp_path, ending):
    mesh = Mesh.from_arrays(*perturbed())
    mesh.save(tmp_path / f"sheet{ending}")
    back = Mesh.from_file(tmp_path / f"sheet{ending}", reorder=False)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.vertices, mesh.vertices)


def test_reads_stl_with_shared_nodes(tmp_path):
    mesh = Mesh.from_arrays(TETRAHEDRON, OUTWARD)
    meshio.Mesh(mesh.vertices, [("triangle", mesh.faces)]).write(tmp_path / "a.stl", binary=True)
    np.testing.assert_allclose(
        Mesh.from_file(tmp_path / "a.stl").rest_curvature, mesh.rest_curvature, rtol=1e-6
    )


def test_reads_files_with_points_and_boundary_lines(tmp_path):
    cells = [("vertex", [[0]]), ("line", [[0, 1], [1, 2]]), ("triangle", TWO)]
    meshio.Mesh(SQUARE, cells).write(tmp_path / "a.vtu")
    assert len(Mesh.from_file(tmp_path / "a.vtu").faces) == 2


def test_refuses_files_it_cannot_use(tmp_path, capsys):
    with pytest.raises(FileNotFoundError, match=r"none\.vtu.*does not exist"):
        Mesh.from_file(tmp_path / "none.vtu")
    for name in ("junk.vtu", "junk.ply", "junk.msh", "junk.stl", "junk.unheard"):
        (tmp_path / name).write_text("not a mesh")
        with pytest.raises(MeshError, match=f"cannot read .*{name}.*re-export"):
            Mesh.from_file(tmp_path / name)
    meshio.Mesh(TETRAHEDRON, [("tetra", [[0, 1, 2, 3]])]).write(tmp_path / "solid.vtu")
    with pytest.raises(MeshError, match="cells of type tetra; export the surface alone"):
        Mesh.from_file(tmp_path / "solid.vtu")
    meshio.Mesh(SQUARE, [("line", [[0, 1]])]).write(tmp_path / "line.vtu")
    with pytest.raises(MeshError, match="has no triangles"):
        Mesh.from_file(tmp_path / "line.vtu")
    with pytest.raises(MeshError, match=r"cannot save .*sheet\.txt.*end the name with one of \.vtu"):
        Mesh.from_arrays(SQUARE, TWO).save(tmp_path / "sheet.txt")
    assert capsys.readouterr() == ("", "")
