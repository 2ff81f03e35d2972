"""The search for candidates inside a compiled program, and batches of self-avoiding sheets."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folded import folded, strip
from pressed import moving_layers

import jaxcrumple as jc
from jaxcrumple import simulation
from jaxcrumple.contact.adjacency import DUE_TURN, LISTED_TURN
from jaxcrumple.contact.broad_phase import find_candidates
from jaxcrumple.contact.coverage import largest_unlisted_turn
from jaxcrumple.contact.host_broad_phase import Search, _tree_pairs
from jaxcrumple.contact.lists import Reference
from jaxcrumple.contact.skin import CANDIDATES, PAIRS
from jaxcrumple.geometry.distance import paired_corners, primitive_distances

SIGMA = 0.5e-3


def layers():
    """A folded strip, and positions and skins of its nodes."""
    mesh = strip(1.2 * SIGMA, columns=(6, 7), rows=5)
    rng = np.random.default_rng(3)
    x = folded(mesh, 1.2 * SIGMA, (6, 7)) + rng.normal(scale=0.05 * SIGMA, size=(mesh.n_nodes, 3))
    reach = SIGMA * rng.uniform(0.1, 1.5, mesh.n_nodes)
    scene = jc.sheet(mesh, jc.Material(thickness=0.3e-3), contact=jc.SelfContact(range=SIGMA, level=1))
    return scene, jnp.asarray(x), jnp.asarray(reach)


def found(scene, x, skin, capacity=6000):
    """Candidates by the grid."""

    def search(scene, reference):
        return find_candidates(scene.contact, scene.bending.hinges(reference.x).half, reference, capacity)

    return eqx.filter_jit(search)(scene, Reference(x, skin))


def every_pair(scene, x, reach):
    """Pairs of triangles that may meet by their true distance, found by looking at all pairs."""
    contact = scene.contact
    faces, rest = np.asarray(contact.faces), np.asarray(contact.rest)
    one, two = np.triu_indices(len(faces), 1)
    parts = primitive_distances(paired_corners(x, contact.faces[one], contact.faces[two]))
    gap = np.sqrt(np.min(parts, axis=0))
    wide = np.asarray(reach)[faces].max(axis=1)
    shared = (faces[one][:, :, None] == faces[two][:, None]).any(axis=(1, 2))
    apart = np.linalg.norm(rest[faces[one]][:, :, None] - rest[faces[two]][:, None], axis=3).max(axis=(1, 2))
    kept = ~shared & (gap <= SIGMA + wide[one] + wide[two]) & (apart >= 2 * SIGMA)
    sharp = np.asarray(contact.fans.turning(scene.bending.hinges(x).theta)) > LISTED_TURN
    pairs = [np.stack([one[kept], two[kept]], axis=1), np.asarray(contact.fans.triangles)[sharp]]
    return np.unique(np.concatenate(pairs), axis=0)


def test_the_grid_finds_what_the_tree_finds_and_misses_no_pair():
    scene, x, reach = layers()
    candidates = found(scene, x, reach)
    pairs, sharp = Search(scene.contact, scene.bending.nodes).find(np.asarray(x), np.asarray(reach))
    assert int(candidates.count) == len(pairs)
    np.testing.assert_array_equal(np.asarray(candidates.triangles)[: len(pairs)], pairs)
    np.testing.assert_array_equal(candidates.folded, sharp)
    expected = {*map(tuple, every_pair(scene, x, reach))}
    assert len(expected) > 500 and expected <= {*map(tuple, pairs)}


def test_no_pair_is_missed_wherever_the_sheet_lies_and_however_it_is_turned():
    scene, x, reach = layers()
    turn = jnp.linalg.qr(jax.random.normal(jax.random.key(0), (3, 3)))[0]
    candidates = found(scene, x @ turn.T + jnp.asarray([-3.0, 0.2, 7.0]), reach)
    pairs = np.asarray(candidates.triangles)[: int(candidates.count)]
    assert {*map(tuple, every_pair(scene, x, reach))} <= {*map(tuple, pairs)}


def test_the_tree_misses_no_pair_of_fast_triangles():
    rng = np.random.default_rng(5)
    for _ in range(20):
        center, radius = rng.uniform(size=(300, 3)), 0.02 * rng.uniform(size=300)
        room = 0.01 * rng.pareto(1.0, 300)
        apart = np.linalg.norm(center[:, None] - center, axis=2)
        size = radius + room
        wanted = np.argwhere(np.triu(apart <= 0.01 + size[:, None] + size, k=1))
        pairs = _tree_pairs(center, radius, room, 0.01)
        assert len(wanted) > 100
        assert set(map(tuple, pairs)) == set(map(tuple, wanted))


def test_pairs_with_two_sharp_ways_count_once():
    """Where few others are near, ways around nodes outnumber all pairs."""
    points = np.array([[0, 0], [0.5, 0.9], [1, 0], [1.5, 0.9], [2, 0], [2.5, 0.9]]) * 3.0 * SIGMA
    mesh = jc.Mesh.from_arrays(points, [[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]], reorder=True)
    scene = jc.sheet(mesh, jc.Material(thickness=0.3e-3), contact=jc.SelfContact(range=SIGMA, level=1))
    lower = np.isin(np.arange(mesh.n_nodes), mesh.faces[np.argmin(mesh.vertices[mesh.faces, 0].sum(axis=1))])
    x = mesh.vertices.copy()
    x[~lower] = x[lower] + np.array([0.0, 0.0, 1.2 * SIGMA])
    x, reach = jnp.asarray(x), jnp.full(mesh.n_nodes, 0.5 * SIGMA)
    sharp = np.sum(scene.contact.fans.turning(scene.bending.hinges(x).theta) > LISTED_TURN)
    candidates = found(scene, x, reach, 20)
    pairs, _ = Search(scene.contact, scene.bending.nodes).find(np.asarray(x), np.asarray(reach))
    assert sharp > len(pairs) == int(candidates.count)
    np.testing.assert_array_equal(np.asarray(candidates.triangles)[: len(pairs)], pairs)


def test_a_bound_on_how_folds_turn_never_hides_one_that_turns_more():
    """Whether it decides (small motions) or not (large ones)."""
    scene, x, reach = layers()
    candidates = found(scene, x, reach)
    contact = scene.contact
    rng, plain = np.random.default_rng(7), 0
    for size in SIGMA * np.array([0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3]):
        half = scene.bending.hinges(x + jnp.asarray(rng.normal(scale=size, size=x.shape))).half
        turn = np.asarray(contact.fans.turning(half.angle))[~np.asarray(candidates.folded)].max()
        told = float(largest_unlisted_turn(contact, candidates, half))
        assert told == turn or turn <= told < DUE_TURN
        plain += told != turn
    assert 2 <= plain <= 5


def test_too_little_room_is_told():
    scene, x, reach = layers()
    candidates = found(scene, x, reach, 100)
    assert int(candidates.count) > 100 and candidates.overflow


@pytest.mark.slow
def test_when_lists_are_made_changes_no_bit(monkeypatch):
    scene, state = moving_layers(2.0)
    solver = jc.integrator(1e-2, scheme="explicit")
    usual = jc.simulate(scene, state, 1.0, solver=solver, max_attempts=900).state
    assert not np.array_equal(usual.listing.candidates.x, state.listing.candidates.x)
    for name, policy, steps in (("PAIRS", PAIRS, 1.0), ("CANDIDATES", CANDIDATES, 4.0)):
        monkeypatch.setattr(f"jaxcrumple.solvers.contact.schedule.{name}", policy._replace(steps=steps))
    own = eqx.filter_jit(lambda *arguments: jc.integrate(*arguments))
    monkeypatch.setattr(simulation, "_integrate", own)
    often = jc.simulate(scene, state, 1.0, solver=solver, max_attempts=900).state
    assert not np.array_equal(usual.listing.pairs.x, often.listing.pairs.x)
    for name in ("t", "x", "v"):
        for a, b in zip(*(jax.tree.leaves(getattr(s, name)) for s in (usual, often)), strict=True):
            np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["explicit", "hybrid"])
def test_a_batch_does_what_its_members_do(scheme):
    scene, state = moving_layers(2.0)
    scene = jc.with_contacts(scene, state.x)
    solver = jc.integrator(1e-2, scheme=scheme, linear="two-level")
    states = [jc.initial_state(scene, state.x, share * state.v) for share in (0.5, 1.0)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    t_stop = jnp.asarray(1e-4)
    batch, _ = eqx.filter_vmap(jc.integrate, in_axes=(None, 0, None, None))(scene, stacked, t_stop, solver)
    run = eqx.filter_jit(jc.integrate)
    for lane, single in enumerate(states):
        alone, _ = run(scene, single, t_stop, solver)
        assert float(alone.t) == float(t_stop) == float(batch.t[lane])
        np.testing.assert_allclose(batch.x[lane], alone.x, rtol=0, atol=1e-9 * SIGMA)
