"""Snap-through of arch and cap: rest shapes, supports, closed forms, and the two branches of equilibria."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import leggauss
from scipy.sparse.linalg import spsolve

from jaxcrumple.material.material import Material
from jaxcrumple.run.config import configure
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.arch import arch, strip
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.scenes.snap import energy_drop, fixed, relaxed_drop
from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.relax import relax
from jaxcrumple.solvers.scheme import integrator
from jaxcrumple.state import initial_state
from jaxcrumple.system import energies, force, tangent

NODES = {"arch": 198, "cap": 200}
BUILD = {"arch": arch, "cap": cap}
_energies, _force = eqx.filter_jit(energies), eqx.filter_jit(force)
SHEET = Material(yield_curvature=None)
KAPPA, YOUNG = SHEET.bending_rigidity, SHEET.young_modulus_2d
# Final loads, spans, rises and times of load growth of the default scenes.
LOAD = {"arch": 0.2, "cap": 0.3}
RISE = {"arch": 2e-3, "cap": 1e-3}
RAMP = 0.03
# Loads in N that the first branch still bears, and that it no longer bears, on these meshes.
BORNE = {"arch": 0.115, "cap": 0.18}
TOO_MUCH = {"arch": 0.125, "cap": 0.20}

scenes = pytest.mark.parametrize("name", ["arch", "cap"])


@functools.cache
def built(name, **options):
    return BUILD[name](NODES[name], **options)


def under(setup, t, x=None):
    """The state at time `t` with positions `x`, by default those of rest."""
    return eqx.tree_at(
        lambda s: s.t, initial_state(setup.scene, setup.x if x is None else x), jnp.asarray(float(t))
    )


def rested(setup, t, x=None):
    """Equilibrium at time `t` found from positions `x`; it must be a minimum."""
    rest = relax(setup.scene, under(setup, t, x), force_tolerance=1e-9)
    assert rest.converged
    assert int(rest.negative) == 0
    return rest.state


def deflection(setup, state):
    """Largest downward displacement in m."""
    return float(jnp.max(setup.x[:, 2] - state.x[:, 2]))


# --- At rest -------------------------------------------------------------------------------------


@scenes
def test_rest_shape_is_free_of_stress(name):
    setup = built(name)
    parts = _energies(setup.scene, setup.x, 0 * setup.x, None, jnp.asarray(0.0))
    # Strains are of the order of rounding: 1e-16, squared, times ks and the area.
    assert abs(float(parts.stretch)) + abs(float(parts.bending)) < 1e-24
    net = _force(setup.scene, setup.x, 0 * setup.x, None, jnp.asarray(0.0))
    assert float(jnp.abs(net).max()) < 1e-16 * 100 * float(setup.scene.membrane.stiffness.max()) * 1e-3
    height = setup.mesh.vertices[:, 2]
    assert height.max() == pytest.approx(RISE[name], rel=0.03)


def test_arch_lies_on_its_circle():
    length, rise = 0.03, 2e-3
    x = built("arch", imperfection=0.0).mesh.vertices
    radius = (length**2 / 4 + rise**2) / (2 * rise)
    from_centre = np.hypot(x[:, 0], x[:, 2] + radius - rise)
    np.testing.assert_allclose(from_centre, radius, rtol=1e-13)
    rows = np.unique(np.round(x[:, 0], 9))
    # The clamps' planes: midway between the two outermost rows.
    assert rows[:2].mean() == pytest.approx(-length / 2, rel=1e-2)
    assert rows[-2:].mean() == pytest.approx(length / 2, rel=1e-2)
    assert x[:, 2].max() == pytest.approx(rise, rel=1e-12)


def test_cap_lies_on_its_sphere():
    radius, rise = 0.025, 1e-3
    x = built("cap").mesh.vertices
    sphere = (radius**2 + rise**2) / (2 * rise)
    centre = np.array([0.0, 0.0, rise - sphere])
    np.testing.assert_allclose(np.linalg.norm(x - centre, axis=1), sphere, rtol=1e-13)
    np.testing.assert_allclose(x[built("cap").mesh.boundary_nodes, 2], 0.0, atol=1e-15)


@scenes
def test_supports_hold_the_edge(name):
    setup = built(name)
    held = np.asarray(setup.scene.prescribed.mask).all(axis=1)
    x = setup.mesh.vertices
    if name == "arch":
        assert len(np.unique(np.round(x[held, 0], 9))) == 4
        assert held.sum() == 4 * 6
    else:
        np.testing.assert_array_equal(np.flatnonzero(held), setup.mesh.boundary_nodes)
    state = rested(setup, RAMP)
    np.testing.assert_array_equal(np.asarray(state.x)[held], x[held])
    assert deflection(setup, state) > 1.5 * RISE[name]


@scenes
def test_load_grows_and_stays(name):
    setup = built(name)
    (load,) = setup.scene.extra
    for t, share in [(0.0, 0.0), (0.5 * RAMP, 0.5), (RAMP, 1.0), (2 * RAMP, 1.0)]:
        total = np.asarray(load.force(setup.x, jnp.asarray(t))).sum(axis=0)
        np.testing.assert_allclose(total, [0.0, 0.0, -share * LOAD[name]], rtol=1e-12, atol=1e-15)


# --- Closed forms --------------------------------------------------------------------------------


def strip_stiffness(nodes, length, width):
    """Bending and stretching stiffness (N m^2, N) of the flat strip, clamped, pushed at midspan."""
    mesh, row = strip(nodes, length, width)
    support = fixed((row < 2) | (row > row.max() - 2), mesh.vertices)
    scene = sheet(mesh, SHEET, prescribed=support)
    middle = row == row.max() // 2
    matrix = tangent(scene, initial_state(scene, mesh.vertices)).tocsc()
    pushed = []
    for axis in (2, 0):
        push = np.zeros((mesh.n_nodes, 3))
        push[middle, axis] = 1.0 / middle.sum()
        pushed.append(push.ravel() @ spsolve(matrix, push.ravel()))
    return length**3 / (192 * pushed[0]), length / (4 * pushed[1])


def arch_limit_load(bending, stretching, length, rise):
    """Limit load in N of a shallow clamped arch (B, S) under a central load, by its exact solution.

    With compression B n^2, deflection w upwards and arch curvature k = 8 f/L^2, the beam's equation
    B w'''' + B n^2 w'' = B n^2 k - P delta has a closed solution, linear in k and P. The compression
    must be what the deflection makes: -(S/L) times the integral of k w + w'^2/2, quadratic in P.
    """
    half, k = length / 2, 8 * rise / length**2
    s, weight = leggauss(40)
    s, weight = half * (s + 1) / 2, half * weight  # one half of the span, counted twice
    n = np.linspace(0.1, 1.43 * np.pi, 1000)[:, None] / half
    clamp = np.sin(n * s) / np.sin(n * half)
    # Slopes w' by the arch alone, and by a load of 1 N.
    arc = k * (s - half * clamp)
    unit = (np.cos(n * s) - 1 - (np.cos(n * half) - 1) * clamp) / (2 * bending * n**2)
    # The integral of k w is that of -k s w': w is 0 at the ends.
    q0 = (arc**2 / 2 - k * s * arc) @ weight + bending * n[:, 0] ** 2 * length / stretching
    q1, q2 = (unit * arc - k * s * unit) @ weight, (unit**2 / 2) @ weight
    root = np.sqrt(np.maximum(q1**2 - 4 * q2 * q0, 0.0))
    loads = np.stack([-q1 - root, -q1 + root]) / (2 * q2)
    sag = (arc @ weight + loads * (unit @ weight)) / 2
    first_branch = (root > 0) & (sag > 0) & (sag < rise)
    return loads[first_branch].max()


def test_limit_load_of_a_shallow_arch():
    length, width, rise = 0.03, 0.006, 1e-3
    bending, stretching = strip_stiffness(NODES["arch"], length, width)
    # Six nodes across: what an edge lacks in hinges and has in excess of springs counts.
    assert bending == pytest.approx(8 / 9 * KAPPA * width, rel=0.08)
    assert stretching == pytest.approx(YOUNG * width, rel=0.08)
    limit = arch_limit_load(bending, stretching, length, rise)
    # Rise over span is 1/30: slopes, squared, are of 2 %, and so is the theory's error.
    setup = built("arch", rise=rise, imperfection=0.0, load=limit)
    x, sag = setup.x, []
    for share in (0.5, 0.8, 0.9, 0.97, 1.01):
        state = rested(setup, share * RAMP, x)
        x = state.x
        sag.append(deflection(setup, state) / rise)
    assert np.all(np.diff(sag) > 0)
    assert sag[-2] < 0.5
    assert sag[-1] > 1.4


def cap_compliance(radius, rise, patch, terms=8):
    """Work of a paraboloidal load over its square, in m/N, on a shallow cap pinned at its rim.

    Ritz's method for the axisymmetric shallow shell: w and u by polynomials that vanish at the rim;
    Poisson's ratio 1/3 in the plane and -1/3 in bending.
    """
    s, weight = leggauss(60)
    s = (s + 1) / 2
    weight = np.pi * radius**2 * weight * s
    w = [Polynomial([1, 0, -1]) * Polynomial([0] * 2 * i + [1]) for i in range(terms)]
    u = [Polynomial([0, 1]) * p for p in w]
    none = np.zeros((terms, len(s)))
    slope = np.array([p.deriv()(s) / radius for p in w])
    sphere = (radius**2 + rise**2) / (2 * rise)
    radial = np.vstack([-s * radius / sphere * slope, [p.deriv()(s) / radius for p in u]])
    hoop = np.vstack([none, [p(s) / (s * radius) for p in u]])
    meridian = np.vstack([[p.deriv(2)(s) / radius**2 for p in w], none])
    parallel = np.vstack([slope / (s * radius), none])

    def form(a, b, poisson):
        cross = (a * weight) @ b.T
        return (a * weight) @ a.T + (b * weight) @ b.T + poisson * (cross + cross.T)

    stiffness = YOUNG / (1 - 1 / 9) * form(radial, hoop, 1 / 3) + KAPPA * form(meridian, parallel, -1 / 3)
    pressure = np.maximum(1 - (s * radius / patch) ** 2, 0.0)
    pressure = pressure / (pressure @ weight)
    work = np.append([(pressure * weight) @ p(s) for p in w], np.zeros(terms))
    return work @ np.linalg.lstsq(stiffness, work, rcond=1e-14)[0]


@pytest.mark.parametrize("rise", [1e-3, 1.5e-3])
def test_linear_stiffness_of_a_pinned_cap(rise):
    setup = built("cap", rise=rise, offset=0.0)
    net = np.asarray(setup.scene.extra[0].force(setup.x, jnp.asarray(RAMP)))
    matrix = tangent(setup.scene, initial_state(setup.scene, setup.x)).tocsc()
    compliance = net.ravel() @ spsolve(matrix, net.ravel()) / LOAD["cap"] ** 2
    # On meshes of 150 to 3000 nodes the ratio lies between 0.98 and 1.02.
    assert compliance == pytest.approx(cap_compliance(0.025, rise, 0.01), rel=0.03)


# --- Two branches --------------------------------------------------------------------------------


@functools.cache
def drop(name):
    return relaxed_drop(built(name), BORNE[name] / LOAD[name] * RAMP, RAMP)


@scenes
def test_two_equilibria_bear_the_same_load(name):
    setup, both = built(name), drop(name)
    for rest in (both.before, both.after):
        assert rest.converged and int(rest.negative) == 0
        assert float(rest.state.t) == pytest.approx(BORNE[name] / LOAD[name] * RAMP, rel=1e-12)
    upright, inverted = (deflection(setup, rest.state) for rest in (both.before, both.after))
    assert upright < 1.2 * RISE[name] < 1.5 * RISE[name] < inverted
    # Near the limit point the inverted side is the lower by far.
    assert both.potential > 0
    parts = [_energies(setup.scene, r.state.x, r.state.v, None, r.state.t) for r in (both.before, both.after)]
    one, two = (float(e.stretch + e.bending) for e in parts)
    assert both.elastic == pytest.approx(one - two, rel=1e-12)
    # An arch clamped at the slopes of rest is bent hard when inverted; a cap free to turn is not.
    assert (both.elastic > 0) == (name == "cap")


@scenes
def test_first_branch_ends_at_the_limit_load(name):
    setup, both = built(name), drop(name)
    beyond = rested(setup, TOO_MUCH[name] / LOAD[name] * RAMP, both.before.state.x)
    assert deflection(setup, beyond) > 1.5 * RISE[name]
    # With less load than the first branch bears it stays inverted: this is another branch.
    back = rested(setup, 0.9 * BORNE[name] / LOAD[name] * RAMP, beyond.x)
    assert deflection(setup, back) > 1.5 * RISE[name]


@scenes
def test_drop_does_not_depend_on_the_way(name):
    setup, both = built(name), drop(name)
    rng = np.random.default_rng(0)
    free = ~np.asarray(setup.scene.prescribed.mask)
    states = [
        under(setup, t, rest.state.x + 1e-6 * free * rng.normal(size=free.shape))
        for t, rest in ((both.before.state.t, both.before), (2 * RAMP, both.after))
    ]
    again = energy_drop(setup.scene, *states)
    assert again.elastic == pytest.approx(both.elastic, rel=1e-6)
    assert again.potential == pytest.approx(both.potential, rel=1e-6)
    assert float(jnp.abs(again.after.state.x - both.after.state.x).max()) < 1e-9


def test_drop_needs_two_equilibria():
    setup = built("cap")
    with pytest.raises(ValueError, match=r"come to rest in the same equilibrium at t = 0\.001 s"):
        energy_drop(setup.scene, under(setup, 0.001), under(setup, 0.002))


@scenes
def test_integrator_ends_in_the_inverted_equilibrium(name):
    setup, t_end = built(name), SCENES[name].t_end
    solver = integrator(1e-3, scheme="dynamic")
    end = simulate(setup.scene, initial_state(setup.scene, setup.x), t_end, solver=solver, throw=True)
    inverted = rested(setup, t_end, drop(name).after.state.x)
    span = float(jnp.ptp(setup.x[:, 0]))
    assert float(jnp.abs(end.state.x - inverted.x).max()) < 1e-4 * span


# --- Options -------------------------------------------------------------------------------------


@scenes
def test_defaults_of_the_options_are_those_of_the_scene(name):
    setup = configure(name, nodes=60, seed=1).build()
    bare = BUILD[name](60, 1)
    np.testing.assert_array_equal(setup.x, bare.x)
    for got, expected in zip(setup.scene.extra[0].parameters, bare.scene.extra[0].parameters, strict=True):
        np.testing.assert_array_equal(got, expected)
    assert setup.scene.plasticity is None


@scenes
def test_sheet_yields_when_asked(name):
    plain = configure(name, nodes=60, settings=["yield_c0=0.3"]).build().scene
    assert plain.plasticity is None
    yielding = configure(name, nodes=60, settings=["plastic=true", "yield_c0=0.3"]).build().scene
    np.testing.assert_allclose(yielding.plasticity.yield_threshold, 0.3)
    assert BUILD[name](60, plastic=True, material=SHEET).scene.plasticity is None


@pytest.mark.parametrize(
    ("build", "options", "message"),
    [
        (arch, {"length": 0.0}, "length = 0.0 must be a positive number in SI units"),
        (arch, {"load": np.nan}, "load = nan must be a positive"),
        (arch, {"rise": 0.02}, "rise = 0.02 m is more than half the length 0.03 m; choose a shallower"),
        (arch, {"imperfection": -1e-6}, "imperfection = -1e-06 m must be zero or positive"),
        (cap, {"ramp": np.inf}, "ramp = inf must be a positive"),
        (cap, {"rise": 0.03}, "rise = 0.03 m is more than the radius 0.025 m; choose a shallower cap"),
        (cap, {"offset": np.nan}, "offset = nan m must be finite"),
        (cap, {"offset": 0.2}, "patch = 0.01 m around the offset 0.2 m holds no free node; choose a larger"),
    ],
)
def test_impossible_scenes_are_refused(build, options, message):
    with pytest.raises(ValueError, match=message):
        build(60, **options)
