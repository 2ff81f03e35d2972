"""Write triangles to a file."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxcrumple.mesh.files.surface import MeshError

#: File name endings that `Mesh.save` writes and `Mesh.from_file` reads back to the last digit.
FILE_FORMATS = (".vtu", ".vtk", ".ply", ".obj", ".off", ".msh")


def write_triangles(
    path: str | Path, points: Float[np.ndarray, "nodes 3"], faces: Int[np.ndarray, "faces 3"]
) -> None:
    """Write points (n, 3) and triangles (f, 3); the ending of `path` selects the format.

    **Raises:** `MeshError` for an unknown ending, `OSError` if the file cannot be written.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in FILE_FORMATS:
        raise MeshError(f"cannot save {str(path)!r}; end the name with one of {', '.join(FILE_FORMATS)}")
    import meshio

    mesh = meshio.Mesh(points.copy(), [("triangle", faces.copy())])
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        mesh.write(path, file_format="gmsh" if ending == ".msh" else ending[1:])
