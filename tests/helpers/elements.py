"""Random hinges and edges, and the package's functions of one element, that several tests share."""

from functools import cache

import appendix_a as paper
import jax
import jax.numpy as jnp
import numpy as np

from jaxcrumple.geometry import hinge as geometry
from jaxcrumple.model import bending
from jaxcrumple.model.bending import Bending
from jaxcrumple.model.elements import upper_pairs
from jaxcrumple.model.plasticity import implicit_update

HINGES, EDGES = 400, 300  # all hinge tests but one use this many: one compilation serves them all
RTOL = 1e-9
FOLD_STOP = np.pi * 170.0 / 180.0


def rotations(rng, count):
    """Random rotation matrices (count, 3, 3)."""
    q, r = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None, :]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def hinges_at(rng, theta, attitude=None):
    """Hinges (m, 4, 3) of random shape, size and place that are bent by `theta` (m,)."""
    m = len(theta)
    attitude = rotations(rng, m) if attitude is None else attitude
    length = rng.uniform(0.5, 2.0, m)
    foot1, foot2 = rng.uniform(-0.5, 1.5, (2, m)) * length
    height1, height2 = rng.uniform(0.3, 2.0, (2, m)) * length
    x = np.zeros((m, 4, 3))
    x[:, 1, 0] = length
    x[:, 2] = np.stack([foot1, height1, np.zeros(m)], axis=1)
    x[:, 3] = np.stack([foot2, -height2 * np.cos(theta), -height2 * np.sin(theta)], axis=1)
    return np.einsum("mij,mkj->mki", attitude, x) + rng.normal(size=(m, 1, 3))


def random_hinges(seed=0, count=HINGES, low=1e-3, high=3.0):
    """Hinges with |theta| log-uniform in [low, high], both signs, some at the end; returns (x, theta)."""
    rng = np.random.default_rng(seed)
    theta = np.exp(rng.uniform(np.log(low), np.log(high), count)) * rng.choice([-1.0, 1.0], count)
    # A third is spread evenly, so that large angles, where curvature is strong, are well covered.
    even = np.arange(0, count, 3)
    theta[even] = rng.uniform(low, high, even.size) * np.sign(theta[even])
    theta[:8] = np.linspace(0.99, 1.0, 8) * high * np.array([1.0, -1.0] * 4)
    return hinges_at(rng, theta), theta


def hinge_sample():
    """Random hinges with the oracle's terms, stiffness K and rest curvatures p."""
    x, theta = random_hinges()
    rng = np.random.default_rng(2)
    K = paper.hinge_stiffness(rng.uniform(0.5, 2.0, HINGES), hinges_at(rng, np.zeros(HINGES)))
    return x, theta, paper.hinge_terms(x), K, rng.uniform(-1.2, 1.2, HINGES)


def random_edges(seed=1, count=EDGES):
    """Edges (m, 2, 3), velocities (m, 2, 3), coefficients and rest lengths (m,)."""
    rng = np.random.default_rng(seed)
    x, v = rng.normal(size=(2, count, 2, 3))
    length = np.linalg.norm(x[:, 0] - x[:, 1], axis=1)
    return x, v, rng.uniform(0.5, 2.0, count), length * rng.uniform(0.6, 1.5, count)


def assert_close(actual, expected, rtol=RTOL, keep=1):
    """Compare element by element, relative to the largest entry of each element's array."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    assert np.all(np.isfinite(actual))
    axes = tuple(range(keep, expected.ndim))
    scale = np.max(np.abs(expected), axis=axes)
    error = np.max(np.abs(actual - expected), axis=axes) / scale
    assert np.max(error) < rtol, f"relative error {np.max(error):.2e} at element {np.argmax(error)}"


def disconnected(x):
    """Nodes (m k, 3) and element numbering (m, k) of elements (m, k, 3) that share no node."""
    m, k = x.shape[:2]
    return jnp.asarray(x.reshape(m * k, 3)), jnp.arange(m * k).reshape(m, k)


def full_matrix(blocks, size):
    """Element Hessians (m, size, 3, size, 3) from the package's upper-triangular blocks."""
    full = np.zeros((blocks.shape[-1], size, 3, size, 3))
    for block, (a, b) in zip(np.moveaxis(np.asarray(blocks), -1, 1), upper_pairs(size), strict=True):
        full[:, b, :, a, :] = np.swapaxes(block, 1, 2)
        full[:, a, :, b, :] = block
    return full


def angle(x):
    """Signed angle of one hinge (4, 3)."""
    return geometry.hinge_angle(*geometry.unpack(x))


def curvature(x):
    """Package's c of one hinge."""
    return geometry.curvature(angle(x))


curvatures = jax.jit(jax.vmap(curvature))


def hinge_energy(x, p, stiffness):
    """Package's energy of one hinge, fold stop included."""
    return bending.hinge_energy(angle(x), p, stiffness)


@cache
def gradients(function):
    """Vectorised gradient by the first argument."""
    return jax.jit(jax.vmap(jax.grad(function)))


@cache
def hessians(function):
    """Vectorised Hessian by the first argument."""
    return jax.jit(jax.vmap(jax.hessian(function)))


@jax.jit
def kernels(x, p, stiffness, loss):
    """Bending's closed-form forces (m, 4, 3) and blocks (10, 3, 3, m) of hinges (m, 4, 3)."""
    nodes = jnp.arange(4 * len(x)).reshape(-1, 4)
    nodes_x = x.reshape(-1, 3)
    model = Bending(nodes, stiffness, jnp.zeros(len(x)))
    force = model.force(model.hinges(nodes_x), p, 4 * len(x)).reshape(-1, 4, 3)
    return force, model.blocks(nodes_x, p, loss)


update = jax.jit(implicit_update)
