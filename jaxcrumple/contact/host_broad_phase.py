"""Candidate pairs of triangles by a tree on the host."""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from jaxcrumple.contact.adjacency import LISTED_TURN, Fans
from jaxcrumple.contact.energy import Contact
from jaxcrumple.contact.lists import EXCLUSION

# Share of the triangles whose reach is large enough to be searched for one by one.
FAST = 0.02


_turning = eqx.filter_jit(Fans.turning)


class Search:
    """Finds the pairs of triangles of one sheet that may meet. What never changes is prepared once."""

    def __init__(self, contact: Contact, hinges: np.ndarray):
        """`hinges` (h, 4): nodes as in `Bending.nodes`."""
        self.faces = np.asarray(contact.faces)
        self.sigma = float(contact.range)
        self.hinges = np.asarray(hinges)
        self.rest = np.asarray(contact.rest)
        self.fan_triangles = np.asarray(contact.fans.triangles)
        self.fans = contact.fans
        pairs = np.unique(self.fan_triangles, axis=0)
        self.sharing = pairs[:, 0].astype(np.int64) * len(self.faces) + pairs[:, 1]

    def find(
        self, x: np.ndarray, reach: np.ndarray, turn: float = LISTED_TURN
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of triangles that may come within the range while no node of `x` (n, 3) moves further than
        its `reach` (n,), and at folds that are sharper than `turn` rad.

        **Returns:** the pairs (c, 2), sorted, and which of the ways of `Fans` (w,) are folded enough to
        count.
        """
        folded = self._folded(x, turn)
        pairs = self.fan_triangles[folded].astype(np.int64)
        at_nodes = pairs[:, 0] * len(self.faces) + pairs[:, 1]
        keys = np.unique(np.concatenate([self._apart(x, reach), at_nodes]))
        return np.stack([keys // len(self.faces), keys % len(self.faces)], axis=1), folded

    def _apart(self, x: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Keys of pairs that share no node."""
        corners = x[self.faces]
        center = corners.mean(axis=1)
        offset = corners - center[:, None]
        radius = np.sqrt(_largest(np.einsum("fkj,fkj->fk", offset, offset)))
        room = _largest(reach[self.faces])
        pairs = _tree_pairs(center, radius, room, self.sigma)
        key = pairs[:, 0] * len(self.faces) + pairs[:, 1]
        fresh = self.sharing[np.minimum(np.searchsorted(self.sharing, key), len(self.sharing) - 1)] != key
        pairs, key = pairs[fresh], key[fresh]
        limit = self.sigma + room[pairs[:, 0]] + room[pairs[:, 1]]
        for bound in (_box_gap, _axis_gap):
            close = bound(corners, pairs) <= limit
            pairs, key, limit = pairs[close], key[close], limit[close]
        return key[self._interact(pairs)]

    def _interact(self, pairs: np.ndarray) -> np.ndarray:
        """Whether some of their sites are far enough from one another at rest."""
        one, two = (self.rest[self.faces[pairs[:, k]]] for k in range(2))
        squared = np.sum((one[:, :, None] - two[:, None]) ** 2, axis=3)
        return squared.max(axis=(1, 2)) >= (EXCLUSION * self.sigma) ** 2

    def _folded(self, x: np.ndarray, turn: float) -> np.ndarray:
        """Which ways around a node have a sharp enough fold in them."""
        a, b, c, d = (x[self.hinges[:, k]] for k in range(4))
        n1, n2 = np.cross(b - a, c - a), np.cross(d - a, b - a)
        angle = np.arctan2(np.linalg.norm(np.cross(n1, n2), axis=1), np.einsum("ij,ij->i", n1, n2))
        return np.asarray(_turning(self.fans, jnp.asarray(angle))) > turn


def _tree_pairs(center: np.ndarray, radius: np.ndarray, room: np.ndarray, sigma: float) -> np.ndarray:
    """Pairs (m, 2), first below second, some of them twice, whose balls of `radius` come within sigma and the
    room of both."""
    tree = cKDTree(center)
    common = np.quantile(room, 1.0 - FAST)
    usual = 2.0 * radius.max() + sigma + 2.0 * common
    pairs = [_in_balls(center, radius + room, sigma, tree.query_pairs(usual, output_type="ndarray").T, 0.0)]
    fast = np.flatnonzero(room > common)
    near = tree.query_ball_point(center[fast], radius[fast] + radius.max() + sigma + 2.0 * room[fast])
    one = np.repeat(fast, np.fromiter(map(len, near), int, len(fast)))
    two = np.fromiter(itertools.chain.from_iterable(near), int, len(one))
    # Of two fast ones that with more room finds the other, and perhaps both do.
    one, two = np.minimum(one, two), np.maximum(one, two)
    pairs.append(_in_balls(center, radius + room, sigma, (one, two), (1.0 - 1e-9) * usual))
    return np.concatenate(pairs)


def _in_balls(center: np.ndarray, size: np.ndarray, sigma: float, pairs, least: float) -> np.ndarray:
    """Those of the `pairs` (2, m), as (k, 2), whose balls of `size` come within sigma, further than `least`
    apart."""
    one, two = (np.asarray(side, np.int64) for side in pairs)
    apart = center[one] - center[two]
    squared = np.einsum("ij,ij->i", apart, apart)
    close = (squared <= (sigma + size[one] + size[two]) ** 2) & (squared >= least * least)
    return np.stack([one[close], two[close]], axis=1)


def _box_gap(corners: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Distance (m,) of the triangles' bounding boxes."""
    low, high = _smallest(corners), _largest(corners)
    one, two = pairs.T
    apart = np.maximum(np.maximum(low[two] - high[one], low[one] - high[two]), 0.0)
    return np.sqrt(np.einsum("ij,ij->i", apart, apart))


def _axis_gap(corners: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Lower bound (m,) of the distance: the largest separation along three axes of a pair."""
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


def _largest(a: np.ndarray) -> np.ndarray:
    """Maximum over the three corners, axis 1: much faster than NumPy's reduction of a short axis."""
    return np.maximum(np.maximum(a[:, 0], a[:, 1]), a[:, 2])


def _smallest(a: np.ndarray) -> np.ndarray:
    return np.minimum(np.minimum(a[:, 0], a[:, 1]), a[:, 2])
