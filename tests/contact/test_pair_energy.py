"""The pair potential of self-contact: Appendix A.3, gaps under load, and its two ends."""

import appendix_a as paper
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import assert_close, gradients, hessians, rotations
from scipy.optimize import brentq

from jaxcrumple.contact.potentials import InversePower, Penalty

PENALTY, INVERSE = Penalty().energy, InversePower().energy


def contact_data(count=200):
    """Six nodes per pair of sites (m, 6, 3), weights (m, 6), and r/sigma from 0.03 to 0.97."""
    rng = np.random.default_rng(5)
    ks, sigma = 1.7, 0.3
    weights = rng.dirichlet(np.ones(3), (count, 2))
    x = rng.normal(size=(count, 2, 3, 3))
    gap = np.linspace(0.03, 0.97, count)[:, None] * sigma * rotations(rng, count)[:, 0]
    sites = np.einsum("msk,mskj->msj", weights, x)
    x[:, 0] += (gap - sites[:, 0] + sites[:, 1])[:, None]
    return x.reshape(count, 6, 3), weights.reshape(count, 6), ks, sigma


def site_vector(x, w):
    """$r_{12}$ of (A.9) from six nodes."""
    return w[:3] @ x[:3] - w[3:] @ x[3:]


def contact_energy(x, w, ks, sigma):
    """Package's contact energy of six nodes."""
    r = site_vector(x, w)
    return PENALTY(jnp.sqrt(r @ r), ks, sigma)


def test_contact_force_is_a8_a9():
    x, w, ks, sigma = contact_data()
    r12 = np.einsum("mk,mkj->mj", w[:, :3], x[:, :3]) - np.einsum("mk,mkj->mj", w[:, 3:], x[:, 3:])
    signed = w * np.array([1, 1, 1, -1, -1, -1])
    expected = signed[:, :, None] * paper.contact_force(r12, ks, sigma)[:, None]
    force = -gradients(lambda x, w: contact_energy(x, w, ks, sigma))(x, w)
    assert_close(force, expected)


def test_contact_hessian_is_a10_with_corrected_sign():
    x, w, ks, sigma = contact_data()
    r12 = np.einsum("mk,mkj->mj", w[:, :3], x[:, :3]) - np.einsum("mk,mkj->mj", w[:, 3:], x[:, 3:])
    block = paper.contact_block(r12, ks, sigma)
    # (A.10) is the block of nodes on different sites; on the same site it changes sign.
    signed = w * np.array([1, 1, 1, -1, -1, -1])
    expected = -np.einsum("mi,mj,mkl->mikjl", signed, signed, block)
    hessian = hessians(lambda x, w: contact_energy(x, w, ks, sigma))(x, w)
    assert_close(hessian, expected)
    size = np.max(np.abs(expected), axis=(1, 2, 3, 4))
    rows = np.max(np.abs(np.sum(expected, axis=3)), axis=(1, 2, 3))
    assert np.max(rows / size) < 1e-12


PAIR_GAPS = {1e-3: 0.9156, 0.01: 0.8889, 0.05: 0.8538, 0.1: 0.8284, 0.2: 0.7876, 0.4: 0.6979, 0.5: 0.6180}


@pytest.mark.parametrize("load", PAIR_GAPS)
def test_contact_gap_under_load(load):
    force = jax.jit(lambda r: -jax.grad(PENALTY)(r, 1.0, 1.0))
    gap = brentq(lambda r: float(force(r)) - load, 0.5, 0.99, xtol=1e-12)
    assert abs(gap - PAIR_GAPS[load]) < 5.1e-5


def test_contact_is_finite_at_zero_and_softens_inside_half_the_range():
    ks, sigma = 1.7, 0.3
    r = np.linspace(1e-6, 0.999, 1999) * sigma
    energy, slope = jax.jit(jax.vmap(jax.value_and_grad(lambda r: PENALTY(r, ks, sigma))))(r)
    assert abs(PENALTY(0.0, ks, sigma) / (ks * sigma**2) - np.exp(-1.0)) < 1e-14
    assert np.all(np.diff(energy) < 0)
    force = -np.asarray(slope) / (ks * sigma)
    peak = np.argmax(force)
    assert abs(r[peak] / sigma - 0.5) < 6e-4
    assert abs(-jax.grad(PENALTY)(0.5, 1.0, 1.0) - 4.0 * np.exp(-2.0)) < 1e-13
    assert abs(force[peak] - 0.5413) < 5e-5


def test_contact_ends_smoothly_at_its_range():
    sigma = 0.3
    r = np.array([sigma * (1 - 1e-3), np.nextafter(sigma, 0.0), sigma, 1.5 * sigma])
    energy = jax.grad(jax.grad(lambda r: PENALTY(r, 1.7, sigma)))
    derivatives = [jax.vmap(lambda r: PENALTY(r, 1.7, sigma))(r), jax.vmap(energy)(r)]
    assert np.all(np.asarray(derivatives) == 0.0)


def test_inverse_power_diverges_and_ends_smoothly_at_its_range():
    ks, sigma = 1.7, 0.3
    r = np.array([1e-3, 0.25, 0.5, 1 - 1e-3, 1.0, 1.5]) * sigma
    value, slope, bend = (jax.vmap(f)(r) for f in derivatives(lambda r: INVERSE(r, ks, sigma)))
    assert abs(value[1] / (ks * sigma**2) - 0.1 * 0.75**3 / 0.25**4) < 1e-13
    assert abs(slope[2] / (ks * sigma) + 0.1 * (3 * 0.5**2 / 0.5**4 + 4 * 0.5**3 / 0.5**5)) < 1e-13
    assert value[0] > 0.099 * 1e12 * ks * sigma**2
    assert abs(bend[3] / (ks * 0.6e-3) - 1.0) < 0.02
    assert np.all(np.array([value, slope, bend])[:, 4:] == 0.0)


def derivatives(energy):
    """The energy and its first two derivatives."""
    return energy, jax.grad(energy), jax.grad(jax.grad(energy))


def test_inverse_power_carries_the_pressure_of_the_penalty_at_two_gaps():
    """The pressure of layers at distance r is in proportion to r times the energy of two sites at r."""
    for low, high, gap in ((0.4, 0.7, 0.541), (0.8, 0.95, 0.875)):
        same = brentq(lambda r: float(INVERSE(r, 1.0, 1.0) - PENALTY(r, 1.0, 1.0)), low, high)
        assert abs(same - gap) < 1e-3
