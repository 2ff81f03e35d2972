"""Stacked records: each lane has the replay and the gradient of its own record; recorders follow lanes."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import bound
from folded import folded, strip

import jaxcrumple as jc
from jaxcrumple.geometry.hinge import curvature
from jaxcrumple.replays.record import STRETCH, StepRecorder
from jaxcrumple.replays.stack import _padded, _rounded, _sizes
from jaxcrumple.state import EXPLICIT, IMPLICIT

TIMES = [0.05, 0.1]


def lane(tree, index):
    """One lane of stacked arrays."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def integrator(scheme):
    """An integrator with a linear solver that batches."""
    return jc.integrator(1e-2, scheme=scheme, linear="two-level")


def recorded(scene, x, times=TIMES, scheme="dynamic", v=None):
    """The record of a run."""
    start = jc.initial_state(scene, x, v)
    solution = jc.simulate(scene, start, times, solver=integrator(scheme), record=True)
    assert solution.result == "success"
    return solution.record


def check_gradients(loss, parameters, records, rtol):
    """Compare the gradients of all lanes with those of the records themselves, which come one by one."""
    stacked = jc.stack_records(records)
    lanes = jax.jit(jax.vmap(jax.value_and_grad(loss)))(parameters, stacked)
    alone = jax.jit(jax.value_and_grad(loss))
    for index, record in enumerate(records):
        value, gradient = alone(parameters[index], record)
        assert np.any(gradient != 0)
        np.testing.assert_allclose(lanes[0][index], value, rtol=rtol)
        np.testing.assert_allclose(lanes[1][index], gradient, rtol=rtol)
    return stacked


# --- Lanes without contact -----------------------------------------------------------------------

SETUP = jc.radial(80, seed=5, sweeps=5, contact=None)
# Yield curvature in 1/m and thickness in m.
LANES = [(yields, thickness) for yields in (2.0, 4.0, 8.0, 16.0) for thickness in (0.2e-3, 0.3e-3)]


def material(values):
    return replace(SETUP.material, yield_curvature=values[0], thickness=values[1])


@pytest.fixture(scope="module")
def lanes():
    """Parameters of eight lanes, and their records, of two or three stretches of steps."""
    ends = np.linspace(0.3, 1.0, len(LANES))[:, None] * TIMES
    records = [
        recorded(SETUP.made_of(material(values)), SETUP.x, times)
        for values, times in zip(LANES, ends, strict=True)
    ]
    assert {-(-int(record.steps.valid.sum()) // STRETCH) for record in records} == {2, 3}
    return jnp.asarray(LANES), records


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"solve": False, "checkpoint": True}], ids=["solved", "taken"])
def test_gradients_of_lanes_are_those_of_single_runs(lanes, options):
    """By yield curvature and thickness; seen are 5e-11, from linear systems solved to 1e-12."""
    parameters, records = lanes
    weights = jnp.asarray(np.random.default_rng(0).normal(size=SETUP.x.shape))

    def loss(values, record):
        walls = [wall.shape for wall in record.scene.walls]
        scene = jc.sheet(SETUP.mesh, material(values), walls=walls, like=record.scene)
        return jnp.sum(weights * jc.replay(scene, record, **options).x[-1])

    check_gradients(loss, parameters, records, 1e-9)


# --- Other stages and lists ----------------------------------------------------------------------


def check_replay(record, padded):
    """Compare the replays of a record and of the padded one; they do not differ by a bit."""
    own, other = (eqx.filter_jit(jc.replay)(r.scene, r) for r in (record, padded))
    assert np.all(np.isfinite(own.x))
    jax.tree.map(np.testing.assert_array_equal, other, own)


def of_stiffness(factor, record):
    """A measure of all frames as a function of a relative change of the bending stiffness."""
    stiffness = factor * record.scene.bending.stiffness
    frames = jc.replay(eqx.tree_at(lambda s: s.bending.stiffness, record.scene, stiffness), record)
    return jnp.sum(jnp.cumsum(frames.x.reshape(-1)) ** 2) + 1e-6 * jnp.sum(frames.v**2)


@pytest.mark.slow
def test_lanes_may_have_other_stages():
    """A run without explicit steps beside one that has both kinds."""
    setup = jc.radial(40, seed=5, sweeps=5, contact=None)
    records = [recorded(setup.scene, setup.x, times, scheme="hybrid") for times in ([0.01, 0.02], [0.1, 0.2])]
    assert [record.stages for record in records] == [(IMPLICIT,), (IMPLICIT, EXPLICIT)]
    stacked = check_gradients(of_stiffness, jnp.ones(2), records, 1e-9)
    assert stacked.stages == (IMPLICIT, EXPLICIT)
    for index, record in enumerate(records):
        check_replay(record, lane(stacked, index))


RANGE, COLUMNS = 0.5e-3, (4, 4)


def pressed(speed):
    """A strip with a fold at rest that a wall presses together at `speed` m/s: scene and positions."""
    mesh = strip(0.9 * RANGE, COLUMNS, 3)
    x = folded(mesh, 0.9 * RANGE, COLUMNS)
    scene = jc.sheet(
        mesh,
        jc.Material(thickness=0.2e-3, yield_curvature=5.0),
        walls=[jc.Plane((0.0, 0.0, -1.0), jc.Ramp(-0.8 * RANGE, speed))],
        contact=jc.SelfContact(range=RANGE),
    )
    bent = curvature(scene.bending.hinges(jnp.asarray(x)).theta)
    return eqx.tree_at(lambda s: s.bending.rest_curvature, scene, bent), x


def with_longer_lists(record):
    """The record with room for twice as many pairs of each kind."""
    lists = record.lists
    triangles = jnp.pad(lists.triangles, ((0, 0), (0, lists.triangles.shape[1]), (0, 0)))
    capacity = type(lists.capacity)(*(2 * size for size in lists.capacity))
    return replace(record, lists=replace(lists, triangles=triangles, capacity=capacity))


@pytest.mark.slow
def test_lanes_may_have_longer_contact_lists():
    """Layers that walls press at different speeds."""
    records = [recorded(*pressed(speed), [0.5e-3, 1e-3], "quasistatic") for speed in (0.05, 0.1)]
    for record in records:
        last = record.steps.x[-1, -1]
        assert int(bound(jc.with_contacts(record.scene, last)).gaps(last)[1]) > 0
    records[1] = with_longer_lists(records[1])
    stacked = check_gradients(of_stiffness, jnp.ones(2), records, 1e-6)
    assert stacked.lists.triangles.shape[2] == 2 * records[0].lists.triangles.shape[1]
    check_replay(records[0], lane(stacked, 0))


@pytest.mark.slow
def test_lanes_of_a_batch_record_their_contacts():
    """Each can be replayed as it went, and their records can be stacked."""
    scenes, x = zip(*map(pressed, (0.05, 0.1)), strict=True)
    states = list(map(jc.initial_state, scenes, x))
    options = {"solver": integrator("quasistatic"), "record": True}
    found = jc.simulate_batch(list(scenes), states, [0.5e-3, 1e-3], **options)
    for scene, lane in zip(scenes, found, strict=True):
        assert lane.history["contact"].iloc[-1] > 0
        np.testing.assert_allclose(jc.replay(scene, lane.record).x, lane.x, rtol=0, atol=1e-9)
    assert len(jc.stack_records([lane.record for lane in found]).t) == 2


def test_sizes_of_batches_are_few_and_close():
    sizes = np.array([_rounded(size) for size in range(1, 1001)])
    wanted = np.arange(1, 1001)
    assert np.all(sizes >= wanted) and np.all(sizes <= 1.25 * wanted)
    assert len(set(sizes.tolist())) < 40


# --- Records that do not fit together ------------------------------------------------------------


def sheet(columns=3, **options):
    """A sheet that falls in air: scene and positions."""
    mesh = jc.hexagonal(columns, 2, 5e-3)
    material = jc.Material(yield_curvature=None)
    return jc.sheet(mesh, material, **{"gravity": (0.0, 0.0, -9.81), **options}), mesh.vertices


@pytest.fixture(scope="module")
def record():
    return recorded(*sheet())


@pytest.mark.parametrize("stretches", [1, 6])
def test_stretches_without_steps_change_nothing(record, stretches):
    """Four are in the record, and one is used."""
    padded = _padded(record, _sizes([record])._replace(stretches=stretches))
    assert padded.steps.valid.shape[0] == stretches and record.steps.valid.shape[0] == 4
    check_replay(record, padded)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: [], r"^records = \[\] must be a list of one or more records"),
        (lambda r: r, r"^records = .* must be a list of one or more records"),
        (lambda r: [r, None], r"^record 1 is None; it must be the record of simulate\(\.\.\., record=True\)"),
        (lambda r: [r, jc.stack_records([r, r, r])], r"^record 1 is a stack of 3; give the records one"),
        (
            lambda r: [r, replace(r, linear=jc.integrator(linear="direct").implicit.linear)],
            r"^record 1 is of a run with the direct solver.*linear='two-level'",
        ),
        (
            lambda r: [r, replace(r, t=r.t[:1])],
            r"^records 0 and 1 have 2 and 1 frames; give all runs as many times",
        ),
        (
            lambda r: [r, replace(r, explicit=jc.integrator().explicit)],
            r"^records 0 and 1 are of different schemes or linear solvers",
        ),
        (
            lambda r: [r, r, replace(r, scene=sheet(4)[0])],
            r"^records 0 and 2 are of different kinds: scene\.mass has sizes \(9,\) and \(12,\); stack runs",
        ),
        (
            lambda r: [r, replace(r, scene=sheet(gravity=None)[0])],
            r"scene\.gravity\.g has sizes \(3,\) and None",
        ),
    ],
)
def test_records_that_do_not_fit_are_refused(record, change, message):
    with pytest.raises(ValueError, match=message):
        jc.stack_records(change(record))


def test_a_stack_is_replayed_by_lanes_only(record):
    stacked = jc.stack_records([record, record])
    with pytest.raises(ValueError, match=r"^the record is a stack of 2 records: call replay in"):
        jc.replay(record.scene, stacked)
    with pytest.raises(ValueError, match="records on the host: call it outside jit"):
        jax.jit(lambda one: jc.stack_records([one]).t)(record)


# --- Recorders of lanes --------------------------------------------------------------------------


@pytest.mark.parametrize("mapped", ["vmap", "map"])
def test_a_recorder_follows_its_lane(mapped):
    """Of a batch that stops at the frames, with trails that are full after three steps."""
    scene, x = sheet()
    speeds = [jnp.full(x.shape, speed) for speed in (0.0, 0.3)]
    starts = [jc.initial_state(scene, x, v) for v in speeds]
    recorders = [StepRecorder(start, integrator("dynamic")) for start in starts]
    solver = recorders[0].solver(integrator("dynamic"))

    @jax.jit
    def advance(states, stop):
        def one(state):
            return jc.integrate(scene, state, stop, solver, 100, 3)

        return jax.vmap(one)(states) if mapped == "vmap" else jax.lax.map(one, states)

    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    for stop in TIMES:
        while np.any(np.asarray(states.t) < stop):
            states, log = advance(states, stop)
            trails = jax.device_get(log.trail)
            for index, recorder in enumerate(recorders):
                recorder.extend(lane(trails, index))
        for recorder in recorders:
            recorder.frame(stop)
    for v, recorder in zip(speeds, recorders, strict=True):
        record, own = recorder.finished(scene, solver), recorded(scene, x, v=v)
        np.testing.assert_array_equal(record.t, own.t)
        np.testing.assert_array_equal(record.steps.frame, own.steps.frame)
        np.testing.assert_array_equal(record.steps.order, own.steps.order)
        np.testing.assert_allclose(record.steps.h, own.steps.h, rtol=1e-6)
        np.testing.assert_allclose(record.steps.x, own.steps.x, atol=1e-10)
