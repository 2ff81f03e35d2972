"""Film of the sheet for ParaView: one temporal VTKHDF file that stores the faces once.

Layout: the VTKHDF file format, version 2, UnstructuredGrid with a `Steps` group
(https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/). Positions are float64, maps are
float32, which is enough for display. An HDF5 name cannot contain "/", so units are written as "J_per_m2".
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import ArrayLike, Float, Real

from jaxcrumple._jax.arrays import HingeValuesLike, ScalarLike
from jaxcrumple.io.atomic import write_bytes
from jaxcrumple.io.frames import Frame
from jaxcrumple.measure import (
    face_bending_density,
    face_plastic_curvature,
    face_stretch_density,
    mean_curvature,
    node_damage,
)
from jaxcrumple.mesh.mesh import Mesh

#: Data at the points or cells, by name, each a function of the frame.
Fields = Mapping[str, Callable[[Frame], Real[ArrayLike, " ..."]]]

_TRIANGLE = 5  # cell type of a triangle in VTK


def write_vtkhdf(
    path: str | Path,
    mesh: Mesh,
    frames: Iterable[Frame],
    point_data: Fields | None = None,
    cell_data: Fields | None = None,
) -> int:
    """Write `frames` to one film atomically and return their number.

    **Arguments:** `frames`: may be a generator; only the film must fit into memory. `point_data`,
    `cell_data`: functions that map a frame to one value (n,) or (f,) or one vector (n, 3) or (f, 3) per point
    or cell; `sheet_fields` returns the standard ones.

    **Raises:** `RunDirectoryError` if the file cannot be written; ValueError for an array of a wrong length,
    a name with "/", or no frames.
    """
    fields = {"PointData": dict(point_data or {}), "CellData": dict(cell_data or {})}
    for name in (*fields["PointData"], *fields["CellData"]):
        if "/" in name:
            raise ValueError(f"{name!r} cannot name an array of an HDF5 file; leave out the '/'")
    # HDF5 crashes the process when it closes a file on a full disk, so the film is built in memory.
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        root = file.create_group("VTKHDF")
        _write_faces(root, mesh)
        times = [_append(root, mesh, frame, fields) for frame in frames]
        if not times:
            raise ValueError("there are no frames to write; give at least one")
        _write_steps(root, mesh, np.array(times), fields)
    write_bytes(Path(path), buffer.getbuffer())
    return len(times)


def sheet_fields(
    mesh: Mesh, ks: Real[ArrayLike, " edges"] | ScalarLike, stiffness: HingeValuesLike
) -> tuple[Fields, Fields]:
    """Return the standard data of a film.

    Points: velocity, mean curvature, damage. Cells: stretching and bending energy density, plastic curvature.

    **Arguments:** `ks` (e,) in N/m: `membrane.stiffness` of the scene; `stiffness` (h,) in J: its
    `bending.stiffness`.
    """

    def rest(frame: Frame) -> Float[np.ndarray, " hinges"]:
        return mesh.rest_curvature if frame.p is None else frame.p

    points: Fields = {
        "velocity_m_per_s": lambda frame: frame.v,
        "mean_curvature_per_m": lambda frame: mean_curvature(mesh, frame.x),
        "damage": lambda frame: node_damage(mesh, rest(frame)),
    }
    cells: Fields = {
        "stretch_energy_J_per_m2": lambda frame: face_stretch_density(mesh, frame.x, ks),
        "bending_energy_J_per_m2": lambda frame: face_bending_density(mesh, frame.x, rest(frame), stiffness),
        "plastic_curvature": lambda frame: face_plastic_curvature(mesh, rest(frame)),
    }
    return points, cells


def _write_faces(root: h5py.Group, mesh: Mesh) -> None:
    count = len(mesh.faces)
    root.attrs["Version"] = (2, 0)
    root.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", len("UnstructuredGrid")))
    root["NumberOfPoints"] = np.array([mesh.n_nodes])
    root["NumberOfCells"] = np.array([count])
    root["NumberOfConnectivityIds"] = np.array([3 * count])
    root["Connectivity"] = mesh.faces.astype(np.int64).ravel()
    root["Offsets"] = 3 * np.arange(count + 1)
    root["Types"] = np.full(count, _TRIANGLE, dtype=np.uint8)


def _append(root: h5py.Group, mesh: Mesh, frame: Frame, fields: Mapping[str, Fields]) -> float:
    """Write one frame and return its time."""
    _extend(root, "Points", np.asarray(frame.x, dtype=np.float64), mesh.n_nodes)
    for group, length in (("PointData", mesh.n_nodes), ("CellData", len(mesh.faces))):
        for name, field in fields[group].items():
            with np.errstate(over="ignore"):  # values beyond the range of float32 become infinite
                _extend(root, f"{group}/{name}", np.asarray(field(frame), dtype=np.float32), length)
    return frame.t


def _extend(root: h5py.Group, name: str, values: Float[np.ndarray, " ..."], length: int) -> None:
    """Append the rows of one frame to a dataset as one chunk."""
    if values.shape not in ((length,), (length, 3)):
        raise ValueError(f"{name} has shape {values.shape}; give ({length},) or ({length}, 3)")
    if name not in root:
        root.create_dataset(
            name, data=values, maxshape=(None, *values.shape[1:]), chunks=values.shape, fillvalue=None
        )
        return
    data = root[name]
    data.resize(len(data) + length, axis=0)
    data[-length:] = values


def _write_steps(
    root: h5py.Group, mesh: Mesh, times: Float[np.ndarray, " times"], fields: Mapping[str, Fields]
) -> None:
    """Write the offset of each time step in the datasets; all steps share the faces at offset 0."""
    count = len(times)
    index = np.arange(count)
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = count
    steps["Values"] = times
    steps["PartOffsets"] = np.zeros(count, dtype=np.int64)
    steps["NumberOfParts"] = np.ones(count, dtype=np.int64)
    steps["PointOffsets"] = index * mesh.n_nodes
    steps["CellOffsets"] = np.zeros((count, 1), dtype=np.int64)
    steps["ConnectivityIdOffsets"] = np.zeros((count, 1), dtype=np.int64)
    for group, length in (("PointData", mesh.n_nodes), ("CellData", len(mesh.faces))):
        for name in fields[group]:
            steps[f"{group}Offsets/{name}"] = index * length
