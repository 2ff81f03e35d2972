"""Supports and loads that cannot be, and starts away from their supports: refused with node and cure."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import jaxcrumple as jc
from jaxcrumple.model.loads import AbstractMotion, dead_load

MESH = jc.rectangle(0.1, 0.1, 40, sweeps=3)
X, N, H = MESH.vertices, MESH.n_nodes, len(MESH.hinges)
MATERIAL = jc.Material()
LEFT = np.repeat((X[:, 0] < -0.04)[:, None], 3, axis=1)
REST = jc.LinearMotion(X, (0.0, 0.0, 0.0))
FIRST = int(np.flatnonzero(LEFT[:, 0])[0])


def scene(**options):
    return jc.sheet(MESH, options.pop("material", MATERIAL), **options)


class Late(AbstractMotion):
    """A motion that is not known from 0.05 s on."""

    position: Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t):
        return self.position * jnp.where(t < 0.05, 1.0, jnp.nan)


def constant(x, parameters, t):
    return jnp.sum(x[0]) * parameters


# --- Supports ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: jc.LinearMotion(np.where(LEFT, np.nan, X), (0, 0, 0)),
            r"^position of LinearMotion\[\d+, 0\] is nan; ",
        ),
        (
            lambda: jc.LinearMotion(X, (0, 0, np.inf)),
            r"^velocity of LinearMotion\[2\] is inf; it must be finite",
        ),
        (
            lambda: jc.LinearMotion(X, 1.0),
            r"^velocity of LinearMotion has shape \(\); it must be \(3,\) or \(40, 3\)",
        ),
        (
            lambda: jc.LinearMotion(X[0], (0, 0, 0)),
            r"^position of LinearMotion has shape \(3,\); it must be \(n, 3\)",
        ),
        (lambda: jc.LinearMotion(X, "1 m/s"), r"^'1 m/s' is neither a number nor an array of numbers"),
        (
            lambda: jc.Prescribed(LEFT.astype(int), REST),
            r"^the mask of Prescribed has type int64; it must be bool",
        ),
        (lambda: jc.Prescribed([0, 1, 2], REST), r"^the mask of Prescribed has type int64; it must be bool"),
        (
            lambda: jc.Prescribed(LEFT[:, 0], REST),
            r"^the mask of Prescribed has shape \(40,\); it must be \(n, 3\): ",
        ),
        (
            lambda: jc.Prescribed(LEFT[:9], REST),
            r"^the motion of Prescribed gives positions \(40, 3\); its mask is \(9, 3\)",
        ),
        (
            lambda: jc.Prescribed(LEFT, X),
            r"^the motion of Prescribed has type ndarray; it must be a LinearMotion",
        ),
        (
            lambda: jc.Prescribed(LEFT, REST, until=np.nan),
            r"^until of Prescribed is NaN; give the time of release in s",
        ),
        (
            lambda: jc.Prescribed(LEFT, REST, until=np.ones(40)),
            r"^until of Prescribed has shape \(40,\); it must be \(\) or \(40, 1\)",
        ),
        (
            lambda: scene(prescribed=[jc.Prescribed(LEFT, REST)]),
            r"^prescribed has type list; it must be one Prescribed\(mask, motion\): join",
        ),
        (
            lambda: scene(prescribed=jc.Prescribed(LEFT[:9], jc.LinearMotion(X[:9], (0, 0, 0)))),
            r"^the mask of prescribed has shape \(9, 3\); it must be \(40, 3\)",
        ),
    ],
)
def test_supports_that_cannot_be(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_mask_may_be_a_list():
    made = jc.Prescribed(LEFT.tolist(), REST)
    np.testing.assert_array_equal(made.mask, LEFT)


def test_a_start_that_disagrees_with_its_supports_is_refused_with_node_and_distance():
    away = jc.LinearMotion(X + [0.0, 3e-3, 4e-3] * LEFT, (0.0, 0.0, 0.0))
    made = scene(prescribed=jc.Prescribed(LEFT, away))
    message = rf"^node {FIRST} starts 0\.005 m from where its support holds it at t = 0 s; start from"
    with pytest.raises(ValueError, match=message):
        jc.initial_state(made, X)
    free = jc.initial_state(scene(), X)
    for go in (
        lambda: jc.simulate(made, free, 0.1),
        lambda: jc.relax(made, free, force_tolerance=1e-6),
        lambda: jc.integrate(made, free, 0.1, jc.integrator()),
        lambda: jc.tangent(made, free),
    ):
        with pytest.raises(ValueError, match=message):
            go()
    # The cure, also in part, and what is within rounding of the sheet's size.
    there = made.prescribed.position(jnp.asarray(X), 0.0)
    np.testing.assert_array_equal(jc.initial_state(made, there).x, there)
    jc.initial_state(made, there + 1e-11)
    with pytest.raises(ValueError, match=r"^node \d+ starts 1\.73e-09 m from where"):
        jc.initial_state(made, there + 1e-9)


def test_the_time_of_a_state_decides_where_supports_hold_it():
    moving = jc.Prescribed(LEFT, jc.LinearMotion(X, (0.0, 0.0, 0.01)), until=0.5)
    made, start = scene(prescribed=moving), jc.initial_state(scene(), X)
    for t, refused in ((0.0, False), (0.2, True), (0.7, False)):
        later = eqx.tree_at(lambda s: s.t, start, jnp.asarray(t))
        if not refused:
            jc.integrate(made, later, t, jc.integrator(scheme="explicit"))
            continue
        with pytest.raises(
            ValueError, match=r"starts 0\.002 m from where its support holds it at t = 0\.2 s"
        ):
            jc.simulate(made, later, 1.0)


def test_a_motion_that_is_not_finite_later_is_refused_before_the_run():
    made = scene(prescribed=jc.Prescribed(LEFT, Late(X)))
    message = rf"^the motion of prescribed gives node {FIRST} the position \[nan nan nan\] at t = 0\.1 s"
    with pytest.raises(ValueError, match=message):
        jc.simulate(made, jc.initial_state(made, X), [0.04, 0.1])
    lost = eqx.tree_at(lambda s: s.prescribed.motion.position, made, jnp.full(X.shape, jnp.nan))
    with pytest.raises(ValueError, match=rf"gives node {FIRST} the position \[nan nan nan\] at t = 0 s"):
        jc.initial_state(lost, X)


# --- Loads ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: jc.ElementEnergy(np.arange(3), constant),
            r"^nodes of ElementEnergy has shape \(3,\); it must be \(m, k\)",
        ),
        (
            lambda: jc.ElementEnergy([[0.0]], constant),
            r"^nodes of ElementEnergy = \[\[0\.0\]\] must be whole numbers",
        ),
        (
            lambda: jc.ElementEnergy([[-1]], constant),
            r"^nodes of ElementEnergy holds -1; nodes are numbered from 0 on",
        ),
        (
            lambda: jc.ElementEnergy([[0, 1], [2, 2]], constant),
            r"^element 1 of ElementEnergy has a node twice: \[2 2\]",
        ),
        (
            lambda: jc.ElementEnergy([[0], [1]], constant, np.ones(3)),
            r"^parameters of ElementEnergy has shape \(3,\); its first axis must be the 2",
        ),
        (
            lambda: jc.ElementEnergy([[0]], 1.0),
            r"^the function of ElementEnergy is 1\.0; it must be function\(x, parameters, t\)",
        ),
        (
            lambda: scene(extra=[jc.ElementEnergy([[0], [40]], constant, np.ones(2))]),
            r"^element 1 of extra 0 has node 40; the sheet has nodes 0 to 39",
        ),
        (
            lambda: scene(extra=jc.ElementEnergy([[0]], constant, np.ones(1))),
            r"^extra = a ElementEnergy must be a list of energies",
        ),
        (
            lambda: scene(extra=[jc.ElementEnergy([[0]], lambda x, p, t: x[0])]),
            r"^the function of extra 0 returns shape \(3,\); it must be one energy in J",
        ),
        (
            lambda: scene(extra=[jc.ElementEnergy([[0]], lambda x: 0.0)]),
            r"^the function of extra 0 cannot be computed: ",
        ),
        (
            lambda: dead_load([[0]], [[0, 0, 1.0]], 1.0),
            r"^nodes of a dead load has shape \(1, 1\); it must be \(1,\)",
        ),
        (
            lambda: dead_load([0, 1], [0, 0, 1.0], 1.0),
            r"^force of a dead load has shape \(3,\); it must be \(2, 3\)",
        ),
        (
            lambda: dead_load([0], [[0, 0, np.nan]], 1.0),
            r"^force of a dead load\[0, 2\] is nan; it must be finite",
        ),
        (lambda: dead_load([0], [[0, 0, 1.0]], 0.0), r"^ramp = 0\.0 s of a dead load must be positive"),
        (
            lambda: dead_load([True], [[0, 0, 1.0]], 1.0),
            r"^nodes of a dead load = \[True\] must be whole numbers",
        ),
        (
            lambda: scene(extra=[dead_load([40], [[0, 0, 1.0]], 1.0)]),
            r"^element 0 of extra 0 has node 40; the sheet has",
        ),
        (lambda: jc.Gravity((0, 0), np.ones(3)), r"^g of Gravity has shape \(2,\); it must be \(3,\)"),
    ],
)
def test_loads_that_cannot_be(make, message):
    with pytest.raises(ValueError, match=message):
        make()
