"""Self-contact of a whole sheet against a sum over all pairs of sites, and what its symmetry demands."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import Bound, bound
from folded import brute_force, folded, strip
from scipy.sparse.linalg import eigsh

import jaxcrumple as jc
from jaxcrumple.solvers.explicit.stability import fastest

SIGMA, PARTS = 0.5e-3, 4


def layers(gap: float = 0.75, potential: str = "penalty", level: int | None = PARTS - 1):
    """A self-avoiding strip folded in half, its layers `gap` ranges apart: scene with lists, and
    positions."""
    mesh = strip(gap * SIGMA)
    options = jc.SelfContact(potential, range=SIGMA, level=level)
    scene = jc.sheet(mesh, jc.Material(thickness=0.3e-3), contact=options)
    rng = np.random.default_rng(4)
    x = folded(mesh, gap * SIGMA) + 0.01 * SIGMA * rng.normal(size=(mesh.n_nodes, 3))
    return mesh, jc.with_contacts(scene, x), jnp.asarray(x)


def creased(mesh: jc.Mesh, half: float) -> np.ndarray:
    """Positions (n, 3) of a sheet folded sharply about x = 0, each half at an angle `half` in degrees."""
    x = mesh.vertices.copy()
    fold = np.abs(x[:, 0])
    x[:, 2], x[:, 0] = fold * np.cos(np.deg2rad(half)), x[:, 0] * np.sin(np.deg2rad(half))
    return x


@pytest.mark.parametrize("gap", [0.45, 0.75, 0.95])
def test_energy_and_force_are_those_of_all_pairs_of_sites(gap):
    mesh, scene, x = layers(gap)
    energy, force = brute_force(mesh, np.asarray(x), float(scene.contact.stiffness), SIGMA, PARTS)
    assert energy > 0
    assert abs(float(bound(scene).energy(x)) / energy - 1.0) < 1e-11
    np.testing.assert_allclose(bound(scene).force(x), force, rtol=0, atol=1e-10 * np.abs(force).max())


@pytest.mark.parametrize("half", [None, 18.0])
def test_force_is_minus_the_gradient_and_blocks_are_the_hessian(half):
    mesh, scene, x = layers()
    if half is not None:
        # Triangles that share a node touch.
        x = jnp.asarray(creased(mesh, half))
        scene = jc.with_contacts(scene, x)
    contact = bound(scene)
    size = float(jnp.max(jnp.abs(contact.force(x))))
    np.testing.assert_allclose(contact.force(x), -jax.grad(contact.energy)(x), rtol=0, atol=1e-12 * size)
    still = jc.initial_state(scene, x)
    alone = eqx.tree_at(
        lambda s: (s.membrane.stiffness, s.bending.stiffness),
        scene,
        (jnp.zeros_like(scene.membrane.stiffness), jnp.zeros_like(scene.bending.stiffness)),
    )
    hessian = jax.hessian(contact.energy)(x).reshape(x.size, x.size)
    matrix = jc.tangent(alone, still).toarray()
    np.testing.assert_allclose(matrix, hessian, rtol=0, atol=1e-11 * np.abs(hessian).max())
    # Moving everything together changes nothing.
    rows = matrix.reshape(x.size, mesh.n_nodes, 3).sum(axis=1)
    assert np.abs(rows).max() < 1e-10 * np.abs(matrix).max()


def test_net_force_and_torque_vanish():
    _, scene, x = layers()
    force = np.asarray(bound(scene).force(x))
    size = np.abs(force).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * size
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-13 * size * 0.02


@pytest.mark.parametrize(
    ("potential", "level"),
    [("penalty", 7), ("inverse-power", 7), pytest.param("penalty", 9, marks=pytest.mark.slow)],
)
def test_pressure_of_two_layers_does_not_depend_on_the_level(potential, level):
    """The limit of many sites: P = 2 pi n_s^2 g U(g), with one site per a_0."""
    gap = 0.8
    mesh, scene, _ = layers(gap, potential=potential, level=level)
    x = folded(mesh, gap * SIGMA)
    contact = bound(jc.with_contacts(scene, x))
    force = np.asarray(contact.force(jnp.asarray(x)))
    inner = (x[:, 0] > -7e-3) & (x[:, 0] < -2e-3) & (np.abs(x[:, 1]) < 1.2e-3) & (x[:, 2] > 0)
    pressure = force[inner, 2].sum() / mesh.node_area[inner].sum()
    density = 1.0 / (np.sqrt(3.0) / 2.0 * SIGMA**2)
    stiffness, g = float(contact.contact.stiffness), gap * SIGMA
    law = {"penalty": np.exp(1.0 / (gap - 1.0)), "inverse-power": 0.1 * (1.0 - gap) ** 3 / gap**4}
    energy = stiffness * SIGMA**2 * law[potential]
    assert pressure == pytest.approx(2.0 * np.pi * density**2 * g * energy, rel=0.05)


@pytest.mark.parametrize("half", [15.0, 20.0, 35.0])
def test_neighbours_at_rest_never_interact_on_a_sharp_fold(half):
    mesh, scene, _ = layers()
    x = creased(mesh, half)
    here = bound(jc.with_contacts(scene, x))
    energy, force = brute_force(mesh, x, float(here.contact.stiffness), SIGMA, PARTS)
    # Sites SIGMA from the crease on both sides of it are 2 SIGMA apart at rest, and 2 SIGMA sin(half) now.
    assert (energy > 0) == (half < 30.0)
    assert float(here.energy(jnp.asarray(x))) == pytest.approx(energy, rel=1e-9)
    np.testing.assert_allclose(
        here.force(jnp.asarray(x)), force, rtol=0, atol=1e-9 * max(np.abs(force).max(), 1e-30)
    )


def test_derivatives_of_the_force_in_both_modes_and_in_batches():
    _, scene, x = layers()
    contact = bound(scene)
    w = jnp.sin(jnp.arange(x.size) * 1.7).reshape(x.shape)

    def work(stiffness, x):
        return jnp.sum(w * eqx.tree_at(lambda c: c.contact.stiffness, contact, stiffness).force(x))

    def pushed(x):
        return jnp.sum(w * jax.grad(contact.energy)(x))

    by_stiffness, by_x = jax.grad(work, (0, 1))(contact.contact.stiffness, x)
    _, forward = jax.jvp(contact.force, (x,), (w,))
    assert float(by_stiffness) == pytest.approx(float(work(1.0, x)), rel=1e-12)
    # The Hessian is symmetric, so both modes give the same, as does that of the energy.
    size = float(jnp.max(jnp.abs(forward)))
    np.testing.assert_allclose(by_x, forward, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(jax.grad(pushed)(x), -forward, rtol=0, atol=1e-11 * size)
    several = jnp.stack([x, x * (1.0 + 1e-6)])
    each = [jax.grad(work, 1)(contact.contact.stiffness, one) for one in several]
    both = jax.vmap(jax.grad(work, 1), (None, 0))(contact.contact.stiffness, several)
    np.testing.assert_allclose(both, each, rtol=0, atol=1e-12 * size)


def test_lists_that_do_not_hold_give_nan_not_zero():
    _, scene, x = layers()
    moved = x.at[0].add(2.0 * SIGMA)
    assert np.isnan(bound(scene).energy(moved))
    assert np.all(np.isnan(bound(scene).force(moved)))
    shifted = x + jnp.asarray([1.0, 2.0, 3.0])
    assert float(bound(scene).energy(shifted)) == pytest.approx(float(bound(scene).energy(x)), rel=1e-6)


def test_barrier_is_infinite_before_layers_touch():
    _, scene, x = layers(0.9, potential="barrier", level=None)
    assert 0 < float(bound(scene).energy(x)) < np.inf
    _, scene, x = layers(0.1, potential="barrier", level=None)
    assert np.isinf(bound(scene).energy(x))


def test_a_barrier_is_finite_where_a_fold_is_sharp():
    mesh, options = jc.hexagonal(9, 6, 1.1e-3), jc.SelfContact("barrier", range=SIGMA)
    x = jnp.asarray(creased(mesh, 18.0))

    def contact_of(mesh: jc.Mesh) -> Bound:
        scene = jc.sheet(mesh, jc.Material(thickness=0.3e-3), contact=options)
        return bound(jc.with_contacts(scene, x))

    # Let the first pair of triangles share its third corner, so that its first pair of sites is one point.
    faces, near = np.array(mesh.faces), contact_of(mesh).lists.pairs
    for one, two in np.asarray(near.triangles)[: int(near.triangle_count)]:
        shared = set(faces[one]) & set(faces[two])
        if len(shared) == 1:
            break
    order = [one, two, *(k for k in range(len(faces)) if k not in (one, two))]
    faces = faces[order]
    for k in range(2):
        faces[k] = np.roll(faces[k], 2 - list(faces[k]).index(*shared))
    contact = contact_of(jc.Mesh.from_arrays(mesh.vertices, faces, reorder=False))
    assert list(contact.lists.pairs.triangles[0]) == [0, 1]
    assert int(contact.lists.pairs.first[0]) == 0
    assert int(contact.gaps(x)[1]) % 256 > 0
    assert 0 < float(contact.energy(x)) < np.inf
    assert np.all(np.isfinite(contact.force(x)))


@pytest.mark.slow
def test_a_sheet_whose_triangles_all_share_a_node_has_no_contact():
    angle = np.arange(6) * np.pi / 3
    rim = 1e-2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    mesh = jc.Mesh.from_arrays(
        np.vstack([[[0.0, 0.0]], rim]), [[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)]
    )
    bent = mesh.vertices + np.array([0.0, 0.0, 20.0]) * mesh.vertices[:, :1] ** 2
    material = jc.Material(thickness=0.3e-3, yield_curvature=None)
    relaxed = []
    for options in (None, jc.SelfContact(range=SIGMA)):
        scene = jc.sheet(mesh, material, contact=options)
        state = jc.initial_state(scene, bent)
        if options is not None:
            listed = jc.with_contacts(scene, bent)
            assert int(listed.lists.candidates.count) == 0
            assert float(bound(listed).energy(state.x)) == 0.0
        relaxed.append(jc.relax(scene, state, force_tolerance=1e-9, linear="two-level"))
        assert bool(relaxed[-1].converged)
    # Each may have turned as a whole.
    apart = [np.linalg.norm(one.state.x[:, None] - one.state.x, axis=2) for one in relaxed]
    np.testing.assert_allclose(apart[1], apart[0], atol=1e-5 * SIGMA)


@pytest.mark.parametrize(
    ("potential", "level", "gap", "stiffer", "most"),
    [
        pytest.param("penalty", 7, 0.35, 0.9, 1.15, marks=pytest.mark.slow),
        ("barrier", None, 0.75, 1.5, 1.17),
    ],
)
def test_stability_limit_of_layers_that_press_one_another(potential, level, gap, stiffer, most):
    """Those next to a barrier's core are stiffer by far than the sheet alone; 0.98 of the way to each other
    8 % more."""
    _, scene, x = layers(gap, potential=potential, level=level)
    assert int(bound(scene).gaps(x)[1]) > 100
    state = jc.initial_state(scene, x)
    matrix, mass = jc.tangent(scene, state), np.repeat(scene.mass, 3)
    scaled = matrix.multiply(mass[:, None] ** -0.5).multiply(mass**-0.5).tocsr()
    exact = np.sqrt(eigsh(scaled, k=1, which="LA", return_eigenvectors=False)[0])
    alone = fastest(eqx.tree_at(lambda s: s.contact.stiffness, scene, jnp.zeros(())), x)
    assert exact > stiffer * alone.omega
    assert 1.0 <= fastest(scene, x).omega / exact < most


def test_lists_have_the_room_that_is_asked_for_and_change_nothing():
    _, scene, x = layers()
    wider = jc.with_contacts(scene, x, needed=[3000, 100_000, 200_000, 100_000])
    near = wider.lists.pairs
    assert np.all(np.array(near.capacity) >= [3000, 100_000, 200_000])
    assert wider.lists.candidates.triangles.shape[0] >= 100_000
    assert float(bound(wider).energy(x)) == float(bound(scene).energy(x))
