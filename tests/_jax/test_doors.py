"""Walls, flow rules, scenes and arguments that cannot be: refused at the first door that sees them."""

import functools
import os
import pickle
import subprocess
import sys
import textwrap

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import jaxcrumple as jc
from jaxcrumple.model.loads import dead_load

MESH = jc.rectangle(0.1, 0.1, 40, sweeps=3)
X, N, H = MESH.vertices, MESH.n_nodes, len(MESH.hinges)
MATERIAL = jc.Material()


def scene(**options):
    return jc.sheet(MESH, options.pop("material", MATERIAL), **options)


# --- Walls, flow rules and materials -------------------------------------------------------------


ORIGIN, UP = np.zeros(3), np.array([0.0, 0.0, 1.0])


class Lukewarm(jc.AbstractFlowRule):
    """A rule with as many numbers as it pleases."""

    time: Array

    def rate(self, c, p):
        return (c - p) / self.time


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jc.Sphere([0, 0], 1.0), r"^center of Sphere has shape \(2,\); it must be \(3,\)"),
        (lambda: jc.Sphere(ORIGIN, [1.0, 2.0]), r"^start of Ramp has shape \(2,\); it must be \(\)"),
        (lambda: jc.Sphere(ORIGIN, "5 cm"), r"^'5 cm' is neither a number nor an array of numbers"),
        (
            lambda: jc.Cylinder(ORIGIN, 2 * UP, 1.0),
            r"^axis of Cylinder has length 2; it must be a unit vector",
        ),
        (lambda: jc.Plane(ORIGIN, 0.0), r"^normal of Plane has length 0; it must be a unit vector"),
        (lambda: jc.Cone(ORIGIN, UP, 45.0, 0.0), r"^half_angle = 45 rad of Cone must lie between 0 and pi/2"),
        (lambda: jc.Ball(ORIGIN, UP, -0.1, 0.0), r"^radius of Ball is -0\.1; it must be positive"),
        (
            lambda: jc.HoledPlate(ORIGIN, UP, 0.1, -0.1),
            r"^edge of HoledPlate is -0\.1; it must be zero or positive",
        ),
        (
            lambda: jc.PiecewiseLinear([0, 2, 1], [0, 0, 0]),
            r"^times of PiecewiseLinear must be at least one time in s",
        ),
        (
            lambda: jc.PiecewiseLinear([0, 1], [0, 0, 0]),
            r"^values of PiecewiseLinear has shape \(3,\); it must be \(2,\)",
        ),
        (
            lambda: scene(walls=[jc.Wall(jc.Sphere(ORIGIN, 0.1), 1.0, 1e-3)]),
            r"^stiffness of wall 0 \(Wall\) has shape \(\); it must be \(40,\)",
        ),
        (
            lambda: scene(walls=[jc.Wall(jc.Sphere(ORIGIN, 0.1), -np.ones(N), 1e-3)]),
            r"^stiffness of wall 0 \(Wall\)\[0\] is -1\.0; it must be zero or positive",
        ),
        (
            lambda: scene(walls=[jc.Wall(jc.Sphere(ORIGIN, 0.1), np.ones(N), 0.0)]),
            r"^range of wall 0 \(Wall\) is 0\.0; it must be positive",
        ),
        (
            lambda: scene(walls=[jc.Sphere(ORIGIN, lambda t: jnp.ones(2))]),
            r"^the gap of wall 0 \(Sphere\) has shape \(2,\); it must be one number",
        ),
        (lambda: scene(material="Mylar"), r"^material = 'Mylar' must be a Material"),
        (lambda: jc.sheet(X, MATERIAL), r"^mesh = a ndarray must be a Mesh"),
        (lambda: scene(plasticity="perfect"), r"^plasticity has type str; it must be an AbstractFlowRule"),
        (
            lambda: scene(plasticity=Lukewarm(jnp.ones((H, 1)))),
            rf"^the rate of plasticity has shape \({H}, {H}\); it must be \({H},\), a number for each hinge",
        ),
        (
            lambda: jc.SmoothstepFlow(np.ones(H), -1.0, 0.0),
            r"^time of SmoothstepFlow is -1\.0; it must be positive",
        ),
        (
            lambda: jc.SmoothstepFlow(2.5, 1.0, 0.0),
            r"^yield_threshold of SmoothstepFlow reaches 2\.5; it must be below 2",
        ),
        (lambda: scene(like=MESH), r"^like has type Mesh; it must be a Scene"),
        (
            lambda: scene(like=scene(extra=[dead_load([0], [[0, 0, 1.0]], 1.0)])),
            r"has an `extra` with other nodes; leave `like` out",
        ),
    ],
)
def test_walls_and_rules_that_cannot_be(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_like_lends_contact_only_to_the_same_options():
    barrier = scene(contact=jc.SelfContact("barrier", range=6e-3, level=10))
    same = scene(contact=jc.SelfContact("barrier", range=6e-3), like=barrier)
    assert len(same.contact.share) == len(barrier.contact.share)
    for other in (jc.SelfContact(range=6e-3), jc.SelfContact("barrier", range=6e-3, level=11)):
        with pytest.raises(ValueError, match=r"has contact by barrier of level 10, not by [\w-]+ of level"):
            scene(contact=other, like=barrier)


# --- Scenes whose numbers were replaced ----------------------------------------------------------


@functools.cache
def surrounded():
    """A scene with walls and gravity and its start."""
    made = scene(gravity=(0.0, 0.0, -9.81), walls=[jc.Sphere(ORIGIN, 0.1)])
    return made, jc.initial_state(made, X)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (lambda s: s.mass, -np.ones(N), r"^scene\.mass\[0\] is -1\.0; it must be positive"),
        (lambda s: s.membrane.stiffness, np.array(np.nan), r"^scene\.membrane\.stiffness is nan; it must be"),
        (
            lambda s: s.membrane.rest_length,
            np.zeros(9),
            r"^scene\.membrane\.rest_length\[0\] is 0\.0; it must",
        ),
        (
            lambda s: s.bending.rest_curvature,
            np.full(H, np.inf),
            r"^scene\.bending\.rest_curvature\[0\] is inf",
        ),
        (
            lambda s: s.drag.coefficient,
            -np.ones(N),
            r"^scene\.drag\.coefficient\[0\] is -1\.0; it must be zero",
        ),
        (lambda s: s.gravity.g, np.array([0, np.nan, 0]), r"^gravity = .* must be finite"),
        (lambda s: s.walls[0].shape.radius.start, np.array(np.nan), r"^wall 0 \(Wall\) has NaN among its"),
    ],
)
def test_replaced_numbers_that_cannot_be(where, value, message):
    whole, start = surrounded()
    broken = eqx.tree_at(where, whole, jnp.asarray(value))
    for go in (lambda: jc.initial_state(broken, X), lambda: jc.simulate(broken, start, 0.1)):
        with pytest.raises(ValueError, match=message):
            go()


# --- Functions -----------------------------------------------------------------------------------


@functools.cache
def plain():
    """A scene without surroundings and its start."""
    made = scene()
    return made, jc.initial_state(made, X)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda s, a: jc.initial_state(MESH, X),
            r"^scene has type Mesh; it must be a Scene from jaxcrumple\.sheet",
        ),
        (lambda s, a: jc.initial_state(s, "x"), r"^'x' is neither a number nor an array of numbers"),
        (lambda s, a: jc.initial_state(s, X, window=1.5), r"^window = 1\.5 must be at least 1 step"),
        (lambda s, a: jc.simulate(MESH, a, 0.1), r"^scene has type Mesh"),
        (
            lambda s, a: jc.simulate(s, X, 0.1),
            r"^state has type ndarray; it must be a State from initial_state",
        ),
        (lambda s, a: jc.simulate(s, a, 0.1, max_attempts=-1), r"^max_attempts = -1 must be zero or more"),
        (
            lambda s, a: jc.simulate(s, a, 0.1, max_seconds=np.nan),
            r"^max_seconds = nan must be zero or more",
        ),
        (lambda s, a: jc.simulate(s, a, 0.1, first_frame=0.5), r"^first_frame = 0\.5 must be a whole number"),
        (
            lambda s, a: jc.integrate(s, a, 0.1, "hybrid"),
            r"^solver = 'hybrid' must come from jaxcrumple\.integrator",
        ),
        (
            lambda s, a: jc.integrate(s, a, [0.1], jc.integrator()),
            r"^t_stop has shape \(1,\); it must be \(\)",
        ),
        (
            lambda s, a: jc.relax(s, a, force_tolerance="1e-6"),
            r"^force_tolerance = '1e-6' N must be positive",
        ),
        (
            lambda s, a: jc.relax(s, a, force_tolerance=1e-6, max_iterations=-1),
            r"^max_iterations = -1 must be",
        ),
        (lambda s, a: jc.energies(s, X, X, X, 0.0), rf"^p has shape \(40, 3\); it must be \({H},\)"),
        (lambda s, a: jc.force(s, X, X, None, [0.0]), r"^t has shape \(1,\); it must be \(\)"),
        (
            lambda s, a: jc.potential_energy(s, X[1:], None, 0.0),
            r"^x has shape \(39, 3\); it must be \(40, 3\)",
        ),
        (
            lambda s, a: jc.elastic_tangent(s, X[1:], None, 0.0),
            r"^x has shape \(39, 3\); it must be \(40, 3\)",
        ),
        (lambda s, a: jc.tangent(s, X), r"^state has type ndarray; it must be a State from initial_state"),
        (lambda s, a: jc.mass_matrix(MESH), r"^scene has type Mesh; it must be a Scene"),
        (lambda s, a: jc.with_contacts(MESH, X), r"^scene has type Mesh; it must be a Scene"),
        (
            lambda s, a: jc.linear_solve("auto", s, X, X),
            r"^pattern has type Scene; it must be scene\.sparsity",
        ),
        (
            lambda s, a: jc.replay(s, a),
            r"^record must be the record of simulate\(\.\.\., record=True\), not State",
        ),
        (lambda s, a: jc.stack_records(a), r"^records = .* must be a list of one or more records"),
        (lambda s, a: jc.frame_times("1 s", 3), r"^t_end = '1 s' s must be a positive time"),
        (lambda s, a: jc.frame_times(1.0, 2.5), r"^frames = 2\.5 must be at least 1, a whole number"),
        (lambda s, a: jc.integrator("small"), r"^rtol = 'small' must be a number between"),
        (lambda s, a: jc.integrator(rho_infinity="0"), r"^rho_infinity = '0' must lie between 0 and 1"),
        (
            lambda s, a: jc.energy_drop(s, X, X),
            r"^state has type ndarray; it must be a State from initial_state",
        ),
        (lambda s, a: jc.relaxed_drop(s, 0.1, 0.2), r"^setup has type Scene; it must be a Setup"),
    ],
)
def test_arguments_that_cannot_be(call, message):
    with pytest.raises(ValueError, match=message):
        call(*plain())


# --- Precision -----------------------------------------------------------------------------------

SINGLE = """
    import pickle, sys
    import numpy as np
    import jaxcrumple as jc

    with open(sys.argv[1], "rb") as file:
        mesh, scene, state, record = pickle.load(file)
    x, solver = mesh.vertices, None
    calls = {
        "sheet": lambda: jc.sheet(mesh, jc.Material()),
        "initial_state": lambda: jc.initial_state(scene, x),
        "simulate": lambda: jc.simulate(scene, state, 0.1),
        "integrate": lambda: jc.integrate(scene, state, 0.1, None),
        "integrator": lambda: jc.integrator(),
        "relax": lambda: jc.relax(scene, state, force_tolerance=1e-6),
        "energies": lambda: jc.energies(scene, x, x, None, 0.0),
        "potential_energy": lambda: jc.potential_energy(scene, x, None, 0.0),
        "force": lambda: jc.force(scene, x, x, None, 0.0),
        "elastic_tangent": lambda: jc.elastic_tangent(scene, x, None, 0.0),
        "tangent": lambda: jc.tangent(scene, state),
        "mass_matrix": lambda: jc.mass_matrix(scene),
        "linear_solve": lambda: jc.linear_solve("two-level", scene.sparsity, x, x),
        "with_contacts": lambda: jc.with_contacts(scene, x),
        "contact_report": lambda: jc.contact_report(scene, x),
        "replay": lambda: jc.replay(scene, record),
        "stack_records": lambda: jc.stack_records([record]),
        "fit": lambda: jc.fit(None, {}),
        "sweep": lambda: jc.sweep("arch", {"rise": [1e-3]}, 0.1),
        "energy_drop": lambda: jc.energy_drop(scene, state, state),
        "load_checkpoint": lambda: jc.io.load_checkpoint("nowhere.npz", state),
        "arch": lambda: jc.arch(60),
        "fold": lambda: jc.fold(60),
        "custom": lambda: jc.custom(60),
    }
    for name, call in calls.items():
        try:
            call()
            print(name, "went through")
        except ValueError as error:
            if "jaxcrumple needs float64" not in str(error) or "jax_enable_x64" not in str(error):
                print(name, error)
        except Exception as error:
            print(name, repr(error))
    print("all asked")
"""


def test_every_door_asks_for_double_precision(tmp_path):
    """Also where the scene was made and pickled by a process that has it."""
    made, start = plain()
    path = tmp_path / "scene.pkl"
    path.write_bytes(pickle.dumps((MESH, made, start, None)))
    environment = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(SINGLE), str(path)],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout == "all asked\n"
