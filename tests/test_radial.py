"""The radial crumple as a whole: long physics, run before a release (pytest -m slow)."""

import numpy as np
import pytest

from jaxcrumple import frame_times, hybrid, initial_state, radial, simulate

pytestmark = pytest.mark.slow


def run(setup, rtol, times):
    return simulate(setup.scene, initial_state(setup.scene, setup.x), times, solver=hybrid(rtol), throw=True)


def test_error_follows_the_tolerance_before_the_first_event():
    setup = radial(500)
    # Inertia settles before the wall comes; the sheet first snaps at 1.9 to 2.1 s, depending on rtol.
    times = np.linspace(0.0, 1.85, 38)[1:]
    reference = run(setup, 1e-7, times)
    assert len(reference.events) == 1 and reference.events["t"][0] < 0.01
    rtols = np.array([1e-3, 1e-4, 1e-5, 1e-6])
    errors = [np.abs(run(setup, rtol, times).x - reference.x).max() / 0.1 for rtol in rtols]
    slope = np.polyfit(np.log(rtols), np.log(errors), 1)[0]
    assert 0.7 < slope < 1.3, errors
    assert np.all(errors < rtols), errors


def test_crumple_uses_both_stages_and_stays_sound():
    setup = radial(1000)
    solution = run(setup, 1e-4, frame_times(2.6, 4))
    directions = set(zip(solution.events["origin"], solution.events["to"], strict=True))
    assert directions >= {("quasistatic", "implicit"), ("implicit", "quasistatic")}
    for name in ("stretch", "bending", "confinement"):
        np.testing.assert_array_equal(solution.events[f"{name}_before"], solution.events[f"{name}_after"])
    strain = np.asarray(setup.scene.membrane.strain(solution.state.x))
    assert np.abs(strain).max() < 0.01
    assert float(setup.scene.walls[0].gap(solution.state.x, solution.state.t).min()) > 0
    # Energies of the prototype at R = 4.75 cm and of three seeds here lie within 25 to 50 mJ at 4.5 cm.
    last = solution.history.iloc[-1]
    assert 0.025 < last["bending"] + last["stretch"] < 0.060
