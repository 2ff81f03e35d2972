"""Frames (saved states of a run) and their mesh as npz files."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxcrumple.io.atomic import RunDirectoryError, npz_bytes
from jaxcrumple.mesh.mesh import Mesh


class Frame(NamedTuple):
    """One saved state: `t` s, `x` (n, 3) m, `v` (n, 3) m/s, `p` (h,) rest curvature or None if elastic."""

    t: float
    x: Float[np.ndarray, "nodes 3"]
    v: Float[np.ndarray, "nodes 3"]
    p: Float[np.ndarray, " hinges"] | None


def pack_frame(frame: Frame) -> bytes:
    """Encode a frame as an npz file."""
    arrays = {"t": np.asarray(frame.t), "x": np.asarray(frame.x), "v": np.asarray(frame.v)}
    if frame.p is not None:
        arrays["p"] = np.asarray(frame.p)
    return npz_bytes(arrays)


def unpack_frame(path: Path, data: bytes) -> Frame:
    """Decode a frame. **Raises:** `RunDirectoryError` if `data` is not a frame."""
    arrays = _unpack(path, data, ("t", "x", "v"))
    return Frame(float(arrays["t"]), arrays["x"], arrays["v"], arrays.get("p"))


#: Stiffness of the edges (e,) in N/m and of the hinges (h,) in J.
Stiffness = tuple[Float[np.ndarray, " edges"], Float[np.ndarray, " hinges"]]
_MESH, _STIFFNESS = ("vertices", "faces", "source_nodes"), ("stretch_stiffness", "bending_stiffness")


def pack_mesh(mesh: Mesh, stiffness: Stiffness) -> bytes:
    """Encode rest positions, ordered faces and source nodes of a mesh, and the stiffness of the sheet.

    The file restores every array bit for bit.
    """
    arrays = {name: getattr(mesh, name) for name in _MESH}
    return npz_bytes({**arrays, **dict(zip(_STIFFNESS, stiffness, strict=True))})


def unpack_mesh(path: Path, data: bytes) -> tuple[Mesh, Stiffness]:
    """Decode a mesh and the stiffness of the sheet; every array equals the saved one.

    **Raises:** `RunDirectoryError`.
    """
    arrays = _unpack(path, data, (*_MESH, *_STIFFNESS))
    source = arrays["source_nodes"]
    source.flags.writeable = False
    mesh = Mesh.from_arrays(arrays["vertices"], arrays["faces"], reorder=False)
    stretch, bending = (arrays[name] for name in _STIFFNESS)
    return replace(mesh, source_nodes=source), (stretch, bending)


def _unpack(path: Path, data: bytes, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError, NotImplementedError) as error:
        raise RunDirectoryError(f"{str(path)!r} is damaged ({error})") from error
    missing = [name for name in names if name not in arrays]
    if missing:
        raise RunDirectoryError(f"{str(path)!r} has no {', '.join(missing)}")
    return arrays
