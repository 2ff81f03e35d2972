"""`Setup.made_of`: another material, with what does not follow from the old one as it was."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import jaxcrumple as jc
from jaxcrumple.model.loads import dead_load

MESH = jc.hexagonal(4, 3, 1e-2)
X = jnp.asarray(MESH.vertices)
H = len(MESH.hinges)
MATERIAL = jc.Material()
STIFFER = replace(MATERIAL, young_modulus=2e9)
WALL = jc.Sphere(np.zeros(3), 0.1)


class Creep(jc.AbstractFlowRule):
    """dp/dt = (c - p) / T."""

    time: Array

    def rate(self, c, p):
        return (c - p) / self.time


def setup(material=MATERIAL, contact=None, **options):
    return jc.Setup(MESH, jc.sheet(MESH, material, contact=contact, **options), X, contact, material)


def assert_same(one, other):
    pairs = zip(*(jax.tree.leaves(eqx.filter(tree, eqx.is_array)) for tree in (one, other)), strict=True)
    for a, b in pairs:
        np.testing.assert_allclose(a, b, rtol=1e-14)


def test_the_same_material_makes_the_same_scene():
    load = dead_load([3], [[0, 0, 1e-3]], 1.0)
    own = jc.Wall(WALL, np.linspace(1, 2, MESH.n_nodes), 2e-3)
    made = setup(
        contact=jc.SelfContact(), walls=[WALL, own], gravity=(0, 0, -9.81), extra=[load], damping="paper"
    )
    assert_same(made.scene, made.made_of(MATERIAL))
    assert type(made.made_of(STIFFER).damping) is type(made.scene.damping)


def test_walls_follow_the_material_unless_they_have_numbers_of_their_own():
    own = jc.Wall(WALL, np.full(MESH.n_nodes, 7.0), 2e-3)
    made = setup(walls=[WALL, own])
    thicker = made.made_of(replace(MATERIAL, thickness=5e-4))
    assert float(thicker.walls[0].range) == pytest.approx(5e-4)
    np.testing.assert_allclose(thicker.walls[0].stiffness, 2 * made.scene.walls[0].stiffness)
    np.testing.assert_array_equal(thicker.walls[1].stiffness, 7.0)
    assert float(thicker.walls[1].range) == 2e-3


def test_a_flow_rule_of_ones_own_is_kept():
    rule = Creep(jnp.asarray(0.5))
    made = setup(plasticity=rule).made_of(STIFFER)
    assert made.plasticity == rule
    np.testing.assert_allclose(made.membrane.stiffness, STIFFER.spring_constant)
    # Also the house's law with other numbers than the material's.
    law = jc.SmoothstepFlow(np.full(H, 0.3), 1.0, 0.0)
    np.testing.assert_array_equal(setup(plasticity=law).made_of(STIFFER).plasticity.yield_threshold, 0.3)


@pytest.mark.parametrize(
    "change", [{"yield_curvature": 50.0}, {"yield_curvature": None}, {"plastic_time": 1.0}, {"gamma": 1.0}]
)
def test_a_yield_point_that_a_flow_rule_of_ones_own_does_not_know_is_refused(change):
    (name,) = change
    with pytest.raises(ValueError, match=rf"^{name} changes, but the setup's flow rule, Creep, does not"):
        setup(plasticity=Creep(jnp.asarray(0.5))).made_of(replace(MATERIAL, **change))


def test_derivatives_by_the_material():
    made = setup(walls=[WALL], contact=jc.SelfContact(), gravity=(0, 0, -9.81))
    x = X.at[:, 2].add(1e-3 * jnp.arange(len(X)))

    def stretch(modulus):
        scene = made.made_of(replace(MATERIAL, young_modulus=modulus))
        return scene.membrane.energy(x)

    value, slope = jax.jit(jax.value_and_grad(stretch))(1e9)
    # The energy is proportional to the modulus.
    assert float(slope) == pytest.approx(float(value) / 1e9, rel=1e-12)
    creeping = setup(plasticity=Creep(jnp.asarray(1.0)))
    with pytest.raises(ValueError, match="yield_curvature changes, but the setup's flow rule, Creep"):
        jax.jit(lambda c: creeping.made_of(replace(MATERIAL, yield_curvature=c)).mass)(9.0)
    with pytest.raises(ValueError, match="made_of needs a setup of plain numbers: make it outside of jit"):
        jax.jit(lambda: setup().made_of(STIFFER).mass)()


def test_a_rest_shape_of_ones_own_is_kept():
    made = setup()
    creased = eqx.tree_at(lambda s: s.bending.rest_curvature, made.scene, jnp.full(H, 0.2))
    found = made._replace(scene=creased).made_of(STIFFER)
    np.testing.assert_array_equal(found.bending.rest_curvature, 0.2)
    np.testing.assert_allclose(found.bending.stiffness, 2 * made.scene.bending.stiffness)


@pytest.mark.parametrize(
    ("where", "name"),
    [
        (lambda s: s.mass, "mass"),
        (lambda s: s.membrane.stiffness, r"membrane\.stiffness"),
        (lambda s: s.drag.coefficient, "drag"),
        (lambda s: s.damping.coefficient, "damping"),
        (lambda s: s.contact.range, r"contact\.range"),
    ],
)
def test_numbers_that_do_not_follow_from_the_material_are_refused(where, name):
    made = setup(contact=jc.SelfContact())
    other = eqx.tree_at(where, made.scene, replace_fn=lambda a: 1.5 * a)
    with pytest.raises(ValueError, match=rf"^{name} of the setup's scene does not follow from its material"):
        made._replace(scene=other).made_of(STIFFER)
    without = eqx.tree_at(lambda s: s.drag, made.scene, None)
    with pytest.raises(ValueError, match=r"^drag of the setup's scene does not follow"):
        made._replace(scene=without).made_of(STIFFER)


def test_a_setup_that_does_not_say_its_material_is_refused():
    with pytest.raises(ValueError, match=r"^the setup has no material, so made_of cannot tell"):
        setup()._replace(material=None).made_of(STIFFER)
