"""Meshes of different seeds as lanes of one program: what is added to their arrays has no effect."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.contact.host_broad_phase import Search
from jaxcrumple.sweeps.size_class import SizeClass, kind_of

SEEDS = range(5)


def sheets(**options):
    options = {"sweeps": 10, "contact": None, **options}
    return [jc.radial(80, seed, **options) for seed in SEEDS]


@pytest.fixture(scope="module", params=[None, "inverse-power"])
def pair(request):
    """Positions of a sheet at rest and with its halves over each other, its scene, and the scene with room
    for more of everything."""
    options = {"contact": request.param}
    options |= {"contact_range": 1e-3, "contact_level": 18} if request.param else {}
    first, *others = sheets(**options)
    sizes = SizeClass.of([setup.scene for setup in (first, *others)])
    assert all(np.all(np.array(SizeClass.of([setup.scene])) <= sizes) for setup in (first, *others))
    more = 2 if request.param else 0
    sizes = SizeClass(
        sizes.entries + 18, sizes.neighbors + 3, sizes.cells + 2, sizes.members + 3, sizes.functions + 5,
        sizes.around + more, sizes.ways + 9 * more,
    )  # fmt: skip
    x = np.array(first.x)
    x[:, 2] = np.where(x[:, 0] > 0, 2e-4, 0.0) + 1e-6 * np.random.default_rng(0).normal(size=len(x))
    x[:, 0] = -np.abs(x[:, 0])
    return np.asarray(first.x), x, first.scene, sizes.padded(first.scene)


def test_forces_are_the_same(pair):
    _, x, own, padded = pair
    found = [jc.force(jc.with_contacts(scene, x), x, np.zeros_like(x), None, 0.0) for scene in (own, padded)]
    assert np.abs(found[0]).max() > 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-12, atol=1e-12 * float(np.abs(found[0]).max()))


@pytest.mark.parametrize("linear", ["two-level", "block-cg"])
def test_linear_systems_have_the_same_solution(pair, linear):
    x, _, own, padded = pair
    b, found = np.random.default_rng(1).normal(size=x.size), []
    for scene in (own, padded):
        scene = jc.with_contacts(scene, x)
        values = jc.elastic_tangent(scene, x, None, 0.0, 1e9)
        found.append(jc.linear_solve(linear, scene.sparsity, values, b, 1e-10))
        np.testing.assert_allclose(scene.sparsity.product(values, found[-1]), b, atol=1e-8)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-8 * float(jnp.abs(found[0]).max()))


def test_the_same_pairs_of_triangles_are_found(pair):
    _, x, own, padded = pair
    if own.contact is None:
        return
    skin = np.full(len(x), 1e-4)
    found = [Search(scene.contact, np.asarray(scene.bending.nodes)).find(x, skin) for scene in (own, padded)]
    np.testing.assert_array_equal(found[0][0], found[1][0])
    ways = len(own.contact.fans.ends)
    np.testing.assert_array_equal(found[0][1], found[1][1][:ways])
    assert not np.any(found[1][1][ways:])


@pytest.mark.parametrize("singles", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_lanes_of_other_seeds_are_their_single_runs(singles):
    """To rounding, in the same steps. Their coarse spaces have different sizes."""
    settings = {"nodes": 80, "sweeps": 10, "contact": None, "linear": "two-level", "rtol": 1e-2}
    assert len({SizeClass.of([setup.scene]) for setup in sheets()}) > 1
    times = [0.05, 0.1]

    def positions(setup, state):
        return {"x": (("node", "axis"), state.x), "area": setup.mesh.area}

    table = jc.sweep("radial", {"seed": SEEDS}, times, settings=settings, measure=positions, backend="batch")
    assert np.all(table.result == "success")
    solver = jc.integrator(rtol=1e-2, linear="two-level")
    for seed, setup in zip(range(singles), sheets(), strict=False):
        here = table.sel(seed=seed)
        run = jc.simulate(setup.scene, jc.initial_state(setup.scene, setup.x), times, solver=solver)
        np.testing.assert_array_equal(here.steps, run.state.counters.steps)
        np.testing.assert_allclose(here.x, run.x, rtol=0, atol=1e-9)
        assert jnp.ptp(run.x[-1, :, 2]) > 0


@pytest.mark.parametrize("contact", [None, "inverse-power"])
def test_seeds_share_the_program_of_factors(contact):
    """All arrays have the same sizes, so a run of another seed compiles nothing."""
    level = {"contact_range": 1e-3, "contact_level": 18} if contact else {}
    scenes = [setup.scene for setup in sheets(contact=contact, sweeps=60, **level)]
    lean = [eqx.tree_at(lambda s: s.pattern, scene, scene.pattern.for_factors()) for scene in scenes]
    kinds = {(str(jax.tree.map(jnp.shape, scene)), jax.tree.structure(scene)) for scene in lean}
    assert len(kinds) == 1 < len({str(jax.tree.map(jnp.shape, scene)) for scene in scenes})
    rng, found = np.random.default_rng(0), []
    values, x = (
        jnp.asarray(rng.normal(size=size)) for size in (scenes[1].pattern.nnz, 3 * scenes[1].n_nodes)
    )
    for scene in (scenes[1], lean[1]):
        found.append(scene.pattern.expanded_product(scene.pattern.expand(values), x))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12, atol=1e-12)


def test_what_size_classes_hold_is_of_one_kind():
    """Other seeds are; other numbers of nodes, terms or sites are not."""
    first, *others = (setup.scene for setup in sheets(contact="inverse-power", contact_level=3))
    assert {kind_of(scene, None) for scene in others} == {kind_of(first, None)}
    other = [
        jc.radial(80, sweeps=10, contact_level=2).scene,
        jc.radial(90, sweeps=10, contact_level=3).scene,
        jc.radial(80, sweeps=10, contact=None).scene,
        eqx.tree_at(lambda s: s.drag, first, None),
    ]
    kinds = [kind_of(scene, None) for scene in (first, *other)]
    assert len(set(kinds)) == len(kinds) and kind_of(first, first.mass) != kind_of(first, None)
