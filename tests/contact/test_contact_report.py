"""What a report on contact tells, and what names a pair of sites for as long as it lasts."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import bound
from folded import folded, strip

import jaxcrumple as jc
from jaxcrumple.contact.lists import NONE, Capacity, Reference, carried
from jaxcrumple.contact.narrow_phase import find_pairs
from jaxcrumple.scene import with_lists

SIGMA, GAP, COLUMNS = 0.5e-3, 0.8, (5, 5)


@pytest.fixture(scope="module")
def layers():
    """A strip folded in half, its layers 0.8 ranges apart, without lists: scene and positions."""
    mesh = strip(GAP * SIGMA, columns=COLUMNS, rows=4)
    scene = jc.sheet(mesh, jc.Material(thickness=0.3e-3), contact=jc.SelfContact(range=SIGMA, level=3))
    return scene, jnp.asarray(folded(mesh, GAP * SIGMA, COLUMNS))


def test_a_report_tells_energy_gap_and_the_closest_triangles(layers):
    scene, x = layers
    report = jc.contact_report(scene, x)
    listed = bound(jc.with_contacts(scene, x))
    assert report.valid and not report.reasons
    assert report.energy == pytest.approx(float(listed.energy(x)), rel=1e-14) and report.energy > 0
    assert report.gap == pytest.approx(GAP * SIGMA, rel=1e-9)
    assert report.interacting == int(listed.gaps(x)[1])
    height = np.asarray(x)[:, 2]
    low, high = sorted(height[list(nodes)].mean() for nodes in report.closest)
    assert high - low == pytest.approx(GAP * SIGMA, rel=1e-6)
    names = [own.name for own in report.lists]
    assert names == ["candidate pairs", "triangle pairs", "sites", "site pairs"]
    assert all(0 < own.entries <= own.capacity and own.share == 0.0 for own in report.lists)
    assert (
        str(report).splitlines()[0].endswith(f"between triangles {report.closest[0]} and {report.closest[1]}")
    )


def test_a_report_names_the_list_that_fails_and_the_node_that_left_it(layers):
    scene, x = layers
    listed = jc.with_contacts(scene, x)
    skin = float(listed.lists.pairs.reference.skin[7])
    moved = x.at[7, 0].add(2.0 * skin)
    report = jc.contact_report(listed, moved)
    assert not report.valid and np.isnan(report.energy)
    assert "node 7 moved" in report.reasons[-1] and "site pairs" in report.reasons[-1]
    # The mean motion of the sheet does not count.
    expected = 2.0 * (1.0 - 1.0 / scene.n_nodes)
    assert report.lists[-1].share == pytest.approx(expected, rel=1e-9)
    assert jc.contact_report(listed, x + 1.0).valid


def test_a_report_tells_what_capacity_is_missing(layers):
    scene, x = layers
    listed = jc.with_contacts(scene, x)
    lists = listed.lists
    wanted = lists.pairs.needed.tolist()
    small = Capacity(*(size // 2 for size in wanted))
    short = find_pairs(scene.contact, lists.candidates, lists.pairs.reference, small)
    report = jc.contact_report(with_lists(listed, lists._replace(pairs=short)), x)
    assert not report.valid and f"triangle pairs need a capacity of {wanted[0]}" in report.reasons[0]


def test_energies_ask_for_the_lists_that_a_scene_lacks(layers):
    scene, x = layers
    for call in (jc.energies, jc.force):
        with pytest.raises(ValueError, match=r"no neighbour lists; build them .*with_contacts\(scene, x\)"):
            call(scene, x, x, None, 0.0)


def test_a_phantom_sheet_has_no_report():
    scene = jc.sheet(jc.hexagonal(3, 3, 1e-2), jc.Material())
    with pytest.raises(ValueError, match="no contact to report on"):
        jc.contact_report(scene, np.zeros((9, 3)))


def test_a_pair_keeps_what_it_remembers_when_its_list_is_rebuilt(layers):
    scene, x = layers
    lists = jc.with_contacts(scene, x).lists
    sites, faces, search = len(scene.contact.share), len(scene.contact.faces), eqx.filter_jit(find_pairs)
    # The upper layer slides, so that some pairs leave the list and others join it.
    there = x.at[:, 0].add(jnp.where(x[:, 2] > 0, 0.8 * SIGMA, 0.0))
    here = Reference(there, jnp.full(scene.n_nodes, 0.1 * SIGMA))
    old, new = lists.pairs, search(scene.contact, lists.candidates, here, Capacity(500, 20_000, 100_000))
    before, after = (pairs.keys(faces, sites) for pairs in (old, new))
    for keys, pairs in ((before, old), (after, new)):
        assert np.all(np.diff(keys[: int(pairs.count)]) > 0) and np.all(keys[int(pairs.count) :] == NONE)
    values = jnp.arange(2.0 * len(before)).reshape(-1, 2)
    kept = np.asarray(carried(before, after, values, -1.0))[: int(new.count)]
    remembered = {
        int(key): value for key, value in zip(before, np.asarray(values), strict=True) if key != NONE
    }
    expected = [remembered.get(int(key), (-1.0, -1.0)) for key in after[: int(new.count)]]
    np.testing.assert_array_equal(kept, expected)
    share = np.mean(kept[:, 0] >= 0)
    assert 0.1 < share < 1.0
