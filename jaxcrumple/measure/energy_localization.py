"""Localization of the energy on a small part of the sheet (Section 4.1, Fig. 8c)."""

from __future__ import annotations

import numpy as np
from jaxtyping import ArrayLike, Float, Real

from jaxcrumple.mesh.mesh import Mesh


def localization(mesh: Mesh, density: Real[ArrayLike, " faces"], share: float = 0.5) -> float:
    """Return the smallest fraction of the rest area that contains the fraction `share` of the energy.

    It equals `share` for a uniform energy, and is nan for a sheet without energy. `density` (f,): energy per
    rest area of the faces, in J/m2, such as `face_bending_density`. The last face counts only in part. The
    result depends on the mesh, since a triangle is the smallest area.

    **Raises:** ValueError unless there is one density for each face, none negative, and 0 < share < 1.

    >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> round(measure.localization(square, [1.0, 3.0]), 4)  # two thirds of one half of the area
    0.3333
    """
    if not 0 < share < 1:
        raise ValueError(f"share = {share!r} is not usable; give a fraction of the energy between 0 and 1")
    density = _density(mesh, density)
    order = np.argsort(-density)
    area, held = (np.cumsum(part[order]) for part in (mesh.face_area, density * mesh.face_area))
    if held[-1] == 0:
        return float("nan")
    return float(np.interp(share * held[-1], np.append(0.0, held), np.append(0.0, area)) / area[-1])


def participation_ratio(mesh: Mesh, density: Real[ArrayLike, " faces"]) -> float:
    """Return the participation ratio of an energy density e: (integral of e)^2 / (A integral of e^2).

    It is 1 for a uniform density. For a density that is uniform on a part of the area and zero elsewhere it
    is the fraction of that part (Bell & Dean, Discuss. Faraday Soc. 50 (1970) 55). It is nan for a sheet
    without energy. `density` (f,) in J/m2 as in `localization`.

    **Raises:** ValueError unless there is one density for each face, none negative.

    >>> square = jc.Mesh.from_arrays([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> measure.participation_ratio(square, [1.0, 0.0]), measure.participation_ratio(square, [1.0, 1.0])
    (0.5, 1.0)
    """
    density = _density(mesh, density)
    squares = mesh.face_area.sum() * (density**2 @ mesh.face_area)
    return float((density @ mesh.face_area) ** 2 / squares) if squares > 0 else float("nan")


def _density(mesh: Mesh, density: Real[ArrayLike, " faces"]) -> Float[np.ndarray, " faces"]:
    density = np.asarray(density, dtype=np.float64)
    if density.shape != mesh.face_area.shape:
        raise ValueError(f"density has shape {density.shape}; give one for each of {len(mesh.faces)} faces")
    if not np.all(density >= 0):
        raise ValueError("density has a negative or nan value; give energies per area >= 0")
    return density
