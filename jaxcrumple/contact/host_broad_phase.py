"""Broad phase on the host: find candidate pairs of triangles with a k-d tree."""

import itertools

import numpy as np
import scipy
from jaxtyping import ArrayLike, Bool, Float, Int

from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple._jax.tree import as_array
from jaxcrumple.contact.adjacency import LISTED_TURN, Fans
from jaxcrumple.contact.lists import EXCLUSION
from jaxcrumple.contact.parameters import Contact

# Share of the triangles, those with the largest skin, whose partners are searched one by one. One common
# search radius for all triangles would otherwise find too many pairs.
FAST = 0.02


_turning = StoredJit(Fans.turning)


class Search:
    """Find the candidate pairs of triangles of one sheet. All constant data is prepared once."""

    def __init__(self, contact: Contact, hinges: Int[ArrayLike, "hinges 4"]) -> None:
        """Prepare the search; `hinges` (h, 4): nodes as in `Bending.nodes`."""
        self.faces = np.asarray(contact.faces)
        self.sigma = float(contact.range)
        self.hinges = np.asarray(hinges)
        self.rest = np.asarray(contact.rest)
        self.fan_triangles = np.asarray(contact.fans.triangles)
        self.fans = contact.fans
        keys = self.fan_triangles[:, 0].astype(np.int64) * len(self.faces) + self.fan_triangles[:, 1]
        self.sharing = np.unique(keys)

    def find(
        self, x: Float[np.ndarray, "nodes 3"], skin: Float[np.ndarray, " nodes"], turn: float = LISTED_TURN
    ) -> tuple[Int[np.ndarray, "pairs 2"], Bool[np.ndarray, " ways"]]:
        """Find the candidate pairs at positions `x` (n, 3) in m.

        These are the pairs without a common node that may come within the range while each node moves up to
        its `skin` (n,) in m, and the pairs at a node whose way turns by more than `turn` in rad.

        **Returns:** the sorted pairs (c, 2), and which ways (w,) of `Fans` turn by more than `turn`.
        """
        folded = self._folded(x, turn)
        pairs = self.fan_triangles[folded].astype(np.int64)
        at_nodes = pairs[:, 0] * len(self.faces) + pairs[:, 1]
        keys = np.unique(np.concatenate([self._apart(x, skin), at_nodes]))
        return np.stack([keys // len(self.faces), keys % len(self.faces)], axis=1), folded

    def _apart(
        self, x: Float[np.ndarray, "nodes 3"], skin: Float[np.ndarray, " nodes"]
    ) -> Int[np.ndarray, " pairs"]:
        """Return the keys of the candidate pairs that share no node."""
        corners = x[self.faces]
        center = corners.mean(axis=1)
        offset = corners - center[:, None]
        radius = np.sqrt(_largest(np.einsum("fkj,fkj->fk", offset, offset)))
        room = _largest(skin[self.faces])
        pairs = _tree_pairs(center, radius, room, self.sigma)
        key = pairs[:, 0] * len(self.faces) + pairs[:, 1]
        fresh = self.sharing[np.minimum(np.searchsorted(self.sharing, key), len(self.sharing) - 1)] != key
        pairs, key = pairs[fresh], key[fresh]
        limit = self.sigma + room[pairs[:, 0]] + room[pairs[:, 1]]
        for bound in (_box_gap, _axis_gap):
            close = bound(corners, pairs) <= limit
            pairs, key, limit = pairs[close], key[close], limit[close]
        return key[self._interact(pairs)]

    def _interact(self, pairs: Int[np.ndarray, "pairs 2"]) -> Bool[np.ndarray, " pairs"]:
        """Return whether some sites of each pair are far enough apart at rest to interact."""
        one, two = (self.rest[self.faces[pairs[:, k]]] for k in range(2))
        squared = np.sum((one[:, :, None] - two[:, None]) ** 2, axis=3)
        return squared.max(axis=(1, 2)) >= (EXCLUSION * self.sigma) ** 2

    def _folded(self, x: Float[np.ndarray, "nodes 3"], turn: float) -> Bool[np.ndarray, " ways"]:
        """Return which ways (w,) around a node turn by more than `turn` in rad."""
        a, b, c, d = (x[self.hinges[:, k]] for k in range(4))
        n1, n2 = np.cross(b - a, c - a), np.cross(d - a, b - a)
        angle = np.arctan2(np.linalg.norm(np.cross(n1, n2), axis=1), np.einsum("ij,ij->i", n1, n2))
        return np.asarray(_turning(self.fans, as_array(angle))) > turn


def _tree_pairs(
    center: Float[np.ndarray, "faces 3"],
    radius: Float[np.ndarray, " faces"],
    room: Float[np.ndarray, " faces"],
    sigma: float,
) -> Int[np.ndarray, "pairs 2"]:
    """Find the pairs whose bounding spheres come within `sigma` of each other.

    The spheres have radius `radius` (f,) + `room` (f,), all in m. Returns the pairs (m, 2), lower index
    first; some occur twice.
    """
    tree = scipy.spatial.cKDTree(center)
    common = np.quantile(room, 1.0 - FAST)
    usual = 2.0 * radius.max() + sigma + 2.0 * common
    pairs = [_in_balls(center, radius + room, sigma, tree.query_pairs(usual, output_type="ndarray").T, 0.0)]
    fast = np.flatnonzero(room > common)
    near = tree.query_ball_point(center[fast], radius[fast] + radius.max() + sigma + 2.0 * room[fast])
    one = np.repeat(fast, np.fromiter(map(len, near), int, len(fast)))
    two = np.fromiter(itertools.chain.from_iterable(near), int, len(one))
    # Of two triangles with a large skin, the one with the larger skin finds the other; both may do so.
    one, two = np.minimum(one, two), np.maximum(one, two)
    pairs.append(_in_balls(center, radius + room, sigma, (one, two), (1.0 - 1e-9) * usual))
    return np.concatenate(pairs)


def _in_balls(
    center: Float[np.ndarray, "faces 3"],
    size: Float[np.ndarray, " faces"],
    sigma: float,
    pairs: Int[np.ndarray, "2 pairs"] | tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]],
    least: float,
) -> Int[np.ndarray, "close 2"]:
    """Return the `pairs` (2, m), as (k, 2), whose spheres of radius `size` come within `sigma` of each other.

    Pairs with centres closer than `least` are left out: another search has found them.
    """
    one, two = (np.asarray(side, np.int64) for side in pairs)
    apart = center[one] - center[two]
    squared = np.einsum("ij,ij->i", apart, apart)
    close = (squared <= (sigma + size[one] + size[two]) ** 2) & (squared >= least * least)
    return np.stack([one[close], two[close]], axis=1)


def _box_gap(
    corners: Float[np.ndarray, "faces 3 3"], pairs: Int[np.ndarray, "pairs 2"]
) -> Float[np.ndarray, " pairs"]:
    """Return the distance (m,) of the bounding boxes of the triangles."""
    low, high = _smallest(corners), _largest(corners)
    one, two = pairs.T
    apart = np.maximum(np.maximum(low[two] - high[one], low[one] - high[two]), 0.0)
    return np.sqrt(np.einsum("ij,ij->i", apart, apart))


def _axis_gap(
    corners: Float[np.ndarray, "faces 3 3"], pairs: Int[np.ndarray, "pairs 2"]
) -> Float[np.ndarray, " pairs"]:
    """Return a lower bound (m,) of the distance: the largest separation along centre line and normals."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    center = corners.mean(axis=1)
    one, two = pairs.T
    gap = np.full(len(pairs), -np.inf)
    for axis in (center[two] - center[one], normal[one], normal[two]):
        axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
        first = np.einsum("mkj,mj->mk", corners[one], axis)
        second = np.einsum("mkj,mj->mk", corners[two], axis)
        separation = np.maximum(_smallest(second) - _largest(first), _smallest(first) - _largest(second))
        gap = np.maximum(gap, separation)
    return gap


def _largest(a: Float[np.ndarray, "faces 3 *axes"]) -> Float[np.ndarray, " faces *axes"]:
    """Return the maximum over the corners, axis 1; much faster than NumPy's reduction of a short axis."""
    return np.maximum(np.maximum(a[:, 0], a[:, 1]), a[:, 2])


def _smallest(a: Float[np.ndarray, "faces 3 *axes"]) -> Float[np.ndarray, " faces *axes"]:
    return np.minimum(np.minimum(a[:, 0], a[:, 1]), a[:, 2])
