"""Broad phase on a grid, traced: find candidate pairs of triangles inside a compiled program.

`jaxcrumple.contact.host_broad_phase` finds the same pairs with a tree on the host. Triangles are sorted by
the grid cell of their centre. The cell width is the largest centre distance of two triangles that may
interact. All partners of a triangle thus lie in its own cell and the 26 around it: nine rows of three
consecutive cells. Each pair is visited once, from the triangle that comes first in this order.
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcrumple._jax.arrays import Count, NodeVectors, Scalar
from jaxcrumple._jax.padded import compacted, counted
from jaxcrumple.contact.adjacency import LISTED_TURN, largest_turn
from jaxcrumple.contact.lists import EXCLUSION, NONE, CandidatePairs, Reference, pair_key
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.geometry.distance import TINY, boxes, boxes_meet
from jaxcrumple.geometry.hinge import HalfAngle, Vec, add, cross, dot, gather, sub

# Pairs of triangles per chunk: pairs in neighbouring cells; of these, pairs with overlapping boxes; of these,
# pairs that share no node.
ROUGH, FIRST, SECOND = 8192, 512, 128


class _Grid(NamedTuple):
    """Hold the triangles sorted by cell, and runs of consecutive partners.

    `order` (f,): the sorted triangles. Per run (5 f,): `owner`: place in `order` of the first triangle of all
    pairs of the run; `before`: add the number of a pair to get the place of its second triangle; `until`:
    number of pairs up to the end of the run. Unused runs hold no pairs.
    """

    order: Int[Array, " faces"]
    owner: Int[Array, " runs"]
    before: Int[Array, " runs"]
    until: Int[Array, " runs"]

    @property
    def pairs(self) -> Count:
        """Return the number of pairs."""
        return self.until[-1]

    def places(self, pair: Int[Array, " pairs"]) -> tuple[Int[Array, " pairs"], Int[Array, " pairs"]]:
        """Return the places (m,) in `order` of both triangles of pairs `pair` (m,), numbered in sequence."""
        width = pair.shape[0]
        # Comparisons instead of a search loop, so that XLA merges two equal calls into one.
        first = jnp.searchsorted(self.until, pair[0], side="right", method="compare_all")
        # `width` pairs span at most `width` runs, because no used run is empty.
        ends = self.until[jnp.minimum(first + jnp.arange(width), self.until.shape[0] - 1)] - pair[0]
        last = jnp.zeros(width, bool).at[jnp.where(ends > 0, ends, width)].set(True, mode="drop")
        run = jnp.minimum(first + counted(last), self.until.shape[0] - 1)
        partner = jnp.clip(self.before[run] + pair, 0, self.order.shape[0] - 1)
        return self.owner[run], partner


def find_candidates(contact: Contact, half: HalfAngle, reference: Reference, capacity: int) -> CandidatePairs:
    """Find the pairs of triangles that may come within the range during the motions `reference`.

    `half` (h,): halves of the hinge angles at `reference.x`. Test the `overflow` of the result.
    """
    turning = contact.fans.turning(half.angle)
    folded = turning > LISTED_TURN
    apart, count = _apart(contact, reference, capacity)
    n_faces = contact.faces.shape[0]
    ways = contact.fans.triangles
    sharp, ways_count = compacted(lambda at: folded[at][:, None], jnp.asarray(len(ways)), 1, capacity, ROUGH)
    parts = ((apart, count), (pair_key(ways[sharp], n_faces), ways_count))
    keys = jnp.sort(jnp.concatenate([jnp.where(jnp.arange(capacity) < m, key, NONE) for key, m in parts]))
    # A pair may appear several times: it has two ways around a shared node, and may share two nodes.
    fresh = (keys < NONE) & (keys != jnp.roll(keys, 1))
    size = jnp.asarray(keys.shape[0])
    kept, fitted = compacted(lambda at: fresh[at][:, None], size, 1, capacity, ROUGH, lambda at: keys[at])
    triangles = jnp.stack([kept // n_faces, kept % n_faces], axis=1).astype(jnp.int32)
    # There are more ways than pairs, so the number of ways decides only after an overflow.
    needed = jnp.maximum(count, ways_count)
    count = jnp.where(needed > capacity, needed, fitted)
    return CandidatePairs(reference, triangles, count, folded, half, largest_turn(turning, folded))


def _apart(contact: Contact, reference: Reference, capacity: int) -> tuple[Int[Array, " pairs"], Count]:
    """Find the pairs that share no node: return their keys (capacity,) and how many there are."""
    faces, n_faces, x = contact.faces, contact.faces.shape[0], reference.x
    corners = x[faces]
    center = jnp.mean(corners, axis=1)
    extent = jnp.max(reference.skin[faces], axis=1)
    radius = extent + jnp.sqrt(jnp.max(jnp.sum((corners - center[:, None]) ** 2, axis=2), axis=1))
    grid = _sorted(center, contact.range + 2.0 * jnp.max(radius))
    # Sort boxes and faces like the grid, to avoid an indirect access through `order` for every pair.
    low, high = boxes(corners[grid.order], extent[grid.order])
    faces, extent = faces[grid.order], extent[grid.order]

    def meets(pair: Int[Array, " pairs"]) -> Bool[Array, "pairs 1"]:
        one, two = grid.places(pair)
        passed = boxes_meet(low, high, one, two, contact.range)
        passed = _those(passed, lambda at: _no_neighbors(faces, one[at], two[at]), FIRST)

        def touch(at: Int[Array, " block"]) -> Bool[Array, " block"]:
            sides = [(faces[k[at]], extent[k[at]]) for k in (one, two)]
            return _may_touch(contact, x, *sides)

        return _those(passed, touch, SECOND)[:, None]

    def both(pair: Int[Array, " pairs"]) -> Int[Array, " pairs"]:
        one, two = grid.places(pair)
        return one.astype(jnp.int64) * n_faces + two

    found, count = compacted(meets, grid.pairs, 1, capacity, ROUGH, both)
    first, second = grid.order[found // n_faces], grid.order[found % n_faces]
    ordered = jnp.stack([jnp.minimum(first, second), jnp.maximum(first, second)], axis=1)
    return pair_key(ordered, n_faces), count


def _those(
    asked: Bool[Array, " pairs"], test: Callable[[Int[Array, " block"]], Bool[Array, " block"]], block: int
) -> Bool[Array, " pairs"]:
    """Return which entries (m,) are flagged in `asked` (m,) and pass `test`, which takes places (block,)."""
    size = asked.shape[0]
    few, many = compacted(lambda at: asked[at][:, None], jnp.asarray(size), 1, size, size)

    def body(carry: tuple[Count, Bool[Array, " pairs"]]) -> tuple[Count, Bool[Array, " pairs"]]:
        start, passed = carry
        rows = start + jnp.arange(block)
        at = few[jnp.minimum(rows, size - 1)]
        return start + block, passed.at[jnp.where(rows < many, at, size)].set(test(at), mode="drop")

    start = jnp.asarray(0), jnp.zeros(size, bool)
    return jax.lax.while_loop(lambda carry: carry[0] < many, body, start)[1]


def _sorted(center: Float[Array, "faces 3"], width: Scalar) -> _Grid:
    """Sort triangles with centres (f, 3) in m into cubic cells of side `width` in m."""
    cell = jnp.floor((center - jnp.min(center, axis=0)) / width).astype(jnp.int64) + 1
    # An empty cell at both ends of a row separates it from the next row.
    columns, rows = jnp.max(cell[:, 0]) + 2, jnp.max(cell[:, 1]) + 2
    number = cell[:, 0] + columns * (cell[:, 1] + rows * cell[:, 2])
    order = jnp.argsort(number).astype(jnp.int32)
    number = number[order]
    # Later partners of a triangle: those behind it in its own row, and four of the other eight rows.
    later = jnp.stack(
        [jnp.zeros_like(rows), columns, columns * (rows - 1), columns * rows, columns * (rows + 1)]
    )
    row = number[:, None] + later
    first = jnp.searchsorted(number, row - 1, side="left").astype(int)
    first = first.at[:, 0].set(jnp.arange(number.shape[0]) + 1)
    length = (jnp.searchsorted(number, row + 1, side="right") - first).reshape(-1)
    room = length.shape[0]
    runs, many = compacted(lambda at: (length[at] > 0)[:, None], jnp.asarray(room), 1, room, ROUGH)
    length = jnp.where(jnp.arange(room) < many, length[runs], 0)
    until = jnp.cumsum(length).astype(jnp.int32)
    before = first.reshape(-1)[runs] - (until - length)
    return _Grid(order, runs // later.shape[0], before.astype(jnp.int32), until)


def _no_neighbors(
    faces: Int[Array, "faces 3"], one: Int[Array, " pairs"], two: Int[Array, " pairs"]
) -> Bool[Array, " pairs"]:
    """Return whether the triangles `one` (m,) and `two` (m,) share no node."""
    same = [faces[:, i][one] == faces[:, j][two] for i in range(3) for j in range(3)]
    return ~reduce(jnp.logical_or, same)


def _may_touch(
    contact: Contact,
    x: NodeVectors,
    one: tuple[Int[Array, "pairs 3"], Float[Array, " pairs"]],
    two: tuple[Int[Array, "pairs 3"], Float[Array, " pairs"]],
) -> Bool[Array, " pairs"]:
    """Return whether pairs of triangles may interact.

    They may if they can come within the range, and if some of their sites are far enough apart at rest.
    `one`, `two`: nodes (m, 3) of the triangles, and how far these nodes may move (m,) in m.
    """
    (first, one_moves), (second, two_moves) = one, two
    rest = gather(contact.rest, first), gather(contact.rest, second)
    squared = [dot(sub(p, q), sub(p, q)) for p in rest[0] for q in rest[1]]
    interact = reduce(jnp.maximum, squared) >= (EXCLUSION * contact.range) ** 2
    gap = _gap(gather(x, first), gather(x, second))
    return interact & (gap <= contact.range + one_moves + two_moves)


def _gap(first: tuple[Vec, ...], second: tuple[Vec, ...]) -> Float[Array, " pairs"]:
    """Return a lower bound (m,) of the distance of two triangles in m.

    It is the largest of the distance of their bounding boxes and their separations along the line between
    their centres and along both normals.
    """
    zero = jnp.zeros_like(first[0][0])
    apart = [jnp.maximum(_apart_by([c[i] for c in first], [c[i] for c in second]), zero) for i in range(3)]
    gap = jnp.sqrt(sum((side * side for side in apart), zero))
    centers = [reduce(add, side) for side in (first, second)]
    normals = [cross(sub(side[1], side[0]), sub(side[2], side[0])) for side in (first, second)]
    for axis in (sub(centers[1], centers[0]), *normals):
        length = jnp.sqrt(dot(axis, axis)) + TINY
        heights = ([dot(c, axis) for c in side] for side in (first, second))
        gap = jnp.maximum(gap, _apart_by(*heights) / length)
    return gap


def _apart_by(one: list[Float[Array, " pairs"]], two: list[Float[Array, " pairs"]]) -> Float[Array, " pairs"]:
    """Return the gap (m,) between intervals, each spanned by three numbers (m,); negative if they overlap."""
    highest, lowest = ([reduce(f, side) for side in (one, two)] for f in (jnp.maximum, jnp.minimum))
    return jnp.maximum(lowest[1] - highest[0], lowest[0] - highest[1])
