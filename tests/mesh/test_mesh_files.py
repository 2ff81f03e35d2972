"""Mesh files: dialects, units, merging, polygons, warnings, and what is refused."""

import re
import warnings

import fuzz_meshes
import meshio
import numpy as np
import pytest
from mesh_dialects import ANGLE, POINTS, QUADS, REFUSED, SURFACES, TRIANGLES, obj, off, ply, stl, vtu

import jaxcrumple as jc
from jaxcrumple import Mesh, MeshError
from jaxcrumple.mesh.files import MeshWarning, read_surface
from jaxcrumple.mesh.files.polygons import triangulated
from jaxcrumple.mesh.files.surface import surface_of


@pytest.fixture
def file(tmp_path):
    def written(name, content):
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return written


@pytest.mark.parametrize("name", SURFACES)
def test_reads_every_dialect_that_holds_a_surface(tmp_path, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error", MeshWarning)
        fuzz_meshes.check_surface(tmp_path, name)


@pytest.mark.parametrize("name", REFUSED)
def test_refuses_what_holds_none_with_cause_and_cure(tmp_path, name):
    fuzz_meshes.check_refusal(tmp_path, name)


@pytest.mark.filterwarnings("ignore::jaxcrumple.mesh.files.MeshWarning")
@pytest.mark.parametrize(
    "name", ["plain.obj", "mixed.ply", "texture_big.ply", "binary_data.vtk", "binary.stl"]
)
def test_a_damaged_file_is_read_or_refused(tmp_path, name):
    outcomes = {fuzz_meshes.damage(tmp_path, name, SURFACES[name][0], number) for number in range(40)}
    assert outcomes <= {"read", "refused"} and "refused" in outcomes


@pytest.mark.parametrize(
    "name", ["plain.obj", "mixed.ply", "little.ply", "binary_offsets.vtk", "faces.off", "all.msh"]
)
def test_positions_and_order_are_those_of_the_file(tmp_path, name):
    (tmp_path / name).write_bytes(SURFACES[name][0])
    mesh = Mesh.from_file(tmp_path / name, reorder=False)
    np.testing.assert_allclose(mesh.vertices, POINTS, rtol=1e-7)
    assert mesh.faces.tolist() == TRIANGLES


# Polygons


def test_quads_are_cut_along_the_shorter_diagonal_that_lies_inside():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    leaning = square + np.array([[0, 0, 0], [0, 0, 0], [0.3, 0, 0], [0.3, 0, 0]])
    assert triangulated(surface_of(square, [[0, 1, 2, 3]])).tolist() == [[0, 1, 2], [0, 2, 3]]
    assert triangulated(surface_of(leaning, [[0, 1, 2, 3]])).tolist() == [[1, 2, 3], [1, 3, 0]]
    # Of a dart only the longer diagonal, from the corner that points inwards, lies inside.
    dart = np.array([[0, 0, 0], [1, 0.1, 0], [2, 0, 0], [1, 9, 0]])
    for turn in range(4):
        polygon = np.roll([0, 1, 2, 3], turn)
        triangles = triangulated(surface_of(dart, [polygon]))
        assert all({1, 3} <= set(triangle) for triangle in triangles.tolist())


@pytest.mark.parametrize("turn", range(6))
@pytest.mark.parametrize("flip", [1, -1])
def test_a_polygon_is_cut_into_triangles_that_cover_it_once(turn, flip):
    polygon = np.roll(np.arange(6), turn)[::flip]
    tilt = np.linalg.qr(np.random.default_rng(turn).normal(size=(3, 3)))[0]
    mesh = Mesh.from_arrays(ANGLE @ tilt, triangulated(surface_of(ANGLE @ tilt, [polygon])), reorder=False)
    # The areas add up to that of the polygon, and the sheet is flat and not folded onto itself.
    assert mesh.area == pytest.approx(12e-4, rel=1e-12)
    np.testing.assert_allclose(mesh.rest_curvature, 0, atol=1e-7)
    # Five corners in a row leave no triangle without area.
    assert mesh.face_area.min() > 1e-4


def test_a_corner_that_repeats_the_one_before_is_none():
    points, polygons = POINTS[[0, 1, 4, 3]], [[0, 1, 2, 2], [0, 0, 2, 3, 3, 0]]
    assert triangulated(surface_of(points, polygons)).tolist() == [[0, 1, 2], [2, 3, 0]]
    with pytest.raises(
        MeshError, match="face 1 with 4 corners crosses itself or has no area; remove or redraw"
    ):
        triangulated(surface_of(points, [[0, 1, 2], [2, 2, 3, 3]]))


def test_polygons_keep_their_order_among_triangles():
    points = np.vstack([POINTS, ANGLE + np.array([1, 0, 0])])
    polygons = [TRIANGLES[0], range(9, 15), TRIANGLES[1], QUADS[1]]
    triangles = triangulated(surface_of(points, polygons)).tolist()
    assert triangles[0] == TRIANGLES[0] and triangles[5:] == TRIANGLES[1:4]
    assert {corner for row in triangles[1:5] for corner in row} == set(range(9, 15))


# Nodes of the file


@pytest.mark.filterwarnings("ignore:the mesh of .* is not isotropic")
def test_source_nodes_and_data_follow_nodes_that_are_dropped_and_merged(file):
    # Two triangles over six points of which two coincide, after one that no face uses.
    points = np.vstack([[[5.0, 5, 5]], POINTS[[0, 1, 4, 0, 4, 3]] + 1e-9 * np.arange(6)[:, None]])
    h = '<PointData><DataArray type="Float64" Name="h" format="ascii">1 2 3 4 5 6 7</DataArray></PointData>\n'
    path = file("a.vtu", vtu([[1, 2, 3], [4, 5, 6]], points=points, data=h))
    with pytest.raises(
        MeshError, match="2 separate pieces of 3, 3 nodes; keep one, or merge coincident nodes"
    ):
        Mesh.from_file(path)
    mesh = Mesh.from_file(path, merge="10 nm")
    assert sorted(mesh.source_nodes) == [1, 2, 3, 6] and len(mesh.faces) == 2
    np.testing.assert_array_equal(mesh.vertices, points[mesh.source_nodes])
    scene = {"shape": "file", "path": str(path), "merge": "10 nm", "thickness": "h", "unit": "mm"}
    with pytest.warns(MeshWarning, match=r"is 2\.5e-05 m across in the unit 'mm'; if its lengths are metres"):
        setup = jc.custom(sheet={**scene, "merge": "10 pm"}, contact=None)
    np.testing.assert_allclose(setup.material.thickness, 1e-3 * (1 + setup.mesh.source_nodes))


@pytest.mark.filterwarnings("ignore:the mesh of .* is not isotropic")
def test_thickness_of_a_ply_file(file):
    path = file("a.ply", ply(vertex="property float h\n", tail=" 0.0001"))
    setup = jc.custom(sheet={"shape": "file", "path": str(path), "thickness": "h"}, contact=None)
    np.testing.assert_allclose(setup.material.thickness, 1e-4, rtol=1e-6)


# Merging


def test_merging_drops_triangles_that_it_leaves_without_area(file):
    # A sliver between the two halves of a square, narrower than the distance.
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1e-7, 0, 0], [1, 1 + 1e-7, 0], [0, 1, 0]])
    path = file("a.obj", obj([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]], points=points))
    with pytest.raises(MeshError, match="has no area"):
        Mesh.from_file(path)
    mesh = Mesh.from_file(path, merge=1e-6, reorder=False)
    assert mesh.source_nodes.tolist() == [0, 1, 2, 5] and mesh.area == pytest.approx(1.0, rel=1e-6)


def test_stl_points_merge_within_a_millionth_of_the_size(file):
    near = Mesh.from_file(file("near.stl", stl(noise=1e-8)))
    assert near.n_nodes == 9 and near.area == pytest.approx(12e-4, rel=1e-5)
    with pytest.raises(MeshError, match="separate pieces"):
        Mesh.from_file(file("far.stl", stl(noise=1e-5)))
    assert Mesh.from_file(file("far.stl", stl(noise=1e-5)), merge="50 um").n_nodes == 9
    with pytest.raises(MeshError, match="separate pieces"):
        Mesh.from_file(file("near.stl", stl(noise=1e-8)), merge=0.0)
    # The tolerance has the unit of the file.
    assert Mesh.from_file(file("mm.stl", stl(noise=1e-5, scale=1e3)), unit="mm").n_nodes == 9


def test_refuses_a_merging_distance_that_cannot_be(file):
    path = file("a.off", off())
    for merge in ("1 kg", "near", -1.0, np.nan, [1]):
        with pytest.raises(MeshError, match=f"merge = {re.escape(repr(merge))} is not .*; give"):
            Mesh.from_file(path, merge=merge)
    with pytest.raises(MeshError, match="merge = 1 m leaves no triangle; give less than the edges"):
        Mesh.from_file(path, merge=1.0)
    many = jc.rectangle(0.1, 0.1, 400, sweeps=0)
    many.save(path)
    with pytest.raises(
        MeshError, match="merge = 1 m would merge most of the sheet; give less than its edges"
    ):
        Mesh.from_file(path, merge="1 m")


# Units


def test_a_unit_is_that_of_all_lengths(file):
    for unit, factor in (("mm", 1e-3), ("inch", 0.0254), ("um", 1e-6), ("m", 1.0)):
        path = file("a.obj", obj(points=POINTS / factor))
        np.testing.assert_allclose(
            Mesh.from_file(path, unit=unit, reorder=False).vertices, POINTS, rtol=1e-12
        )
    for unit, hint in (
        ("mmm", "did you mean 'mm'?"),
        ("kg", "did you mean"),
        ("1", "choose one of"),
        ("", "choose"),
    ):
        with pytest.raises(MeshError, match=f"unit = '{unit}' is not a unit of length; {re.escape(hint)}"):
            Mesh.from_file(path, unit=unit)


def test_warns_of_a_size_that_suggests_another_unit(file):
    def size(factor, unit=None):
        Mesh.from_file(file("a.obj", obj(points=factor * POINTS)), unit=unit)

    with pytest.warns(MeshWarning, match=r"is 50 m across, if its lengths are metres; give unit = 'mm'"):
        size(1e3)
    with pytest.warns(MeshWarning, match=r"is 5e-05 m across, if its lengths are metres; give its unit"):
        size(1e-3)
    with pytest.warns(
        MeshWarning, match=r"is 5e-05 m across in the unit 'mm'; if its lengths are metres, leave"
    ):
        size(1.0, "mm")
    # What is said is believed.
    for factor, unit in ((1e3, "m"), (1e3, "mm"), (1e4, "um"), (1e-3, "m"), (1.0, None)):
        size(factor, unit)


@pytest.mark.filterwarnings("ignore:the mesh of .* is not isotropic")
def test_a_scene_file_has_unit_and_merging_distance(file, tmp_path):
    file("a.stl", stl(noise=1e-5, scale=1e3))
    head = 'scene = "custom"\n[options.sheet]\nshape = "file"\npath = "a.stl"\n'
    scene = file("a.toml", (head + 'unit = "mm"\nmerge = "0.1 um"\n').encode())
    mesh = jc.read_scene_file(scene).build().mesh
    assert mesh.n_nodes == 9 and mesh.area == pytest.approx(12e-4, rel=1e-5)
    for line, said in (
        (
            'unit = "mmm"',
            r"line 5: options\.sheet\.unit = 'mmm': is not a unit of length; did you mean 'mm'\?",
        ),
        ('merge = "1 kg"', r"line 5: options\.sheet\.merge = '1 kg' is a mass; give a length"),
        ("merge = -1", r"line 5: options\.sheet\.merge = -1: Input should be greater than or equal to 0"),
    ):
        with pytest.raises(jc.ConfigError, match=said):
            jc.read_scene_file(file("b.toml", (head + line).encode()))


# Refusals


def test_a_readers_own_reason_is_passed_on_and_no_exception_but_mesh_error_leaves(file, monkeypatch, capsys):
    with pytest.raises(MeshError, match=r"\(its header has an unknown type 'quad'\); re-export it"):
        Mesh.from_file(file("a.ply", REFUSED["type.ply"][0]))
    with pytest.raises(MeshError, match=r"cannot read .*a\.msh' as a mesh \(.*[a-z].*\); re-export it"):
        Mesh.from_file(file("a.msh", b"$MeshFormat\n9.9 0 8\n$EndMeshFormat\n"))
    for error in (
        KeyError("cells"),
        MemoryError(),
        RecursionError("deep"),
        SystemExit(1),
        RuntimeWarning("odd"),
    ):

        def fails(path, error=error):
            raise error

        monkeypatch.setattr(meshio, "read", fails)
        with pytest.raises(MeshError, match=r"cannot read .* as a mesh \(.+\); re-export it"):
            Mesh.from_file(file("a.vtu", vtu()))
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("ending", [".xdmf", ".mesh", ".inp", ".vtk", ".su2"])
def test_reads_other_formats_through_meshio(tmp_path, ending):
    points = np.vstack([POINTS, [[0.5, 0.5, 0]]])
    cells = [("line", [[0, 1], [1, 2]]), ("triangle", TRIANGLES[:4]), ("quad", QUADS[2:])]
    if ending == ".su2":
        points, cells = points[:, :2], cells[1:2] + cells[2:]
    meshio.Mesh(points, cells).write(tmp_path / f"a{ending}")
    mesh = Mesh.from_file(tmp_path / f"a{ending}", reorder=False)
    assert mesh.source_nodes.tolist() == list(range(9)) and len(mesh.faces) == 8
    np.testing.assert_allclose(mesh.vertices, POINTS, rtol=1e-7)


def test_points_keep_what_a_sheet_does_not_need(file):
    surface = read_surface(file("a.ply", SURFACES["colours.ply"][0]))
    assert sorted(surface.data) == ["blue", "green", "red"] and len(surface.points) == 9
