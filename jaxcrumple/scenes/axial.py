"""Axial crumpling: a sheet, rolled into a cylinder, is compressed along its axis, once or repeatedly.

The experiment is that of Gottesman et al., Commun. Phys. 1, 70 (2018), simulated as in the paper (Figs. 7,
9). One cycle: a cylinder shrinks around the upright sheet and rolls it up; two planes compress it along the
axis; all walls open; springs pull the sheet's edge back to its position in the flat sheet; two planes flatten
it. A rolled sheet snaps throughout the compression, so that all time steps are short. The compression is
therefore fast; the kinetic energy stays below 1 % of all other energy.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Scalar
from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.loads import ElementEnergy
from jaxcrumple.model.walls import AbstractShape, Cylinder, PiecewiseLinear, Plane, of_time
from jaxcrumple.scenes.quantities import Cycles, Duration, Length
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions, upright, wrapped
from jaxcrumple.scenes.snap import check_gap, check_positive

# Initial bending radius, in units of the sheet size. It makes the sheet roll up to one side.
BIAS = 2.0
# Default range of self-contact in thicknesses. The free edges of a rolled sheet meet edge-on, where contact
# sites are sparse; a range of one thickness barely keeps them apart.
RANGE = 2.0
# First and last stiffness in N/m of the springs that pull the edge back.
PULL = (1e-3, 100.0)


class AxialTimes(NamedTuple):
    """Durations in s of the parts of a cycle.

    `roll`: roll the sheet up; `compress`: compress it; `open`: open the walls; `unfold`: pull its edge back;
    `flatten`: flatten it; `rest`: wait without springs.
    """

    roll: float = 0.1
    compress: float = 0.2
    open: float = 0.03
    unfold: float = 0.12
    flatten: float = 0.08
    rest: float = 0.04

    @property
    def cycle(self) -> float:
        """Duration of a whole cycle in s."""
        return sum(self)

    def ends(self, cycles: int) -> Float[np.ndarray, "cycles 6"]:
        """Return the times (cycles, 6) in s at which the parts of each cycle end."""
        return self.cycle * np.arange(cycles)[:, None] + np.cumsum(self)


TIMES = AxialTimes()


@door
def cylindrical(
    nodes: int = 1000,
    seed: int = 0,
    *,
    size: Length = 0.1,
    radius: Length = 0.017,
    height: Length = 0.045,
    compress: Duration = TIMES.compress,
    **options: Any,
) -> Setup:
    """Build a square sheet, rolled up in a cylinder, that two planes compress along the axis.

    It is the cylindrical confinement of Fig. 7.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `size`: edge of the sheet,
    `radius` of the cylinder, `height` after the compression in m; `compress`: duration in s; `options` of the
    sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or a time that are not positive, a height >= the size, or a cylinder
    too small for the sheet.
    """
    check_positive(size=size, radius=radius, height=height, compress=compress)
    _check_height(height, size)
    sheet = SheetOptions(**options).reaching(RANGE)
    inner, least = radius - sheet.clearance - sheet.imperfection, (size + sheet.clearance) / (2.0 * math.pi)
    if inner < least:
        raise ValueError(
            f"radius = {radius} m is too small for a sheet of {size} m that does not overlap; choose at "
            f"least {least + radius - inner:.4g} m."
        )
    mesh = sheet.square(size, nodes, seed)
    wide = 0.5 * size + sheet.clearance + sheet.imperfection
    along = jnp.array([0.0, 0.0, 1.0])
    planes = _piecewise([0.0, compress], [-wide, -0.5 * height])
    walls = [
        Cylinder(jnp.zeros(3), along, of_time(radius)),
        Plane(along, planes),
        Plane(-along, planes),
    ]
    x = upright(curled(mesh.vertices, inner)) + np.array([0.0, inner, 0.0])
    return sheet.finer(mesh).setup(mesh, walls, x=x)


@door
def axial(
    nodes: int = 2000,
    seed: int = 0,
    *,
    cycles: Cycles = 5,
    size: Length = 0.1,
    radius: Length = 0.017,
    height: Length = 0.045,
    gap: Length = 2e-3,
    roll: Duration = TIMES.roll,
    compress: Duration = TIMES.compress,
    open: Duration = TIMES.open,
    unfold: Duration = TIMES.unfold,
    flatten: Duration = TIMES.flatten,
    rest: Duration = TIMES.rest,
    **options: Any,
) -> Setup:
    """Build a square sheet that is repeatedly rolled up, compressed, unfolded and flattened.

    Damage accumulates over the cycles, as in Fig. 9 and the experiment of Gottesman et al., Commun. Phys. 1
    (2018) 70.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of the random mesh; `cycles`: number of cycles;
    `size`: edge of the sheet, `radius` of the roll, `height` after the compression, `gap` between the
    flattening planes in m; `roll`, `compress`, `open`, `unfold`, `flatten`, `rest`: durations in s of the
    parts of a cycle (`AxialTimes`); `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or times that are not positive, less than one cycle, a height >= the
    size, or a gap of at most two thicknesses.
    """
    if cycles < 1:
        raise ValueError(f"cycles = {cycles!r} must be at least 1.")
    require(1000.0 * cycles, f"a motion of {cycles} cycles", "choose fewer")
    times = AxialTimes(roll, compress, open, unfold, flatten, rest)
    sheet = SheetOptions(**options).reaching(RANGE)
    check_positive(size=size, radius=radius, height=height, gap=gap, **times._asdict())
    _check_height(height, size)
    check_gap(gap, sheet.thickness)
    mesh = sheet.square(size, nodes, seed)
    home = upright(mesh.vertices)
    wide = 0.5 * size + sheet.clearance + sheet.imperfection
    walls = _walls(wide, radius, height, 0.5 * gap, times.ends(cycles))
    x = upright(curled(mesh.vertices, BIAS * size))
    return sheet.finer(mesh).setup(mesh, walls, x=x, extra=[_pull(mesh, home, times, cycles)])


def _check_height(height: float, size: float) -> None:
    if height >= size:
        raise ValueError(f"height = {height} m must be less than the size {size} m of the sheet.")


def curled(vertices: Float[np.ndarray, "nodes 3"], radius: float) -> Float[np.ndarray, "nodes 3"]:
    """Roll a flat sheet upwards about the y axis to a `radius` in m; return points (n, 3) in m."""
    turned = np.array([1.0, 1.0, -1.0])
    return turned * wrapped(turned * vertices, radius, along="y")


def _walls(
    wide: float, radius: float, height: float, thin: float, ends: Float[np.ndarray, "cycles 6"]
) -> list[AbstractShape]:
    """Build the cylinder, the two planes that compress along z, and the two planes that flatten along y.

    When open, all walls are at the distance `wide` in m. When closed, they leave a `radius`, a `height` and
    twice `thin` in m. `ends` (cycles, 6): end times in s of the parts of each cycle.
    """
    cycles, moments = len(ends), [0.0, *ends.ravel()]
    round_ = [wide] + cycles * [radius, radius, wide, wide, wide, wide]
    tall = [wide] + cycles * [wide, 0.5 * height, wide, wide, wide, wide]
    deep = [wide] + cycles * [wide, wide, wide, wide, thin, wide]
    along, across = jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 1.0, 0.0])
    walls: list[AbstractShape] = [Cylinder(jnp.zeros(3), along, _piecewise(moments, round_))]
    for normal, half in ((along, tall), (across, deep)):
        walls += [
            Plane(sign * normal, _piecewise(moments, [-value for value in half])) for sign in (1.0, -1.0)
        ]
    return walls


def _piecewise(moments: list[float], values: list[float]) -> PiecewiseLinear:
    return PiecewiseLinear(jnp.array(moments), jnp.array(values))


def _pull(mesh: Mesh, x: Float[np.ndarray, "nodes 3"], times: AxialTimes, cycles: int) -> ElementEnergy:
    """Build springs from the nodes of the edge to their positions `x` (n, 3) in m in the flat sheet.

    The stiffness grows during `unfold`, is constant during `flatten`, and is zero otherwise.
    """
    edge = jnp.asarray(mesh.boundary_nodes)
    shared = (jnp.asarray(times.ends(cycles)[:, 2]), jnp.array([times.unfold, times.flatten]))
    begin, lasts = (jnp.tile(values, (len(edge), 1)) for values in shared)
    return ElementEnergy(edge[:, None], _spring, (jnp.asarray(x)[edge], begin, lasts))


def _spring(
    x: Float[Array, "1 3"],
    parameters: tuple[Float[Array, " 3"], Float[Array, " cycles"], Float[Array, " 2"]],
    t: Scalar,
) -> Scalar:
    """Return the energy in J of one spring.

    `parameters`: its anchor (3,) in m, the start times (cycles,) in s, and the durations (2,) in s of growth
    and of constant stiffness.
    """
    home, begin, (grows, stays) = parameters
    since = t - begin
    low, high = PULL
    growth = jnp.clip(since / grows, 0.0, 1.0)
    pulls = (since > 0.0) & (since < grows + stays)
    stiffness = jnp.sum(jnp.where(pulls, low * jnp.exp(growth * math.log(high / low)), 0.0))
    return 0.5 * stiffness * jnp.sum((x[0] - home) ** 2)
