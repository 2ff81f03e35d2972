"""Choose the reader of a mesh file, and report a file that cannot be read."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxcrumple.mesh.files.ply import read_ply
from jaxcrumple.mesh.files.polydata import is_polydata, read_polydata
from jaxcrumple.mesh.files.surface import MeshError, Surface, spatial
from jaxcrumple.mesh.files.text import read_obj, read_off

_SKIPPED = {"vertex", "line", "line3"}
_REASON = 200  # most characters of a reader's own message that an error quotes


def read_surface(path: str | Path) -> Surface:
    """Read points and polygons of a file, with lengths as in the file; skip vertex and line cells.

    **Raises:** `FileNotFoundError`; `MeshError` that quotes the reader's reason, or names cells that are
    neither points, lines nor flat polygons.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"mesh file {str(path)!r} does not exist; check the path")
    said = io.StringIO()
    try:
        # NumPy only warns of text that is not a number and of numbers that overflow; make these errors.
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            surface = _reader(path)(path)
    except MeshError:
        raise
    except (Exception, SystemExit) as error:  # meshio calls sys.exit when its last reader fails
        raise MeshError(
            f"cannot read {str(path)!r} as a mesh ({_reason(error, said.getvalue())}); re-export it, for "
            "example as .vtu"
        ) from error
    if len(surface.sizes) == 0:
        raise MeshError(f"{str(path)!r} has no triangles; export the surface as a triangle mesh")
    n = len(surface.points)
    bad = np.flatnonzero((surface.corners < 0) | (surface.corners >= n))
    if len(bad):
        raise MeshError(
            f"{str(path)!r} has a face with point {surface.corners[bad[0]]}, outside 0..{n - 1}; re-export it"
        )
    bad = np.flatnonzero(~np.isfinite(surface.points[surface.corners]).all(axis=1))
    if len(bad):
        raise MeshError(
            f"{str(path)!r} has a face with point {surface.corners[bad[0]]}, which is not finite; "
            "re-export it"
        )
    return surface


def _reader(path: Path) -> Callable[[Path], Surface]:
    ending = path.suffix.lower()
    own = {".obj": read_obj, ".off": read_off, ".ply": read_ply}.get(ending)
    if ending == ".vtk" and is_polydata(path.read_bytes()):
        own = read_polydata
    if own is not None:
        return lambda path: own(path.read_bytes())
    return _read_stl if ending == ".stl" else _read_with_meshio


def _reason(error: BaseException, said: str) -> str:
    """Return the reason of a reader's failure on one line: its exception, or the text it printed."""
    text = str(error) if isinstance(error, Exception) else said
    text = " ".join(text.split())
    if not text:
        return "no reader accepts its contents" if isinstance(error, SystemExit) else type(error).__name__
    return text if len(text) <= _REASON else f"{text[:_REASON]}..."


def _read_stl(path: Path) -> Surface:
    # Imported here because the import takes a second and only STL needs it.
    import trimesh

    content = path.read_bytes()
    if len(content) < 84 or len(content) != 84 + 50 * int.from_bytes(content[80:84], "little"):
        # Text: a name in another encoding would make trimesh require a further package.
        content = content.decode("utf-8", errors="replace").encode()
    mesh: Any = trimesh.load(io.BytesIO(content), file_type="stl", force="mesh", process=False)
    if len(mesh.faces) == 0:
        raise ValueError("it has no facets, or its size does not match its header")
    faces = np.asarray(mesh.faces, np.int64)
    return Surface(spatial(mesh.vertices), faces.ravel(), np.full(len(faces), 3))


def _read_with_meshio(path: Path) -> Surface:
    # Most programs read no mesh, and its import takes a twentieth of a second.
    import meshio

    data = meshio.read(path)
    kept = [block for block in data.cells if block.type not in _SKIPPED and len(block.data)]
    others = {block.type for block in kept if block.type not in ("triangle", "quad")}
    others = {name for name in others if not name.startswith("polygon")}
    if others:
        raise MeshError(
            f"{str(path)!r} has cells of type {', '.join(sorted(others))}; export the surface alone, as "
            "triangles"
        )
    tables = [np.asarray(block.data) for block in kept]
    widths = {"triangle": 3, "quad": 4}
    if any(
        table.shape[1] != widths.get(b.type, max(table.shape[1], 3))
        for b, table in zip(kept, tables, strict=True)
    ):
        raise ValueError("the number of corners of its cells does not match their type")
    sizes = np.concatenate([np.full(len(table), table.shape[1]) for table in tables] or [np.zeros(0, int)])
    corners = np.concatenate([table.ravel() for table in tables] or [np.zeros(0, int)])
    return Surface(spatial(data.points), corners.astype(np.int64), sizes, data.point_data)
