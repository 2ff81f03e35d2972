"""Crease patterns whose facets are known, put on meshes as plastic curvature, and how well labels agree."""

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree


def voronoi(count, seed, size):
    """Cells of points kept apart, as a function of points (m, 2) in a square of side `size` around 0."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-size / 2, size / 2, (count, 2))
    for _ in range(2):  # Lloyd's algorithm on random samples, so that no cell is tiny
        samples = rng.uniform(-size / 2, size / 2, (4000, 2))
        owner = cKDTree(points).query(samples)[1]
        points = np.array([samples[owner == k].mean(axis=0) for k in range(count)])
    return lambda x: cKDTree(points).query(x)[1]


def lines(count, seed, size):
    """`count` facets between parallel and crossing straight lines."""
    rng = np.random.default_rng(seed)
    side = round(np.sqrt(count))
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    at = (np.arange(side + 2) - (side + 1) / 2 + rng.uniform(-0.15, 0.15, (2, side + 2))) * size / side

    def cell(x):
        u, v = (x @ turn).T
        return np.searchsorted(at[0], u) * (side + 3) + np.searchsorted(at[1], v)

    return cell


def fragments(count, seed, size):
    """Convex pieces of a square split by lines, the largest piece first."""
    rng = np.random.default_rng(seed)
    samples = rng.uniform(-size / 2, size / 2, (20000, 2))
    pieces, cuts = np.zeros(len(samples), int), []
    for new in range(1, count):
        old = np.argmax(np.bincount(pieces))
        mine = samples[pieces == old]
        axis = np.linalg.eigh(np.cov(mine.T))[1][:, 1]
        angle = rng.normal(0, 0.5)
        normal = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ axis
        offset = np.quantile(mine @ normal, rng.uniform(0.3, 0.7))
        cuts.append((old, new, normal, offset))
        pieces[(pieces == old) & (samples @ normal > offset)] = new

    def piece(x):
        out = np.zeros(len(x), int)
        for old, new, normal, offset in cuts:
            out[(out == old) & (x @ normal > offset)] = new
        return out

    return piece


def labels(mesh, pattern):
    return pattern(mesh.vertices[mesh.faces].mean(axis=1)[:, :2])


def damage(mesh, pattern, seed, *, missing=0.15, broad=True, background=0.02, speckle=0.01):
    """Plastic curvature (h,): creases of about 0.6 that alternate in sign from facet to facet.

    Noise of a third; `missing`: the part of the length of creases that is undamaged, in gaps of 1.5 node
    distances or more; `broad`: half of the creases share their fold with the next row of hinges; a normal
    `background` everywhere and a `speckle` of single damaged hinges.
    """
    rng = np.random.default_rng(seed)
    truth = labels(mesh, pattern)
    sides = truth[mesh.hinge_faces]
    crossing = sides[:, 0] != sides[:, 1]
    middle = mesh.vertices[mesh.hinges[:, :2], :2].mean(axis=1)
    sign = np.where(sides.sum(axis=1) % 2, 1, -1)
    p = crossing * sign * 0.6 * rng.lognormal(0, 0.33, len(sides))
    if broad:
        chosen = crossing & (rng.random(truth.max() + 1)[sides.min(axis=1)] < 0.5)
        touched = np.isin(mesh.hinge_faces, mesh.hinge_faces[chosen]).any(axis=1) & ~crossing
        touched &= rng.random(len(p)) < 0.5
        p[chosen] *= 0.6
        p[touched] = 0.25 * rng.lognormal(0, 0.33, touched.sum())
    spacing = 1.07 / mesh.linear_density
    total, on = mesh.hinge_length[crossing].sum(), np.flatnonzero(crossing)
    gap = np.zeros(len(p), bool)
    while mesh.hinge_length[gap & crossing].sum() < missing * total:
        gap |= np.linalg.norm(middle - middle[rng.choice(on)], axis=1) < 0.75 * spacing
    p[gap] = 0
    p += background * rng.normal(size=len(p))
    single = rng.random(len(p)) < speckle
    p[single] += 0.2 * rng.normal(size=single.sum())
    return np.clip(p, -1.9, 1.9)


def adjusted_rand(a, b, area):
    """Adjusted Rand index of two labellings of triangles, pairs of triangles weighted by their areas.

    Hubert & Arabie (1985) with the measure of sets in place of their number of elements: 1 for equal
    partitions, 0 on average for independent ones.
    """
    table = coo_array((area / area.sum(), (a, b))).toarray()
    both, first, second = (table**2).sum(), (table.sum(axis=1) ** 2).sum(), (table.sum(axis=0) ** 2).sum()
    return (both - first * second) / ((first + second) / 2 - first * second)
