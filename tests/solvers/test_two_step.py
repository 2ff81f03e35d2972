"""The two-step family for inertia: what it is at its ends, its order, stability, and error estimate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcrumple.history import HISTORY
from jaxcrumple.solvers.implicit import bdf

_two_step = jax.jit(bdf.two_step)
_coefficients = jax.jit(bdf.coefficients)
_error_constant = jax.jit(bdf.error_constant)
_extrapolation = jax.jit(bdf.extrapolation)

RADII = [0.0, 0.3, 0.8, 1.0]
THETAS = [0.5, 0.55, 0.7, 1.0]


def random_steps(seed):
    """New step and past steps (6,), of any ratio up to e^3."""
    h, *past = np.exp(np.random.default_rng(seed).uniform(-1.5, 1.5, HISTORY + 1))
    return h, jnp.array(past)


def method(h, past, theta, order=2):
    """Coefficients of $(Y + a_0 y_0 + a_1 y_{-1})/(\\beta h)$: alpha (2,), beta h, share of the error."""
    step = _two_step(h, past, order, theta)
    assert np.all(np.asarray(step.alpha)[2:] == 0)
    return np.asarray(step.alpha)[:2], float(step.beta_h), float(step.error)


# --- Coefficients --------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2])
def test_theta_one_is_bdf(order):
    for seed in range(20):
        h, past = random_steps(seed)
        alpha, beta_h, share = method(h, past, 1.0, order)
        expected, expected_beta = _coefficients(h, past, order)
        np.testing.assert_allclose(alpha, expected[:2], rtol=1e-13, atol=1e-13)
        assert beta_h == pytest.approx(float(expected_beta), rel=1e-13)
        assert share == pytest.approx(float(_error_constant(h, past, order)), rel=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_theta_one_half_is_the_midpoint_rule(order):
    for seed in range(20):
        h, past = random_steps(seed)
        alpha, beta_h, _ = method(h, past, 0.5, order)
        np.testing.assert_allclose(alpha, [-1.0, 0.0], atol=1e-12)
        assert beta_h == pytest.approx(h / 2, rel=1e-14)


@pytest.mark.parametrize("theta", THETAS)
@pytest.mark.parametrize("order", [1, 2])
def test_derivative_is_exact_on_polynomials(theta, order):
    """Of degree 1 and 2, at the time t + theta h that the equations belong to."""
    for seed in range(20):
        h, past = random_steps(seed)
        alpha, beta_h, _ = method(h, past, theta, order)
        new, before = (1 - theta) * h, -theta * h - float(past[0])
        for power in range(order + 1):
            y = np.array([new, -theta * h, before]) ** power
            mean = theta * y[0] + (1 - theta) * y[1]
            assert (mean + alpha @ y[1:]) / beta_h == pytest.approx(float(power == 1), abs=1e-10)


@pytest.mark.parametrize("theta", THETAS)
def test_error_share_is_exact_on_a_cubic(theta):
    """y' = N y, whose solution is (1, t, t^2/2, t^3/6): only the cubic is in error."""
    shift = np.diag(np.ones(3), -1)

    def exact(t):
        return np.array([1.0, t, t**2 / 2, t**3 / 6])

    for seed in range(20):
        h, past = random_steps(seed)
        alpha, beta_h, share = method(h, past, theta)
        times = -np.cumsum([0.0, *past[:2]])
        points = np.array([exact(t) for t in times])
        mean = np.linalg.solve(np.eye(4) / beta_h - shift, -(alpha @ points[:2]) / beta_h)
        new = points[0] + (mean - points[0]) / theta
        scale = np.abs(points).max() + np.abs(exact(h)).max()
        np.testing.assert_allclose(new[:3], exact(h)[:3], atol=1e-12 * scale)
        predicted = np.asarray(_extrapolation(h, past, 3))[:3] @ points[:, 3]
        error = abs(new[3] - exact(h)[3])
        assert error == pytest.approx(share * abs(exact(h)[3] - predicted), rel=1e-7, abs=1e-12 * scale)
        assert 0 < share < 1


# --- Stability -----------------------------------------------------------------------------------


def amplification(z, theta):
    """Roots (2,) of the method at equal steps for y' = lambda y, z = lambda h."""
    alpha, beta, _ = method(1.0, jnp.ones(HISTORY), theta)
    new, now, before = theta, alpha[0] + 1 - theta, alpha[1]
    return np.roots([new - beta * z * theta, now - beta * z * (1 - theta), before])


@pytest.mark.parametrize("rho", RADII)
def test_a_mode_of_infinite_frequency_shrinks_by_rho(rho):
    theta = 1 / (1 + rho)
    for z in (1e9j, -1e9, 1e9 * (-1 + 1j)):
        assert np.abs(amplification(z, theta)).max() == pytest.approx(rho, abs=1e-4)


@pytest.mark.parametrize("rho", RADII)
def test_stable_on_the_imaginary_axis_and_left_of_it(rho):
    theta = 1 / (1 + rho)
    for y in np.geomspace(1e-3, 1e4, 200):
        radius = np.abs(amplification(1j * y, theta)).max()
        assert radius <= 1 + 1e-12
        assert radius < 1 - 1e-13 or rho == 1 or y < 1e-2
        for x in (-1e-2, -1.0, -1e2):
            assert np.abs(amplification(x + 1j * y, theta)).max() < 1


def test_what_is_lost_falls_from_bdf2_to_the_midpoint_rule():
    loss = [1 - np.abs(amplification(0.1j, 1 / (1 + rho))).max() for rho in RADII]
    assert np.all(np.diff(loss) < 0)
    assert loss[-1] == pytest.approx(0.0, abs=1e-13)
    # At small steps theta (theta - 1/2) (omega h)^4 / 2, a quarter at BDF2.
    for rho, lost in zip(RADII[:-1], loss, strict=False):
        theta = 1 / (1 + rho)
        assert lost == pytest.approx(theta * (theta - 0.5) * 0.1**4 / 2, rel=0.03)


# --- Runs ----------------------------------------------------------------------------------------


def oscillate(theta, steps, omega=1.0):
    """Positions and velocities (n + 1, 2) of y'' = -omega^2 y from (1, 0); the first step has order 1."""
    matrix = np.array([[0.0, 1.0], [-(omega**2), 0.0]])
    points = [np.array([1.0, 0.0])]
    past = np.ones(HISTORY)
    for count, h in enumerate(steps):
        alpha, beta_h, _ = method(h, jnp.array(past), theta, 1 if count == 0 else 2)
        memory = alpha[0] * points[-1] + (alpha[1] * points[-2] if count else 0.0)
        mean = np.linalg.solve(np.eye(2) - beta_h * matrix, -memory)
        points.append(points[-1] + (mean - points[-1]) / theta)
        past = np.concatenate([[h], past[:-1]])
    return np.array(points)


def varied(count, span):
    steps = np.random.default_rng(count).uniform(0.6, 1.4, count)
    return span * steps / steps.sum()


@pytest.mark.parametrize("theta", [0.5, 0.7, 1.0])
@pytest.mark.parametrize(
    "steps", [lambda n: np.full(n, 6.0 / n), lambda n: varied(n, 6.0)], ids=["equal", "varied"]
)
def test_order_two(theta, steps):
    counts = np.array([100, 200, 400])
    errors = []
    for count in counts:
        end = oscillate(theta, steps(count))[-1]
        errors.append(np.linalg.norm(end - [np.cos(6.0), -np.sin(6.0)]))
    observed = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert observed == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize("omega", [0.1, 1.0, 5.0, 50.0])
@pytest.mark.parametrize("theta", THETAS)
def test_energy_of_an_undamped_oscillator_never_exceeds_its_start(theta, omega):
    points = oscillate(theta, np.ones(60), omega)
    energy = (omega * points[:, 0]) ** 2 + points[:, 1] ** 2
    assert np.all(energy <= energy[0] * (1 + 1e-12))
    if theta == 0.5:
        np.testing.assert_allclose(energy, energy[0], rtol=1e-11)
    else:
        assert energy[-1] < energy[0] * (1 - 1e-5)


def test_the_midpoint_rule_keeps_the_energy_at_any_steps():
    points = oscillate(0.5, varied(60, 100.0))
    np.testing.assert_allclose(np.sum(points**2, axis=1), 1.0, rtol=1e-12)
