"""BDF coefficients and the Runge-Kutta pair on problems with known solutions: exactness, order, stability."""

import functools
import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxcrumple.history import HISTORY, History
from jaxcrumple.solvers.explicit.runge_kutta import RK43
from jaxcrumple.solvers.implicit import bdf
from jaxcrumple.solvers.implicit.base import GROWTH

# --- BDF: coefficients ---------------------------------------------------------------------------

_coefficients = jax.jit(bdf.coefficients)
_error_constant = jax.jit(bdf.error_constant)
_extrapolation = jax.jit(bdf.extrapolation)
_push = jax.jit(bdf.push)


def past_times(h, steps):
    """Times of the history when the new point is at 0, newest first."""
    return -np.cumsum([h, *steps[: HISTORY - 1]])


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_coefficients_are_exact_on_polynomials(order):
    rng = np.random.default_rng(order)
    for _ in range(20):
        h, *steps = np.exp(rng.uniform(-1.5, 1.5, HISTORY + 1))
        alpha, beta_h = (np.asarray(a) for a in _coefficients(h, jnp.array(steps), order))
        assert np.all(alpha[order:] == 0)
        times = past_times(h, steps)
        for power in range(order + 1):
            value, slope = float(power == 0), float(power == 1)
            found = (value + alpha @ times**power) / beta_h
            scale = np.abs(alpha / beta_h) @ np.abs(times) ** power + 1 / beta_h
            assert abs(found - slope) < 1e-13 * scale


@pytest.mark.parametrize("points", [1, 2, 3, 4, 5, 6])
def test_extrapolation_is_exact_on_polynomials(points):
    rng = np.random.default_rng(points)
    for _ in range(20):
        h, *steps = np.exp(rng.uniform(-1.5, 1.5, HISTORY + 1))
        weights = np.asarray(_extrapolation(h, jnp.array(steps), points))
        assert np.all(weights[points:] == 0)
        times = past_times(h, steps)
        for power in range(points):
            scale = np.abs(weights) @ np.abs(times) ** power
            assert abs(weights @ times**power - (power == 0)) < 1e-13 * scale


def test_coefficients_at_equal_steps_are_the_textbook_ones():
    tables = {
        1: (1, [-1]),
        2: (2 / 3, [-4 / 3, 1 / 3]),
        3: (6 / 11, [-18 / 11, 9 / 11, -2 / 11]),
        4: (12 / 25, [-48 / 25, 36 / 25, -16 / 25, 3 / 25]),
        5: (60 / 137, [-300 / 137, 300 / 137, -200 / 137, 75 / 137, -12 / 137]),
    }
    for order, (beta, alpha) in tables.items():
        found, beta_h = _coefficients(1.0, jnp.ones(HISTORY), order)
        np.testing.assert_allclose(found[:order], alpha, rtol=1e-14)
        assert float(beta_h) == pytest.approx(beta, rel=1e-14)


def roots(order, ratio):
    """Characteristic roots for y' = 0 when every step is `ratio` times the one before."""
    alpha, _ = _coefficients(1.0, ratio ** -np.arange(1.0, HISTORY + 1), order)
    return np.roots([1.0, *np.asarray(alpha)[:order]])


def parasitic_radius(order, ratio):
    """Largest modulus of the characteristic roots other than 1."""
    found = roots(order, ratio)
    return np.max(np.abs(np.delete(found, np.argmin(np.abs(found - 1)))), initial=0.0)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_growth_limits_keep_zero_stability(order):
    assert np.max(np.abs(roots(order, GROWTH[order - 1]))) < 1 + 1e-12
    assert parasitic_radius(order, GROWTH[order - 1]) < 1.0


@pytest.mark.parametrize(
    ("order", "limit"), [(2, 1 + np.sqrt(2)), (3, (1 + np.sqrt(5)) / 2), (4, 1.2807), (5, 1.1275)]
)
def test_growth_that_breaks_zero_stability(order, limit):
    ratio = brentq(lambda r: parasitic_radius(order, r) - 1, 1.02, 4.0)
    assert ratio == pytest.approx(limit, rel=1e-9 if order < 4 else 1e-3)
    assert GROWTH[order - 1] < ratio


@pytest.mark.parametrize(("order", "alpha"), [(3, 86.0), (4, 73.35), (5, 51.84)])
def test_stability_angle(order, alpha):
    weights, beta = _coefficients(1.0, jnp.ones(HISTORY), order)
    zeta = np.exp(-1j * np.linspace(1e-3, np.pi, 20001))
    locus = (1 + sum(np.asarray(weights)[j] * zeta ** (j + 1) for j in range(order))) / float(beta)
    left = locus[locus.real < 0]
    angle = np.degrees(np.min(np.arctan2(np.abs(left.imag), -left.real)))
    assert angle == pytest.approx(alpha, abs=0.1)


# --- BDF: error estimate -------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_error_constant_is_exact_on_the_next_power(order):
    """y' = g(t) with exact past values: what the step adds, against the predictor's error."""
    rng = np.random.default_rng(order)
    for _ in range(20):
        h, *steps = np.exp(rng.uniform(-1.0, 1.0, HISTORY + 1))
        alpha, beta_h = (np.asarray(a) for a in _coefficients(h, jnp.array(steps), order))
        past = past_times(h, steps)
        # The polynomial has the values below at the past times, 0 at the new one, and slope 1 there.
        power = order + 1
        values = past + rng.normal() * past**power
        solution = beta_h * 1.0 - alpha @ values
        predictor = np.asarray(_extrapolation(h, jnp.array(steps), order + 1)) @ values
        share = float(_error_constant(h, jnp.array(steps), order))
        assert 0 < share < 1
        assert solution == pytest.approx(share * (0.0 - predictor), rel=1e-8)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_error_estimate_of_a_run_is_its_local_error(order):
    """With equal steps the errors of past values drop out of the difference of solution and predictor."""
    h, power = 0.1, order + 1
    steps = jnp.full(HISTORY, h)
    alpha, beta_h = (np.asarray(a) for a in _coefficients(h, steps, order))
    weights = np.asarray(_extrapolation(h, steps, order + 1))
    past = 1.0 - h * np.arange(HISTORY)
    values = past**power
    # Old values far enough back that parasitic roots have died out.
    for count in range(1, 90):
        t = 1.0 + count * h
        solution = beta_h * power * t**order - alpha @ values
        estimate = float(_error_constant(h, steps, order)) * (solution - weights @ values)
        values = np.concatenate([[solution], values[:-1]])
    # beta h^(k+1) y^(k+1) / (k+1) with y = t^(k+1)
    assert estimate == pytest.approx(beta_h * h**order * math.factorial(order), rel=1e-4)


# --- BDF: order of convergence -------------------------------------------------------------------
# A problem is (residual(t, y, dy), jacobians (by y, by dy), solution(t), t0, t1).


def solve_bdf(problem, order, steps):
    """Maximum error over the run, with exact starting values and Newton to rounding."""
    residual, jacobian, solution, t0, _ = problem
    times = t0 + np.concatenate([[0.0], np.cumsum(steps)])
    y0, one = jnp.asarray(solution(t0)), jnp.asarray(1)
    velocities = jnp.zeros((HISTORY, len(y0)))
    history = History(jnp.tile(y0, (HISTORY, 1)), velocities, None, jnp.ones(HISTORY), one, one)
    for k in range(1, order):
        history = _push(history, steps[k - 1], jnp.asarray(solution(times[k])), velocities[0], None, one)
    worst = np.zeros_like(solution(t0))
    for h, t in zip(steps[order - 1 :], times[order:], strict=True):
        alpha, beta_h = _coefficients(h, history.steps, order)
        memory, beta_h = np.asarray(alpha @ history.x), float(beta_h)
        y = np.asarray(_extrapolation(h, history.steps, order) @ history.x)
        for _ in range(4):
            dy = (y + memory) / beta_h
            by_y, by_dy = jacobian(t, y, dy)
            y = y - np.linalg.solve(by_y + by_dy / beta_h, residual(t, y, dy))
        history = _push(history, h, jnp.asarray(y), velocities[0], None, one)
        worst = np.maximum(worst, np.abs(y - solution(t)))
    return worst


def prothero_robinson():
    """y' = -1e3 (y - sin t) + cos t: stiff, with the smooth solution sin t."""
    lam = 1e3

    def residual(t, y, dy):
        return dy + lam * (y - np.sin(t)) - np.cos(t)

    return residual, lambda t, y, dy: (lam * np.eye(1), np.eye(1)), lambda t: np.array([np.sin(t)]), 0.0, 4.0


def van_der_pol():
    """x'' = mu (1 - x^2) x' - x, mu = 1."""
    mu = 1.0

    def field(t, y):
        return np.array([y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]])

    def jacobian(t, y, dy):
        return -np.array([[0, 1], [-2 * mu * y[0] * y[1] - 1, mu * (1 - y[0] ** 2)]]), np.eye(2)

    solution = reference(field, [2.0, 0.0], 4.0)
    return lambda t, y, dy: dy - field(t, y), jacobian, solution, 0.0, 4.0


def robertson():
    """Robertson's kinetics with the conservation law in place of the third equation: a DAE of index 1."""

    def rates(t, y):
        slow, back, fast = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
        return np.array([back - slow, slow - back - fast, fast])

    def residual(t, y, dy):
        return np.array([*(dy - rates(t, y))[:2], y.sum() - 1.0])

    def jacobian(t, y, dy):
        back = [1e4 * y[2], 1e4 * y[1]]
        by_y = -np.array([[-0.04, *back], [0.04, -back[0] - 6e7 * y[1], -back[1]], [-1.0, -1.0, -1.0]])
        return by_y, np.diag([1.0, 1.0, 0.0])

    return residual, jacobian, reference(rates, [1.0, 0.0, 0.0], 10.0), 1.0, 10.0


def massless_spring():
    """x' = v and 0 = b v + k x, both unknown: the quasistatic sheet in one dimension."""
    b, k = 0.5, 1.0

    def residual(t, y, dy):
        return np.array([dy[0] - y[1], b * y[1] + k * y[0]])

    def solution(t):
        return np.exp(-k / b * t) * np.array([1.0, -k / b])

    def jacobian(t, y, dy):
        return np.array([[0.0, -1.0], [k, b]]), np.diag([1.0, 0.0])

    return residual, jacobian, solution, 0.0, 2.0


def reference(field, start, end):
    """Dense solution to 12 digits or so."""
    method = {"method": "Radau", "rtol": 1e-11, "atol": 1e-15}
    if len(start) == 2:
        method = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    run = solve_ivp(field, (0.0, end), start, dense_output=True, **method)
    return run.sol


PROBLEMS = {f.__name__: f for f in (prothero_robinson, van_der_pol, robertson, massless_spring)}


@functools.cache
def problem(name):
    return PROBLEMS[name]()


def grid(count, span, varied):
    """Equal steps, or steps that vary at random by up to 10 % each way."""
    steps = np.ones(count)
    if varied:
        steps = np.random.default_rng(count).uniform(0.9, 1.1, count)
    return span * steps / steps.sum()


@pytest.mark.parametrize("varied", [False, True], ids=["equal", "varied"])
@pytest.mark.parametrize("order", [2, 3, 4, 5])
@pytest.mark.parametrize("name", list(PROBLEMS))
def test_order_of_convergence(name, order, varied):
    setup = problem(name)
    counts = np.array([80, 160, 320])
    errors = np.array([np.max(solve_bdf(setup, order, grid(n, setup[4] - setup[3], varied))) for n in counts])
    observed = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert observed == pytest.approx(order, abs=0.2)


# --- Runge-Kutta pair ----------------------------------------------------------------------------


def oscillator(t, y, args):
    """A forced nonlinear oscillator: no order condition is met by accident."""
    return jnp.array([y[1], -jnp.sin(y[0]) + 0.3 * jnp.cos(2 * t) * y[0] ** 2])


_TERM = diffrax.ODETerm(oscillator)
_START = jnp.array([1.0, 0.4])


@jax.jit
def end_point(dt0):
    run = diffrax.diffeqsolve(
        _TERM, RK43(), 0.0, 2.0, dt0, _START, stepsize_controller=diffrax.ConstantStepSize(), max_steps=1024
    )
    return run.ys[-1]


def single_step(h, term=_TERM, y=_START):
    """New value, embedded error and the stage handed on."""
    solver = RK43()
    first = solver.init(term, 0.0, h, y, None)
    new, error, _, stages, _ = solver.step(term, 0.0, h, y, None, first, False)
    return new, error, stages


def slope(h, errors):
    return np.polyfit(np.log(h), np.log(errors), 1)[0]


def test_runge_kutta_is_of_order_four():
    h = 2.0 / np.array([10, 20, 40, 80])
    exact = solve_ivp(
        lambda t, y: np.asarray(oscillator(t, y, None)),
        (0, 2),
        _START,
        rtol=1e-12,
        atol=1e-13,
        method="DOP853",
    ).y[:, -1]
    errors = [np.linalg.norm(np.asarray(end_point(step)) - exact) for step in h]
    assert slope(h, errors) == pytest.approx(4.0, abs=0.2)


def test_embedded_method_is_of_order_three():
    h = np.array([0.1, 0.05, 0.025])
    errors = [float(jnp.linalg.norm(single_step(step)[1])) for step in h]
    assert slope(h, errors) == pytest.approx(4.0, abs=0.2)
    tableau = RK43.tableau
    weights, nodes = tableau.b_sol - tableau.b_error, np.array([0.0, *tableau.c])
    np.testing.assert_allclose(weights, [1 / 12, 1 / 2, 1 / 4, 0, 1 / 6], atol=1e-15)
    for power in range(3):
        assert weights @ nodes**power == pytest.approx(1 / (power + 1), rel=1e-14)


def test_last_stage_is_the_derivative_at_the_new_point():
    h = 0.1
    new, _, (_, handed_on) = single_step(h)
    np.testing.assert_allclose(handed_on, oscillator(h, new, None), rtol=1e-14)
    assert RK43.tableau.fsal


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0])
def test_energy_drift_of_an_undamped_oscillator(z):
    term = diffrax.ODETerm(lambda t, y, args: jnp.array([y[1], -y[0]]))
    new, _, _ = single_step(z, term, jnp.array([0.6, 0.8]))
    drift = float(new @ new) - 1
    # |R(iz)|^2 = 1 - z^6/72 + z^8/576: stable up to z = 2 sqrt 2.
    assert drift == pytest.approx(-(z**6) / 72 + z**8 / 576, rel=1e-12)
    if z <= 0.5:
        assert drift == pytest.approx(-(z**6) / 72, rel=z**2 / 7)
