"""Sheets that meet themselves nowhere, seen without a list."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from folded import strip
from scipy.spatial.distance import pdist

import jaxcrumple as jc
from jaxcrumple.contact.flatness import build_chart
from jaxcrumple.state import IMPLICIT

SIDE, ANGLE = 0.1, 1.0


def bound(mesh, x):
    """What the chart says of the distances at positions `x` over those at rest."""
    chart, x = build_chart(mesh), jnp.asarray(x)
    return float(chart.least(x, chart.frame(x)))


def test_the_bound_of_a_stretched_sheet_is_its_least_stretch():
    mesh = jc.rectangle(SIDE, SIDE, 200, seed=0)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    x = mesh.vertices * [1.1, 0.8, 1.0] @ turn + [1.0, 2.0, 3.0]
    assert bound(mesh, x) == pytest.approx(0.8, rel=1e-12)


def test_the_bound_of_a_cylinder_is_the_cosine_of_its_steepest_slope():
    mesh = jc.rectangle(SIDE, SIDE, 2000, seed=0)
    x, y, _ = mesh.vertices.T - mesh.vertices.mean(axis=0)[:, None]
    radius = SIDE / (2.0 * ANGLE)
    bent = np.stack([radius * np.sin(x / radius), y, radius * np.cos(x / radius)], axis=1)
    # A triangle is no steeper than its steepest point, and an edge long less steep than that.
    edge = mesh.edge_length.max() / radius
    assert np.cos(ANGLE) < bound(mesh, bent) < np.cos(ANGLE - edge)


def test_no_distance_falls_below_the_bound():
    mesh = jc.disc(SIDE / 2.0, 300, seed=0)
    rest, random = pdist(mesh.vertices), np.random.default_rng(1)
    bounds = []
    for _ in range(40):
        wave = random.normal(size=(3, 2)) * 60.0
        shift = random.normal(size=(3, 3)) * 10.0 ** random.uniform(-4, -2)
        x = mesh.vertices + np.sin(mesh.vertices[:, :2] @ wave.T) @ shift
        bounds.append(bound(mesh, x))
        assert np.min(pdist(x) / rest) > bounds[-1] - 1e-12
    assert min(bounds) < 0.0 and max(bounds) > 0.9


def test_a_fold_is_not_taken_for_flat():
    mesh = jc.rectangle(SIDE, SIDE, 200, seed=0)
    x = mesh.vertices - mesh.vertices.mean(axis=0)
    x[:, 2], x[:, 0] = 1e-3 * (x[:, 0] > 0), np.abs(x[:, 0])
    assert not bound(mesh, x) > 0.0


def test_a_shell_is_as_far_from_flat_as_its_slope():
    mesh = jc.disc(SIDE / 2.0, 2000, seed=0)
    sphere = np.sqrt(SIDE**2 - np.sum(mesh.vertices**2, axis=1))
    lifted = mesh.vertices + sphere[:, None] * [0.0, 0.0, 1.0]
    shell = jc.Mesh.from_arrays(lifted, mesh.faces)
    # Seen from above its steepest triangles are shorter by the cosine of 30 degrees.
    assert bound(shell, shell.vertices) == pytest.approx(np.cos(np.pi / 6.0), rel=0.02)


def test_only_what_lies_over_a_convex_part_of_a_plane_has_a_chart():
    mesh = jc.rectangle(SIDE, SIDE, 200, seed=0)
    assert build_chart(mesh) is not None
    inside = mesh.vertices[mesh.faces].mean(axis=1)
    notched = mesh.faces[inside @ [1.0, 1.0, 0.0] < inside[:, 0].max()]
    used, faces = np.unique(notched, return_inverse=True)
    assert build_chart(jc.Mesh.from_arrays(mesh.vertices[used], faces.reshape(-1, 3))) is None
    # A cut of no width ends in the middle.
    whole = strip(1e-3, columns=(12,), step=1e-3)
    assert build_chart(whole) is not None
    cut = np.flatnonzero((np.abs(whole.vertices[:, 1]) < 1e-9) & (whole.vertices[:, 0] < 0))
    double = np.arange(whole.n_nodes)
    double[cut] = whole.n_nodes + np.arange(len(cut))
    above = whole.vertices[whole.faces].mean(axis=1)[:, 1] > 0
    faces = np.where(above[:, None], double[whole.faces], whole.faces)
    assert (
        build_chart(jc.Mesh.from_arrays(np.concatenate([whole.vertices, whole.vertices[cut]]), faces)) is None
    )
    x, y, _ = mesh.vertices.T
    angle = 5.0 * x / SIDE
    rolled = SIDE / 5.0 * np.stack([np.sin(angle), np.cos(angle), 5.0 * y / SIDE], axis=1)
    assert build_chart(jc.Mesh.from_arrays(rolled, mesh.faces)) is None


@pytest.mark.slow
def test_a_run_takes_the_same_steps_without_a_chart():
    setup = jc.radial(400)
    state = jc.initial_state(setup.scene, setup.x)
    plain = eqx.tree_at(lambda s: s.contact.chart, setup.scene, None)
    ends = [
        jc.simulate(scene, state, 10.0, solver=jc.integrator(scheme="dynamic"), max_attempts=60).state
        for scene in (setup.scene, plain)
    ]
    assert int(ends[0].counters.steps[IMPLICIT]) > 40
    for name in ("t", "x", "v", "h", "p", "history"):
        one, two = getattr(ends[0], name), getattr(ends[1], name)
        assert eqx.tree_equal(one, two), name
