"""The list of sites that may meet against a sum over all pairs of sites."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from folded import folded, layer_of, strip
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import jaxcrumple as jc
from jaxcrumple.model.near import EXCLUSION, Around, Room, no_neighbors
from jaxcrumple.model.neighbors import find_near
from jaxcrumple.model.scene import with_near
from jaxcrumple.renewal import Renewal

SIGMA, GAP = 0.5e-3, 0.9
COLUMNS = (5, 6, 5)


def layers(level: int, roughness: float, turned: bool):
    """Contact of a strip folded twice, with candidates and room, its positions and reach.

    Where it is smooth and straight, sites lie in the planes that bound what is looked at, up to rounding.
    """
    mesh = strip(GAP * SIGMA, columns=COLUMNS, rows=4)
    rng = np.random.default_rng(2)
    x = folded(mesh, GAP * SIGMA, COLUMNS) + roughness * SIGMA * rng.normal(size=(mesh.n_nodes, 3))
    if turned:
        x = Rotation.random(rng=rng).apply(x)
    reach = SIGMA * rng.uniform(0.02, 0.4, mesh.n_nodes)
    options = jc.SelfContact(range=SIGMA, level=level)
    scene = jc.sheet(mesh, jc.Material(thickness=0.3e-3), contact=options)
    scene = with_near(scene, no_neighbors(scene.n_nodes, len(scene.contact.share), Room(2000, 40000, 400000)))
    around = Around(jnp.asarray(x), jnp.asarray(reach))
    return Renewal(scene, merged=False).searched(scene, around).contact, around


def all_pairs(contact, x, reach, miss):
    """Sites (triangle, triangle, site, site) of candidates as near as their reach allows, but for `miss`."""
    faces, weights, rest = (np.asarray(a) for a in (contact.faces, contact.weights, contact.rest))
    pairs = np.asarray(contact.candidates.triangles[: int(contact.candidates.count)])
    one, two = faces[pairs[:, 0]], faces[pairs[:, 1]]
    limit = SIGMA + reach[one].max(axis=1) + reach[two].max(axis=1)

    def apart(points):
        sides = (np.einsum("sk,pki->psi", weights, points[nodes]) for nodes in (one, two))
        return np.linalg.norm(next(sides)[:, :, None] - next(sides)[:, None], axis=3)

    near = apart(x) <= limit[:, None, None] + miss
    pair, first, second = np.nonzero(near & (apart(rest) >= EXCLUSION * SIGMA))
    return set(zip(*pairs[pair].T, first, second, strict=True))


def listed(near, sites):
    """The same of a list."""
    at, second = np.divmod(np.asarray(near.picked[: int(near.site_count)]), sites)
    owner, first = np.divmod(np.asarray(near.found)[at], sites)
    triangles = np.asarray(near.triangles)[owner]
    return list(zip(*triangles.T, first, second, strict=True))


@pytest.mark.filterwarnings("ignore:contact level = 0 leaves")
@pytest.mark.parametrize(
    ("level", "roughness", "turned"), [(0, 0.0, False), (4, 0.0, False), (4, 0.0, True), (3, 0.1, True)]
)
def test_the_list_holds_the_sites_that_may_meet_and_no_others(level, roughness, turned):
    contact, around = layers(level, roughness, turned)
    near = eqx.filter_jit(find_near)(contact, around)
    assert not np.any(near.overflow)
    found = listed(near, contact.weights.shape[0])
    assert len(found) > 100
    assert found == sorted(set(found))
    x, reach = np.asarray(around.x), np.asarray(around.reach)
    assert all_pairs(contact, x, reach, -1e-9 * SIGMA) <= set(found)
    # What lies beyond by less than rounding allows for may be in it.
    assert set(found) <= all_pairs(contact, x, reach, 1e-4 * SIGMA)


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
    options = jc.SelfContact(range=sigma, level=359)
    contact = jc.with_contacts(jc.sheet(mesh, jc.Material(thickness=1e-5), contact=options), x).contact
    assert int(contact.near.needed[1]) * len(contact.share) > np.iinfo(np.int32).max
    assert contact.energy(jnp.asarray(x)) == pytest.approx(layer_energy(mesh, x, contact), rel=1e-10)
