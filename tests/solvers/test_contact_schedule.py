"""Keeping the lists of contact while a run goes on: nothing depends on when they were made."""

import itertools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import bound
from folded import strip
from pressed import COLUMNS, SIGMA, moving_layers, pressed_layers

import jaxcrumple as jc
from jaxcrumple import simulation
from jaxcrumple.contact.adjacency import PLACED_TURN
from jaxcrumple.contact.host_broad_phase import Search
from jaxcrumple.contact.lists import Capacity, Reference, pair_key
from jaxcrumple.solvers.contact import schedule as schedules
from jaxcrumple.solvers.contact.reallocate import PLACES, Reallocation, _with_sizes
from jaxcrumple.solvers.contact.schedule import (
    around,
    crowded,
    largest_move,
    ready_for,
    renewed,
    start_schedule,
)
from jaxcrumple.solvers.log import empty_log
from jaxcrumple.state import EXPLICIT, IMPLICIT


@pytest.mark.parametrize(
    ("scheme", "speed"),
    [pytest.param("dynamic", 0.0, marks=pytest.mark.slow), ("explicit", 2.0)],
)
def test_a_run_cut_anywhere_goes_on_to_the_same_bits(monkeypatch, scheme, speed):
    """Also within the life of a factor that serves several steps, and of a list; and compiles nothing new."""
    once = eqx.filter_jit(eqx.debug.assert_max_traces(jc.integrate, max_traces=1))
    monkeypatch.setattr(simulation, "_integrate", once)
    (scene, state), solver = moving_layers(speed), jc.integrator(scheme=scheme)
    whole = jc.simulate(scene, state, 1.0, solver=solver, max_attempts=48).state
    steps = whole.counters.steps - state.counters.steps
    if scheme == "dynamic":
        assert int(whole.counters.factors) < int(steps[IMPLICIT])
    else:
        assert int(steps[EXPLICIT]) > 30
        assert np.all(np.isfinite(whole.listing.active.x))
    assert float(bound(jc.with_contacts(scene, state.x)).energy(state.x)) > 0
    for cut in (7, 30):
        first = jc.simulate(scene, state, 1.0, solver=solver, max_attempts=cut)
        assert first.result == "budget"
        rest = jc.simulate(scene, first.state, 1.0, solver=solver, max_attempts=48 - cut).state
        for name in ("t", "x", "v", "h", "history", "kept", "listing"):
            for a, b in zip(*(jax.tree.leaves(getattr(s, name)) for s in (whole, rest)), strict=True):
                assert np.asarray(a).tobytes() == np.asarray(b).tobytes(), (cut, name)


@pytest.mark.slow
def test_a_list_of_sites_holds_for_several_implicit_steps():
    """To make one takes as long as a step or two."""
    (scene, state), solver = moving_layers(0.3), jc.integrator(scheme="dynamic")
    made = set()
    for _ in range(40):
        state = jc.simulate(scene, state, 1.0, solver=solver, max_attempts=1).state
        made.add(np.asarray(state.listing.pairs.x).tobytes())
    assert int(state.counters.steps[IMPLICIT]) > 30
    assert len(made) < 6


def test_lists_and_places_are_those_that_a_state_waits_for():
    scene, state = pressed_layers()
    far = Reference(state.x, jnp.full(scene.n_nodes, 3.0 * SIGMA))
    needed = jnp.asarray([5000, 200_000, 400_000, 100_000])
    waiting = eqx.tree_at(lambda s: (s.listing.matrix, s.listing.needed), state, (far, needed))
    here, there = jc.with_contacts(scene, state), jc.with_contacts(scene, waiting)
    assert int(here.lists.pairs.count) == int(there.lists.pairs.count) > 0
    assert np.all(np.array(there.lists.pairs.capacity) >= needed[:3])
    assert there.lists.candidates.triangles.shape[0] >= 100_000
    pairs, _ = Search(scene.contact, scene.bending.nodes).find(
        *map(np.asarray, (far.x, far.skin)), PLACED_TURN
    )
    keys = pair_key(jnp.asarray(pairs), len(scene.contact.faces))
    assert np.all(np.isin(keys, there.lists.matrix.keys))
    assert not np.all(np.isin(keys, here.lists.matrix.keys))


@pytest.mark.slow
def test_lists_with_room_for_one_grow_and_change_no_bit(monkeypatch):
    scene, state = pressed_layers()
    roomy = jc.simulate(scene, state, 1.0, max_attempts=48).state
    for name in ("CANDIDATES_PER_NODE", "LEAST_CANDIDATES"):
        monkeypatch.setattr(f"jaxcrumple.solvers.contact.reallocate.{name}", 0)
    monkeypatch.setattr("jaxcrumple.solvers.contact.reallocate.first_capacity", lambda n: Capacity(1, 1, 1))
    # They are filled before the run compiles, with room to spare.
    once = eqx.filter_jit(eqx.debug.assert_max_traces(jc.integrate, max_traces=1))
    monkeypatch.setattr(simulation, "_integrate", once)
    narrow = jc.simulate(scene, state, 1.0, max_attempts=48).state
    np.testing.assert_array_equal(narrow.x, roomy.x)
    np.testing.assert_array_equal(narrow.v, roomy.v)


def test_lists_that_never_fit_end_in_a_named_result(monkeypatch):
    scene, state = pressed_layers()
    module = simulation

    def waiting(scene, state, *_):
        """A call that wants longer lists, whatever it gets."""
        return eqx.tree_at(lambda s: s.listing.needed, state, state.listing.needed + 1), empty_log(1)

    monkeypatch.setattr(module, "_integrate", waiting)
    solution = jc.simulate(scene, state, 1.0)
    assert solution.result == "collapsed"
    np.testing.assert_array_equal(solution.state.x, state.x)


def test_compiling_for_longer_lists_uses_no_time_of_the_run(monkeypatch):
    """By a clock on which each compilation takes 1000 s. The first call only asks for longer lists."""
    scene, state = pressed_layers()
    integrate, compile_, compiled, asked = simulation._integrate, simulation._compile, [], []

    def asking(scene, state, *rest):
        ended, log = integrate(scene, state, *rest)
        if float(rest[2]) == 0 or asked:
            return ended, log
        asked.append(state.listing.needed + 1)
        return eqx.tree_at(lambda s: s.listing.needed, state, asked[0]), empty_log(1)

    def compiling(*arguments):
        compile_(*arguments)
        compiled.append(1000.0)
        return 1000.0

    clock = SimpleNamespace(perf_counter=lambda: 1e-3 * next(ticks) + sum(compiled))
    ticks = itertools.count()
    for name, stand_in in (("_integrate", asking), ("_compile", compiling), ("time", clock)):
        monkeypatch.setattr(simulation, name, stand_in)
    solution = jc.simulate(scene, state, 2e-3, max_seconds=600.0)
    assert asked and solution.result == "success"
    assert solution.compile_s == 2000.0 and 0.0 < solution.run_s < 1.0


@pytest.mark.filterwarnings("ignore:contact level = 3 leaves")
@pytest.mark.parametrize(
    "room",
    [
        pytest.param(Capacity(1, 1, 1), id="tight"),
        pytest.param(Capacity(1000, 1000, 1000), id="roomy", marks=pytest.mark.slow),
    ],
)
def test_what_is_only_near_a_long_step_makes_it_short_and_needs_no_room(room):
    """Triangles 5 ranges apart are near if a node may move as far, and the list of a short step is empty."""
    sigma = 0.02e-3
    mesh = strip(5.0 * sigma, columns=COLUMNS, rows=4)
    x = jnp.asarray(mesh.vertices)
    scene = jc.sheet(mesh, jc.Material(thickness=sigma), contact=jc.SelfContact(range=sigma, level=3))
    # As in a sheet whose triangles are all as wide as most of these, and which is not flat.
    calm = jnp.asarray(8.0 * sigma)
    scene = eqx.tree_at(lambda s: s.contact.calm, scene, calm)
    own = Reallocation(scene, merged=False)
    own.capacity = room
    state = jc.initial_state(scene, x)
    scene = own.first(scene, state)
    state, schedule = start_schedule(scene, state, False)
    flight = jnp.where(x[:, :1] > 0, 12.0 * sigma, 0.0) * jnp.asarray([0.0, 0.0, 1.0])

    @eqx.filter_jit
    def prepared(state, schedule):
        state, schedule = renewed(scene, state, schedule)
        share = largest_move(scene, schedule, x, x + flight)
        return *ready_for(scene, state, schedule, x + share * flight), share

    shares = []
    for _ in range(8):
        state, schedule, ready, share = prepared(state, schedule)
        shares.append(float(share))
        assert not np.any(state.listing.needed)
        if ready:
            break
    assert ready
    # A node moves 6 ranges against the mean: all at once, and then by one at most.
    assert shares[0] == 1.0 and shares[-1] == pytest.approx(1.0 / 6.0, rel=1e-6)


def test_around_an_iterate_astray_no_room_is_needed(monkeypatch):
    """Where many pairs are near: the step fails instead. Around a close one the lists grow."""
    scene, state = pressed_layers()
    least = Capacity(1, 1, 1)
    monkeypatch.setattr(schedules, "first_capacity", lambda nodes: least)
    tight = _with_sizes(scene, least, 10_000)
    upper = state.x[:, 2] > jnp.mean(state.x[:, 2])
    for ranges, grows in ((1.0, True), (6.0, False)):
        x = state.x + jnp.where(upper[:, None], jnp.asarray([0.0, 0.0, ranges * SIGMA]), 0.0)
        fresh, schedule = start_schedule(tight, state, False)
        asked, schedule = renewed(tight, *around(tight, fresh, schedule, x))
        assert np.all(schedule.lists.pairs.needed > 1)
        assert bool(np.any(asked.listing.needed)) is grows
        assert bool(crowded(tight, schedule)) is not grows


@pytest.mark.parametrize("short", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 4))])
def test_a_list_that_is_too_short_is_the_one_that_grows(short):
    """Pairs of triangles near, sites there, pairs of sites, and pairs of triangles that may meet."""
    scene, state = pressed_layers()
    own = Reallocation(scene, merged=True)
    scene = own.first(scene, state)
    pairs, candidates = scene.lists.pairs, scene.lists.candidates
    sizes = [*pairs.needed.tolist(), int(candidates.count)]
    assert min(sizes) > 8
    own.candidates = sizes[3] - 1 if short == 3 else own.candidates
    rooms = [size - 1 if place == short else size for place, size in enumerate(sizes)]
    own.capacity = Capacity(*rooms[:3])
    tight = _with_sizes(scene, own.capacity, rooms[3])
    # The first lists reach no further than those that were measured.
    state = eqx.tree_at(lambda s: s.listing.pairs, state, pairs.reference)
    state, schedule = start_schedule(tight, state, False)
    state, _ = eqx.filter_jit(renewed)(tight, state, schedule)
    needed = np.asarray(state.listing.needed)
    assert needed[short] > rooms[short]
    grown = own.grown(tight.lists, needed)
    after = [*grown.pairs.capacity, grown.candidates.triangles.shape[0]]
    assert after[short] >= sizes[short]


def test_places_in_the_matrix_grow_with_the_lists():
    """Else the program is compiled for longer lists, and soon again for more places."""
    scene, state = pressed_layers()
    own = Reallocation(scene, merged=True)
    scene = own.first(scene, state)
    before = scene.lists.matrix.keys
    needed = jnp.asarray([4 * scene.lists.pairs.capacity.triangles, 0, 0, 0])
    grown = own(scene, eqx.tree_at(lambda s: s.listing.needed, state, needed))
    after, room = grown.lists.matrix.keys, grown.lists.pairs.capacity
    assert room.triangles >= needed[0]
    assert len(after) >= PLACES * room.triangles > len(before)
    np.testing.assert_array_equal(after[: len(before)], before)
