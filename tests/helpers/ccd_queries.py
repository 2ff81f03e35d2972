"""Random motions of two triangles of thin layers, and whether they collide by tight inclusion (ipctk)."""

import numpy as np

from jaxcrumple.geometry.distance import CORNERS, EDGES, ENDS
from jaxcrumple.geometry.intersections import pierces

SIGMA = 0.25e-3


def queries(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (m, 2, 3, 3) in m of two triangles at the start and at the end of a step: layers of a folded
    sheet, from nearly touching to two ranges apart, that approach, slide, turn or stay."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, (count, 2, 1)) + 2.0 * np.pi / 3.0 * np.arange(3)
    flat = (
        1.1e-3 * rng.uniform(0.5, 1.5, (count, 2, 3, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    )
    gap = SIGMA * 10.0 ** rng.uniform(-2, 0.3, count)
    height = rng.normal(size=(count, 2, 3)) * 0.3 * gap[:, None, None]
    start = np.concatenate([flat, height[..., None]], axis=-1)
    start[:, 1, :, 2] += gap[:, None]
    start[:, 1, :, :2] += rng.normal(size=(count, 1, 2)) * 1e-3
    size = SIGMA * 10.0 ** rng.uniform(-3, 0.7, count)
    together = rng.normal(size=(count, 1, 1, 3)) * 3.0
    apart = rng.normal(size=(count, 2, 1, 3))
    bent = rng.normal(size=(count, 2, 3, 3)) * 0.5
    end = start + size[:, None, None, None] * (together + apart + bent)
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    free = ~_intersecting(start)
    start, end = (np.einsum("mij,mabj->mabi", turn, x)[free] for x in (start, end))
    return start, end


def _intersecting(x: np.ndarray) -> np.ndarray:
    """Whether an edge of one of the two triangles (m, 2, 3, 3) passes through the other."""
    found = np.zeros(len(x), bool)
    for side in range(2):
        for a, b in ENDS:
            found |= pierces(x[:, side, [a, b]], x[:, 1 - side])
    return found


def collide(start: np.ndarray, end: np.ndarray) -> bool:
    """Whether two triangles (2, 3, 3) collide on straight ways, from start to end."""
    import ipctk  # has no wheel for some machines, where only what needs it is skipped

    oracle = ipctk.TightInclusionCCD()
    # Its tolerance is 1e-6, a millionth of the range then.
    start, end = start / SIGMA, end / SIGMA
    for side, corner in CORNERS:
        p, q = start[side, corner], end[side, corner]
        if oracle.point_triangle_ccd(p, *start[1 - side], q, *end[1 - side])[0]:
            return True
    for one, two in EDGES:
        (a, b), (c, d) = ENDS[one], ENDS[two]
        x, y = start[0], end[0]
        u, v = start[1], end[1]
        if oracle.edge_edge_ccd(x[a], x[b], u[c], u[d], y[a], y[b], v[c], v[d])[0]:
            return True
    return False
