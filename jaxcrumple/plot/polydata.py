"""Frames of a run as meshes of PyVista, to turn them in a window or a notebook (extra `view`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxcrumple.io.run import Run
from jaxcrumple.plot.fields import field_kind
from jaxcrumple.plot.picture import frame_number

if TYPE_CHECKING:
    import pyvista


def polydata(
    run: Run, frame: int = -1, *, fields: Sequence[str] = ("curvature", "damage", "strain")
) -> pyvista.PolyData:
    """Return a frame of a run as a PyVista mesh with positions in m.

    **Arguments:** `frame`: index of the frame, -1 for the last; `fields`: names as of `picture`, with the
    same units; each is an array of the points or of the triangles. Show one by
    `polydata(run).plot(scalars="damage")`.

    **Raises:** ImportError without the extra `view`; ValueError for an unknown field, or a frame that the run
    does not have.
    """
    try:
        import pyvista
    except ImportError as error:
        raise ImportError("this needs PyVista (pip install pyvista).") from error
    number, faces = frame_number(run, frame), run.mesh.faces
    kinds = {name: field_kind(name) for name in fields}
    sheet = pyvista.PolyData.from_regular_faces(np.array(run.x[number]), np.array(faces))
    for name, kind in kinds.items():
        if kind is not None:
            values = kind.values(run, number)
            data = sheet.point_data if len(values) == run.mesh.n_nodes else sheet.cell_data
            data[name] = values
    return sheet
