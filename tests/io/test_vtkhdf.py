"""The film for ParaView, read back by VTK itself."""

import os
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple import measure
from jaxcrumple.io import Frame, RunDirectoryError, sheet_fields, write_vtkhdf
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.model.bending import Bending

hdf = pytest.importorskip("vtkmodules.vtkIOHDF")
from vtkmodules.util.numpy_support import vtk_to_numpy  # noqa: E402


@pytest.fixture(scope="module")
def mesh():
    return rectangle(0.1, 0.1, 150, sweeps=20)


@pytest.fixture(scope="module")
def frames(mesh):
    rng = np.random.default_rng(0)
    x = mesh.vertices + 1e-3 * rng.normal(size=(4, mesh.n_nodes, 3))
    p = mesh.rest_curvature + 0.1 * rng.normal(size=(4, len(mesh.hinges)))
    v = rng.normal(size=(4, mesh.n_nodes, 3))
    return [Frame(t, *arrays) for t, *arrays in zip((0.0, 0.1, 0.35, 2.0), x, v, p, strict=True)]


@pytest.fixture(scope="module")
def constants(mesh):
    return np.full(len(mesh.edges), 2e5), 1.7e-3 * mesh.hinge_weight


def opened(path):
    reader = hdf.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader


def step(reader, index):
    """Points, faces, and arrays by name of one step."""
    reader.SetStep(index)
    reader.Update()
    grid = reader.GetOutput()
    cells = grid.GetCells()
    arrays = {}
    for kind, data in (("point", grid.GetPointData()), ("cell", grid.GetCellData())):
        for i in range(data.GetNumberOfArrays()):
            arrays[kind, data.GetArrayName(i)] = vtk_to_numpy(data.GetArray(i)).copy()
    faces = vtk_to_numpy(cells.GetConnectivityArray()).reshape(-1, 3)
    assert {grid.GetCellType(i) for i in range(grid.GetNumberOfCells())} == {5}
    return vtk_to_numpy(grid.GetPoints().GetData()).copy(), faces.copy(), arrays


def test_vtk_reads_every_step(tmp_path, mesh, frames, constants):
    path = tmp_path / "run.vtkhdf"
    assert write_vtkhdf(path, mesh, iter(frames), *sheet_fields(mesh, *constants)) == 4
    reader = opened(path)
    assert reader.GetNumberOfSteps() == 4
    information = reader.GetOutputInformation(0)
    assert information.Get(reader.GetExecutive().TIME_STEPS()) == tuple(f.t for f in frames)
    for index in (0, 3, 1, 2):
        frame = frames[index]
        x, faces, arrays = step(reader, index)
        assert reader.GetTimeValue() == frame.t
        assert x.tobytes() == frame.x.tobytes()
        assert (faces == mesh.faces).all()
        expected = {
            ("point", "velocity_m_per_s"): frame.v,
            ("point", "mean_curvature_per_m"): measure.mean_curvature(mesh, frame.x),
            ("point", "damage"): measure.node_damage(mesh, frame.p),
            ("cell", "stretch_energy_J_per_m2"): measure.face_stretch_density(mesh, frame.x, constants[0]),
            ("cell", "bending_energy_J_per_m2"): measure.face_bending_density(
                mesh, frame.x, frame.p, constants[1]
            ),
            ("cell", "plastic_curvature"): measure.face_plastic_curvature(mesh, frame.p),
        }
        assert set(arrays) == set(expected)
        for name, values in expected.items():
            assert (arrays[name] == values.astype(np.float32)).all(), name


def test_cell_data_integrate_to_the_energy(tmp_path, mesh, frames, constants):
    path = tmp_path / "run.vtkhdf"
    write_vtkhdf(path, mesh, frames, *sheet_fields(mesh, *constants))
    _, _, arrays = step(opened(path), 2)
    bending = Bending(*(jnp.asarray(a) for a in (mesh.hinges, constants[1], mesh.rest_curvature)))
    energy = float(bending.energy(jnp.asarray(frames[2].x), jnp.asarray(frames[2].p)))
    total = float(arrays["cell", "bending_energy_J_per_m2"].astype(float) @ mesh.face_area)
    assert total == pytest.approx(energy, rel=1e-6)


def test_elastic_single_frame_without_data(tmp_path, mesh, frames, constants):
    path = tmp_path / "run.vtkhdf"
    elastic = frames[0]._replace(p=None)
    write_vtkhdf(path, mesh, [elastic], *sheet_fields(mesh, *constants))
    assert not step(opened(path), 0)[2]["point", "damage"].any()
    write_vtkhdf(path, mesh, [elastic])
    x, _, arrays = step(opened(path), 0)
    assert arrays == {}
    assert x.tobytes() == elastic.x.tobytes()


def test_faces_are_stored_once(tmp_path, mesh, frames):
    sizes = []
    for count in (1, 2, 4):
        write_vtkhdf(tmp_path / "f", mesh, frames[:count])
        sizes.append((tmp_path / "f").stat().st_size)
    assert sizes[2] - sizes[1] < 3 * frames[0].x.nbytes


def test_failures_leave_the_old_film(tmp_path, mesh, frames, monkeypatch):
    path = tmp_path / "run.vtkhdf"
    write_vtkhdf(path, mesh, frames)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="no frames"):
        write_vtkhdf(path, mesh, [])
    with pytest.raises(ValueError, match="leave out the '/'"):
        write_vtkhdf(path, mesh, frames, {"1/m": lambda frame: frame.t})
    with pytest.raises(ValueError, match=r"PointData/a has shape \(3,\)"):
        write_vtkhdf(path, mesh, frames, {"a": lambda frame: np.zeros(3)})
    monkeypatch.setattr(os, "fsync", lambda file: os.write(-1, b""))
    with pytest.raises(RunDirectoryError, match=r"cannot write .*run\.vtkhdf"):
        write_vtkhdf(path, mesh, frames)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.vtkhdf"]


def test_folder_that_cannot_be_written(tmp_path, mesh, frames):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunDirectoryError, match="cannot write"):
        write_vtkhdf(tmp_path / "file" / "run.vtkhdf", mesh, frames)
    with pytest.raises(RunDirectoryError, match=r"cannot write .*its folder must exist"):
        write_vtkhdf(tmp_path / "nowhere" / "run.vtkhdf", mesh, frames)


def test_full_disk(tmp_path, mesh, frames):
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(tmp_path)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("cannot mount a small file system here")
    try:
        write_vtkhdf(tmp_path / "a", mesh, frames[:1])
        with pytest.raises(RunDirectoryError, match=r"No space left.*free some space"):
            write_vtkhdf(tmp_path / "b", mesh, 40 * frames)
        assert [p.name for p in tmp_path.iterdir()] == ["a"]
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)
