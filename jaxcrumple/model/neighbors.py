"""Lists of the pairs of sites that may interact, made from candidate pairs of triangles."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple.model.chunks import compacted, enumerated, filled
from jaxcrumple.model.distance import TINY, boxes, boxes_meet, primitive_distances, shared_parts
from jaxcrumple.model.geometry import Vec, add, cross, dot, gather, scale, sub
from jaxcrumple.model.near import EXCLUSION, Around, Near, place_type, split

if TYPE_CHECKING:
    from jaxcrumple.model.contact import Contact

# Pairs of boxes and of triangles, and rows of sites, that are looked at together.
BOXES, PAIRS, LINES, REST = 1024, 256, 2048, 1024
# Sites are found that miss a bound by this much of their spacing or their reach.
ROUNDING = 1e-6
# In spacings of sites, far more than that.
NEARLY = 1e-4


def find_near(contact: "Contact", around: Around) -> Near:
    """The pairs of sites that may interact within motions `around`, in a list of the same size as the one
    that `contact` has."""
    room, x = contact.near.room, around.x
    triangles, distance, pair_count = _near_triangles(contact, around)
    first, second = contact.faces[triangles[:, 0]], contact.faces[triangles[:, 1]]
    reach = _limit(contact, around, first, second)
    lattice = _Lattice(contact.weights)
    alien = _may_meet(contact, x, first, second, reach)

    def close(at: Array) -> tuple[Array, Array]:
        start, behind = _in_prism(lattice, gather(x, first[at]), gather(x, second[at]), reach[at])
        return start, jnp.where(alien[at][:, None], behind, start)

    def place(at: Array, number: Array) -> Array:
        return at.astype(contact.near.found.dtype)[:, None] * lattice.count + lattice.first + number

    chunk = max(LINES // len(lattice.row), 1)
    pairs = jnp.minimum(pair_count, room.triangles)
    found, found_count = enumerated(close, pairs, room.sites, chunk, place)
    sites = jnp.minimum(found_count, room.sites)

    def sides(at: Array, x: Array) -> tuple[Vec, Vec, Vec]:
        """Where in the second triangle's lattice the site is: from there to its start, and its two steps."""
        owner, site = split(found[at], lattice.count)
        point = lattice.point(site, gather(x, first[owner]))
        return lattice.steps(point, gather(x, second[owner]))

    def limit(at: Array) -> Array:
        return reach[split(found[at], lattice.count)[0]]

    def rows(at: Array) -> tuple[Array, Array]:
        start, row, step = sides(at, x)
        return _within(_across(start, step), _across(row, step), limit(at), lattice.parts)

    width = lattice.parts + 1
    wide = place_type(room.sites * width)
    lines, line_count = enumerated(
        rows, sites, room.pairs, LINES, lambda at, k: at.astype(wide)[:, None] * width + k
    )

    looked_at = jnp.minimum(line_count, room.pairs)

    def columns(at: Array) -> tuple[Array, Array]:
        here, number = split(lines[at], width)
        start, row, step = sides(here, x)
        near = _within(add(start, scale(number, row)), step, limit(here), lattice.parts - number)
        start, row, step = sides(here, contact.rest)
        # Rounding must not make it hold more than neighbours at rest.
        known = EXCLUSION * contact.range - NEARLY * jnp.sqrt(dot(step, step))
        return _without(near, _within(add(start, scale(number, row)), step, known, lattice.parts - number))

    def entry(at: Array, column: Array) -> Array:
        here, number = split(lines[at], width)
        first = here.astype(contact.near.picked.dtype) * lattice.count + lattice.first[number]
        return first[:, None] + column

    met, met_count = enumerated(columns, looked_at, room.pairs, LINES, entry)

    def strange(at: Array) -> Array:
        """Whether sites are no neighbours at rest."""
        row, other = split(met[at], lattice.count)
        owner, site = split(found[row], lattice.count)
        here = lattice.point(site, gather(contact.rest, first[owner]))
        apart = sub(here, lattice.point(other, gather(contact.rest, second[owner])))
        return (dot(apart, apart) >= (EXCLUSION * contact.range) ** 2)[:, None]

    known = jnp.minimum(met_count, room.pairs)
    picked, total = compacted(strange, known, 1, room.pairs, REST, lambda at: met[at])
    # What did not fit was not looked at further, and has as many sites and pairs as the rest.
    found_count = _in_all(found_count, pair_count, pairs)
    lines_met = jnp.maximum(line_count, _in_all(met_count, line_count, looked_at))
    return Near(
        triangles=triangles,
        distance=distance,
        pair_count=pair_count,
        found=found,
        picked=picked,
        site_count=total,
        around=around,
        needed=jnp.stack([pair_count, found_count, _in_all(lines_met, found_count, sites)]),
    )


def _in_all(count: Array, whole: Array, part: Array) -> Array:
    """What `count`, that of a part of a list, is for the `whole`."""
    return jnp.where(
        part < whole, jnp.ceil(count * (whole / jnp.maximum(part, 1))).astype(count.dtype), count
    )


def _near_triangles(contact: "Contact", around: Around) -> tuple[Array, Array, Array]:
    """Pairs of triangles (T, 2) that may come within the range, the distance (T,) of those of their parts
    that share no node, and how many they are."""
    candidates, faces = contact.candidates, contact.faces
    low, high = boxes(around.x[faces], jnp.max(around.reach[faces], axis=1))

    def overlap(at: Array) -> Array:
        one, two = candidates.triangles[at, 0], candidates.triangles[at, 1]
        return boxes_meet(low, high, one, two, contact.range)[:, None]

    size = candidates.triangles.shape[0]
    rough, count = compacted(overlap, jnp.minimum(candidates.count, size), 1, size, BOXES)

    def distances(at: Array) -> Array:
        first, second = (faces[candidates.triangles[rough[at], side]] for side in range(2))
        whole, parts = _distances(around.x, first, second)
        return jnp.stack([whole - _limit(contact, around, first, second), parts], axis=1)

    beyond = filled(distances, count, (size, 2), PAIRS)
    places, pair_count = compacted(
        lambda at: (beyond[at, 0] <= 0)[:, None], count, 1, contact.near.room.triangles, BOXES
    )
    return candidates.triangles[rough[places]], beyond[places, 1], pair_count


def _limit(contact: "Contact", around: Around, first: Array, second: Array) -> Array:
    """Distance (m,) within which pairs of triangles with nodes (m, 3) may interact."""
    return contact.range + sum(jnp.max(around.reach[nodes], axis=1) for nodes in (first, second))


def _distances(x: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Distance (m,) of triangles with nodes (m, 3), and of those of their parts that share no node."""
    parts = primitive_distances(gather(x, first), gather(x, second))
    shared = shared_parts(first, second)
    whole = jnp.where(jnp.any(shared, axis=0), 0.0, jnp.sqrt(jnp.min(parts, axis=0)))
    return whole, jnp.sqrt(jnp.min(jnp.where(shared, jnp.inf, parts), axis=0))


def _may_meet(contact: "Contact", x: Array, first: Array, second: Array, reach: Array) -> Array:
    """Whether points of triangles with nodes (m, 3) that are no neighbours at rest may be as near as `reach`
    (m,).

    With barycentric coordinates a_i and b_j, the squared distance of two points is sum(a_i b_j d_ij) less
    sum(a_i a_k e_ik) and sum(b_j b_l f_jl) over pairs of corners, where d, e and f are those of corners. So
    it was larger at rest by no more than the largest difference of d and, as sum(a_i a_k) <= 1/3, a third of
    that by which edges grew.
    """
    (apart, *edges), (rest, *lengths) = (_squares(y, first, second) for y in (x, contact.rest))
    grown = sum(jnp.maximum(jnp.max(now - was, axis=0), 0.0) for now, was in zip(edges, lengths, strict=True))
    nearer = jnp.max(rest - apart, axis=0) + grown / 3.0
    return jnp.minimum(jnp.max(rest, axis=0), reach * reach + nearer) >= (EXCLUSION * contact.range) ** 2


def _squares(x: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Squared distances between the corners of triangles with nodes (m, 3), (9, m), and of the corners of
    each of them, (3, m)."""

    def square(p: Vec, q: Vec) -> Array:
        return dot(sub(p, q), sub(p, q))

    one, two = gather(x, first), gather(x, second)
    own = [jnp.stack([square(c[k - 1], c[k]) for k in range(3)]) for c in (one, two)]
    return jnp.stack([square(p, q) for p in one for q in two]), own[0], own[1]


class _Lattice:
    """The sites of a triangle by rows: those whose weight of the first corner is the same."""

    def __init__(self, weights: Array):
        self.weights, self.count = weights, weights.shape[0]
        self.parts = (int(np.sqrt(8 * self.count + 1)) - 3) // 2
        self.row = np.arange(self.parts + 1)
        self.first = jnp.asarray(self.row * (self.parts + 1) - self.row * (self.row - 1) // 2, jnp.int32)

    def point(self, site: Array, corners: tuple[Vec, ...]) -> Vec:
        """Positions of sites (m,) of triangles with given corners."""
        a, b, c = (scale(self.weights[:, k][site], corner) for k, corner in enumerate(corners))
        return add(add(a, b), c)

    def steps(self, point: Vec, corners: tuple[Vec, ...]) -> tuple[Vec, Vec, Vec]:
        """From points to the site of the third corner, from there to the next row, and along a row."""
        row, step = (scale(1.0 / self.parts, sub(corners[k], corners[2])) for k in range(2))
        return sub(corners[2], point), row, step


def _in_prism(
    lattice: _Lattice, first: tuple[Vec, ...], second: tuple[Vec, ...], reach: Array
) -> tuple[Array, Array]:
    """Intervals (m, r) of sites of the first triangles in a prism around the second ones, `reach` (m,) wide.

    The prism's five sides are planes, and a site's height above one is linear in its number in a row.
    """
    edges = [sub(second[(k + 1) % 3], second[k]) for k in range(3)]
    normal = _unit(cross(edges[0], edges[1]))
    low, high = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    for corner, direction in [
        (second[0], normal),
        (second[0], scale(-1.0, normal)),
        *((second[k], _unit(cross(edges[k], normal))) for k in range(3)),
    ]:
        # Once a triangle, which the compiler would do again for each of its rows.
        a, b, c = jax.lax.optimization_barrier(tuple(dot(sub(p, corner), direction) for p in first))
        row, rise = (a - c) / lattice.parts, ((b - c) / lattice.parts)[:, None]
        room = (reach - c)[:, None] - row[:, None] * lattice.row
        # The sign of what is zero but for rounding may change from one use to the next.
        least = (ROUNDING * reach / lattice.parts)[:, None]
        steep = jnp.abs(rise) > least
        end = room / jnp.where(steep, rise, 1.0)
        low = jnp.maximum(low, jnp.where(steep & (rise < 0), end, -jnp.inf))
        level = jnp.where(room >= -least, jnp.inf, -jnp.inf)
        high = jnp.minimum(high, jnp.where(steep, jnp.where(rise > 0, end, jnp.inf), level))
    return _whole(low, high, lattice.parts - lattice.row)


def _across(a: Vec, b: Vec) -> Vec:
    """The part of vectors that is normal to others."""
    return sub(a, scale(dot(a, b) / (dot(b, b) + TINY), b))


def _within(start: Vec, step: Vec, reach: Array, last: Array | int) -> tuple[Array, Array]:
    """Intervals (m, 1) of whole numbers k up to `last` for which `start` + k `step` is no longer than
    `reach`: its square is quadratic in k."""
    square = dot(step, step) + TINY
    middle = -dot(start, step) / square
    half = middle * middle - (dot(start, start) - reach * reach) / square
    width = jnp.where(half >= 0, jnp.sqrt(jnp.maximum(half, 0.0)), -jnp.inf)
    first, behind = _whole(middle - width, middle + width, last)
    return first[:, None], behind[:, None]


def _without(whole: tuple[Array, Array], part: tuple[Array, Array]) -> tuple[Array, Array]:
    """Intervals (m, 2): of intervals (m, 1) what lies before others and what lies behind them."""
    (first, behind), (begin, end) = whole, part
    empty = begin >= end
    begin, end = jnp.where(empty, behind, begin), jnp.where(empty, behind, end)
    starts = jnp.concatenate([first, jnp.maximum(first, end)], axis=1)
    return starts, jnp.concatenate([jnp.minimum(behind, begin), behind], axis=1)


def _whole(low: Array, high: Array, last: Array | int | np.ndarray) -> tuple[Array, Array]:
    """Whole numbers from 0 to `last` between `low` and `high`: the first one and the one behind the last."""
    first = jnp.ceil(jnp.clip(low - ROUNDING, 0.0, last + 1.0))
    behind = jnp.floor(jnp.clip(high + ROUNDING, -1.0, last)) + 1.0
    return first.astype(jnp.int32), behind.astype(jnp.int32)


def _unit(a: Vec) -> Vec:
    return scale(1.0 / jnp.sqrt(dot(a, a) + TINY), a)
