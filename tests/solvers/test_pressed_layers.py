"""Layers that are pressed, crushed and thrown upon one another: scenes in which penalty contact usually
fails."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from contacts import bound
from folded import folded, layer_of, strip
from lattice import held
from scipy.optimize import brentq

import jaxcrumple as jc
from jaxcrumple import simulation
from jaxcrumple.geometry.hinge import curvature
from jaxcrumple.measure import count_intersections, edge_strain
from jaxcrumple.solvers.linear.registry import direct_available

SIGMA, THICKNESS, DENSITY, G = 0.5e-3, 0.3e-3, 1000.0, 9.81
UP = np.array([0.0, 0.0, 1.0])
FAR = 1.0


def scene(mesh, floor=-FAR, ceiling=FAR, gravity=0.0, sinks=0.0, drag=1e4, level=2):
    """A self-avoiding elastic sheet between two planes in m, of which the upper one sinks, in m/s.

    Scenes of one level have the same terms and as many nodes, so that one program serves them.
    """
    material = jc.Material(thickness=THICKNESS, density=DENSITY, yield_curvature=None, drag_rate=drag)
    walls = [jc.Plane(UP, floor), jc.Plane(-UP, jc.Ramp(-ceiling, sinks))]
    contact = jc.SelfContact(range=SIGMA, level=level)
    return jc.sheet(mesh, material, walls=walls, gravity=(0.0, 0.0, -gravity), contact=contact)


def pushed(mesh, x, speed):
    """A fold whose lower layer is held and whose upper layer's edge goes down, in m/s."""
    upper, edge = layer_of(mesh) == 1, mesh.vertices[:, 0] == mesh.vertices[:, 0].max()
    support = held(np.repeat(~upper | edge, 3).reshape(-1, 3), x, np.where(edge[:, None], -speed * UP, 0.0))
    material = jc.Material(thickness=THICKNESS, density=DENSITY, yield_curvature=None, drag_rate=1e4)
    return jc.sheet(mesh, material, contact=jc.SelfContact(range=SIGMA, level=2), prescribed=support)


def creased(sheet, x, stiffness=1.0):
    """The same sheet with the folds of positions `x` at rest, of so much of their stiffness."""
    rest = curvature(sheet.bending.hinges(jnp.asarray(x)).theta)
    stiff = jnp.where(jnp.abs(rest) > 0.1, stiffness, 1.0) * sheet.bending.stiffness
    return eqx.tree_at(lambda s: (s.bending.rest_curvature, s.bending.stiffness), sheet, (rest, stiff))


def ran(sheet, x, times, v=None, **options):
    return jc.simulate(sheet, jc.initial_state(sheet, x, v), times, **options)


def sound(mesh, solution):
    """Whether a run succeeded and no frame intersects."""
    return solution.result == "success" and all(count_intersections(mesh, x) == 0 for x in solution.x)


def borne(sheet, x, upper):
    """Force in N by which contact lifts the upper layer."""
    x = jnp.asarray(x)
    return float(bound(jc.with_contacts(sheet, x)).force(x)[upper, 2].sum())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("columns", "rows", "step", "pitch"),
    [
        pytest.param((9, 9), 5, 2.2 * SIGMA, None, id="two layers"),
        pytest.param((5, 4, 4, 5), 5, 2.2 * SIGMA, None, id="four layers"),
        pytest.param((9, 9), 5, 1.1 * SIGMA, 8.0 * SIGMA, id="needles"),
        pytest.param((18, 18), 15, 0.6 * SIGMA, None, id="range above the spacing"),
    ],
)
def test_layers_crushed_between_planes(columns, rows, step, pitch):
    start, end, duration = 0.95 * SIGMA, 0.8 * SIGMA, 0.02
    mesh = strip(start, columns, rows, step, pitch)
    # The planes' range is the thickness: they touch nothing at first.
    gaps, soft = len(columns) - 1, 1.02 * THICKNESS
    height = 0.5 * gaps * start + soft
    x = folded(mesh, start, columns)
    sinks = (gaps * (start - end) + 1.2 * THICKNESS) / duration
    # Drag that bears a thousandth of the pressure ends the ringing of layers that slip.
    sheet = creased(scene(mesh, -height, height, sinks=sinks, drag=1e6, level=None), x)
    solution = ran(sheet, x, np.linspace(0, duration, 5)[1:])
    assert sound(mesh, solution)
    # The ceiling bears what contact lifts the top layer with, and the layers lie as they lay, closer.
    x, layer = solution.x[-1], layer_of(mesh, columns)
    heights = np.array([np.mean(x[layer == k, 2]) for k in range(len(columns))])
    assert np.all((np.diff(heights) > 0.4 * SIGMA) & (np.diff(heights) < start))
    pressed = [np.asarray(wall.force(jnp.asarray(x), duration))[:, 2].sum() for wall in sheet.walls]
    # The folds bear a part.
    assert borne(sheet, x, layer == gaps) == pytest.approx(-pressed[1], rel=0.15)
    assert solution.history["contact"].iloc[-1] > solution.history["contact"].iloc[0]
    assert all(float(wall.gap(jnp.asarray(x), duration).min()) > 0 for wall in sheet.walls)


@pytest.mark.slow
def test_two_layers_under_a_thousand_weights_bear_them_by_pressure():
    load, upper = 1000.0 * G, layer_of(strip(SIGMA)) == 1

    def excess(gap):
        """Of flat layers so far apart."""
        mesh = strip(gap)
        sheet = scene(mesh, gravity=load)
        return borne(sheet, folded(mesh, gap), upper) - load * float(np.sum(np.asarray(sheet.mass)[upper]))

    gap = brentq(excess, 0.8 * SIGMA, 0.9999 * SIGMA, xtol=1e-4 * SIGMA)
    mesh = strip(gap)
    x = folded(mesh, gap)
    sheet = scene(mesh, floor=x[:, 2].min() - THICKNESS, gravity=load)
    # Folds without stiffness bear nothing but their pull.
    sheet = creased(sheet, x, stiffness=0.0)
    solution = ran(sheet, x, np.array([0.002, 0.005, 0.01]))
    assert sound(mesh, solution)
    end = solution.x[-1]
    weight = load * float(np.sum(np.asarray(sheet.mass)[upper]))
    assert borne(sheet, end, upper) == pytest.approx(weight, rel=0.05)
    # It leans towards the folds, beside which neighbours at rest leave it alone.
    assert 0.8 * gap < np.median(end[upper, 2]) - np.median(end[~upper, 2]) < 1.1 * gap


@pytest.mark.slow
def test_a_sheet_that_relaxes_upon_itself_comes_to_rest_where_a_run_does():
    mesh = strip(2.0 * SIGMA)
    x, upper, load = folded(mesh, 2.0 * SIGMA), layer_of(mesh) == 1, 100.0 * G
    sheet = creased(scene(mesh, floor=-SIGMA - 0.8 * THICKNESS, gravity=load), x, stiffness=0.02)
    rest = jc.relax(sheet, jc.initial_state(sheet, x), force_tolerance=1e-9)
    assert rest.converged and rest.max_force <= 1e-9 and rest.negative == 0
    # The upper layer has come down by more than lists of contact hold for, and not through the lower one.
    end = np.asarray(rest.state.x)
    assert np.max(x[upper, 2] - end[upper, 2]) > 0.8 * SIGMA
    assert count_intersections(mesh, end) == 0
    floor = np.asarray(sheet.walls[0].force(rest.state.x, 0.0))[:, 2].sum()
    assert floor == pytest.approx(load * float(jnp.sum(sheet.mass)), rel=1e-6)
    assert borne(sheet, end, upper) > 0
    later = ran(sheet, end, 5e-3)
    assert sound(mesh, later)
    assert np.abs(later.x[-1] - end).max() < 1e-6 * SIGMA


@pytest.mark.slow
def test_a_fold_pressed_to_its_range_opens_again():
    mesh = strip(2.0 * SIGMA)
    x = folded(mesh, 2.0 * SIGMA)
    middle = 2.0 * SIGMA / 2.0
    down, up = 0.02, 0.06
    # The planes' own range is the thickness; they close to one contact range and a little less of each of
    # theirs.
    travel = 2.0 * SIGMA + 2.0 * 0.9 * THICKNESS - (SIGMA + 2.0 * 0.5 * THICKNESS)
    closing = scene(mesh, -middle - 0.9 * THICKNESS, middle + 0.9 * THICKNESS, sinks=travel / down)
    pressed = ran(closing, x, down)
    assert sound(mesh, pressed)
    assert np.ptp(pressed.x[-1][:, 2]) < 1.3 * SIGMA
    opening = scene(mesh, -middle - 0.9 * THICKNESS, FAR)
    state = jc.initial_state(opening, pressed.x[-1])
    opened = jc.simulate(opening, state, up)
    assert sound(mesh, opened)
    # Elastic: it springs back to flat in the end, and is on its way.
    assert np.ptp(opened.x[-1][:, 2]) > 2.0 * np.ptp(pressed.x[-1][:, 2])


@pytest.mark.slow
def test_a_fast_fold_does_not_pass_through_itself():
    mesh = strip(4.0 * SIGMA)
    x = folded(mesh, 4.0 * SIGMA)
    upper = layer_of(mesh) == 1
    v = np.where(upper[:, None], -10.0 * UP, 0.0)
    solution = ran(scene(mesh, drag=1e2), x, np.linspace(0, 6e-4, 4)[1:], v)
    assert sound(mesh, solution)
    # The layers met, 1.5 mm apart at 10 m/s, and what was the upper one is still above.
    assert solution.history["contact"].max() > 0
    assert np.mean(solution.x[-1][upper, 2]) > np.mean(solution.x[-1][~upper, 2])


@pytest.mark.slow
def test_a_sheet_that_starts_in_contact_rests_or_parts():
    mesh = strip(0.7 * SIGMA)
    x = folded(mesh, 0.7 * SIGMA)
    solution = ran(scene(mesh), x, 2e-3)
    assert sound(mesh, solution)
    assert solution.history["contact"].iloc[0] > solution.history["contact"].iloc[-1]
    assert np.abs(edge_strain(mesh, solution.x[-1])).max() < 0.05


@pytest.mark.slow
def test_a_frame_that_intersects_is_no_success(monkeypatch):
    """Where nothing stops the sheet, the audit tells."""
    for stage in ("implicit", "explicit"):
        monkeypatch.setattr(f"jaxcrumple.solvers.{stage}.base.passes", lambda *_: jnp.asarray(False))
    module = simulation
    monkeypatch.setattr(module, "_integrate", eqx.filter_jit(jc.integrate))
    mesh = strip(2.0 * SIGMA)
    x, upper = folded(mesh, 2.0 * SIGMA), layer_of(mesh) == 1
    v = np.where(upper[:, None], -10.0 * UP, 0.0)
    weak = eqx.tree_at(lambda s: s.contact.stiffness, scene(mesh, drag=1e2), jnp.asarray(1e-9))
    solution = ran(weak, x, np.linspace(0, 1e-3, 6)[1:], v)
    assert solution.result == "intersected"
    found = [count_intersections(mesh, frame) for frame in solution.x]
    assert found[-1] > 0 and not any(found[:-1])


@pytest.mark.slow
def test_planes_that_leave_no_room_end_in_a_named_result():
    mesh = strip(1.5 * SIGMA)
    x = folded(mesh, 1.5 * SIGMA)
    height = 1.5 * SIGMA / 2.0 + 0.9 * THICKNESS
    crushed = scene(mesh, -height, height, sinks=0.1)
    state = jc.initial_state(crushed, x)
    solution = jc.simulate(crushed, state, 2.5 * height / 0.1, max_attempts=4000)
    assert solution.result in ("blocked", "collapsed", "budget")
    end = solution.state
    assert count_intersections(mesh, end.x) == 0
    assert all(float(wall.gap(end.x, end.t).min()) > 0 for wall in crushed.walls)


@pytest.mark.slow
@pytest.mark.skipif(not direct_available(), reason="needs the extra `direct`")
def test_prescribed_motion_through_the_sheet_ends_in_a_named_result():
    mesh = strip(2.0 * SIGMA)
    x, edge = folded(mesh, 2.0 * SIGMA), mesh.vertices[:, 0] == mesh.vertices[:, 0].max()
    sheet, ends = pushed(mesh, x, 0.1), {}
    for linear in ("direct", "two-level"):
        solver = jc.integrator(rtol=1e-3, scheme="dynamic", linear=linear)
        ends[linear] = ran(sheet, x, [1.4 * SIGMA / 0.1, 2.5 * SIGMA / 0.1], solver=solver)
    for solution in ends.values():
        assert solution.result in ("blocked", "collapsed")
        assert count_intersections(mesh, solution.state.x) == 0
        # The edge has come close to the layer below, not to the middle between it and where it began.
        assert 0 < np.mean(solution.state.x[edge, 2]) + 0.5 * 2.0 * SIGMA < 0.6 * SIGMA
        assert solution.history["contact"].iloc[-1] > 0
    # Both solvers press the fold to the same shape on the way.
    one, two = (solution.x[0] for solution in ends.values())
    assert np.abs(one - two).max() < 1e-3 * np.ptp(x[:, 0])
