"""Narrow phase: find the site pairs that may interact among the candidate pairs of triangles."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from jax import Array

from jaxcrumple._jax.padded import compacted, enumerated, filled
from jaxcrumple.contact.lists import EXCLUSION, Around, Near, place_type, split
from jaxcrumple.contact.site_rows import Lattice, across, in_prism, within, without
from jaxcrumple.geometry.distance import boxes, boxes_meet, primitive_distances, shared_parts
from jaxcrumple.geometry.hinge import Vec, add, dot, gather, scale, sub

if TYPE_CHECKING:
    from jaxcrumple.contact.energy import Contact

# Entries per chunk: pairs of boxes, pairs of triangles, rows of sites, and site pairs in tests of distances.
BOXES, PAIRS, LINES, REST = 1024, 256, 2048, 1024
# Margin in site spacings, far above the rounding errors of positions along rows.
NEARLY = 1e-4


def find_near(contact: "Contact", around: Around) -> Near:
    """Find the site pairs that may interact during the motions `around`.

    The candidates of `contact` must cover these motions. The list has the capacities of `contact.near`; test
    its `overflow`.
    """
    room = contact.near.room
    triangles, distance, pair_count = _near_triangles(contact, around)
    pairs = jnp.minimum(pair_count, room.triangles)
    stages = _Stages(contact, around, triangles)
    found, found_count = stages.sites(pairs)
    sites = jnp.minimum(found_count, room.sites)
    lines, line_count = stages.rows(found, sites)
    looked_at = jnp.minimum(line_count, room.pairs)
    met, met_count = stages.columns(found, lines, looked_at)
    picked, total = stages.strangers(found, met, jnp.minimum(met_count, room.pairs))
    owner, apart = stages.distances(found, picked, total)
    # Entries beyond a capacity were not processed: assume as many sites and pairs for them as for the others.
    found_count = _in_all(found_count, pair_count, pairs)
    lines_met = jnp.maximum(line_count, _in_all(met_count, line_count, looked_at))
    return Near(
        triangles=triangles,
        distance=distance,
        pair_count=pair_count,
        found=found,
        picked=picked,
        owner=owner,
        apart=apart,
        site_count=total,
        around=around,
        needed=jnp.stack([pair_count, found_count, _in_all(lines_met, found_count, sites)]),
    )


class _Stages:
    """Reduce pairs of `triangles` (T, 2) to site pairs, stage by stage.

    `sites`: sites of the first triangle near the second; `rows`: rows of sites of the second triangle near
    these; `columns`: sites in these rows; `strangers`: pairs that are not neighbours at rest.
    """

    def __init__(self, contact: "Contact", around: Around, triangles: Array):
        self.contact, self.x, self.room = contact, around.x, contact.near.room
        self.first, self.second = (contact.faces[triangles[:, side]] for side in range(2))
        self.reach = _limit(contact, around, self.first, self.second)
        self.lattice = Lattice(contact.weights)
        self.width = self.lattice.parts + 1

    def sites(self, pairs: Array) -> tuple[Array, Array]:
        """Find the sites, as in `Near.found`, of the first `pairs` pairs; return them and their number."""
        contact, lattice = self.contact, self.lattice
        strange = _may_meet(contact, self.x, self.first, self.second, self.reach)

        def close(at: Array) -> tuple[Array, Array]:
            first, second = gather(self.x, self.first[at]), gather(self.x, self.second[at])
            start, behind = in_prism(lattice, first, second, self.reach[at])
            return start, jnp.where(strange[at][:, None], behind, start)

        def place(at: Array, number: Array) -> Array:
            return at.astype(contact.near.found.dtype)[:, None] * lattice.count + lattice.first + number

        return enumerated(close, pairs, self.room.sites, max(LINES // len(lattice.row), 1), place)

    def _sides(self, found: Array, x: Array) -> tuple[Vec, Vec, Vec]:
        """Return `Lattice.steps` from the sites `found` (m,) in the lattice of the second triangle."""
        owner, site = split(found, self.lattice.count)
        point = self.lattice.point(site, gather(x, self.first[owner]))
        return self.lattice.steps(point, gather(x, self.second[owner]))

    def _limit(self, found: Array) -> Array:
        return self.reach[split(found, self.lattice.count)[0]]

    def rows(self, found: Array, count: Array) -> tuple[Array, Array]:
        """Find the rows near the first `count` sites: place in `found` * `width` + row, and their number."""

        def near(at: Array) -> tuple[Array, Array]:
            start, row, step = self._sides(found[at], self.x)
            return within(across(start, step), across(row, step), self._limit(found[at]), self.lattice.parts)

        wide = place_type(self.room.sites * self.width)
        return enumerated(
            near, count, self.room.pairs, LINES, lambda at, k: at.astype(wide)[:, None] * self.width + k
        )

    def columns(self, found: Array, lines: Array, count: Array) -> tuple[Array, Array]:
        """Find the near sites in the first `count` rows, without neighbours at rest up to rounding.

        Returns the pairs, as in `Near.picked`, and their number.
        """
        contact, lattice = self.contact, self.lattice

        def near(at: Array) -> tuple[Array, Array]:
            here, number = split(lines[at], self.width)
            last = lattice.parts - number
            start, row, step = self._sides(found[here], self.x)
            close = within(add(start, scale(number, row)), step, self._limit(found[here]), last)
            start, row, step = self._sides(found[here], contact.rest)
            # With the margin, rounding excludes no pair other than neighbours at rest.
            known = EXCLUSION * contact.range - NEARLY * jnp.sqrt(dot(step, step))
            return without(close, within(add(start, scale(number, row)), step, known, last))

        def entry(at: Array, column: Array) -> Array:
            here, number = split(lines[at], self.width)
            first = here.astype(contact.near.picked.dtype) * lattice.count + lattice.first[number]
            return first[:, None] + column

        return enumerated(near, count, self.room.pairs, LINES, entry)

    def strangers(self, found: Array, met: Array, count: Array) -> tuple[Array, Array]:
        """Select the pairs among the first `count` that are not neighbours at rest, and count them."""

        def strange(at: Array) -> Array:
            _, apart = self._between(found, met[at], self.contact.rest)
            return (dot(apart, apart) >= (EXCLUSION * self.contact.range) ** 2)[:, None]

        return compacted(strange, count, 1, self.room.pairs, REST, lambda at: met[at])

    def distances(self, found: Array, picked: Array, count: Array) -> tuple[Array, Array]:
        """Compute `Near.owner` and `Near.apart` for the first `count` pairs."""

        def distance(at: Array) -> tuple[Array, Array]:
            owner, r = self._between(found, picked[at], self.x)
            return owner.astype(self.contact.near.owner.dtype), jnp.sqrt(dot(r, r))

        return filled(distance, count, self.room.pairs, REST)

    def _between(self, found: Array, pairs: Array, x: Array) -> tuple[Array, Vec]:
        """Return the place of each site pair in the list of triangle pairs, and the vector from the second
        site to the first."""
        row, other = split(pairs, self.lattice.count)
        owner, site = split(found[row], self.lattice.count)
        here = self.lattice.point(site, gather(x, self.first[owner]))
        return owner, sub(here, self.lattice.point(other, gather(x, self.second[owner])))


def _in_all(count: Array, whole: Array, part: Array) -> Array:
    """Extrapolate `count`, found in the first `part` entries of a list, to all `whole` entries."""
    return jnp.where(
        part < whole, jnp.ceil(count * (whole / jnp.maximum(part, 1))).astype(count.dtype), count
    )


def _near_triangles(contact: "Contact", around: Around) -> tuple[Array, Array, Array]:
    """Find the candidate pairs of triangles that may come within the range during the motions `around`.

    Returns the pairs (T, 2), the distance (T,) in m between the parts that share no node, and the number of
    pairs.
    """
    candidates, faces = contact.candidates, contact.faces
    low, high = boxes(around.x[faces], jnp.max(around.reach[faces], axis=1))

    def overlap(at: Array) -> Array:
        one, two = candidates.triangles[at, 0], candidates.triangles[at, 1]
        return boxes_meet(low, high, one, two, contact.range)[:, None]

    size = candidates.triangles.shape[0]
    rough, count = compacted(overlap, jnp.minimum(candidates.count, size), 1, size, BOXES)

    def distances(at: Array) -> tuple[Array, Array]:
        first, second = (faces[candidates.triangles[rough[at], side]] for side in range(2))
        whole, parts = _distances(around.x, first, second)
        return whole - _limit(contact, around, first, second), parts

    beyond, apart = filled(distances, count, size, PAIRS)
    places, pair_count = compacted(
        lambda at: (beyond[at] <= 0)[:, None], count, 1, contact.near.room.triangles, BOXES
    )
    return candidates.triangles[rough[places]], apart[places], pair_count


def _limit(contact: "Contact", around: Around, first: Array, second: Array) -> Array:
    """Return the distance (m,) within which triangles with nodes (m, 3) may interact: range plus skins."""
    return contact.range + sum(jnp.max(around.reach[nodes], axis=1) for nodes in (first, second))


def _distances(x: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Return the distance (m,) of triangles with nodes (m, 3), and that between parts that share no node."""
    parts = primitive_distances(gather(x, first), gather(x, second))
    shared = shared_parts(first, second)
    whole = jnp.where(jnp.any(shared, axis=0), 0.0, jnp.sqrt(jnp.min(parts, axis=0)))
    return whole, jnp.sqrt(jnp.min(jnp.where(shared, jnp.inf, parts), axis=0))


def _may_meet(contact: "Contact", x: Array, first: Array, second: Array, reach: Array) -> Array:
    """Return whether two points that are not neighbours at rest may be within `reach` (m,) of each other.

    The points lie on triangles with nodes `first`, `second` (m, 3). With barycentric coordinates a_i and b_j,
    their squared distance is sum(a_i b_j d_ij) - sum(a_i a_k e_ik) - sum(b_j b_l f_jl) over pairs of corners.
    Here d are the squared distances between corners of the two triangles, and e, f those within each
    triangle. The squared distance at rest thus exceeds the current one by at most the largest decrease of d
    plus, as sum(a_i a_k) <= 1/3, a third of the largest increase of e and of f.
    """
    (apart, *edges), (rest, *lengths) = (_squares(y, first, second) for y in (x, contact.rest))
    grown = sum(jnp.maximum(jnp.max(now - was, axis=0), 0.0) for now, was in zip(edges, lengths, strict=True))
    nearer = jnp.max(rest - apart, axis=0) + grown / 3.0
    return jnp.minimum(jnp.max(rest, axis=0), reach * reach + nearer) >= (EXCLUSION * contact.range) ** 2


def _squares(x: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Return squared corner distances of triangles with nodes (m, 3): (9, m) between the two triangles, and
    (3, m) within each."""

    def square(p: Vec, q: Vec) -> Array:
        return dot(sub(p, q), sub(p, q))

    one, two = gather(x, first), gather(x, second)
    own = [jnp.stack([square(c[k - 1], c[k]) for k in range(3)]) for c in (one, two)]
    return jnp.stack([square(p, q) for p in one for q in two]), own[0], own[1]
