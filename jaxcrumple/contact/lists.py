"""Neighbour lists with a skin (Verlet lists), in four tiers.

`CandidatePairs` holds the pairs of triangles that may come within the contact range while no node moves
further than its skin, which covers many steps. `SitePairs` holds those that may do so within a few steps,
with their site pairs. `ActiveSet` holds the site pairs that may interact in the next explicit steps.
`MatrixPairs` holds the pairs of triangles that have entries in the matrix of a direct solver.

Motion counts from the positions at which a list was built, without the mean motion of the sheet, which
changes no distance. The lists are sorted, and pairs that do not interact add exact zeros. Results therefore
do not depend on when a list was built.
"""

from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxcrumple._jax.arrays import Count, Flag, NodeValues, NodeVectors, Scalar
from jaxcrumple._jax.padded import filled
from jaxcrumple.geometry.hinge import HalfAngle, dot

# Sites closer than this many ranges at rest are neighbours at rest: they never interact.
EXCLUSION = 2.0
# Key of an unused entry: larger than the keys of all pairs of triangles.
NONE = jnp.iinfo(jnp.int64).max
# Pairs of triangles per chunk.
TRIANGLES = 1024
# Capacity of a list that grows over its required size. A new capacity needs a compilation, which takes longer
# than many steps.
SOON = 1.5


class Reference(eqx.Module):
    """Describe the motions that a list covers: up to the `skin` (n,) m from positions `x` (n, 3) m."""

    x: NodeVectors
    skin: NodeValues

    def equals(self, other: "Reference") -> Flag:
        """Return whether positions and skin equal those of `other`."""
        return jnp.all(self.x == other.x) & jnp.all(self.skin == other.skin)

    def covers(self, x: NodeVectors, margin: NodeValues | Scalar | float = 0.0) -> Flag:
        """Return whether each node of `x` (n, 3) can move `margin` m further and stay within its skin."""
        return jnp.all(motion(self.x, x) + margin <= self.skin)


class Capacity(NamedTuple):
    """Hold the capacities of `SitePairs`: pairs of triangles, sites near triangles, site pairs."""

    triangles: int = 1
    sites: int = 1
    pairs: int = 1


class VerletList(eqx.Module):
    """Base of the lists: valid for the motions of `reference`, unless more entries are needed than fit."""

    reference: eqx.AbstractVar[Reference]

    @property
    def overflow(self) -> Flag:
        """Return whether more entries are needed than the list has capacity for; it is then never valid."""
        raise NotImplementedError

    def covers(self, x: NodeVectors, margin: NodeValues | Scalar | float = 0.0) -> Flag:
        """Return whether the list is valid at `x` (n, 3), and if each node moves `margin` m further."""
        return self.reference.covers(x, margin) & ~self.overflow


class CandidatePairs(VerletList):
    """Hold the candidate pairs of triangles.

    - `reference`: the motions that the list covers.
    - `triangles` (c, 2): sorted pairs, lower index first; the first `count` are valid.
    - `folded` (w,): which ways of `Fans` are listed.
    - `half` (h,): halves of the hinge angles when the list was built.
    - `turn`: largest turn in rad at these angles of the ways that are not listed.
    """

    reference: Reference
    triangles: Int[Array, "triangles 2"]
    count: Count
    folded: Bool[Array, " ways"]
    half: HalfAngle
    turn: Scalar

    @property
    def overflow(self) -> Flag:
        """Return whether there are more candidate pairs than the list has capacity for."""
        return self.count > self.triangles.shape[0]


class SitePairs(VerletList):
    """Hold the site pairs that may interact, and their pairs of triangles.

    - `reference`: the motions that the list covers.
    - `triangles` (T, 2): pairs of triangles; `distance` (T,) in m: between the parts of the two that share no
      node; the first `triangle_count` are valid.
    - `owner` (P,): place in `triangles`; `first`, `second` (P,): sites of the first and of the second
      triangle; `apart` (P,) in m: distance of the two sites; the first `count` are valid.
    - `needed` (3,): lower bound of the required capacities, as `Capacity`.
    - `capacity`: also of the list of sites near triangles, which the narrow phase builds in between.
    """

    reference: Reference
    triangles: Int[Array, "triangles 2"]
    distance: Float[Array, " triangles"]
    triangle_count: Count
    owner: Int[Array, " pairs"]
    first: Int[Array, " pairs"]
    second: Int[Array, " pairs"]
    apart: Float[Array, " pairs"]
    count: Count
    needed: Int[Array, "3"]
    capacity: Capacity = eqx.field(static=True)

    @property
    def overflow(self) -> Flag:
        """Return whether one of the three capacities is too small."""
        return jnp.any(self.needed > jnp.asarray(self.capacity))

    def approach(self, faces: Int[Array, "faces 3"], *positions: NodeVectors) -> Float[Array, " triangles"]:
        """Return a bound (T,) in m on the approach of two triangles since the last rebuild, at any of the
        `positions` (n, 3)."""
        return self.approach_of(faces, reduce(jnp.maximum, [motion(self.reference.x, x) for x in positions]))

    def approach_of(self, faces: Int[Array, "faces 3"], moves: NodeValues) -> Float[Array, " triangles"]:
        """Return a bound (T,) in m on the approach of two triangles whose nodes move by `moves` (n,) in m.

        It is not differentiated."""
        most = jax.lax.stop_gradient(reduce(jnp.maximum, [moves[faces[:, k]] for k in range(3)]))

        def bound(at: Int[Array, " chunk"]) -> Float[Array, " chunk"]:
            pairs = self.triangles[at]
            return most[pairs[:, 0]] + most[pairs[:, 1]]

        return filled(bound, self.triangle_count, self.triangles.shape[0], TRIANGLES)

    def keys(self, n_faces: int, sites: int) -> Int[Array, " pairs"]:
        """Return sorted integer keys (P,) that name a site pair by its triangles and sites, `NONE` if unused.

        A pair has the same key in all lists of a sheet with `n_faces` triangles of `sites` sites each.
        """
        pair = pair_key(self.triangles[self.owner], n_faces)
        used = jnp.arange(self.owner.shape[0]) < self.count
        return jnp.where(used, (pair * sites + self.first) * sites + self.second, NONE)


class ActiveSet(VerletList):
    """Hold the part of `SitePairs` that matters for the small motions `reference`, for which it is valid.

    - `pairs` (P,): places in `SitePairs`; the first `count` may interact; `count` is -1 before they are
      found.
    - `close` (T,): places of pairs of triangles in `SitePairs.triangles`; the first `close_count` may touch.
    """

    reference: Reference
    pairs: Int[Array, " pairs"]
    count: Count
    close: Int[Array, " triangles"]
    close_count: Count

    @property
    def overflow(self) -> Flag:
        """Return False: the set has the capacity of the list of which it is a part."""
        return jnp.asarray(False)


class MatrixPairs(eqx.Module):
    """Hold the structure of sheet and contact in one matrix of compressed sparse rows.

    `indptr` (3n+1,); `indices` (e,), of which those after the last row are unused; `place` (nnz,): index of
    the sheet's entries; `keys` (c,): sorted keys of pairs of triangles; `entries` (c, 81): index of the
    entries of their blocks, or e for entries below the diagonal, which are dropped.
    """

    indptr: Int[Array, " starts"]
    indices: Int[Array, " merged"]
    place: Int[Array, " entries"]
    keys: Int[Array, " triangles"]
    entries: Int[Array, "triangles 81"]


class ContactLists(NamedTuple):
    """Hold the lists of a sheet; `active` only during explicit steps, `matrix` only for a direct solver."""

    candidates: CandidatePairs
    pairs: SitePairs
    active: ActiveSet | None = None
    matrix: MatrixPairs | None = None


SMALLEST = Capacity()
# First capacities per node, and their lower limits: a coarse mesh has as many interacting sites. They suffice
# for a crumple to a third of its size. Larger ones slow every step, because lists are written whole.
CAPACITY_PER_NODE, LEAST_CAPACITY = Capacity(1, 16, 32), Capacity(1000, 32_000, 64_000)


def first_capacity(n: int) -> Capacity:
    """Return the capacities of the first list of a sheet with `n` nodes."""
    sizes = zip(CAPACITY_PER_NODE, LEAST_CAPACITY, strict=True)
    return Capacity(*(max(share * n, least) for share, least in sizes))


def doubled(size: int, needed: int) -> int:
    """Double `size` until it is at least `needed`."""
    while size < needed:
        size *= 2
    return size


def pair_key(triangles: Int[Any, "pairs 2"], n_faces: int) -> Int[Any, " pairs"]:
    """Return integer keys (m,) of pairs of triangles (m, 2), lower index first; keys sort like the pairs."""
    wide = triangles.astype(jnp.int64)
    return wide[:, 0] * n_faces + wide[:, 1]


def carried(
    old: Int[Array, " before"],
    new: Int[Array, " after"],
    values: Shaped[Array, " before *axes"],
    default: Shaped[Array, "..."] | float,
) -> Shaped[Array, " after *axes"]:
    """Carry `values` (P, ...) of site pairs over to a rebuilt list.

    `old`, `new` (P,): `SitePairs.keys` of both lists. Pairs that were not in the old list get the `default`.
    """
    place = jnp.minimum(jnp.searchsorted(old, new), old.shape[0] - 1)
    same = (old[place] == new) & (new != NONE)
    return jnp.where(same.reshape(-1, *[1] * (values.ndim - 1)), values[place], default)


def motion(start: Float[Any, "nodes 3"], end: Float[Any, "nodes 3"]) -> NodeValues:
    """Return the distance (n,) that each node moved from `start` to `end` (n, 3), without the mean motion."""
    # By columns, because rows of three do not vectorise.
    moved = end.T - start.T
    x, y, z = moved - jnp.mean(moved, axis=1, keepdims=True)
    return jnp.sqrt(dot((x, y, z), (x, y, z)))


def nowhere(n: int) -> Reference:
    """Return the `Reference` that covers no positions: those of `n` nodes are NaN."""
    return Reference(jnp.full((n, 3), jnp.nan, float), jnp.zeros(n))


def no_candidates(n: int, hinges: int, ways: int, capacity: int = 1) -> CandidatePairs:
    """Return an empty list of candidates that covers no positions."""
    triangles, folded = jnp.zeros((capacity, 2), jnp.int32), jnp.zeros(ways, bool)
    return CandidatePairs(nowhere(n), triangles, jnp.zeros((), int), folded, *unknown_turns(hinges))


def unknown_turns(hinges: int) -> tuple[HalfAngle, Scalar]:
    """Return angles and the turn of candidates that no motion relies on: NaN."""
    unknown = jnp.full(hinges, jnp.nan, float)
    return HalfAngle(unknown, unknown), jnp.asarray(jnp.nan, float)


def no_pairs(n: int, capacity: Capacity = SMALLEST) -> SitePairs:
    """Return an empty list of site pairs that covers no positions."""
    triangles, zero = capacity.triangles, jnp.zeros((), int)
    empty = jnp.zeros(capacity.pairs, jnp.int32)
    return SitePairs(
        reference=nowhere(n),
        triangles=jnp.zeros((triangles, 2), jnp.int32),
        distance=jnp.zeros(triangles),
        triangle_count=zero,
        owner=empty,
        first=empty,
        second=empty,
        apart=jnp.zeros(capacity.pairs),
        count=zero,
        needed=jnp.zeros(3, int),
        capacity=capacity,
    )


def no_active(n: int, capacity: Capacity) -> ActiveSet:
    """Return an empty active set, marked as not yet found."""
    pairs, close = jnp.zeros(capacity.pairs, jnp.int32), jnp.zeros(capacity.triangles, jnp.int32)
    return ActiveSet(nowhere(n), pairs, jnp.asarray(-1, int), close, jnp.asarray(0, int))
