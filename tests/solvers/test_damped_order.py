"""BDF of order 3 to 5 with inertia: where drag makes it stable, and what it is worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple import Material, initial_state, radial, simulate
from jaxcrumple.history import HISTORY
from jaxcrumple.solvers.implicit.bdf import REACH, coefficients, damped_order
from jaxcrumple.solvers.scheme import integrator

ORDERS = (3, 4, 5)
_coefficients = jax.jit(coefficients)
_damped_order = jax.jit(damped_order)


def growth(order, decay):
    """Largest amplification a step (h = 1) of vibrations of any frequency that decay at rate `decay`."""
    alpha, beta = _coefficients(1.0, jnp.ones(HISTORY), order)
    memory = np.asarray(alpha)[:order]
    frequencies = np.geomspace(decay, 1e4, 4000)
    modes = -decay + 1j * np.sqrt(np.maximum(frequencies**2 - decay**2, 0.0))
    return max(np.abs(np.roots([1.0 - float(beta) * z, *memory])).max() for z in modes)


@pytest.mark.parametrize("order", ORDERS)
def test_reach_is_where_the_formula_turns_stable_at_every_frequency(order):
    reach = REACH[order - 3]
    assert growth(order, 1.001 * reach) < 1.0
    assert growth(order, 0.95 * reach) > 1.0


def test_order_two_is_stable_without_drag():
    assert growth(2, 1e-9) <= 1.0 + 1e-12


@pytest.mark.parametrize("order", ORDERS)
def test_the_order_is_allowed_from_its_reach_on(order):
    edge = 1.2 * REACH[order - 3] / 500.0
    assert int(_damped_order(0.999 * edge, 500.0)) == order - 1
    assert int(_damped_order(1.001 * edge, 500.0)) == order


def crumpled(rtol, drag=5e3, **options):
    """A coarse sheet in a shrinking sphere, inertia throughout."""
    setup = radial(60, sweeps=5, contact=None, material=Material(drag_rate=drag))
    solver = integrator(rtol, scheme="dynamic", linear="block-cg", **options)
    state = initial_state(setup.scene, setup.x)
    return simulate(setup.scene, state, [0.1, 0.2, 0.3], solver=solver, throw=True)


@pytest.mark.slow
def test_high_order_takes_fewer_steps_to_a_smaller_error():
    reference, size = crumpled(1e-6, max_order=2), 0.1
    low, high = (crumpled(2.5e-4, max_order=order) for order in (2, 5))
    error_low, error_high = (np.abs(run.x - reference.x).max() / size for run in (low, high))
    assert high.history["order"].max() == 5
    assert high.state.counters.steps.sum() < 0.6 * low.state.counters.steps.sum()
    assert error_high < 0.5 * error_low < 0.5e-4


@pytest.mark.slow
def test_short_steps_and_other_dissipation_keep_to_order_two():
    assert crumpled(1e-3, drag=50.0).history["order"].max() == 2
    assert crumpled(1e-3, rho_infinity=0.5).history["order"].max() == 2
