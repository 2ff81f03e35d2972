"""Refusing starts that no motion leads on from."""

import numpy as np
from numpy.typing import ArrayLike

from jaxcrumple.model.intersections import intersections
from jaxcrumple.model.scene import Scene
from jaxcrumple.state import State

# Layers that start closer than this many ranges lie in one another.
CLOSEST = 1e-6


def pierced(scene: Scene, x: ArrayLike) -> np.ndarray:
    """Edges and triangles of a self-avoiding scene that intersect at positions `x` (n, 3), as their nodes
    (k, 5)."""
    assert scene.contact is not None
    faces, edges = np.asarray(scene.contact.faces), np.asarray(scene.membrane.nodes)
    pairs = intersections(x, faces, edges)
    return np.concatenate([edges[pairs[:, 0]], faces[pairs[:, 1]]], axis=1)


def check_start(scene: Scene, state: State) -> None:
    """Refuse a sheet that is behind a wall or, in a scene with contact, passes through itself.

    **Raises:** ValueError that names a node, or an edge and a triangle.
    """
    for index, wall in enumerate(scene.walls):
        gap = np.asarray(wall.gap(state.x, state.t))
        if np.min(gap) < 0:
            node = int(np.argmin(gap))
            raise ValueError(
                f"node {node} starts {-gap[node]:.3g} m behind wall {index} ({type(wall.shape).__name__}); "
                "move the sheet or the wall."
            )
    if scene.contact is None:
        return
    found = pierced(scene, state.x)
    if len(found):
        a, b, *face = found[0].tolist()
        raise ValueError(
            f"the sheet starts passing through itself at {len(found)} places: edge ({a}, {b}) pierces "
            f"triangle {tuple(face)}; start from positions without intersections, or leave contact out."
        )


def check_gap(scene: Scene, state: State) -> None:
    """Refuse layers that lie so deep in one another that forces point nowhere; the scene has its lists.

    **Raises:** ValueError that tells their distance.
    """
    contact = scene.contact
    assert contact is not None
    gap = float(contact.gaps(state.x)[0])
    least = float(CLOSEST * contact.range if contact.core is None else contact.core)
    if gap <= least:
        raise ValueError(
            f"the sheet starts {gap:.3g} m from itself; contact of range {float(contact.range):.3g} m needs "
            f"more than {least:.3g} m. Start from layers farther apart, or take another range."
        )
