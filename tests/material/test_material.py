"""Material properties against the numbers of the paper's sheet, and the constants of a mesh."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.material.material import MAX_C0, Material
from jaxcrumple.mesh.generate import hexagonal, rectangle


def test_constants_of_the_papers_sheet():
    sheet = Material()
    assert sheet.young_modulus_2d == pytest.approx(2.5e5)
    assert sheet.spring_constant == pytest.approx(2.165e5, rel=1e-4)
    assert sheet.bending_constant == pytest.approx(1.69e-3, rel=2e-3)
    assert sheet.bending_rigidity == pytest.approx(1.465e-3, rel=1e-3)
    # (21) with nu = 1/3 must agree with (14) and (23).
    plate = 1e9 * 0.25e-3**3 / (12 * (1 - 1 / 9))
    assert sheet.bending_rigidity == pytest.approx(plate, rel=1e-12)


@pytest.mark.parametrize(
    ("nodes", "a_ref", "c0"), [(500, 1.9e8, None), (1000, 2.7e8, 0.59), (3000, 4.7e8, 0.34)]
)
def test_reference_acceleration_and_yield_point_of_the_papers_meshes(nodes, a_ref, c0):
    mesh = rectangle(0.1, 0.1, nodes, sweeps=10)
    constants = Material().discretize(mesh)
    assert constants.a_ref == pytest.approx(a_ref, rel=0.02)
    np.testing.assert_allclose(constants.mass, 2.5e-3 / nodes)
    np.testing.assert_allclose(constants.c0, 200 * mesh.hinge_height)
    if c0 is not None:
        assert constants.c0.mean() == pytest.approx(c0, rel=0.03)


def test_yield_point_of_the_finest_sheet():
    # A lattice of the area per node of n = 12000 on 10 cm.
    spacing = np.sqrt(0.01 / 12000 * 2 / np.sqrt(3))
    constants = Material().discretize(hexagonal(8, 8, spacing))
    assert constants.c0.mean() == pytest.approx(0.17, abs=0.005)


def test_uniform_constants():
    mesh = rectangle(0.1, 0.05, 80, sweeps=5)
    material = Material(gamma=0.5, plastic_time=2e-3, drag_rate=30.0, internal_damping_time=1e-6)
    c = material.discretize(mesh)
    assert (len(c.ks), len(c.kb), len(c.mass), len(c.c0)) == (
        len(mesh.edges),
        len(mesh.hinges),
        80,
        len(mesh.hinges),
    )
    np.testing.assert_allclose(c.ks, material.spring_constant)
    np.testing.assert_allclose(c.kb, material.bending_constant)
    np.testing.assert_allclose(c.drag, 30.0 * c.mass)
    np.testing.assert_allclose(c.b_int, 1e-6 * c.ks)
    assert c.sigma == pytest.approx(0.25e-3)
    assert (c.gamma, c.plastic_time) == (0.5, 2e-3)


def test_both_lumpings_keep_the_mass():
    mesh = rectangle(0.1, 0.1, 100, sweeps=5)
    uniform, area = (Material(mass_lumping=m).discretize(mesh) for m in ("uniform", "area"))
    np.testing.assert_allclose(area.mass, 0.25 * mesh.node_area)
    np.testing.assert_allclose([uniform.mass.sum(), area.mass.sum()], 0.25 * 0.01)
    assert np.ptp(uniform.mass) == 0 < np.ptp(area.mass)


def test_properties_per_node():
    mesh = hexagonal(5, 3, 0.01)
    h = np.where(mesh.vertices[:, 0] > 0, 2e-4, 1e-4)
    curvature = 50.0 * (1 + np.arange(20))
    material = Material(thickness=h, yield_curvature=curvature)
    c = material.discretize(mesh)
    a, b = mesh.edges.T
    ks = np.sqrt(3) / 2 * 1e9 * h
    np.testing.assert_allclose(c.ks, (ks[a] + ks[b]) / 2)
    i, j = mesh.hinges[:, 0], mesh.hinges[:, 1]
    kb = ks * h**2 / 8
    np.testing.assert_allclose(c.kb, (kb[i] + kb[j]) / 2)
    np.testing.assert_allclose(
        c.c0, np.minimum((curvature[i] + curvature[j]) / 2 * mesh.hinge_height, MAX_C0)
    )
    assert c.sigma == pytest.approx(h.mean())
    np.testing.assert_allclose(c.mass.sum(), 1000 * (h * mesh.node_area).sum())
    with pytest.raises(
        ValueError, match="thickness has 20 values but the mesh has 12 nodes; give one value per node"
    ):
        material.discretize(hexagonal(4, 2, 0.01))


def test_kinds_of_yield():
    mesh = hexagonal(5, 3, 0.01)
    assert Material().yield_curvature == 200.0
    paper = Material(yield_c0=0.3)
    assert paper.yield_curvature is None and not paper.is_elastic
    np.testing.assert_array_equal(paper.discretize(mesh).c0, 0.3)
    elastic = Material(yield_curvature=None)
    assert elastic.is_elastic and elastic.discretize(mesh).c0 is None
    np.testing.assert_array_equal(Material(yield_curvature=1e6).discretize(mesh).c0, MAX_C0)
    np.testing.assert_array_equal(Material(yield_c0=2.5).discretize(mesh).c0, MAX_C0)
    with pytest.raises(ValueError, match="yield_curvature and yield_c0 both set the yield point; give one"):
        Material(yield_c0=0.3, yield_curvature=100.0)
    assert dataclasses.replace(Material(), yield_curvature=None, yield_c0=0.3).yield_c0 == 0.3


@pytest.mark.parametrize("field", ["young_modulus", "thickness", "density", "plastic_time"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "much"])
def test_positive_fields(field, value):
    with pytest.raises(ValueError, match=rf"{field} = .*\[.*\] is not usable; give a finite number > 0"):
        Material(**{field: value})


@pytest.mark.parametrize(
    "field", ["yield_curvature", "yield_c0", "gamma", "drag_rate", "internal_damping_time"]
)
def test_nonnegative_fields(field):
    for value in (-1e-9, np.nan, np.inf):
        with pytest.raises(ValueError, match=rf"{field} = .* is not usable; give a finite number >= 0"):
            Material(**{field: value})
    assert getattr(Material(**{field: 0}), field) == 0


def test_messages_name_unit_and_entry():
    with pytest.raises(ValueError, match=r"young_modulus = -5 \[Pa\]"):
        Material(young_modulus=-5)
    with pytest.raises(ValueError, match=r"thickness\[1\] = 0\.0 \[m\]"):
        Material(thickness=[1e-4, 0.0])
    with pytest.raises(
        ValueError, match=r"thickness has shape \(2, 2\); give a number or an array \(n,\) in m"
    ):
        Material(thickness=np.ones((2, 2)))
    with pytest.raises(ValueError, match=r"density has shape \(2,\); give a single number in kg/m\^3"):
        Material(density=[1.0, 2.0])
    with pytest.raises(ValueError, match="mass_lumping = 'lumpy' is unknown; give 'uniform' or 'area'"):
        Material(mass_lumping="lumpy")


def test_a_material_keeps_its_own_copy():
    h = np.full(20, 1e-4)
    material = Material(thickness=h)
    h[:] = -1
    assert (material.thickness == 1e-4).all()
    with pytest.raises(ValueError, match="read-only"):
        material.thickness[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        material.density = 1.0


def test_a_scene_differentiates_by_its_material():
    """Energies of all terms by every property, against central differences of scenes built anew."""
    setup = jc.radial(60, sweeps=5)
    x = jnp.asarray(setup.mesh.vertices) * 0.99 * jnp.array([1.0, 1.0, 1.2])
    walls = [wall.shape for wall in setup.scene.walls]
    own = {
        "young_modulus": 1e9,
        "thickness": 0.25e-3,
        "density": 1000.0,
        "yield_curvature": 50.0,
        "plastic_time": 1e-3,
        "drag_rate": 1e3,
        "internal_damping_time": 2e-7,
    }

    def numbers(values, like=None):
        made = jc.Material(**own | values)
        scene = jc.sheet(setup.mesh, made, walls=walls, contact=jc.SelfContact(), like=like)
        p = scene.bending.rest_curvature
        parts = scene.membrane.energy(x), scene.bending.energy(x, 0.1 + p), scene.walls[0].energy(x, 0.2)
        contact = scene.contact.stiffness * jnp.sum(scene.contact.density) * scene.contact.range**4
        rate = jnp.sum(scene.plasticity.rate(p + 1.5, p))
        rest = jnp.sum(scene.mass), jnp.sum(scene.drag.coefficient), jnp.sum(scene.damping.coefficient)
        scales = scene.velocity_scale, scene.reference_acceleration, scene.contact.calm
        return jnp.stack([*parts, contact, rate, *rest, *scales])

    with pytest.raises(ValueError, match="give it as `like`"):
        jax.jvp(lambda h: numbers({"thickness": h}), (1e-4,), (1.0,))
    for name, value in own.items():
        traced = jax.jvp(lambda v, name=name: numbers({name: v}, setup.scene), (value,), (value,))
        np.testing.assert_allclose(traced[0], numbers({}), rtol=1e-12)
        e = 1e-5
        expected = (numbers({name: value * (1 + e)}) - numbers({name: value * (1 - e)})) / (2 * e)
        assert np.all(np.abs(traced[1] - expected) <= 1e-6 * np.abs(expected) + 1e-9 * np.abs(traced[0]))
        assert np.any(expected != 0.0)
