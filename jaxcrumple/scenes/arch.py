"""Clamped shallow arch that snaps through under a dead load at midspan."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxcrumple._jax.door import door
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import hexagonal
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.loads import dead_load
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.quantities import Damping, Duration, Imperfection, Length, Load
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import smooth_imperfection
from jaxcrumple.scenes.snap import check_positive, fixed, sheet_material

# Distance between lattice rows, in units of the node spacing.
ROW = np.sqrt(3.0) / 2.0


@door
def arch(
    nodes: int = 400,
    seed: int = 0,
    *,
    length: Length = 0.03,
    width: Length = 0.006,
    rise: Length = 0.002,
    load: Load = 0.2,
    ramp: Duration = 0.03,
    imperfection: Imperfection = 25e-6,
    plastic: bool = False,
    damping: Damping = "central",
    material: Material | None = None,
) -> Setup:
    """Build a strip clamped at both ends, whose stress-free shape is a circular arch over the x axis.

    The nodes of the middle row share the load, which points down (-z). The load grows linearly during the
    time `ramp` and then stays constant. The arch snaps at a symmetric limit point, not by asymmetric
    buckling: its compression there is at most (2.7 pi/L)^2 B, below the (2.86 pi/L)^2 B of asymmetric
    buckling. For a rise f of many thicknesses the limit load is near 237 B f / L^3, with span L and the
    bending stiffness B = (8/9) kappa W of a narrow strip (shallow-arch theory). That is 0.14 N for the
    default values; the default mesh and imperfection give 0.126 N. The inverted arch supports at least half
    of that load.

    **Arguments:** `nodes`: approximate number of nodes of a triangular lattice with rows across the strip;
    `length`, `width`, `rise` in m; ``load`` in N; `ramp` in s; `imperfection`: largest height in m of a
    smooth, stress-free deviation from the circle, random with `seed`; `plastic`: whether the sheet may yield;
    `damping`: "central" or "paper"; `material`: default `Material()`. The last two rows at each end are
    fixed; the ends of `length` lie midway between these two rows.

    **Raises:** ValueError for lengths, a load or a time that are not positive, a negative imperfection, or a
    rise above half the length.
    """
    check_positive(length=length, width=width, rise=rise, load=load, ramp=ramp)
    if not (np.isfinite(imperfection) and imperfection >= 0):
        raise ValueError(f"imperfection = {imperfection!r} m must be zero or positive.")
    if 2 * rise > length:
        raise ValueError(f"rise = {rise} m is more than half the length {length} m; choose a shallower arch.")
    flat, row = strip(nodes, length, width)
    along, across = flat.vertices[:, 0], flat.vertices[:, 1]
    x = on_arc(along, across, length, rise)
    x[:, 2] += smooth_imperfection(flat.vertices[:, :2], length, imperfection, seed)
    mesh = flat.with_rest_shape(x)
    middle = np.flatnonzero(row == row.max() // 2)
    push = np.tile([0.0, 0.0, -load / len(middle)], (len(middle), 1))
    made_of = sheet_material(material, plastic)
    scene = sheet(
        mesh,
        made_of,
        prescribed=fixed((row < 2) | (row > row.max() - 2), x),
        extra=[dead_load(middle, push, ramp)],
        damping=damping,
    )
    return Setup(mesh, scene, jnp.asarray(mesh.vertices), material=made_of)


def strip(nodes: int, length: float, width: float) -> tuple[Mesh, Int[np.ndarray, " nodes"]]:
    """Return a flat lattice strip along x with rows across it, and the row (n,) of each node, from 0.

    The number of rows is odd, so that one row is at midspan. The outermost rows are half a row distance
    beyond the ends of `length`.
    """
    spacing = np.sqrt(length * width / (nodes * ROW))
    per_row = max(round(width / spacing + 0.5), 2)
    spacing = width / (per_row - 0.5)
    gaps = max(2 * round((length / (ROW * spacing) + 1.0) / 2.0), 6)
    lattice = hexagonal(per_row, gaps, spacing)
    row = np.rint(lattice.vertices[:, 1] / (ROW * spacing) + gaps / 2).astype(int)
    along = (row - gaps / 2) * (length / (gaps - 1))
    return lattice.with_rest_shape(np.column_stack([along, -lattice.vertices[:, 0]])), row


def on_arc(
    along: Float[np.ndarray, " nodes"], across: Float[np.ndarray, " nodes"], length: float, rise: float
) -> Float[np.ndarray, "nodes 3"]:
    """Bend a flat strip to a circle with sagitta `rise` over the chord `length`; return points (n, 3) in m.

    The ends of the chord are at x = -length/2 and length/2, z = 0. Points beyond them continue along the
    circle.
    """
    radius = (length**2 / 4 + rise**2) / (2 * rise)
    angle = 2 * np.arcsin(length / (2 * radius)) * along / length
    height = radius * np.cos(angle) - (radius - rise)
    return np.column_stack([radius * np.sin(angle), across, height])
