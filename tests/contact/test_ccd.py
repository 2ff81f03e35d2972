"""No step lets the sheet through itself: continuous collision detection and the audit, against ipctk."""

import subprocess
import sys

import ccd_queries
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folded import folded, strip

import jaxcrumple as jc
from jaxcrumple.contact.ccd import touches
from jaxcrumple.geometry.distance import primitive_distances
from jaxcrumple.geometry.intersections import intersections
from jaxcrumple.measure import count_intersections

SIGMA = ccd_queries.SIGMA


@pytest.fixture(scope="module")
def ipctk():
    module = pytest.importorskip("ipctk")
    # A wheel may be built for other processors, and ends a process on this one.
    query = (
        "import numpy as np, ipctk; a = np.eye(4, 3); ipctk.TightInclusionCCD().point_triangle_ccd(*a, *-a)"
    )
    if subprocess.run([sys.executable, "-c", query], capture_output=True).returncode < 0:
        pytest.skip("the wheel of ipctk does not run on this processor")
    return module


def corners(x):
    """Two triangles (m, 2, 3, 3) as the package's kernels take them."""
    return jnp.moveaxis(x, 0, -1)


@jax.jit
def touching(start, end):
    """Which of the steps of pairs of triangles (m, 2, 3, 3) are refused."""
    shared, asked = jnp.zeros((15, start.shape[0]), bool), jnp.ones(start.shape[0], bool)
    return touches(corners(start), corners(end - start), shared, SIGMA, asked)


def verdicts(count, seed):
    """What the package and the oracle say about random queries."""
    start, end = ccd_queries.queries(count, seed)
    ours = np.asarray(touching(jnp.asarray(start), jnp.asarray(end)))
    return ours, np.array([ccd_queries.collide(a, b) for a, b in zip(start, end, strict=True)])


def test_no_collision_is_missed_and_few_are_made_up(ipctk):
    ours, truth = verdicts(3000, 1)
    assert 0.1 < truth.mean() < 0.5
    assert not np.any(truth & ~ours)
    assert np.mean(ours & ~truth) <= 0.01


@pytest.mark.slow
def test_no_collision_is_missed_in_a_million_queries(ipctk):
    """Each pair of triangles is fifteen queries of a point and a triangle, or of two edges."""
    made_up = []
    for seed in range(7):
        ours, truth = verdicts(10_000, 10 + seed)
        assert not np.any(truth & ~ours), seed
        made_up.append(np.mean(ours & ~truth))
    assert np.mean(made_up) <= 0.01


def test_distance_of_triangles_is_that_of_ipctk(ipctk):
    start, _ = ccd_queries.queries(400, 2)
    parts = np.asarray(primitive_distances(corners(jnp.asarray(start))))
    nearest = np.full(len(start), np.inf)
    for row, x in enumerate(start):
        for side in range(2):
            for k in range(3):
                found = ipctk.point_triangle_distance(x[side, k], *x[1 - side])
                nearest[row] = min(nearest[row], found)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            for k, l in ((0, 1), (1, 2), (2, 0)):
                nearest[row] = min(nearest[row], ipctk.edge_edge_distance(x[0, i], x[0, j], x[1, k], x[1, l]))
    np.testing.assert_allclose(parts.min(axis=0), nearest, rtol=1e-9, atol=1e-20)


def test_parallel_edges_have_a_distance():
    x = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0.3], [1, 0, 0.3], [0, 1, 0.3]]], float)[None]
    parts = primitive_distances(corners(jnp.asarray(x)))
    assert float(parts.min()) == pytest.approx(0.09, rel=1e-14)


@pytest.mark.parametrize("seed", range(6))
def test_audit_agrees_with_ipctk(ipctk, seed):
    mesh = jc.rectangle(0.1, 0.1, 150, seed=seed, sweeps=10)
    rng = np.random.default_rng(seed)
    # A smooth crumple that just meets itself in about half of the cases.
    waves = rng.normal(size=(3, 6, 2)) * 40.0
    phases = rng.uniform(0, 2 * np.pi, (3, 6))
    x = np.stack(
        [np.sin(mesh.vertices[:, :2] @ w.T + p).sum(axis=1) for w, p in zip(waves, phases, strict=True)],
        axis=1,
    )
    x = 0.004 * x + mesh.vertices * (0.2 + 0.15 * seed)
    oracle = ipctk.has_intersections(ipctk.CollisionMesh(mesh.vertices, mesh.edges, mesh.faces), x)
    assert (count_intersections(mesh, x) > 0) == oracle


def test_audit_finds_the_edges_and_the_triangles():
    """Where two triangles intersect, an edge ends the common segment on each side."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.3, 1], [5, 5, 5]], float)
    faces, edges = (
        np.array([[0, 1, 2], [3, 4, 5]]),
        np.array([[0, 1], [1, 2], [0, 2], [3, 4], [4, 5], [3, 5]]),
    )
    np.testing.assert_array_equal(intersections(x, faces, edges), [[1, 1], [3, 0]])
    x[4, 2] = -0.5
    assert len(intersections(x, faces, edges)) == 0


def crossed_strip():
    """A strip folded in half whose upper layer dips through the lower one, and a scene that would avoid
    that."""
    mesh = strip(1e-3)
    scene = jc.sheet(mesh, jc.Material(), contact=jc.SelfContact(range=1e-3))
    x = folded(mesh, 1e-3)
    x[:, 2] -= 0.3 * np.maximum(mesh.vertices[:, 0], 0.0)
    return mesh, scene, x


def test_a_start_that_passes_through_itself_is_refused_by_name():
    mesh, scene, x = crossed_strip()
    edge, face = intersections(x, mesh.faces, mesh.edges)[0]
    a, b = mesh.edges[edge]
    named = rf"edge \({a}, {b}\) pierces triangle \({', '.join(map(str, mesh.faces[face]))}\)"
    with pytest.raises(ValueError, match=named):
        jc.simulate(scene, jc.initial_state(scene, x), 1e-3)
    with pytest.raises(ValueError, match=named):
        jc.relax(scene, jc.initial_state(scene, x), force_tolerance=1e-6)


def test_a_start_behind_a_wall_is_refused_by_name():
    mesh = jc.rectangle(0.03, 0.006, 90, seed=1, sweeps=10)
    wall = jc.Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    scene = jc.sheet(mesh, jc.Material(), walls=[wall])
    x = mesh.vertices + np.array([0.0, 0.0, 1e-3])
    x[7, 2] = -2e-5
    with pytest.raises(ValueError, match=r"node 7 starts 2e-05 m behind wall 0 \(Plane\); move"):
        jc.simulate(scene, jc.initial_state(scene, x), 1e-3)
