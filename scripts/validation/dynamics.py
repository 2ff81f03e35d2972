"""Dynamics: waves of the lattice, falling, damping, and energy."""

from dataclasses import replace

import numpy as np

import jaxcrumple as jc

from .base import KAPPA, PLAIN, ROW, Outcome, benchmark, energies, fixed, modes, strip

KS = PLAIN.spring_constant


@benchmark(
    "dynamics",
    "Lattice: sqrt(9/8), sqrt(3/8) a sqrt(ks/m) (Born & Huang 1954); plate: sqrt(kappa/rho h) q^2",
)
def plane_waves() -> list[Outcome]:
    """Speeds of long waves in the plane, and frequency of a long flexural wave."""
    spacing, q, direction = 1e-3, 0.02, np.deg2rad(11.0)
    mesh = jc.hexagonal(13, 12, spacing)
    scene = jc.sheet(mesh, PLAIN)
    stiffness, mass = jc.tangent(scene, jc.initial_state(scene, mesh.vertices)), float(scene.mass[0])
    along = np.array([np.cos(direction), np.sin(direction), 0.0])
    phase = np.exp(1j * q / spacing * (mesh.vertices @ along))
    inner = np.linalg.norm(mesh.vertices, axis=1) < 3.0 * spacing
    unit, rows = spacing * np.sqrt(KS / mass), []
    across = np.array([-along[1], along[0], 0.0])
    for name, way, speed in (("longitudinal", along, 9.0 / 8.0), ("transverse", across, 3.0 / 8.0)):
        pull = (stiffness @ (phase[:, None] * way).ravel()).reshape(-1, 3)
        omega = np.sqrt(np.mean((pull @ way / phase).real[inner]) / mass)
        expected = np.sqrt(speed) * unit
        rows.append(
            Outcome(f"{name} speed", "m/s", expected, omega * spacing / q, 1e-3, "lattice, q a = 0.02")
        )
    up = np.array([0.0, 0.0, 1.0])
    pull = (stiffness @ (phase[:, None] * up).ravel()).reshape(-1, 3)
    omega = np.sqrt(np.mean((pull @ up / phase).real[inner]) / mass)
    expected = np.sqrt(KAPPA * ROW * spacing**2 / mass) * (q / spacing) ** 2
    rows.append(Outcome("flexural frequency", "1/s", expected, omega, 1e-3, "lattice, q a = 0.02"))
    return rows


@benchmark("dynamics", "Linear drag: v = (g/b) (1 - exp(-b t))", quick=False)
def falling_sheet() -> list[Outcome]:
    """Depth and speed of a sheet that falls in air, at 0.5, 1 and 5 relaxation times."""
    drag, g = 50.0, 9.81
    mesh = jc.rectangle(0.1, 0.1, 60, seed=0)
    scene = jc.sheet(mesh, jc.Material(drag_rate=drag, yield_curvature=None), gravity=(0.0, 0.0, -g))
    times = np.array([0.5, 1.0, 5.0]) / drag
    solver = jc.integrator(1e-3, scheme="dynamic")
    run = jc.simulate(scene, jc.initial_state(scene, mesh.vertices), times, solver=solver, throw=True)
    rows = []
    for k, t in enumerate(times):
        speed = g / drag * -np.expm1(-drag * t)
        depth = g / drag * (t + np.expm1(-drag * t) / drag)
        about = "60 nodes, rtol 1e-3"
        rows += [
            Outcome(f"depth at {drag * t:g}/b", "mm", 1e3 * depth, -1e3 * run.x[k, :, 2].mean(), 0.02, about),
            Outcome(f"speed at {drag * t:g}/b", "m/s", speed, -run.v[k, :, 2].mean(), 0.02, about),
        ]
    return rows


@benchmark(
    "dynamics",
    "Damped oscillator: period 2 pi/omega_d, decrement pi b/omega_d; mode and omega of the tangent",
    quick=False,
)
def logarithmic_decrement() -> list[Outcome]:
    """Ringing of a cantilever in its lowest mode."""
    drag, band = 20.0, strip(36, 2, 3e-3)
    x = band.mesh.vertices
    held = fixed(band.clamp(both=False)[0], x)
    scene = jc.sheet(band.mesh, replace(PLAIN, drag_rate=drag), prescribed=held)
    values, shapes = modes(scene, x, 2)
    shape = shapes[:, 0].reshape(-1, 3) / np.abs(shapes[:, 0]).max()
    damped = np.sqrt(values[0] - 0.25 * drag**2)
    t = np.linspace(0.0, 4.0, 81)[1:] * np.pi / damped
    # An amplitude of 1 % of the length, in which the mode is straight to 1e-4.
    start = jc.initial_state(scene, x + 5e-4 * shape)
    run = jc.simulate(scene, start, t, solver=jc.integrator(1e-3, scheme="dynamic"), throw=True)
    weight = np.asarray(scene.mass)[:, None] * shape
    q, speed = (np.sum(weight * change, axis=(1, 2)) for change in (run.x - x, run.v))
    # Displacement and speed of the mode on a circle that shrinks.
    turning = q + 1j * (speed + 0.5 * drag * q) / damped
    angle, decay = np.unwrap(np.angle(turning)), np.abs(turning[39] / turning[79])
    period = 2.0 * np.pi * (t[79] - t[39]) / abs(angle[79] - angle[39])
    about, why = "lattice, 108 nodes, rtol 1e-3", "implicit steps damp as well, the less the smaller rtol"
    return [
        Outcome("period", "ms", 2e3 * np.pi / damped, 1e3 * period, 0.01, about, why),
        Outcome("log. decrement", "1", np.pi * drag / damped, np.log(decay), 0.02, about, why),
    ]


@benchmark("dynamics", "Conservation of energy and of angular momentum", quick=False)
def spinning_sheet() -> list[Outcome]:
    """Free sheet without losses that spins and shakes."""
    mesh = jc.hexagonal(9, 4, 1e-3)
    scene = jc.sheet(mesh, PLAIN)
    x = mesh.vertices
    v = np.cross([300.0, -200.0, 500.0], x) + 0.05 * np.random.default_rng(0).normal(size=x.shape)
    solver = jc.integrator(1e-4, scheme="explicit")
    end = jc.simulate(scene, jc.initial_state(scene, x, v), 2e-3, solver=solver, throw=True).state
    mass, rows = np.asarray(scene.mass)[:, None], []
    pairs = ((x, v), (np.asarray(end.x), np.asarray(end.v)))
    energy = [sum(map(float, energies(scene, *pair, None, 0.0))) for pair in pairs]
    spin = [np.linalg.norm(np.sum(mass * np.cross(*pair), axis=0)) for pair in pairs]
    for name, unit, (first, last), tolerance in (
        ("energy", "uJ", np.multiply(1e6, energy), 5e-3),
        ("angular momentum", "nJ s", np.multiply(1e9, spin), 1e-6),
    ):
        rows.append(Outcome(name, unit, first, last, tolerance, "lattice, 45 nodes, explicit, rtol 1e-4"))
    return rows


@benchmark(
    "dynamics",
    "First law: energy of the sheet = work of walls - drag, damping, plastic and numerical losses",
    quick=False,
)
def closed_ledger() -> list[Outcome]:
    """Energy of a sheet in a shrinking sphere and the sum of the work on it."""
    setup = jc.radial(60, contact=None)
    state = jc.initial_state(setup.scene, setup.x, ledger=True)
    run = jc.simulate(setup.scene, state, 1.0, solver=jc.integrator(1e-2, scheme="dynamic"), throw=True)
    end = run.state
    energy = sum(map(float, energies(setup.scene, end.x, end.v, end.p, end.t)))
    work = sum(map(float, end.work))
    return [Outcome("energy", "mJ", 1e3 * work, 1e3 * energy, 0.01, "60 nodes, rtol 1e-2")]
