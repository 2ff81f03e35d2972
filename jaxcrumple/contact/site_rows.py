"""Find the sites of a triangle near a point or triangle, as integer intervals in the rows of its lattice."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxcrumple.geometry.distance import TINY
from jaxcrumple.geometry.hinge import Vec, add, cross, dot, scale, sub

# Tolerance of the bounds, in site spacings or in units of the reach: sites that miss a bound by less count.
ROUNDING = 1e-6


class Lattice:
    """Order the sites of a triangle by rows, in which the weight of the first corner is constant.

    `parts`: intervals along an edge; `row` (r,): row numbers; `first` (r,): first site of each row.
    """

    def __init__(self, weights: Float[Array, "sites 3"]) -> None:
        self.weights, self.count = weights, weights.shape[0]
        self.parts = (int(np.sqrt(8 * self.count + 1)) - 3) // 2
        self.row = np.arange(self.parts + 1)
        self.first = jnp.asarray(self.row * (self.parts + 1) - self.row * (self.row - 1) // 2, jnp.int32)

    def point(self, site: Int[Array, " pairs"], corners: tuple[Vec, ...]) -> Vec:
        """Return the positions of sites `site` (m,) of triangles with given `corners`."""
        a, b, c = (scale(self.weights[:, k][site], corner) for k, corner in enumerate(corners))
        return add(add(a, b), c)

    def steps(self, point: Vec, corners: tuple[Vec, ...]) -> tuple[Vec, Vec, Vec]:
        """Return the vectors from `point` to the third corner, from a row to the next, and along a row."""
        row, step = (scale(1.0 / self.parts, sub(corners[k], corners[2])) for k in range(2))
        return sub(corners[2], point), row, step


def in_prism(
    lattice: Lattice, first: tuple[Vec, ...], second: tuple[Vec, ...], reach: Float[Array, " pairs"]
) -> tuple[Int[Array, "pairs rows"], Int[Array, "pairs rows"]]:
    """Find the sites of the first triangles in prisms around the second ones that extend by `reach` (m,).

    The five sides of a prism are planes, and the height of a site above a plane is linear in its number in
    the row.

    **Returns:** start and exclusive end of intervals (m, r) of site numbers in each row.
    """
    edges = [sub(second[(k + 1) % 3], second[k]) for k in range(3)]
    normal = _unit(cross(edges[0], edges[1]))
    low, high = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    for corner, direction in [
        (second[0], normal),
        (second[0], scale(-1.0, normal)),
        *((second[k], _unit(cross(edges[k], normal))) for k in range(3)),
    ]:
        # The barrier makes XLA compute this once per triangle instead of once per row.
        a, b, c = jax.lax.optimization_barrier(tuple(dot(sub(p, corner), direction) for p in first))
        row, rise = (a - c) / lattice.parts, ((b - c) / lattice.parts)[:, None]
        room = (reach - c)[:, None] - row[:, None] * lattice.row
        # XLA may evaluate a rise more than once; if it is zero up to rounding, its sign may differ each time.
        least = (ROUNDING * reach / lattice.parts)[:, None]
        steep = jnp.abs(rise) > least
        end = room / jnp.where(steep, rise, 1.0)
        low = jnp.maximum(low, jnp.where(steep & (rise < 0), end, -jnp.inf))
        level = jnp.where(room >= -least, jnp.inf, -jnp.inf)
        high = jnp.minimum(high, jnp.where(steep, jnp.where(rise > 0, end, jnp.inf), level))
    return _whole(low, high, lattice.parts - lattice.row)


def across(a: Vec, b: Vec) -> Vec:
    """Return the component of `a` normal to `b`."""
    return sub(a, scale(dot(a, b) / (dot(b, b) + TINY), b))


def within(
    start: Vec, step: Vec, reach: Float[Array, " pairs"], last: Int[Array, " pairs"] | int
) -> tuple[Int[Array, "pairs 1"], Int[Array, "pairs 1"]]:
    """Find the integers k from 0 to `last` for which |`start` + k `step`| <= `reach`, a quadratic inequality.

    **Returns:** start and exclusive end of the intervals (m, 1).
    """
    square = dot(step, step) + TINY
    middle = -dot(start, step) / square
    half = middle * middle - (dot(start, start) - reach * reach) / square
    width = jnp.where(half >= 0, jnp.sqrt(jnp.maximum(half, 0.0)), -jnp.inf)
    first, behind = _whole(middle - width, middle + width, last)
    return first[:, None], behind[:, None]


def without(
    whole: tuple[Int[Array, "pairs 1"], Int[Array, "pairs 1"]],
    part: tuple[Int[Array, "pairs 1"], Int[Array, "pairs 1"]],
) -> tuple[Int[Array, "pairs 2"], Int[Array, "pairs 2"]]:
    """Return the intervals (m, 2) that `part` (m, 1) leaves of `whole` (m, 1): before it and after it."""
    (first, behind), (begin, end) = whole, part
    empty = begin >= end
    begin, end = jnp.where(empty, behind, begin), jnp.where(empty, behind, end)
    starts = jnp.concatenate([first, jnp.maximum(first, end)], axis=1)
    return starts, jnp.concatenate([jnp.minimum(behind, begin), behind], axis=1)


def _whole(
    low: Float[Array, " *axes"],
    high: Float[Array, " *axes"],
    last: Int[Array, " pairs"] | Int[np.ndarray, " rows"] | int,
) -> tuple[Int[Array, " *axes"], Int[Array, " *axes"]]:
    """Return start and exclusive end of the integers from 0 to `last` between `low` and `high`."""
    first = jnp.ceil(jnp.clip(low - ROUNDING, 0.0, last + 1.0))
    behind = jnp.floor(jnp.clip(high + ROUNDING, -1.0, last)) + 1.0
    return first.astype(jnp.int32), behind.astype(jnp.int32)


def _unit(a: Vec) -> Vec:
    return scale(1.0 / jnp.sqrt(dot(a, a) + TINY), a)
