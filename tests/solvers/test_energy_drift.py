"""Energy of an undamped vibration over steps of varying size, by how much the two-step family dissipates."""

import functools

import equinox as eqx
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.system import energies

_energies = eqx.filter_jit(energies)
TIMES = np.linspace(0.0, 0.0125, 6)[1:]


@functools.cache
def drift(rho_infinity):
    """Energy at each frame over that at the start of a free sheet that vibrates without any damping, and
    the history of its steps."""
    mesh = jc.rectangle(0.05, 0.02, 40, seed=1)
    material = jc.Material(yield_curvature=None, drag_rate=0.0, internal_damping_time=0.0)
    scene = jc.sheet(mesh, material)
    x, v = mesh.vertices, np.zeros_like(mesh.vertices)
    v[:, 2] = 0.3 * np.cos(2 * np.pi * (x[:, 0] - x[:, 0].min()) / 0.05)
    state = jc.initial_state(scene, x, v - v.mean(axis=0))
    solver = jc.integrator(scheme="dynamic", rho_infinity=rho_infinity)
    solution = jc.simulate(scene, state, TIMES, solver=solver)
    assert solution.result == "success"
    stored = [
        float(sum(_energies(scene, x, v, None, t)))
        for x, v, t in zip(solution.x, solution.v, TIMES, strict=True)
    ]
    start = float(sum(_energies(scene, state.x, state.v, None, 0.0)))
    return np.array(stored) / start, solution.history


def test_the_midpoint_rule_neither_gains_nor_loses_energy():
    energy, history = drift(1.0)
    steps = history["h"].to_numpy()
    assert len(steps) > 400
    assert len(np.unique(np.round(steps, 12))) > 20 and steps.max() > 2.0 * steps.min()
    # Newton's error alone fed in 0.4 % over these steps.
    np.testing.assert_allclose(energy, 1.0, atol=2e-4)


@pytest.mark.parametrize("rho", [0.5, 0.8])
def test_between_the_ends_energy_only_falls(rho):
    energy, _ = drift(rho)
    assert np.all(np.diff(np.append(1.0, energy)) < 0)
    assert energy[-1] > 0.99


def test_the_more_is_left_of_high_frequencies_the_less_is_lost():
    lost = [1.0 - drift(rho)[0][-1] for rho in (0.5, 0.8, 1.0)]
    assert lost[0] > lost[1] > abs(lost[2])
