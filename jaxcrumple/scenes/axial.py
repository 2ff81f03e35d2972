"""Axial crumpling: a sheet rolled into a cylinder and compressed along it, once or again and again (Figs.
7, 9).

After Gottesman et al., Commun. Phys. 1, 70 (2018), in the paper's manner: a cylinder shrinks around the
upright sheet until it is rolled up, two planes come together along the axis, all walls open, the sheet's
edge is pulled back to where it was when the sheet was flat, and planes flatten it. A rolled sheet snaps all
the time that it is compressed, and every step is a short one: so it is done fast, with kinetic energy below
1 % of the rest.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require
from jaxcrumple.mesh.mesh import FloatArray, Mesh
from jaxcrumple.model.loads import ElementEnergy
from jaxcrumple.model.walls import AbstractShape, Corners, Cylinder, Plane, of_time
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import SheetOptions, upright, wrapped
from jaxcrumple.scenes.snap import check_gap, check_positive

# Radius, in units of its size, to which a sheet is bent that is to be rolled up: so it bends to one side.
BIAS = 2.0
# Range of self-contact in thicknesses where none is given: the free edges of a rolled sheet meet edge on,
# where sites are few, and with a range of one thickness hold each other apart only just.
RANGE = 2.0
# Springs that pull the edge home grow from the first to the second stiffness in N/m.
PULL = (1e-3, 100.0)


class AxialTimes(NamedTuple):
    """How long each part of a cycle lasts, in s: to `roll` the sheet up, to `compress` it, to `open` the
    walls, to `unfold` it, to `flatten` it, and to let it `rest` without a pull."""

    roll: float = 0.1
    compress: float = 0.2
    open: float = 0.03
    unfold: float = 0.12
    flatten: float = 0.08
    rest: float = 0.04

    @property
    def cycle(self) -> float:
        """Time of a whole cycle."""
        return sum(self)

    def ends(self, cycles: int) -> FloatArray:
        """Times (cycles, 6) in s at which the parts of each cycle end."""
        return self.cycle * np.arange(cycles)[:, None] + np.cumsum(self)


TIMES = AxialTimes()


@door
def cylindrical(
    nodes: int = 1000,
    seed: int = 0,
    *,
    size: float = 0.1,
    radius: float = 0.017,
    height: float = 0.045,
    compress: float = TIMES.compress,
    **options: Any,
) -> Setup:
    """A square sheet of edge `size`, rolled up in a cylinder of `radius`, that is compressed to `height`.

    **Arguments:** `nodes` of the random mesh made with `seed`; `size`, `radius`, `height` in m; `compress`:
    how long that takes in s; `options` of the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or a time that are not positive, a height that is not less than the
    size, or a cylinder that the sheet is too wide for.
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
    planes = _corners([0.0, compress], [-wide, -0.5 * height])
    walls = [
        Cylinder(jnp.zeros(3), along, of_time(radius)),
        Plane(along, planes),
        Plane(-along, planes),
    ]
    x = upright(curled(mesh.vertices, inner)) + np.array([0.0, inner, 0.0])
    return sheet.setup(mesh, walls, x=x)


@door
def axial(
    nodes: int = 2000,
    seed: int = 0,
    *,
    cycles: int = 5,
    size: float = 0.1,
    radius: float = 0.017,
    height: float = 0.045,
    gap: float = 2e-3,
    roll: float = TIMES.roll,
    compress: float = TIMES.compress,
    open: float = TIMES.open,
    unfold: float = TIMES.unfold,
    flatten: float = TIMES.flatten,
    rest: float = TIMES.rest,
    **options: Any,
) -> Setup:
    """A square sheet that is rolled up, compressed, unfolded and flattened, again and again; damage stays.

    **Arguments:** `nodes` of the random mesh made with `seed`; `cycles`: how often; `size`, `radius` of the
    roll, `height` to which it is compressed, `gap` between the planes that flatten it in m; `roll`,
    `compress`, `open`, `unfold`, `flatten`, `rest`: how long each part of a cycle lasts in s; `options` of
    the sheet: `SheetOptions`.

    **Raises:** ValueError for lengths or times that are not positive, less than one cycle, a height that is
    not less than the size, or a gap that the sheet fills.
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
    return sheet.setup(mesh, walls, x=x, extra=[_pull(mesh, home, times, cycles)])


def _check_height(height: float, size: float) -> None:
    if height >= size:
        raise ValueError(f"height = {height} m must be less than the size {size} m of the sheet.")


def curled(vertices: FloatArray, radius: float) -> FloatArray:
    """Points (n, 3) of a flat sheet rolled upwards about the y axis to a `radius` in m."""
    turned = np.array([1.0, 1.0, -1.0])
    return turned * wrapped(turned * vertices, radius, along="y")


def _walls(wide: float, radius: float, height: float, thin: float, ends: FloatArray) -> list[AbstractShape]:
    """The cylinder, the two planes that compress along z, and the two that flatten along y.

    All are `wide` open, except as they close: to `radius`, `height`, and twice `thin` in m; `ends` (cycles,
    6) in s are those of the parts of each cycle.
    """
    cycles, moments = len(ends), [0.0, *ends.ravel()]
    round_ = [wide] + cycles * [radius, radius, wide, wide, wide, wide]
    tall = [wide] + cycles * [wide, 0.5 * height, wide, wide, wide, wide]
    deep = [wide] + cycles * [wide, wide, wide, wide, thin, wide]
    along, across = jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 1.0, 0.0])
    walls: list[AbstractShape] = [Cylinder(jnp.zeros(3), along, _corners(moments, round_))]
    for normal, half in ((along, tall), (across, deep)):
        walls += [Plane(sign * normal, _corners(moments, [-value for value in half])) for sign in (1.0, -1.0)]
    return walls


def _corners(moments: list[float], values: list[float]) -> Corners:
    return Corners(jnp.array(moments), jnp.array(values))


def _pull(mesh: Mesh, x: FloatArray, times: AxialTimes, cycles: int) -> ElementEnergy:
    """Springs between the nodes of the edge and their places `x` (n, 3) in the flat sheet, which grow
    while it is unfolded, stay while it is flattened, and are gone after that."""
    edge = jnp.asarray(mesh.boundary_nodes)
    shared = (jnp.asarray(times.ends(cycles)[:, 2]), jnp.array([times.unfold, times.flatten]))
    begin, lasts = (jnp.tile(values, (len(edge), 1)) for values in shared)
    return ElementEnergy(edge[:, None], _spring, (jnp.asarray(x)[edge], begin, lasts))


def _spring(x: Array, parameters: tuple[Array, Array, Array], t: Array) -> Array:
    """Energy in J of one spring: `parameters` are its place (3,), the times (cycles,) in s at which it begins
    to pull, and how long (2,) it grows and stays."""
    home, begin, (grows, stays) = parameters
    since = t - begin
    low, high = PULL
    growth = jnp.clip(since / grows, 0.0, 1.0)
    pulls = (since > 0.0) & (since < grows + stays)
    stiffness = jnp.sum(jnp.where(pulls, low * jnp.exp(growth * math.log(high / low)), 0.0))
    return 0.5 * stiffness * jnp.sum((x[0] - home) ** 2)
