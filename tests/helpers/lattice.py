"""Small sheets and helpers that several physics tests share."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import hexagonal
from jaxcrumple.model.loads import LinearMotion, Prescribed
from jaxcrumple.scene import sheet
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.scheme import integrator
from jaxcrumple.solvers.switch import Switch
from jaxcrumple.state import RESULTS, initial_state
from jaxcrumple.system import energies, tangent

SPACING = 1e-3
ROW = np.sqrt(3) / 2 * SPACING
CELL = SPACING * ROW  # area per node

# One jitted function for all files, so that equal structures compile once.
run = eqx.filter_jit(integrate)
# Thresholds that no run reaches: each stays in the stage it starts in.
FOREVER = Switch(up=np.inf, dwell=1e30)


def elastic(**properties):
    """The default sheet without plasticity; `properties` as `Material` takes them."""
    return Material(yield_curvature=None, **properties)


def lattice(nx, ny):
    """Hexagonal strip of spacing `SPACING`; node i of row j has the number nx j + i."""
    return hexagonal(nx, ny, SPACING, reorder=False)


def constants(scene):
    """Spring constant, bending constant and node mass of a uniform hexagonal scene."""
    return float(scene.membrane.stiffness[0]), float(scene.bending.stiffness[0]), float(scene.mass[0])


def held(mask, position, velocity=(0.0, 0.0, 0.0)):
    """Prescribed components `mask` (n, 3) that start at `position` (n, 3) and move uniformly."""
    motion = LinearMotion(jnp.asarray(position), jnp.asarray(velocity, float))
    return Prescribed(jnp.asarray(mask), motion)


def strip_scene():
    """Mesh and scene of an elastic strip that has every optional load, all of them switched off.

    Tests switch terms on with `eqx.tree_at`: the structure stays the same and nothing recompiles.
    """
    mesh = lattice(9, 4)
    support = held(np.zeros((mesh.n_nodes, 3), bool), mesh.vertices)
    scene = sheet(mesh, elastic(), gravity=(0.0, 0.0, 0.0), prescribed=support)
    off = (jnp.zeros_like(scene.drag.coefficient), jnp.zeros_like(scene.damping.coefficient))
    return mesh, eqx.tree_at(lambda s: (s.drag.coefficient, s.damping.coefficient), scene, off)


def solver(rtol, scheme="quasistatic", **options):
    """The integrator with one stage; `paper` keeps to the stage it starts in."""
    return integrator(rtol, scheme=scheme, switch=FOREVER, **options)


def with_terms(scene, *, drag=0.0, internal=0.0, gravity=(0.0, 0.0, 0.0)):
    """The scene with drag rate (1/s), internal damping time (s) and gravity (m/s2)."""
    return eqx.tree_at(
        lambda s: (s.drag.coefficient, s.damping.coefficient, s.gravity.g),
        scene,
        (drag * scene.mass, internal * scene.membrane.stiffness, jnp.asarray(gravity)),
    )


def advance(scene, state, t_stop, solver, calls=20):
    """Integrate to `t_stop`, however many budgets it takes."""
    for _ in range(calls):
        state, _ = run(scene, state, jnp.asarray(float(t_stop)), solver)
        assert state.result == RESULTS.success
        if float(state.t) >= t_stop:
            return state
    raise AssertionError(f"t = {float(state.t)} after {calls} calls, asked for {t_stop}")


def angle_rotation(angle):
    """Rotation of the plane by `angle`, (2, 2)."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def total_energy(scene, state):
    """Sum of all energies in J."""
    return float(sum(energies(scene, state.x, state.v, state.p, state.t)))


def patch():
    """Mesh, scene and stiffness matrix of a flat patch."""
    mesh = lattice(9, 8)
    scene = sheet(mesh, elastic())
    return mesh, scene, tangent(scene, initial_state(scene, mesh.vertices))
