"""Plasticity of hinges: the flow rule, the plastic edge and the implicit update."""

import appendix_a as paper
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import update
from scipy.integrate import solve_ivp

from jaxcrumple.model.plasticity import AbstractFlowRule, SmoothstepFlow, implicit_update


def law(c0=0.3, time=1.0, gamma=1.0):
    """The paper's law."""
    return SmoothstepFlow(jnp.asarray(c0), jnp.asarray(time), jnp.asarray(gamma))


def smoothstep_gap(u):
    """G(u) with $G' = 1/S$: the time that the excess u takes to decay, in units of $T$."""
    log = 11.0 * np.log(u) - 5.5 * np.log(u * u - 2.5 * u + 5.0 / 3.0)
    arc = 3.0 * np.sqrt(15.0) * np.arctan((4.0 * u - 5.0) * np.sqrt(15.0) / 5.0)
    return 3.0 / 200.0 * (log + arc) - 3.0 / (20.0 * u) - 1.0 / (20.0 * u * u)


def integrate(rate, start, times):
    """Tight integration of a scalar equation; values at `times`."""
    solution = solve_ivp(
        lambda t, y: [float(rate(t, y[0]))],
        (0.0, times[-1]),
        [start],
        "DOP853",
        times,
        rtol=1e-12,
        atol=1e-13,
    )
    assert solution.success
    return solution.y[0]


def test_flow_rate_is_eqs_34_to_36():
    rng = np.random.default_rng(15)
    c, p = rng.uniform(-2.0, 2.0, (2, 5000))
    c0, time, gamma = 0.3, 0.7, 1.6
    u = np.clip((np.abs(c - p) - c0) / (2.0 - c0), 0.0, 1.0)
    expected = np.sign(c - p) * (6.0 * u**5 - 15.0 * u**4 + 10.0 * u**3) / (time * (1.0 + gamma))
    rate = np.asarray(law(c0, time, gamma).rate(jnp.asarray(c), jnp.asarray(p)))
    assert np.max(np.abs(rate - expected)) < 1e-14
    elastic = np.abs(c - p) <= c0
    assert np.all(rate[elastic] == 0.0)
    assert np.all(rate[~elastic] != 0.0)
    beyond = np.abs(c - p) > 2.0
    assert np.sum(beyond) > 0
    assert np.max(np.abs(np.abs(rate[beyond]) * time * (1.0 + gamma) - 1.0)) < 1e-14


def test_plastic_edge_under_held_curvature():
    C, c0, gamma = 1.5, 0.3, 1.0
    rate = jax.jit(lambda p: law(c0, 1.0, gamma).rate(jnp.full(1, C), p[None])[0])
    times = np.array([1.0, 5.0, 20.0, 50.0])
    p = integrate(lambda t, p: rate(p), 0.0, times)
    assert np.max(np.abs(p - [0.337495915, 0.790048489, 1.017490305, 1.090856147])) < 6e-10
    u = (C - p - c0) / (2.0 - c0)
    elapsed = (smoothstep_gap((C - c0) / (2.0 - c0)) - smoothstep_gap(u)) * (1.0 + gamma) * (2.0 - c0)
    assert np.max(np.abs(elapsed / times - 1.0)) < 1e-9


def test_plastic_edge_on_a_ramp():
    rate = jax.jit(lambda c, p: law().rate(c[None], p[None])[0])
    p = integrate(lambda t, p: rate(0.1 * t, p), 0.0, np.array([60.0, 70.0]))
    elastic = 0.1 * np.array([60.0, 70.0]) - p
    assert np.max(np.abs(elastic - 0.855217)) < 6e-7


def test_unloading_yields_again_only_beyond_c0():
    p = np.array([0.1, 0.2999, 0.3, 0.3001, 0.8])
    rate = np.asarray(law().rate(jnp.zeros(5), jnp.asarray(p)))
    assert np.all(rate[:3] == 0.0)
    assert np.all(rate[3:] < 0.0)


class Bingham(AbstractFlowRule):
    """A user's law: flow proportional to the excess over a per-hinge yield curvature."""

    yield_curvature: jax.Array
    time: jax.Array

    def rate(self, c, p):
        """dp/dt in 1/s."""
        elastic = c - p
        return jnp.sign(elastic) * jnp.maximum(jnp.abs(elastic) - self.yield_curvature, 0.0) / self.time


def implicit_data(count=2000, seed=16):
    """Random states of an implicit plastic step."""
    rng = np.random.default_rng(seed)
    c, start = rng.uniform(-2.0, 2.0, (2, count))
    return jnp.asarray(c), jnp.asarray(start)


@pytest.mark.parametrize("beta_h", [1e-12, 1e-3, 0.3, 10.0, 1e3, 1e6, 1e12])
@pytest.mark.parametrize("c0", [0.05, 0.3, 1.2])
def test_implicit_update_finds_the_root(beta_h, c0):
    c, start = implicit_data()
    p, slope = (np.asarray(a) for a in update(law(c0), c, -start, beta_h))
    c, start = np.asarray(c), np.asarray(start)
    assert np.all(np.isfinite(p))
    assert np.all((slope >= 0.0) & (slope < 1.0))

    # Bisection of eq. (48) in plain NumPy.
    def mismatch(p):
        u = np.clip((np.abs(c - p) - c0) / (2.0 - c0), 0.0, 1.0)
        return p - start - beta_h * np.sign(c - p) * (6.0 * u**5 - 15.0 * u**4 + 10.0 * u**3) / 2.0

    low, high = np.minimum(start, c), np.maximum(start, c)
    for _ in range(70):
        middle = 0.5 * (low + high)
        positive = mismatch(middle) > 0.0
        low, high = np.where(positive, low, middle), np.where(positive, middle, high)
    elastic = np.abs(c - start) <= c0
    assert np.max(np.abs(p - 0.5 * (low + high))[~elastic]) < 1e-13
    assert np.array_equal(p[elastic], start[elastic])
    assert 0.01 < np.mean(elastic) < 0.9
    expected = paper.softening(c - p, c0, 2.0, beta_h)
    assert np.max(np.abs(slope - expected)) < 1e-9


@pytest.mark.parametrize("beta_h", [0.3, 10.0])
def test_implicit_update_slope(beta_h):
    c, start = implicit_data()
    # Away from the onset of yield, where the law is only twice differentiable.
    keep = np.abs(np.abs(c - start) - 0.3) > 1e-3
    c, start = c[keep], start[keep]
    slope = update(law(), c, -start, beta_h)[1]

    @jax.jit
    def derivative(c, beta_h):
        return jax.jvp(lambda c: implicit_update(law(), c, -start, beta_h)[0], (c,), (jnp.ones_like(c),))[1]

    tangent = derivative(c, beta_h)
    assert np.max(np.abs(tangent - slope)) < 1e-12
    step = 1e-5
    plus, minus = (update(law(), c + s, -start, beta_h)[0] for s in (step, -step))
    difference = (plus - minus) / (2.0 * step)
    assert np.max(np.abs(difference - slope)) < 1e-7
    assert np.max(slope) > 0.1


def test_implicit_update_can_be_differentiated_in_reverse():
    c, start = implicit_data(200)
    beta_h, c0 = 3.0, jnp.full(200, 0.3)

    @jax.jit
    def total(c, memory, beta_h, c0):
        return jnp.sum(
            implicit_update(SmoothstepFlow(c0, jnp.asarray(1.0), jnp.asarray(1.0)), c, memory, beta_h)[0]
        )

    by_c, by_memory, by_step, by_c0 = jax.grad(total, (0, 1, 2, 3))(c, -start, beta_h, c0)
    p, slope = update(law(), c, -start, beta_h)
    assert np.max(np.abs(by_c - slope)) < 1e-12
    # (48) differentiated: (1 + beta h f') dp = dp* + g d(beta h) + beta h f' dc.
    assert np.max(np.abs(by_memory + (1.0 - slope))) < 1e-12
    assert abs(by_step - np.sum((1.0 - slope) * law().rate(c, p))) < 1e-10
    step = 1e-6
    difference = (total(c, -start, beta_h, c0 + step) - total(c, -start, beta_h, c0 - step)) / (2.0 * step)
    assert abs(np.sum(by_c0) - difference) < 1e-6


@pytest.mark.parametrize("beta_h", [1e-6, 0.5, 1e8])
def test_implicit_update_with_a_law_of_ones_own(beta_h):
    c, start = implicit_data(500)
    c0 = jnp.linspace(0.1, 1.0, 500)
    p, slope = update(Bingham(c0, jnp.asarray(0.5)), c, -start, beta_h)
    ratio = beta_h / 0.5
    yielding = np.abs(c - start) > c0
    flow = np.sign(c - start) * (np.abs(c - start) - c0) * ratio / (1.0 + ratio)
    assert np.max(np.abs(p - np.where(yielding, start + flow, start))) < 1e-13
    assert np.max(np.abs(slope - np.where(yielding, ratio / (1.0 + ratio), 0.0))) < 1e-9
    assert np.array_equal(p[~yielding], start[~yielding])
