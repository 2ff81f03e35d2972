"""Narrow phase: find the site pairs that may interact among the candidate pairs of triangles."""

import functools
import operator
from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Real

from jaxcrumple._jax.arrays import Count, NodeVectors
from jaxcrumple._jax.padded import compacted, enumerated, filled
from jaxcrumple.contact.lists import (
    EXCLUSION,
    CandidatePairs,
    Capacity,
    Reference,
    SitePairs,
)
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.contact.site_rows import Lattice, across, in_prism, within, without
from jaxcrumple.geometry.distance import boxes, boxes_meet, paired_corners, primitive_distances, shared_parts
from jaxcrumple.geometry.hinge import Vec, add, dot, gather, scale, sub

# Entries per chunk: pairs of boxes, pairs of triangles, rows of sites, and site pairs in tests of distances.
BOXES, PAIRS, LINES, REST = 1024, 256, 2048, 1024
# Margin in site spacings, far above the rounding errors of positions along rows.
NEARLY = 1e-4


def find_pairs(
    contact: Contact, candidates: CandidatePairs, reference: Reference, capacity: Capacity
) -> SitePairs:
    """Find the site pairs that may interact during the motions `reference`, which `candidates` must cover.

    Test the `overflow` of the result.
    """
    triangles, distance, triangle_count = _close_triangles(contact, candidates, reference, capacity)
    pairs = jnp.minimum(triangle_count, capacity.triangles)
    stages = _Stages(contact, reference, triangles, capacity)
    found, found_count = stages.sites(pairs)
    sites = jnp.minimum(found_count, capacity.sites)
    lines, line_count = stages.rows(found, sites)
    looked_at = jnp.minimum(line_count, capacity.pairs)
    met, met_count = stages.columns(found, lines, looked_at)
    met, count = stages.strangers(found, met, jnp.minimum(met_count, capacity.pairs))
    owner, first, second, apart = stages.unpacked(found, met, count)
    # Entries beyond a capacity were not processed: assume as many sites and pairs for them as for the others.
    found_count = _in_all(found_count, triangle_count, pairs)
    lines_met = jnp.maximum(line_count, _in_all(met_count, line_count, looked_at))
    return SitePairs(
        triangles=triangles,
        distance=distance,
        triangle_count=triangle_count,
        owner=owner,
        first=first,
        second=second,
        apart=apart,
        count=count,
        reference=reference,
        needed=jnp.stack([triangle_count, found_count, _in_all(lines_met, found_count, sites)]),
        capacity=capacity,
    )


class _Stages:
    """Reduce pairs of `triangles` (T, 2) to site pairs, stage by stage.

    `sites`: sites of the first triangle near the second; `rows`: rows of sites of the second triangle near
    these; `columns`: sites in these rows; `strangers`: pairs that are not neighbours at rest. Between the
    stages, one integer stands for a site near a triangle, pair of triangles * s + site, and one for a site
    pair, place in that list * s + site of the second triangle.
    """

    def __init__(
        self,
        contact: Contact,
        reference: Reference,
        triangles: Int[Array, "triangles 2"],
        capacity: Capacity,
    ) -> None:
        self.contact, self.x, self.capacity = contact, reference.x, capacity
        self.first, self.second = (contact.faces[triangles[:, side]] for side in range(2))
        self.reach = _limit(contact, reference, self.first, self.second)
        self.lattice = Lattice(contact.weights)
        self.width = self.lattice.parts + 1

    def sites(self, pairs: Count) -> tuple[Int[Array, " sites"], Count]:
        """Find the sites near the second triangle of the first `pairs` pairs, and count them."""
        contact, lattice = self.contact, self.lattice
        integer = _place_type(self.capacity.triangles * lattice.count)
        strange = _may_meet(contact, self.x, self.first, self.second, self.reach)

        def close(at: Int[Array, " chunk"]) -> tuple[Int[Array, "chunk rows"], Int[Array, "chunk rows"]]:
            first, second = gather(self.x, self.first[at]), gather(self.x, self.second[at])
            start, behind = in_prism(lattice, first, second, self.reach[at])
            return start, jnp.where(strange[at][:, None], behind, start)

        def place(at: Int[Array, " chunk"], number: Int[Array, " chunk #rows"]) -> Int[Array, "chunk rows"]:
            return at.astype(integer)[:, None] * lattice.count + lattice.first + number

        return enumerated(close, pairs, self.capacity.sites, max(LINES // len(lattice.row), 1), place)

    def _sides(self, found: Int[Array, " chunk"], x: NodeVectors) -> tuple[Vec, Vec, Vec]:
        """Return `Lattice.steps` from the sites `found` (m,) in the lattice of the second triangle."""
        owner, site = _split(found, self.lattice.count)
        point = self.lattice.point(site, gather(x, self.first[owner]))
        return self.lattice.steps(point, gather(x, self.second[owner]))

    def _limit(self, found: Int[Array, " chunk"]) -> Float[Array, " chunk"]:
        return self.reach[_split(found, self.lattice.count)[0]]

    def rows(self, found: Int[Array, " sites"], count: Count) -> tuple[Int[Array, " pairs"], Count]:
        """Find the rows near the first `count` sites: place in `found` * `width` + row, and their number."""

        def near(at: Int[Array, " chunk"]) -> tuple[Int[Array, "chunk 1"], Int[Array, "chunk 1"]]:
            start, row, step = self._sides(found[at], self.x)
            return within(across(start, step), across(row, step), self._limit(found[at]), self.lattice.parts)

        wide = _place_type(self.capacity.sites * self.width)
        return enumerated(
            near, count, self.capacity.pairs, LINES, lambda at, k: at.astype(wide)[:, None] * self.width + k
        )

    def columns(
        self, found: Int[Array, " sites"], lines: Int[Array, " pairs"], count: Count
    ) -> tuple[Int[Array, " pairs"], Count]:
        """Find the near sites in the first `count` rows, without neighbours at rest up to rounding.

        Returns the pairs and their number.
        """
        contact, lattice = self.contact, self.lattice
        integer = _place_type(self.capacity.sites * lattice.count)

        def near(at: Int[Array, " chunk"]) -> tuple[Int[Array, "chunk 2"], Int[Array, "chunk 2"]]:
            here, number = _split(lines[at], self.width)
            last = lattice.parts - number
            start, row, step = self._sides(found[here], self.x)
            close = within(add(start, scale(number, row)), step, self._limit(found[here]), last)
            start, row, step = self._sides(found[here], contact.rest)
            # With the margin, rounding excludes no pair other than neighbours at rest.
            known = EXCLUSION * contact.range - NEARLY * jnp.sqrt(dot(step, step))
            return without(close, within(add(start, scale(number, row)), step, known, last))

        def entry(
            at: Int[Array, " chunk"], column: Int[Array, "chunk columns"]
        ) -> Int[Array, "chunk columns"]:
            here, number = _split(lines[at], self.width)
            first = here.astype(integer) * lattice.count + lattice.first[number]
            return first[:, None] + column

        return enumerated(near, count, self.capacity.pairs, LINES, entry)

    def strangers(
        self, found: Int[Array, " sites"], met: Int[Array, " pairs"], count: Count
    ) -> tuple[Int[Array, " pairs"], Count]:
        """Select the pairs among the first `count` that are not neighbours at rest, and count them."""

        def strange(at: Int[Array, " chunk"]) -> Bool[Array, "chunk 1"]:
            _, apart = self._between(found, met[at], self.contact.rest)
            return (dot(apart, apart) >= (EXCLUSION * self.contact.range) ** 2)[:, None]

        return compacted(strange, count, 1, self.capacity.pairs, REST, lambda at: met[at])

    def unpacked(
        self, found: Int[Array, " sites"], met: Int[Array, " pairs"], count: Count
    ) -> tuple[Int[Array, " pairs"], Int[Array, " pairs"], Int[Array, " pairs"], Float[Array, " pairs"]]:
        """Compute `owner`, `first`, `second` and `apart` of `SitePairs` for the first `count` pairs."""

        def unpack(at: Int[Array, " chunk"]) -> tuple[Real[Array, " chunk"], ...]:
            (owner, first, second), r = self._between(found, met[at], self.x)
            sites = (place.astype(jnp.int32) for place in (owner, first, second))
            return *sites, jnp.sqrt(dot(r, r))

        return filled(unpack, count, self.capacity.pairs, REST)

    def _between(
        self, found: Int[Array, " sites"], pairs: Int[Array, " chunk"], x: NodeVectors
    ) -> tuple[tuple[Int[Array, " chunk"], Int[Array, " chunk"], Int[Array, " chunk"]], Vec]:
        """Return the pair of triangles and the two sites of site pairs, and the vector from the second site
        to the first."""
        row, second = _split(pairs, self.lattice.count)
        owner, first = _split(found[row], self.lattice.count)
        here = self.lattice.point(first, gather(x, self.first[owner]))
        r = sub(here, self.lattice.point(second, gather(x, self.second[owner])))
        return (owner, first, second), r


def _place_type(size: int) -> type:
    """Return the narrowest integer type that counts up to `size`; wider integers are slower."""
    return jnp.int32 if size <= jnp.iinfo(jnp.int32).max else jnp.int64


def _split(place: Int[Array, " chunk"], width: int) -> tuple[Int[Array, " chunk"], Int[Array, " chunk"]]:
    """Split places row * `width` + column, which must not be negative, into row and column."""
    columns = jnp.asarray(width, place.dtype)
    return jax.lax.div(place, columns), jax.lax.rem(place, columns)


def _in_all(count: Count, whole: Count, part: Count) -> Count:
    """Extrapolate `count`, found in the first `part` entries of a list, to all `whole` entries."""
    return jnp.where(
        part < whole, jnp.ceil(count * (whole / jnp.maximum(part, 1))).astype(count.dtype), count
    )


def _close_triangles(
    contact: Contact, candidates: CandidatePairs, reference: Reference, capacity: Capacity
) -> tuple[Int[Array, "triangles 2"], Float[Array, " triangles"], Count]:
    """Find the candidate pairs of triangles that may come within the range during the motions `reference`.

    Returns the pairs (T, 2), the distance (T,) in m between the parts that share no node, and the number of
    pairs.
    """
    faces, x = contact.faces, reference.x
    low, high = boxes(x[faces], jnp.max(reference.skin[faces], axis=1))

    def overlap(at: Int[Array, " chunk"]) -> Bool[Array, "chunk 1"]:
        one, two = candidates.triangles[at, 0], candidates.triangles[at, 1]
        return boxes_meet(low, high, one, two, contact.range)[:, None]

    size = candidates.triangles.shape[0]
    rough, count = compacted(overlap, jnp.minimum(candidates.count, size), 1, size, BOXES)

    def distances(at: Int[Array, " chunk"]) -> tuple[Float[Array, " chunk"], Float[Array, " chunk"]]:
        first, second = (faces[candidates.triangles[rough[at], side]] for side in range(2))
        whole, parts = _distances(x, first, second)
        return whole - _limit(contact, reference, first, second), parts

    beyond, apart = filled(distances, count, size, PAIRS)
    places, pair_count = compacted(lambda at: (beyond[at] <= 0)[:, None], count, 1, capacity.triangles, BOXES)
    return candidates.triangles[rough[places]], apart[places], pair_count


def _limit(
    contact: Contact, reference: Reference, first: Int[Array, "pairs 3"], second: Int[Array, "pairs 3"]
) -> Float[Array, " pairs"]:
    """Return the distance (m,) within which triangles with nodes (m, 3) may interact: range plus skins."""
    return contact.range + sum(jnp.max(reference.skin[nodes], axis=1) for nodes in (first, second))


def _distances(
    x: NodeVectors, first: Int[Array, "pairs 3"], second: Int[Array, "pairs 3"]
) -> tuple[Float[Array, " pairs"], Float[Array, " pairs"]]:
    """Return the distance (m,) of triangles with nodes (m, 3), and that between parts that share no node."""
    parts = primitive_distances(paired_corners(x, first, second))
    shared = shared_parts(first, second)
    whole = jnp.where(jnp.any(shared, axis=0), 0.0, jnp.sqrt(jnp.min(parts, axis=0)))
    return whole, jnp.sqrt(jnp.min(jnp.where(shared, jnp.inf, parts), axis=0))


def _may_meet(
    contact: Contact,
    x: NodeVectors,
    first: Int[Array, "pairs 3"],
    second: Int[Array, "pairs 3"],
    reach: Float[Array, " pairs"],
) -> Bool[Array, " pairs"]:
    """Return whether two points that are not neighbours at rest may be within `reach` (m,) of each other.

    The points lie on triangles with nodes `first`, `second` (m, 3). With barycentric coordinates a_i and b_j,
    their squared distance is sum(a_i b_j d_ij) - sum(a_i a_k e_ik) - sum(b_j b_l f_jl) over pairs of corners.
    Here d are the squared distances between corners of the two triangles, and e, f those within each
    triangle. The squared distance at rest thus exceeds the current one by at most the largest decrease of d
    plus, as sum(a_i a_k) <= 1/3, a third of the largest increase of e and of f.
    """
    (apart, *edges), (rest, *lengths) = (_squares(y, first, second) for y in (x, contact.rest))
    grown = sum(
        jnp.maximum(_largest(map(operator.sub, now, was)), 0.0)
        for now, was in zip(edges, lengths, strict=True)
    )
    nearer = _largest(map(operator.sub, rest, apart)) + grown / 3.0
    return jnp.minimum(_largest(rest), reach * reach + nearer) >= (EXCLUSION * contact.range) ** 2


def _largest(values: Iterable[Float[Array, " pairs"]]) -> Float[Array, " pairs"]:
    """Return the elementwise maximum; ten times as fast as a reduction of stacked values."""
    return functools.reduce(jnp.maximum, values)


def _squares(
    x: NodeVectors, first: Int[Array, "pairs 3"], second: Int[Array, "pairs 3"]
) -> tuple[list[Float[Array, " pairs"]], ...]:
    """Return squared corner distances (m,) of triangles with nodes (m, 3): nine between the two triangles,
    and three within each."""

    def square(p: Vec, q: Vec) -> Float[Array, " pairs"]:
        return dot(sub(p, q), sub(p, q))

    one, two = gather(x, first), gather(x, second)
    own = ([square(c[k - 1], c[k]) for k in range(3)] for c in (one, two))
    return [square(p, q) for p in one for q in two], *own
