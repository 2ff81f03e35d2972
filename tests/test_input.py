"""Input that cannot be: one ValueError that names cause and cure, before any work."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple import (
    LinearMotion,
    Material,
    Prescribed,
    SelfContact,
    Sphere,
    Switch,
    elastic_tangent,
    energies,
    fold_angle,
    force,
    initial_state,
    integrator,
    linear_solve,
    measure,
    relax,
    sheet,
    simulate,
    with_contacts,
)
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.solvers.linear.registry import direct_available

MESH = rectangle(0.1, 0.1, 40, sweeps=3)
MATERIAL = Material()
SPHERE = Sphere(jnp.zeros(3), 0.1)


def scene(**options):
    return sheet(MESH, options.pop("material", MATERIAL), **options)


def state(**options):
    return initial_state(scene(**options), MESH.vertices)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"up": np.nan}, "up = nan of a Switch must be zero or positive"),
        ({"dwell": -1.0}, r"dwell = -1\.0 of a Switch"),
        ({"up": 1e-4, "down": 1e-3}, r"down = 0\.001 lies above up = 0\.0001"),
        ({"measure": "speed"}, "'speed' is unknown; choose one of displacement, acceleration"),
    ],
)
def test_switches(options, message):
    with pytest.raises(ValueError, match=message):
        Switch(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rtol": "1e-4"}, "rtol = '1e-4' must be a number between 0 and 1"),
        ({"rtol": np.nan}, "rtol = nan must be a number"),
        ({"rtol": -1e-4}, "rtol = -0.0001 must be"),
        ({"max_step": "1"}, "max_step = '1' s must be positive"),
        ({"scheme": "hybird"}, "'hybird' is unknown; choose one of hybrid, dynamic"),
        ({"linear": 3}, "linear solver 3 is unknown; choose one of auto, direct"),
        ({"switch": {"up": 1.0}}, "must be a jaxcrumple.Switch"),
    ],
)
def test_solvers(options, message):
    with pytest.raises(ValueError, match=message):
        integrator(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gravity": 9.81}, "must be three accelerations in m/s2, e.g."),
        ({"gravity": (0, 0, np.nan)}, "must be finite"),
        ({"walls": Sphere(np.zeros(3), 0.1)}, r"must be a list of shapes or walls"),
        ({"walls": [Sphere(np.zeros(3), np.nan)]}, r"wall 0 \(Sphere\) has NaN among its numbers"),
        ({"walls": [0.1]}, r"must be a list of shapes or walls"),
        ({"damping": "none"}, "choose 'central' or 'paper'"),
        (
            {"prescribed": Prescribed(np.ones((3, 3), bool), LinearMotion(np.zeros((3, 3)), np.zeros(3)))},
            r"the mask of prescribed has shape \(3, 3\); it must be \(40, 3\)",
        ),
    ],
)
def test_surroundings(options, message):
    with pytest.raises(ValueError, match=message):
        scene(**options)


def test_energies_and_forces_take_arrays_of_numpy_and_refuse_other_shapes():
    x, p = np.array(MESH.vertices), np.zeros(len(MESH.hinges))
    made = with_contacts(scene(contact=SelfContact()), x)
    for compute in (energies, force):
        given = (x, 0 * x, p)
        own, its = (compute(made, *arrays, 0.0) for arrays in (given, map(jnp.asarray, given)))
        jax.tree.map(np.testing.assert_array_equal, own, its)
        with pytest.raises(ValueError, match=r"x has shape \(39, 3\); it must be \(40, 3\)"):
            compute(made, x[1:], x, p, 0.0)


def test_states_of_another_scene():
    elastic = Material(yield_curvature=None)
    other = rectangle(0.1, 0.1, 50, sweeps=3)
    stranger = initial_state(sheet(other, MATERIAL), other.vertices)
    with pytest.raises(
        ValueError, match=r"the state has positions \(50, 3\), the scene 40 nodes; start from"
    ):
        simulate(scene(), stranger, 0.1)
    with pytest.raises(ValueError, match="the state is of an elastic scene, the scene is a plastic one"):
        simulate(scene(), state(material=elastic), 0.1)
    with pytest.raises(ValueError, match="the state is of a plastic scene, the scene is an elastic one"):
        relax(scene(material=elastic), state(), force_tolerance=1e-6)
    turned = eqx.tree_at(lambda s: s.p, state(), jnp.zeros(3))
    with pytest.raises(ValueError, match="the state has 3 hinges, the scene"):
        simulate(scene(), turned, 0.1)
    with pytest.raises(ValueError, match="window = 0 must be at least 1"):
        initial_state(scene(), MESH.vertices, window=0)


@pytest.mark.parametrize("times", [0.0, -1.0, np.nan, np.inf, [0.2, 0.1], [], [[0.1, 0.2]]])
def test_times(times):
    with pytest.raises(ValueError, match="frame times in seconds"):
        simulate(scene(), state(), times)


def test_times_that_have_passed():
    later = eqx.tree_at(lambda s: s.t, state(), jnp.asarray(0.05))
    with pytest.raises(ValueError, match=r"time 0\.01 s lies before the state's, 0\.05 s"):
        simulate(scene(), later, [0.01, 0.1])


def test_what_is_no_solver():
    with pytest.raises(ValueError, match=r"solver = 'hybrid' must come from jaxcrumple\.integrator"):
        simulate(scene(), state(), 0.1, solver="hybrid")


def test_linear_systems():
    made = scene()
    values = elastic_tangent(
        made, jnp.asarray(MESH.vertices), made.rest_curvature_of(None), jnp.asarray(0.0), 1e4
    )
    rhs = jnp.ones(3 * made.n_nodes)
    with pytest.raises(ValueError, match=r"rhs \(5,\) do not fit the pattern: \(\d+,\) and \(120,\)"):
        linear_solve("two-level", made.sparsity, values, rhs[:5])
    with pytest.raises(ValueError, match="linear solver 'lu' is unknown"):
        linear_solve("lu", made.sparsity, values, rhs)
    if direct_available():
        with pytest.raises(ValueError, match=r"cannot be batched by vmap \(here over 2 lanes\)"):
            jax.vmap(lambda v: linear_solve("direct", made.sparsity, v, rhs))(jnp.stack([values, values]))


def test_a_wall_that_stands_still_is_given_by_a_number():
    moving = Sphere(np.zeros(3), lambda t: jnp.asarray(0.06))
    still, point = Sphere(np.zeros(3), 0.06), jnp.array([0.03, 0.0, 0.0])
    assert float(still.gap(point, jnp.asarray(2.0))) == float(moving.gap(point, jnp.asarray(2.0)))


def test_whole_numbers_compile_to_the_same_program():
    """An int where a float is usual must not cost a compilation of a minute."""
    pairs = [
        (integrator(1e-4, max_step=1), integrator(1e-4, max_step=1.5)),
        (Switch(up=1, down=0, dwell=2), Switch(up=1.5, down=0.5, dwell=2.5)),
        (Sphere([0, 0, 0], 1), Sphere([0.0, 0.5, 0.0], 1.5)),
    ]
    for whole, part in pairs:
        assert jax.tree.structure(whole) == jax.tree.structure(part)
        leaves = [jax.tree.leaves(eqx.filter(tree, eqx.is_array)) for tree in (whole, part)]
        for a, b in zip(*leaves, strict=True):
            assert (a.dtype, a.weak_type) == (b.dtype, b.weak_type)


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        ("penalty", r"contact = 'penalty' must be SelfContact\(\.\.\.\), or None"),
        (SelfContact(range="1e-3"), "contact range = '1e-3' m must be a positive length"),
        (SelfContact(range=[1e-3]), r"contact range = \[0.001\] m must be a positive length"),
        (SelfContact(level=1.5), "contact level = 1.5 must be a whole number from 0 on; leave it out for"),
        (SelfContact(level=True), "contact level = True must be a whole number"),
    ],
)
def test_contact_that_is_none_is_refused(contact, message):
    with pytest.raises(ValueError, match=message):
        sheet(MESH, Material(), contact=contact)


def test_a_level_that_leaves_holes_in_the_sheet_is_pointed_out():
    # Between three sites a distance s apart there is a point s / sqrt(3) from each.
    longest = MESH.edge_length.max()
    for share, warns in ((0.99, True), (1.01, False)):
        options = SelfContact(range=share * longest / (2 * np.sqrt(3)), level=1)
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            sheet(MESH, Material(), contact=options)
        ours = [str(w.message) for w in seen if issubclass(w.category, UserWarning)]
        assert [text[:45] for text in ours] == ["contact level = 1 leaves sites so far apart t"] * warns


def test_positions_that_are_none_are_refused_before_a_search():
    made, x = sheet(MESH, Material(), contact=SelfContact()), MESH.vertices
    with pytest.raises(ValueError, match=r"x has shape \(39, 3\); it must be \(40, 3\)"):
        with_contacts(made, x[1:])
    with pytest.raises(ValueError, match=r"x of node 3 is \[nan nan nan\]; it must be finite"):
        with_contacts(made, np.where(np.arange(40)[:, None] == 3, np.nan, x))
    with pytest.raises(ValueError, match="call it outside jit, grad and vmap"):
        jax.jit(lambda x: with_contacts(made, x).mass)(jnp.asarray(x))


def test_states_of_phantoms_and_of_sheets_with_contact_are_told_apart():
    made = [sheet(MESH, Material(), contact=contact) for contact in (None, SelfContact())]
    states = [initial_state(scene, MESH.vertices) for scene in made]
    with pytest.raises(ValueError, match="the state is of a phantom scene, the scene is a self-avoiding one"):
        simulate(made[1], states[0], 0.1)
    with pytest.raises(ValueError, match="the state is of a self-avoiding scene, the scene is a phantom one"):
        simulate(made[0], states[1], 0.1)
    lost = eqx.tree_at(lambda s: s.x, states[1], states[1].x.at[7].set(jnp.nan))
    with pytest.raises(ValueError, match="the state's x of node 7 is"):
        simulate(made[1], lost, 0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fold_angle(MESH, jnp.zeros((20, 3))), r"x has shape \(20, 3\); it must be \(40, 3\)"),
        (lambda: measure.thick_section(MESH, MESH.vertices, -1.0, (0, 0, 0), (1, 0, 0)), "must be positive"),
        (lambda: measure.face_stretch_density(MESH, MESH.vertices, np.ones(3)), "ks has shape"),
        (lambda: measure.face_bending_density(MESH, MESH.vertices, 0.0, 1.0), r"p has shape \(\)"),
        (lambda: measure.wall_force(scene(walls=[SPHERE]).walls[0], np.zeros((3, 3)), 0.0), "x has shape"),
        (lambda: measure.area_density(-1.0, 2.0), r"xi is -1\.0; it must be positive"),
        (lambda: measure.area_cdf(1.0, 0.0), r"a is 0\.0; it must be positive"),
        (lambda: measure.folded_hinges(MESH, MESH.vertices, 200.0), r"limit_deg = 200\.0"),
    ],
)
def test_measures(call, message):
    with pytest.raises(ValueError, match=message):
        call()
