"""`integrate` and `simulate`: what compiles, when stages change, how runs end, many at once."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from snapping import NODES, SNAP_END, equal, setup, snap, solver, start, with_speed

from jaxcrumple import simulation
from jaxcrumple.material.material import Material
from jaxcrumple.scenes.radial import radial
from jaxcrumple.simulation import SimulationError, frame_times, simulate
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.log import ENERGIES, empty_log
from jaxcrumple.solvers.loop import LIMIT_EVERY
from jaxcrumple.solvers.stages import Handover, after_explicit, logged, no_entry
from jaxcrumple.state import EXPLICIT, IMPLICIT, QUASISTATIC, RESULTS, STAGES, initial_state

# --- Stages --------------------------------------------------------------------------------------


def test_a_snap_switches_to_inertia_and_back():
    solution = snap()
    assert solution.result == "success"
    events = solution.events
    assert events["origin"].tolist() == ["implicit", "quasistatic", "implicit"]
    assert events["to"].tolist() == ["quasistatic", "implicit", "quasistatic"]
    assert int(solution.state.counters.switches) == 3
    assert int(solution.state.stage) == QUASISTATIC
    assert int(solution.state.counters.steps[IMPLICIT]) > 10
    scene = setup().scene
    inertial = float(scene.inertial_time)
    assert inertial == pytest.approx(1 / 1500)
    displacement = events["acceleration_mean"] * float(scene.reference_acceleration / scene.length_scale)
    assert displacement[1] * inertial**2 > 3e-4
    assert displacement[2] * inertial**2 < 1e-4
    assert events["t"][0] >= inertial
    assert events["t"][2] - events["t"][1] >= inertial
    events = events.iloc[1:]
    for name in ("stretch", "bending", "walls"):
        assert np.all(events[f"{name}_before"] > 0)
        np.testing.assert_array_equal(events[f"{name}_before"], events[f"{name}_after"])
    assert np.all(events["kinetic_after"] > 0)


@pytest.mark.slow
def test_what_the_switch_leaves_out_vanishes_with_the_tolerance():
    """Quasistatic steps leave inertia out; their switch makes them converge to inertia throughout."""
    sheet = radial(NODES, sweeps=5, contact=None, material=Material(drag_rate=400.0))
    times = frame_times(0.03, 6)[1:]

    def positions(**options):
        state = initial_state(sheet.scene, sheet.x)
        return simulate(sheet.scene, state, times, solver=solver(**options)).x

    reference = positions(rtol=1e-6, scheme="dynamic")
    size = float(sheet.scene.length_scale)
    errors = [np.max(np.abs(positions(rtol=rtol) - reference)) / size for rtol in (1e-4, 1e-5, 1e-6)]
    assert errors[0] < 2e-2
    assert errors[1] < errors[0] / 1.5
    assert errors[2] < errors[1] / 2


@pytest.mark.slow
def test_the_default_keeps_its_tolerance_across_explicit_spells():
    """Held against explicit steps alone, whose step the stability limit sets far below the tolerance."""
    times = frame_times(0.012, 6)[1:]
    scene, size = setup().scene, float(setup().scene.length_scale)
    reference = simulate(scene, start(), times, solver=solver(1e-5, "explicit")).x
    for rtol in (1e-4, 3e-5):
        solution = simulate(scene, start(), times, solver=solver(rtol, "hybrid"))
        assert np.max(np.abs(solution.x - reference)) < rtol * size
        events = solution.events
        assert set(events["origin"]) == {"implicit", "explicit"}
        assert len(events) == int(solution.state.counters.switches) > 2
        for name in ENERGIES:
            np.testing.assert_array_equal(events[f"{name}_before"], events[f"{name}_after"])
        steps = solution.state.counters.steps
        assert (int(steps[QUASISTATIC]), int(steps[IMPLICIT]) > 5) == (0, True)
        # Explicit steps alone would be 1800.
        assert 100 < int(steps[EXPLICIT]) < 1200


def test_frames_and_history_tell_the_run():
    solution = snap()
    np.testing.assert_allclose(solution.t, frame_times(SNAP_END, 3), rtol=1e-14)
    np.testing.assert_array_equal(solution.x[0], setup().x)
    np.testing.assert_array_equal(solution.x[-1], solution.state.x)
    np.testing.assert_array_equal(solution.p[-1], solution.state.p)
    history = solution.history
    steps = history[history["kind"] == 0]
    assert np.all(np.diff(history["t"]) >= 0)
    assert steps["t"].iloc[-1] == pytest.approx(SNAP_END, rel=1e-12)
    assert set(steps["stage"]) == {"quasistatic", "implicit"}
    for stage, count in zip(STAGES, solution.state.counters.steps, strict=True):
        assert history[f"{stage}_steps"].iloc[-1] == int(count)
        if stage != "explicit":
            assert np.sum(steps["stage"] == stage) == int(count)
    assert history["factors"].iloc[-1] == int(solution.state.counters.factors)
    assert 0 < int(solution.state.counters.factors) <= int(solution.state.counters.newton)
    assert steps["order"][steps["stage"] == "implicit"].tolist()[:4] == [1, 1, 1, 2]
    assert set(steps["order"][steps["stage"] == "implicit"][3:]) == {2, 3}
    assert steps["order"].iloc[0] == 1
    assert steps["order"].max() > 2


def test_quasistatic_only_never_switches():
    solution = simulate(setup().scene, start(), SNAP_END, solver=solver(scheme="quasistatic"))
    assert solution.result == "success"
    assert len(solution.events) == 0
    counters = solution.state.counters
    assert (int(counters.switches), *counters.steps[1:]) == (0, 0, 0)
    assert set(solution.history["stage"]) == {"quasistatic"}


@pytest.mark.slow
def test_more_drag_makes_inertia_a_small_correction_in_a_snap():
    damped = radial(NODES, sweeps=5, contact=None, material=Material(drag_rate=2000.0))
    ends = []
    for scheme in ("quasistatic", "dynamic"):
        state = initial_state(damped.scene, damped.x)
        ends.append(simulate(damped.scene, state, SNAP_END, solver=solver(scheme=scheme)).state.x)
    assert np.max(np.abs(ends[0] - ends[1])) < 0.1 * np.max(np.abs(ends[1] - damped.x))


# --- How runs end --------------------------------------------------------------------------------


def test_budgets_end_a_run_that_can_go_on():
    scene = setup().scene
    halted = simulate(scene, start(), SNAP_END, solver=solver(), max_attempts=20)
    assert halted.result == "budget"
    assert "resume" in halted.message
    assert int(sum(halted.state.counters.steps) + sum(halted.state.counters.rejected)) == 20
    assert repr(halted).startswith("Solution(budget, n = 60, 0 frames, ")
    assert 0 < float(halted.state.t) < SNAP_END
    assert simulate(scene, start(), SNAP_END, solver=solver(), max_seconds=0.0).result == "budget"
    assert simulate(scene, start(), SNAP_END, solver=solver(), max_attempts=0).state.t == 0
    resumed = simulate(scene, halted.state, SNAP_END, solver=solver())
    assert resumed.result == "success"
    assert equal(resumed.state, simulate(scene, start(), SNAP_END, solver=solver()).state)


@pytest.mark.parametrize(("scheme", "rtol", "end"), [("hybrid", 1e-6, 0.01), ("explicit", 1e-4, 2e-3)])
def test_a_run_cut_amid_explicit_steps_goes_on_bit_for_bit(scheme, rtol, end):
    scene, options = setup().scene, solver(rtol, scheme)
    straight = simulate(scene, start(), end, solver=options)
    assert straight.result == "success"
    assert float(straight.state.limit.step) == pytest.approx(
        float(options.stability_limit(scene, setup().x, 0.0)), rel=0.1
    )
    for attempts in (37, 111):
        halted = simulate(scene, start(), end, solver=options, max_attempts=attempts)
        assert int(halted.state.stage) == EXPLICIT
        assert int(halted.state.monitor.steps) % LIMIT_EVERY > 0
        assert equal(simulate(scene, halted.state, end, solver=options).state, straight.state)


def test_throw_raises_with_the_solution():
    with pytest.raises(SimulationError, match=r"budget: the budget .* resume") as caught:
        simulate(setup().scene, start(), SNAP_END, solver=solver(), max_attempts=20, throw=True)
    assert caught.value.solution.result == "budget"
    assert np.all(np.isfinite(caught.value.solution.state.x))
    assert simulate(setup().scene, start(), 1e-5, solver=solver(), throw=True).result == "success"


PARAMETERS = {
    "spring": lambda s: s.membrane.stiffness,
    "hinge": lambda s: s.bending.stiffness,
    "mass": lambda s: s.mass,
    "drag": lambda s: s.drag.coefficient,
    "yield": lambda s: s.plasticity.yield_threshold,
    "wall": lambda s: s.walls[0].stiffness,
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_nan_in_the_scene_is_refused_or_ends_in_a_named_result(name):
    """Inside a program nobody can look at numbers, so that the result has to tell."""
    where = PARAMETERS[name]
    scene = eqx.tree_at(where, setup().scene, where(setup().scene).at[1].set(jnp.nan))
    with pytest.raises(
        ValueError, match=r"^scene\..*\[1\] is nan; it must be finite|has NaN among its numbers"
    ):
        simulate(scene, start(), SNAP_END, solver=solver())
    program = simulation._integrate
    state, _ = program(scene, start(), jnp.asarray(SNAP_END), solver(), jnp.asarray(100.0))
    assert bool(state.result == RESULTS.nonfinite) or bool(state.result == RESULTS.collapsed)
    np.testing.assert_array_equal(state.x, setup().x)


# --- Many runs at once ---------------------------------------------------------------------------


@pytest.mark.slow
def test_vmap_over_wall_speeds_equals_single_runs():
    scene, state = setup().scene, start()
    speeds = (0.01, 0.015)

    def run(rate, state):
        moved = eqx.tree_at(lambda s: s.walls[0].shape.radius.rate, scene, rate)
        return integrate(moved, state, jnp.asarray(SNAP_END), solver())[0]

    batch = eqx.filter_jit(eqx.filter_vmap(run))
    rates = jnp.asarray([-speed for speed in speeds])
    both = eqx.filter_vmap(lambda _: state)(rates)
    for _ in range(6):
        both = batch(rates, both)
    single = [simulate(with_speed(scene, s), state, SNAP_END, solver=solver()).state for s in speeds]
    for lane, alone in enumerate(single):
        np.testing.assert_allclose(both.t[lane], SNAP_END, rtol=1e-14)
        np.testing.assert_array_equal(both.counters.steps[lane], alone.counters.steps)
        np.testing.assert_allclose(both.x[lane], alone.x, atol=1e-9)
        np.testing.assert_allclose(both.p[lane], alone.p, atol=1e-9)
        assert int(alone.counters.steps[IMPLICIT]) > 0
    assert float(jnp.max(jnp.abs(both.x[0] - both.x[1]))) > 1e-6


def test_futile_tries_of_implicit_steps_become_rare():
    """Stages over within few steps double the explicit spell after them, up to four times; a long one ends
    that."""
    scene, log = setup().scene, empty_log(64, NODES)
    state, cap = eqx.tree_at(lambda s: s.stage, start(), jnp.asarray(IMPLICIT)), jnp.asarray(1e-6)
    spells = []
    for steps in (3, 3, 3, 3, 3, 50, 3):
        state = eqx.tree_at(lambda s: s.monitor.steps, state, jnp.asarray(steps))
        state, log = logged(scene, state, log, no_entry(), Handover(jnp.asarray(EXPLICIT), cap))
        spell = next(
            spell
            for spell in 100 * 2 ** np.arange(8)
            if int(after(eqx.tree_at(lambda s: s.monitor.since, state, 1.01 * spell * cap), cap)) == IMPLICIT
        )
        spells.append(int(spell))
        state, log = logged(scene, state, log, no_entry(), Handover(jnp.asarray(IMPLICIT), 20.0 * cap))
    assert spells == [400, 800, 800, 800, 800, 200, 400]


def after(state, cap):
    """The stage that an explicit step asks for."""
    return after_explicit(setup().scene, state, jnp.asarray(True), cap, solver(scheme="hybrid")).stage
