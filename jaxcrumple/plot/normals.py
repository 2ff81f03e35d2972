"""Normals for smooth shading that keeps creases sharp."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

# Faces at a node that enclose more than this angle in rad are shaded as two smooth parts.
CREASE = np.radians(40.0)


def face_normals(
    faces: Int[np.ndarray, "faces 3"], x: Float[np.ndarray, "nodes 3"]
) -> Float[np.ndarray, "faces 3"]:
    """Return the unit normals (f, 3) of triangles at `x` (n, 3); zero for a triangle without area."""
    corners = x[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)


def corner_normals(
    faces: Int[np.ndarray, "faces 3"], x: Float[np.ndarray, "nodes 3"], crease: float = CREASE
) -> Float[np.ndarray, "faces 3 3"]:
    """Return unit normals (f, 3, 3) at the corners of triangles, positions `x` (n, 3).

    The normal at a corner is the mean over the faces at its node whose normals enclose at most `crease` in
    rad with that of its own face, weighted by their angles at the node (Thürrner & Wüthrich 1998).
    """
    normal = face_normals(faces, x)
    weighted = (_angles(x[faces])[:, :, None] * normal[:, None, :]).reshape(-1, 3)
    mine, other = _same_node(faces)
    alike = np.einsum("pi,pi->p", normal[mine // 3], normal[other // 3]) >= np.cos(crease)
    mine, other = mine[alike], other[alike]
    total = np.stack([np.bincount(mine, weighted[other, i], minlength=faces.size) for i in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, np.finfo(float).tiny), 0.0).reshape(-1, 3, 3)


def _angles(corners: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3"]:
    """Return the angles (f, 3) in rad of triangles at their corners."""
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    across = np.linalg.norm(np.cross(ahead, behind), axis=2)
    return np.arctan2(across, np.sum(ahead * behind, axis=2))


def _same_node(faces: Int[np.ndarray, "faces 3"]) -> tuple[Int[np.ndarray, " pairs"], ...]:
    """Return all ordered pairs of corners at the same node, each corner with itself too, by index."""
    order = np.argsort(faces, axis=None, kind="stable")
    counts = np.bincount(faces.reshape(-1))
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    node = faces.reshape(-1)[order]
    mine = np.repeat(order, counts[node])
    start = np.repeat(first[node], counts[node])
    within = np.arange(len(mine)) - np.repeat(np.cumsum(counts[node]) - counts[node], counts[node])
    return mine, order[start + within]
