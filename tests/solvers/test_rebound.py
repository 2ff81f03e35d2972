"""Two rigid layers that fly at one another and rebound: energy and time of the bounce in closed form, and
what many bounces lose."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import bound
from scipy.integrate import quad
from scipy.optimize import brentq

import jaxcrumple as jc
from jaxcrumple.model.loads import ElementEnergy
from jaxcrumple.solvers.explicit.verlet import Verlet
from jaxcrumple.solvers.log import ENERGIES

SIGMA, SPEED, START = 0.5e-3, 1.0, 1.2 * 0.5e-3
# Speed in m/s at which layers meet that fall from rest.
FALLEN = 0.5


def pull(x, force, t):
    """Energy in J of two nodes that a `force` in N draws together across the layers."""
    return force * (x[1][2] - x[0][2])


def layers():
    """Two equilateral triangles that face each other, with a force between them that is 0: scene
    without losses, positions, and which nodes are of the upper one."""
    points = (
        3.0 * SIGMA * np.array([[0, 0], [0.5, 0.75**0.5], [1, 0], [1.5, 0.75**0.5], [2, 0], [2.5, 0.75**0.5]])
    )
    mesh = jc.Mesh.from_arrays(points, [[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]], reorder=True)
    material = jc.Material(thickness=0.3e-3, yield_curvature=None, drag_rate=0.0, internal_damping_time=0.0)
    first = mesh.faces[np.argmin(mesh.vertices[mesh.faces, 0].sum(axis=1))]
    upper = ~np.isin(np.arange(mesh.n_nodes), first)
    x = mesh.vertices.copy()
    # So that the triangles between them do not lie on one another.
    x[upper] = np.roll(x[~upper], -1, axis=0)
    facing = [(low, np.flatnonzero(upper & np.all(x == x[low], axis=1))[0]) for low in np.flatnonzero(~upper)]
    together = ElementEnergy(jnp.asarray(facing), pull, jnp.zeros(3))
    scene = jc.sheet(mesh, material, contact=jc.SelfContact(range=SIGMA, level=5), extra=[together])
    own = upper[mesh.edges[:, 0]] == upper[mesh.edges[:, 1]]
    whole = np.isin(upper[mesh.faces].sum(axis=1), (0, 3))
    scene = eqx.tree_at(
        lambda s: (s.membrane.stiffness, s.bending.stiffness, s.contact.density),
        scene,
        (
            jnp.where(own, scene.membrane.stiffness, 0.0),
            jnp.zeros_like(scene.bending.stiffness),
            # By area alone, so that all nodes are stopped alike.
            jnp.where(whole[:, None], jnp.broadcast_to(scene.contact.density[:, :1], (len(whole), 7)), 0.0),
        ),
    )
    return scene, x, upper


def bounce(scene, x, upper):
    """Time in s from the start to the return to the same gap, and the closest gap, by quadrature."""
    reduced = 0.25 * float(jnp.sum(scene.mass))
    near = jnp.asarray(x + np.where(upper, 0.95 * SIGMA, 0.0)[:, None] * np.array([0.0, 0.0, 1.0]))
    contact = bound(jc.with_contacts(scene, near))

    @jax.jit
    def potential(gap):
        return contact.energy(near.at[:, 2].set(jnp.where(upper, gap, 0.0)))

    def left(gap):
        return SPEED**2 - 2.0 * float(potential(gap)) / reduced

    closest = brentq(left, 0.8 * SIGMA, SIGMA, xtol=1e-14)
    # With gap = closest + s^2 the integrand has no singularity.
    slope = -(left(closest) - left(closest + 1e-9)) / 1e-9

    def time(s):
        return 2.0 * s / np.sqrt(left(closest + s * s)) if s > 1e-6 else 2.0 / np.sqrt(slope)

    inside = quad(time, 0.0, np.sqrt(SIGMA - closest), epsrel=1e-7)[0]
    return 2.0 * (inside + (START - SIGMA) / SPEED), closest


@pytest.mark.parametrize(
    ("scheme", "rtol", "loss"),
    [
        pytest.param("explicit", 1e-3, 1e-4, marks=pytest.mark.slow),
        ("dynamic", 1e-3, 3e-3),
        ("dynamic", 1e-4, 3e-4),
    ],
)
def test_layers_rebound_with_their_energy_and_in_time(scheme, rtol, loss):
    """The speed after the bounce is that before it, but for an error that falls with the tolerance; nothing
    moves sideways."""
    scene, x, upper = layers()
    duration, closest = bounce(scene, x, upper)
    assert 0.85 * SIGMA < closest < 0.98 * SIGMA
    x[upper, 2] += START
    v = np.zeros_like(x)
    v[:, 2] = np.where(upper, -0.5, 0.5) * SPEED
    state = jc.initial_state(scene, x, v)
    end = jc.simulate(scene, state, duration, solver=jc.integrator(rtol, scheme=scheme)).state
    v, gap = np.asarray(end.v), np.asarray(end.x)[upper, 2].mean() - np.asarray(end.x)[~upper, 2].mean()
    parting = v[upper, 2].mean() - v[~upper, 2].mean()
    assert abs(parting / SPEED - 1.0) < loss
    assert abs(gap - START) < loss * START
    assert np.abs(v[:, :2]).max() < 1e-8 * SPEED


@pytest.mark.parametrize("speed", [150.0, 300.0, 1000.0])
def test_layers_that_meet_within_a_step_gain_little_energy(speed):
    """Wherever the last free step ends, layers whose steps reach deep into the range gain at most a quarter
    of their energy. Steps at the stability limit of free layers return up to four times of it."""
    scene, x, upper = layers()
    solver = jc.integrator(1e-2, scheme="explicit")
    solver = eqx.tree_at(lambda s: s.explicit, solver, Verlet(jnp.asarray(1e-2)))
    v = np.zeros_like(x)
    v[:, 2] = np.where(upper, -0.5, 0.5) * speed
    for start in START * np.linspace(1.0, 1.5, 8):
        apart = x + np.where(upper, start, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
        end = jc.simulate(scene, jc.initial_state(scene, apart, v), 2.5 * start / speed, solver=solver).state
        assert np.mean(np.asarray(end.v)[upper, 2]) > 0
        assert float(jnp.sum(end.v**2)) / np.sum(v**2) < 1.25


def loss_of_bounces(scheme: str, rtol: float) -> np.ndarray:
    """Energy lost until the top of each bounce of layers that fall on one another again and again, in units
    of what they fall with."""
    scene, x, upper = layers()
    fall = START - SIGMA
    energy = 0.125 * float(jnp.sum(scene.mass)) * FALLEN**2
    scene = eqx.tree_at(lambda s: s.extra[0].parameters, scene, jnp.full(3, energy / fall / 3.0))
    x[upper, 2] += START
    state = jc.initial_state(scene, x)
    run = jc.simulate(scene, state, 44.0 * fall / FALLEN, solver=jc.integrator(rtol, scheme=scheme))
    assert run.result == "success"
    gap = run.history["extra"].to_numpy()
    tops = np.flatnonzero((gap[1:-1] > gap[:-2]) & (gap[1:-1] >= gap[2:])) + 1
    total = run.history[list(ENERGIES)].sum(axis=1).to_numpy()
    return (total[0] - total[tops]) / energy


@pytest.mark.slow
def test_bounces_lose_what_the_integrator_predicts():
    """Explicit steps, here far below their tolerance, keep the energy, and implicit ones lose a share that is
    proportional to their tolerance."""
    loss = loss_of_bounces("explicit", 1e-2)
    assert len(loss) >= 9
    assert np.max(np.abs(loss)) < 1e-5
    coarse, fine = (loss_of_bounces("dynamic", rtol)[8] for rtol in (1e-2, 1e-3))
    assert 0 < fine < coarse < 0.5
    assert 0.7 < np.log10(coarse / fine) < 1.5
