"""The list of sites that may meet against a sum over all pairs of sites."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import Bound, bound
from folded import folded, layer_of, strip
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import jaxcrumple as jc
from jaxcrumple.contact.active_set import find_active
from jaxcrumple.contact.lists import EXCLUSION, Capacity, Reference
from jaxcrumple.contact.narrow_phase import find_pairs
from jaxcrumple.solvers.contact.reallocate import Reallocation
from jaxcrumple.solvers.contact.schedule import empty_lists

SIGMA, GAP = 0.5e-3, 0.9
COLUMNS = (5, 6, 5)


def layers(level: int, roughness: float, turned: bool, reach=(0.02, 0.4)):
    """Contact of a strip folded twice, its candidates, and its positions with a skin.

    Where it is smooth and straight, sites lie in the planes that bound what is looked at, up to rounding.
    """
    mesh = strip(GAP * SIGMA, columns=COLUMNS, rows=4)
    rng = np.random.default_rng(2)
    x = folded(mesh, GAP * SIGMA, COLUMNS) + roughness * SIGMA * rng.normal(size=(mesh.n_nodes, 3))
    if turned:
        x = Rotation.random(rng=rng).apply(x)
    reach = SIGMA * rng.uniform(*reach, mesh.n_nodes)
    options = jc.SelfContact(range=SIGMA, level=level)
    scene = jc.sheet(mesh, jc.Material(thickness=0.3e-3), contact=options)
    here, lists = Reference(jnp.asarray(x), jnp.asarray(reach)), empty_lists(scene, scene.contact)
    lists = Reallocation(scene, merged=False).searched(scene, lists, here)
    return Bound(scene.contact, lists), here


def found(bound, reference):
    """The site pairs among the candidates."""
    search = eqx.filter_jit(find_pairs)
    return search(bound.contact, bound.lists.candidates, reference, Capacity(2000, 40000, 400000))


def all_pairs(bound, x, reach, miss):
    """Sites (triangle, triangle, site, site) of candidates as near as their reach allows, but for `miss`."""
    contact, candidates = bound.contact, bound.lists.candidates
    faces, weights, rest = (np.asarray(a) for a in (contact.faces, contact.weights, contact.rest))
    pairs = np.asarray(candidates.triangles[: int(candidates.count)])
    one, two = faces[pairs[:, 0]], faces[pairs[:, 1]]
    limit = SIGMA + reach[one].max(axis=1) + reach[two].max(axis=1)

    def apart(points):
        sides = (np.einsum("sk,pki->psi", weights, points[nodes]) for nodes in (one, two))
        return np.linalg.norm(next(sides)[:, :, None] - next(sides)[:, None], axis=3)

    near = apart(x) <= limit[:, None, None] + miss
    pair, first, second = np.nonzero(near & (apart(rest) >= EXCLUSION * SIGMA))
    return set(zip(*pairs[pair].T, first, second, strict=True))


def listed(pairs, places=None):
    """The same of a list, or of some places in it."""
    places = np.arange(int(pairs.count)) if places is None else places
    owner, first, second = (np.asarray(a)[places] for a in (pairs.owner, pairs.first, pairs.second))
    return list(zip(*np.asarray(pairs.triangles)[owner].T, first, second, strict=True))


@pytest.mark.filterwarnings("ignore:contact level = 0 leaves")
@pytest.mark.parametrize(
    ("level", "roughness", "turned"), [(0, 0.0, False), (4, 0.0, False), (4, 0.0, True), (3, 0.1, True)]
)
def test_the_list_holds_the_sites_that_may_meet_and_no_others(level, roughness, turned):
    contact, here = layers(level, roughness, turned)
    pairs = found(contact, here)
    assert not pairs.overflow
    names = listed(pairs)
    assert len(names) > 100
    assert names == sorted(set(names))
    x, skin = np.asarray(here.x), np.asarray(here.skin)
    assert all_pairs(contact, x, skin, -1e-9 * SIGMA) <= set(names)
    # What lies beyond by less than rounding allows for may be in it.
    assert set(names) <= all_pairs(contact, x, skin, 1e-4 * SIGMA)


def held_active(contact, here, share):
    """The contact with what is active for a `share` of the motions that its list of sites is made for, from
    where some of the others have led to."""
    lists = contact.lists._replace(pairs=found(contact, here))
    way = np.random.default_rng(4).normal(size=here.x.shape)
    way *= 0.5 * (1 - share) * np.asarray(here.skin)[:, None] / np.linalg.norm(way, axis=1)[:, None]
    small = Reference(here.x + (way - way.mean(axis=0)), share * here.skin)
    active = eqx.filter_jit(find_active)(contact.contact, lists, small)
    return [Bound(contact.contact, own) for own in (lists, lists._replace(active=active))]


def test_what_is_active_interacts_as_the_whole_list_does():
    contact, here = layers(3, 0.1, True, reach=(0.2, 0.4))
    whole, part = held_active(contact, here, 0.1)
    active, pairs = part.lists.active, whole.lists.pairs
    assert 0 < int(active.count) < 0.7 * int(pairs.count)
    known = set(listed(pairs, np.asarray(active.pairs)[: int(active.count)]))
    rng, faces = np.random.default_rng(3), np.asarray(contact.contact.faces)
    force = eqx.filter_jit(lambda contact, x: contact.force(x))
    for _ in range(5):
        way = rng.normal(size=here.x.shape)
        way *= (0.08 * np.asarray(here.skin) / np.linalg.norm(way, axis=1))[:, None]
        x = active.reference.x + (way - way.mean(axis=0))
        touching = all_pairs(contact, np.asarray(x), np.zeros(len(x)), 0.0)
        assert len(touching) > 100
        assert touching <= known
        np.testing.assert_array_equal(force(part, x), force(whole, x))
        assert float(part.energy(x)) == float(whole.energy(x)) > 0
    far = active.reference.x.at[faces[0, 0], 2].add(0.3 * here.skin[faces[0, 0]])
    assert np.all(np.isfinite(force(whole, far)))
    assert np.all(np.isnan(force(part, far)))


@pytest.mark.parametrize(("way", "crosses"), [(0.3, False), (0.55, True)])
def test_what_is_active_touches_where_the_whole_list_does(way, crosses):
    contact, here = layers(3, 0.0, False, reach=(0.6, 0.6))
    whole, part = held_active(contact, here, 0.99)
    # The middle layer and the upper one meet.
    layer = np.round(np.asarray(here.x)[:, 2] / (GAP * SIGMA))
    end = here.x.at[:, 2].add(-way * SIGMA * (layer - 0.5) * (layer >= 0) * 2)
    for one in (whole, part):
        assert bool(one.covers(end))
        assert bool(one.crosses(here.x, end)) == crosses
    assert int(part.lists.active.close_count) > 0


def layer_energy(mesh, x, contact):
    """Energy of sites of the lower layer with those of the upper one."""
    weights, share, place = (np.asarray(a) for a in (contact.weights, contact.share, contact.place))
    sigma = float(contact.range)
    upper = layer_of(mesh, (2, 2))[mesh.faces]
    sides = [np.flatnonzero(np.all(upper == side, axis=1)) for side in (0, 1)]
    sites, rest = (
        [np.einsum("sk,fki->fsi", weights, y[mesh.faces[side]]).reshape(-1, 3) for side in sides]
        for y in (x, mesh.vertices)
    )
    strength = [(np.asarray(contact.density)[side][:, place] * share).reshape(-1) for side in sides]
    met = cKDTree(sites[0]).sparse_distance_matrix(cKDTree(sites[1]), sigma, output_type="coo_matrix")
    apart = np.linalg.norm(rest[0][met.row] - rest[1][met.col], axis=1) >= EXCLUSION * sigma
    parts = strength[0][met.row] * strength[1][met.col] * np.exp(sigma / (met.data - sigma))
    return float(contact.stiffness) * sigma**2 * np.sum(parts[apart])


@pytest.mark.slow
def test_places_beyond_32_bits_are_told_apart():
    step = 1e-3
    sigma = step / 60
    mesh = strip(0.8 * sigma, columns=(2, 2), rows=2, step=step)
    x = folded(mesh, 0.8 * sigma, (2, 2))
    options = jc.SelfContact("penalty", range=sigma, level=359)
    scene = jc.with_contacts(jc.sheet(mesh, jc.Material(thickness=1e-5), contact=options), x)
    contact = scene.contact
    assert int(scene.lists.pairs.needed[1]) * len(contact.share) > np.iinfo(np.int32).max
    assert bound(scene).energy(jnp.asarray(x)) == pytest.approx(layer_energy(mesh, x, contact), rel=1e-10)
