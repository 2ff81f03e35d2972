"""Energies and flow rules of the user's own, against closed forms."""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array
from lattice import elastic, held, lattice

from jaxcrumple.geometry.hinge import curvature
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.model.loads import ElementEnergy
from jaxcrumple.model.plasticity import AbstractFlowRule
from jaxcrumple.scene import sheet
from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.relax import relax
from jaxcrumple.solvers.scheme import integrator
from jaxcrumple.state import initial_state

NODES = 60
# The linear solver needs no extra.
SOLVER = integrator(1e-5, linear="block-cg")


def tether(x, parameters, t):
    """A spring from a node to its anchor; it breaks (NaN) beyond `limit`."""
    stiffness, anchor, limit = parameters
    square = jnp.sum((x[0] - anchor) ** 2)
    return 0.5 * stiffness * square * jnp.where(square > limit**2, jnp.nan, 1.0)


G = 9.81
STIFFNESS = 0.02


@functools.cache
def tethered_mesh():
    return rectangle(0.1, 0.08, NODES, seed=3, sweeps=5)


def tethered(anchor, limit=1.0):
    """An elastic sheet under gravity whose nodes hang on equal springs."""
    mesh = tethered_mesh()
    ground = ElementEnergy(
        jnp.arange(NODES)[:, None],
        tether,
        (jnp.full(NODES, STIFFNESS), jnp.asarray(anchor), jnp.full(NODES, limit)),
    )
    return sheet(mesh, elastic(drag_rate=1e3), gravity=(0.0, 0.0, -G), extra=[ground])


def test_springs_to_ground_relax_to_their_closed_form():
    flat = tethered_mesh().vertices
    angle = 0.3
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    anchor = flat @ turn.T + np.array([0.01, 0.0, 0.02])
    scene = tethered(anchor)
    tolerance = 1e-11
    relaxed = relax(scene, initial_state(scene, flat), force_tolerance=tolerance, linear="block-cg")
    assert bool(relaxed.converged)
    # Every node has the same weight and the same spring: the turned sheet sinks without deforming.
    sag = float(scene.mass[0]) * G / STIFFNESS
    assert sag > 1e-3
    np.testing.assert_allclose(relaxed.state.x, anchor - [0, 0, sag], atol=100 * tolerance / STIFFNESS)


def test_springs_to_ground_sink_as_their_closed_form():
    flat = tethered_mesh().vertices
    scene = tethered(flat)
    mass, drag = float(scene.mass[0]), float(scene.drag.coefficient[0])
    sag, t = mass * G / STIFFNESS, 1.5 * drag / STIFFNESS
    solution = simulate(scene, initial_state(scene, flat), t, solver=SOLVER)
    assert solution.result == "success"
    # An overdamped oscillator from rest, displacement -sag + a exp(r t) + (sag - a) exp(s t).
    root = np.sqrt(0.25 * (drag / mass) ** 2 - STIFFNESS / mass)
    r, s = -0.5 * drag / mass + root, -0.5 * drag / mass - root
    a = -s * sag / (r - s)
    expected = flat + np.array([0, 0, -sag + a * np.exp(r * t) + (sag - a) * np.exp(s * t)])
    np.testing.assert_allclose(solution.state.x, expected, atol=1e-5 * float(scene.length_scale))


def test_an_energy_that_turns_nan_ends_in_a_named_result():
    flat = tethered_mesh().vertices
    limit = 0.5 * float(tethered(flat).mass[0]) * G / STIFFNESS
    scene = tethered(flat, limit)
    solution = simulate(scene, initial_state(scene, flat), 3.0, solver=SOLVER, max_seconds=20.0)
    assert solution.result in ("collapsed", "nonfinite")
    assert 0 < float(solution.state.t) < 3.0
    moved = np.linalg.norm(solution.state.x - flat, axis=1)
    assert np.all(np.isfinite(solution.state.v))
    assert 0.9 * limit < moved.max() <= limit
    assert np.isfinite(solution.history.drop(columns="stage").to_numpy(float)).all()


def cliff(x, depth, t):
    """Next to nothing down to a depth, and nothing known below it."""
    return 1e-30 * jnp.sqrt(x[0, 2] + depth)


def test_a_step_whose_end_alone_has_no_forces_is_cut():
    # From rest the last stage of an explicit step falls by g h^2 / 3, its end by g h^2 / 2.
    flat, h = tethered_mesh().vertices, 1e-7
    depth = 0.4 * G * h**2
    ground = ElementEnergy(jnp.arange(NODES)[:, None], cliff, jnp.full(NODES, depth))
    scene = sheet(tethered_mesh(), elastic(drag_rate=0.0), gravity=(0.0, 0.0, -G), extra=[ground])
    solver = integrator(1e-3, scheme="explicit", max_step=h)
    solution = simulate(scene, initial_state(scene, flat), 1.0, solver=solver, max_seconds=20.0)
    assert solution.result == "nonfinite"
    np.testing.assert_allclose(solution.state.t, np.sqrt(2 * depth / G), rtol=1e-3)
    assert -depth < solution.state.x[:, 2].min() < -0.999 * depth


class Creep(AbstractFlowRule):
    """A sheet that forgets: dp/dt = (c - p) / T."""

    time: Array

    def rate(self, c, p):
        return (c - p) / self.time


def test_a_flow_rule_of_the_users_own():
    mesh = lattice(2, 2)
    fold = mesh.vertices + np.array([0, 0, 3e-4]) * np.arange(mesh.n_nodes)[:, None] ** 2
    scene = sheet(
        mesh,
        elastic(),
        prescribed=held(np.ones((mesh.n_nodes, 3), bool), fold),
        plasticity=Creep(jnp.asarray(0.5)),
    )
    c = np.asarray(curvature(scene.bending.hinges(jnp.asarray(fold)).theta))
    assert np.min(np.abs(c)) > 0.05
    solution = simulate(scene, initial_state(scene, fold), [0.25, 1.0], solver=SOLVER)
    assert solution.result == "success"
    for t, p in zip(solution.t, solution.p, strict=True):
        np.testing.assert_allclose(p, c * (1 - np.exp(-t / 0.5)), atol=2e-5)
