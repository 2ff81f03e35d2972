"""Frames: the saved states of a run, and the mesh they live on, as npz files."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxcrumple.io.atomic import RunDirectoryError, write_npz
from jaxcrumple.mesh import FloatArray, Mesh


class Frame(NamedTuple):
    """One saved state: `t` s, `x` (n, 3) m, `v` (n, 3) m/s, `p` (h,) rest curvature or None if elastic."""

    t: float
    x: FloatArray
    v: FloatArray
    p: FloatArray | None


def save_frame(path: Path, frame: Frame) -> None:
    """Write a frame. **Raises:** `RunDirectoryError`."""
    arrays = {"t": np.asarray(frame.t), "x": np.asarray(frame.x), "v": np.asarray(frame.v)}
    if frame.p is not None:
        arrays["p"] = np.asarray(frame.p)
    write_npz(path, arrays)


def load_frame(path: Path) -> Frame:
    """Read a frame. **Raises:** `RunDirectoryError` if the file is missing, damaged or not a frame."""
    arrays = _read_npz(path, ("t", "x", "v"))
    return Frame(float(arrays["t"]), arrays["x"], arrays["v"], arrays.get("p"))


def save_mesh(path: Path, mesh: Mesh) -> None:
    """Write nodes, faces in order, rest positions and origin of a mesh, to the last bit."""
    names = ("vertices", "faces", "source_nodes")
    write_npz(path, {name: getattr(mesh, name) for name in names})


def load_mesh(path: Path) -> Mesh:
    """Read a mesh; every array equals that of the mesh that was saved. **Raises:** `RunDirectoryError`."""
    arrays = _read_npz(path, ("vertices", "faces", "source_nodes"))
    source = arrays["source_nodes"]
    source.flags.writeable = False
    return replace(Mesh.from_arrays(arrays["vertices"], arrays["faces"], reorder=False), source_nodes=source)


def _read_npz(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    cure = "delete it if the run can do without, or restore it from a copy"
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError as error:
        raise RunDirectoryError(f"{str(path)!r} does not exist; the run was not saved this far") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise RunDirectoryError(f"{str(path)!r} is damaged ({error}); {cure}") from error
    missing = [name for name in names if name not in arrays]
    if missing:
        raise RunDirectoryError(f"{str(path)!r} has no {', '.join(missing)}; {cure}")
    return arrays
