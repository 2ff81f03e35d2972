"""Volume fraction of a crumpled sheet as a function of the radius (Fig. 8b).

It follows the experiments of Cambou & Menon, PNAS 108 (2011) 14741, and shows whether the sheet is denser
near its centre of mass or outside.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxcrumple._jax.arrays import NodeVectorsLike
from jaxcrumple.measure.shells import center_of_mass, require_shells, shell_areas
from jaxcrumple.measure.strain import positions
from jaxcrumple.mesh.mesh import Mesh


class VolumeFraction(NamedTuple):
    """Volume fraction of the sheet, dimensionless, in shells around its centre of mass.

    `radii` (k + 1,) in m: bounds of the shells, from 0 to `r0`; `phi` (k,): volume fraction of each shell;
    `phi0`: that of the sphere of radius `r0`.
    """

    radii: Float[np.ndarray, " bounds"]
    phi: Float[np.ndarray, " shells"]
    phi0: float

    @property
    def r0(self) -> float:
        """Largest distance of the sheet from its centre of mass in m."""
        return float(self.radii[-1])


def volume_fraction(mesh: Mesh, x: NodeVectorsLike, thickness: float, *, shells: int = 20) -> VolumeFraction:
    """Return the volume fraction of a sheet in spherical shells of equal width (Fig. 8b).

    The measure is that of Cambou & Menon, PNAS 108 (2011) 14741. The volume in a shell is the area of the
    middle surface in it, exact for the triangles, times the thickness. The surface itself has zero thickness:
    use shells wider than the thickness. A sheet with self-intersections can have a volume fraction above 1.

    **Arguments:** `x` (n, 3) in m; `thickness` in m; `shells`: number k of shells.

    **Raises:** ValueError for a wrong shape of `x`, a thickness that is not positive or no shell.
    """
    if not (np.ndim(thickness) == 0 and 0 < thickness < np.inf):
        raise ValueError(f"thickness = {thickness!r} is not usable; give one positive number in metres")
    if shells < 1:
        raise ValueError(f"shells = {shells!r} is not usable; give the number of shells, 1 or more")
    require_shells(mesh, shells)
    r0 = np.linalg.norm(positions(mesh, x) - center_of_mass(mesh, x), axis=1).max()
    radii = np.linspace(0.0, r0, shells + 1)
    filled = thickness * shell_areas(mesh, x, radii).sum(axis=0)
    volume = 4.0 / 3.0 * np.pi * radii**3
    return VolumeFraction(radii, filled / np.diff(volume), float(filled.sum() / volume[-1]))
