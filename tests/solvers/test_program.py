"""The program of a run: new numbers compile nothing, and what a scene lacks leaves no operation."""

import collections
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from lattice import elastic, held
from snapping import NODES, SNAP_END, cost, equal, setup, solver, start

from jaxcrumple import simulation
from jaxcrumple.io import load_checkpoint, save_checkpoint
from jaxcrumple.material.material import Material
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.radial import radial
from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.linear.registry import direct_available
from jaxcrumple.solvers.loop import BUDGET, IMPLICIT_COST
from jaxcrumple.solvers.scheme import SCHEMES, integrator
from jaxcrumple.solvers.switch import Switch
from jaxcrumple.state import initial_state


def test_new_numbers_do_not_compile_again(monkeypatch, tmp_path):
    once, calls = eqx.filter_jit(eqx.debug.assert_max_traces(integrate, max_traces=1)), []

    def counted(*arguments):
        state, log = once(*arguments)
        calls.append((float(state.t), cost(state) - cost(arguments[1])))
        return state, log

    monkeypatch.setattr(simulation, "_integrate", counted)
    scene = setup().scene
    first = simulate(scene, start(), SNAP_END, solver=solver())
    # After the one that compiles the run takes several calls: the first is short, none exceeds its budget.
    assert calls[0] == (0.0, 0) and calls[1][0] < SNAP_END == calls[-1][0]
    assert 0 < max(spent for _, spent in calls) < BUDGET + IMPLICIT_COST
    other = radial(
        NODES, seed=0, sweeps=5, contact=None, speed=0.02, radius=0.0715, material=Material(thickness=3e-4)
    )
    faster = simulate(other.scene, initial_state(other.scene, other.x), 0.004, solver=solver(3e-4))
    assert faster.result == "success"
    save_checkpoint(tmp_path / "checkpoint.npz", first.state)
    state, _ = load_checkpoint(tmp_path / "checkpoint.npz", start())
    resumed = simulate(scene, state, SNAP_END + 0.002, solver=solver())
    straight = simulate(scene, first.state, SNAP_END + 0.002, solver=solver())
    assert equal(resumed.state, straight.state)
    options = solver(switch=Switch(up=2e-5, down=1e-6, dwell=2e-3), max_step=1e-3)
    simulate(scene, first.state, SNAP_END + 0.001, solver=options, max_attempts=50)
    simulate(scene, first.state, SNAP_END + 0.001, solver=options, max_seconds=50.0)


def _equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for leaf in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns")):
            inner = getattr(leaf, "jaxpr", leaf)
            if hasattr(inner, "eqns"):
                yield from _equations(inner)


def origins(scene, x, scheme="alternating"):
    """Number of operations by the files and functions of the package that brought them in, and by name."""
    traced = eqx.filter_make_jaxpr(integrate)
    jaxpr, _, _ = traced(scene, initial_state(scene, x), jnp.asarray(1.0), solver(scheme=scheme))
    places, names = collections.Counter(), collections.Counter()
    for equation in _equations(jaxpr.jaxpr):
        frames = [f for f in equation.source_info.traceback.frames if "jaxcrumple" in f.file_name]
        files = {"/".join(Path(f.file_name).parts[-2:]) for f in frames}
        places.update(files | {f.function_name.rpartition(".")[2] for f in frames})
        names[equation.primitive.name] += 1
    return places, names


def test_absent_terms_leave_no_operation():
    terms = ("model/plasticity.py", "model/damping.py", "model/walls.py", "model/loads.py")
    mesh = setup().mesh
    still = held(np.zeros((NODES, 3), bool), mesh.vertices)
    walls, gravity = setup().scene.walls, (0.0, 0.0, -9.81)
    full = sheet(mesh, Material(), walls=walls, gravity=gravity, prescribed=still)
    bare = sheet(mesh, elastic(drag_rate=0.0, internal_damping_time=0.0))
    with_terms, all_names = origins(full, mesh.vertices)
    without, bare_names = origins(bare, mesh.vertices)
    assert all(with_terms[name] > 50 for name in terms), with_terms
    assert all(without[name] == 0 for name in terms), without
    assert without["model/bending.py"] > 50
    assert bare_names["while"] < all_names["while"]
    assert bare_names.total() < all_names.total() - with_terms["model/plasticity.py"]


def test_absent_stages_leave_no_operation():
    scene, x = setup().scene, setup().x
    inertia, pair, explicit = (
        ("two_step",),
        ("implicit/bdf_pair.py",),
        ("explicit/base.py", "explicit/stage.py"),
    )
    absent = {
        "hybrid": pair,
        "alternating": pair,
        "dynamic": pair + explicit,
        "quasistatic": inertia + pair + explicit,
        "explicit": (
            *inertia,
            *pair,
            "implicit/variable_order.py",
            "implicit/newton.py",
            "linear/block_jacobi.py",
            "residual",
        ),
        "paper": (*inertia, "implicit/variable_order.py"),
    }
    present = {
        "hybrid": (*inertia, *explicit, "implicit/variable_order.py"),
        "alternating": (*inertia, *explicit, "implicit/variable_order.py"),
        "dynamic": (*inertia, "implicit/variable_order.py"),
        "quasistatic": ("implicit/variable_order.py",),
        "explicit": explicit,
        "paper": pair + explicit,
    }
    for scheme in SCHEMES:
        places, _ = origins(scene, x, scheme)
        for place in absent[scheme]:
            assert places[place] == 0, (scheme, place)
        for place in present[scheme]:
            assert places[place] > 3, (scheme, place)


def test_the_default_program_calls_no_lapack():
    # XLA waits for batches of such calls on the threads that are to run them: two at once may hang.
    traced = eqx.filter_make_jaxpr(integrate)
    for scheme in SCHEMES:
        if scheme != "paper":
            options = integrator(scheme=scheme, linear="direct" if direct_available() else "two-level")
            jaxpr, _, _ = traced(setup().scene, start(), jnp.asarray(1.0), options)
            names = {equation.primitive.name for equation in _equations(jaxpr.jaxpr)}
            assert not names & {"eigh", "svd", "lu", "qr", "geqrf"}
            assert "cholesky" not in names or not direct_available()
