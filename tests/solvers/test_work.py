"""The work ledger: what goes into a sheet is found again, term by term."""

import jax.numpy as jnp
import numpy as np
import pytest
from lattice import held

import jaxcrumple as jc
from jaxcrumple.solvers.log import ENERGIES
from jaxcrumple.state import Work


def ledger(scene, x, times, v=None, **options):
    """The ledger and the change of energy of a run, in J, and the run."""
    state = jc.initial_state(scene, x, v, ledger=True)
    before = sum(map(float, jc.energies(scene, state.x, state.v, state.p, state.t)))
    solution = jc.simulate(scene, state, times, solver=jc.integrator(**options))
    assert solution.result == "success"
    last = solution.history.iloc[-1]
    gained = sum(last[name] for name in ENERGIES) - before
    return {name: last[f"work_{name}"] for name in Work._fields}, gained, solution


def test_a_sheet_carried_at_constant_speed_costs_its_drag():
    mesh = jc.hexagonal(6, 5, 1e-3)
    velocity, rate, time = np.array([0.3, -0.2, 0.1]), 50.0, 0.02
    material = jc.Material(yield_curvature=None, drag_rate=rate)
    everywhere = np.ones((mesh.n_nodes, 3), bool)
    scene = jc.sheet(mesh, material, prescribed=held(everywhere, mesh.vertices, velocity))
    start = np.tile(velocity, (mesh.n_nodes, 1))
    work, gained, _ = ledger(scene, mesh.vertices, time, start, scheme="dynamic")
    spent = rate * float(jnp.sum(scene.mass)) * (velocity @ velocity) * time
    assert work["supports"] == pytest.approx(spent, rel=1e-9)
    assert work["drag"] == pytest.approx(-spent, rel=1e-9)
    assert abs(gained) + abs(work["numerical"]) + abs(work["damping"]) < 1e-9 * spent


@pytest.mark.parametrize(
    ("scheme", "rtol"),
    [
        ("hybrid", 1e-2),
        pytest.param("alternating", 1e-3, marks=pytest.mark.slow),
        pytest.param("explicit", 1e-4, marks=pytest.mark.slow),
        ("quasistatic", 1e-3),
    ],
)
def test_the_ledger_of_a_snap_is_closed(scheme, rtol):
    """Of an arch: the load's work, what drag takes, and what the method adds, add up to the energy."""
    material = jc.Material(yield_curvature=60.0)
    load = 0.05 if scheme == "quasistatic" else 0.2
    setup = jc.arch(100, load=load, plastic=True, material=material)
    end = 0.004 if scheme == "explicit" else 0.03
    work, gained, solution = ledger(setup.scene, setup.x, end, scheme=scheme, rtol=rtol)
    size = max(abs(value) for value in work.values())
    assert abs(sum(work.values()) - gained) < 1e-4 * size
    assert abs(work["numerical"]) < 0.05 * size
    assert work["drag"] < 0 and work["damping"] < 0 and work["plastic"] <= 1e-12 * size
    if scheme == "hybrid":
        # Beyond its limit point it has snapped, and yielded.
        assert float(solution.state.x[:, 2].min()) < 0 and work["plastic"] < -1e-8
        assert abs(work["numerical"]) < 0.01 * size


@pytest.mark.parametrize("rho", [0.0, 1.0])
def test_energy_without_a_cause_is_numerical(rho):
    """Of a strip that vibrates without drag: all that its energy changes by, the method has done."""
    mesh = jc.hexagonal(3, 12, 2e-3)
    material = jc.Material(yield_curvature=None, drag_rate=0.0, internal_damping_time=0.0)
    along = mesh.vertices[:, 1]
    clamp = np.repeat((along < along.min() + 3e-3)[:, None], 3, axis=1)
    scene = jc.sheet(mesh, material, prescribed=held(clamp, mesh.vertices, np.zeros(3)))
    height = (along - along.min() - 3e-3).clip(0) ** 2
    v = np.outer(height / height.max(), [0.0, 0.0, 0.5])
    options = {"scheme": "dynamic", "rho_infinity": rho, "rtol": 0.09}
    work, gained, _ = ledger(scene, mesh.vertices, 0.02, v, **options)
    # The midpoint rule, whose rho is 1, conserves energy.
    assert abs(gained) < 1e-10 if rho == 1.0 else abs(gained) > 1e-10
    # What is missing is the remaining error of Newton's method, over 600 steps.
    kinetic = 0.5 * np.asarray(scene.mass) @ np.sum(v**2, axis=1)
    assert gained == pytest.approx(work["numerical"], rel=1e-2, abs=1e-5 * kinetic)
    assert all(work[name] == 0.0 for name in ("walls", "drag", "damping", "plastic"))


def test_a_state_without_a_ledger_keeps_none():
    setup = jc.arch(60)
    state, solver = jc.initial_state(setup.scene, setup.x), jc.integrator(scheme="dynamic")
    solution = jc.simulate(setup.scene, state, 1e-3, solver=solver)
    assert solution.state.work is None and not solution.history["work_drag"].any()
