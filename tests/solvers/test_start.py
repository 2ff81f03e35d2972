"""Starts: what no run can proceed from is refused by name, and what pushes is reported with its size."""

import re
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import jaxcrumple as jc
from jaxcrumple.cli import cli
from jaxcrumple.run.balance import start_balance
from jaxcrumple.run.config import configure
from jaxcrumple.simulation import simulate
from jaxcrumple.solvers.start import check_start
from jaxcrumple.sweeps.campaign import _check as check_case

PAIR = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.005, 0.01, 0.0], [0.005, -0.01, 0.0]])
FACES = np.array([[0, 1, 2], [1, 0, 3]])


def pair(**options):
    """Two triangles with one hinge."""
    mesh = jc.Mesh.from_arrays(PAIR, FACES, reorder=False)
    return jc.sheet(mesh, jc.Material(yield_curvature=None), **options)


def turned(degrees):
    """Positions of the two triangles, folded by an angle."""
    angle = np.radians(degrees)
    x = PAIR.copy()
    x[3] = 0.005, -0.01 * np.cos(angle), 0.01 * np.sin(angle)
    return x


@pytest.fixture
def uncompiled(monkeypatch):
    """Fail where the program of a run would be compiled."""

    def compiled(*arguments):
        raise AssertionError("a run was compiled")

    for module, program in (("simulation", "_integrate"), ("solvers.relax", "_relax")):
        monkeypatch.setattr(sys.modules[f"jaxcrumple.{module}"], program, compiled)


@pytest.mark.parametrize("degrees", [180.0, -180.0, 180.0 - 1e-6])
def test_a_hinge_at_180_degrees_is_refused_before_compiling(uncompiled, degrees):
    scene = pair()
    state = jc.initial_state(scene, turned(degrees))
    message = r"1 hinges start folded by 180 degrees, the first at edge \(0, 1\) between nodes 2 and 3"
    for use in (
        lambda: simulate(scene, state, 0.1),
        lambda: jc.relax(scene, state, force_tolerance=1e-6),
        lambda: start_balance(scene, state),
    ):
        with pytest.raises(ValueError, match=message):
            use()


@pytest.mark.parametrize("degrees", [0.0, 90.0, 179.0, 180.0 - 1e-3])
def test_an_open_hinge_may_start(degrees):
    scene = pair()
    state = jc.initial_state(scene, turned(degrees))
    check_start(scene, state)
    balance = start_balance(scene, state)
    # A turn about the edge leaves the lengths of springs; half of K c^2 is the energy below 170 degrees.
    assert balance.in_balance == (degrees == 0.0)
    if degrees == 90.0:
        stiffness = float(scene.bending.stiffness[0])
        assert balance.lines[1].startswith(f"bending: stores {stiffness * 1e3:.3g} mJ, pushes node ")


def test_an_edge_without_length_and_a_triangle_without_area_are_refused(uncompiled):
    scene = pair()
    together, flat = turned(0.0), turned(0.0)
    together[3] = together[1]
    with pytest.raises(ValueError, match=r"edge \(1, 3\) starts without length"):
        simulate(scene, jc.initial_state(scene, together), 0.1)
    flat[2] = 0.002, 1e-12, 0.0
    with pytest.raises(ValueError, match=r"triangle \(0, 1, 2\) starts without area"):
        simulate(scene, jc.initial_state(scene, flat), 0.1)


def test_a_blocked_run_names_what_is_in_its_way():
    """A plane rises to a node that a support holds; the edge beside it is free."""
    held = np.zeros((4, 3), bool)
    held[2] = True
    supports = jc.Prescribed(held, jc.LinearMotion(PAIR, (0.0, 0.0, 0.0)))
    plane = jc.Plane((0.0, 0.0, 1.0), jc.Ramp(-0.02, 0.1, 1.0))
    scene = pair(walls=[plane], prescribed=supports)
    solution = simulate(scene, jc.initial_state(scene, PAIR), 0.3)
    assert solution.result == "blocked" and 0.19 < float(solution.state.t) < 0.2
    assert re.search(r"Here wall 0 \(Plane\) comes within .* m of node 2, where a support", solution.message)


def test_a_node_on_a_wall_and_a_wall_of_nan_are_refused(uncompiled):
    scene = pair(walls=[jc.Plane(np.array([0.0, 0.0, 1.0]), 0.0)])
    with pytest.raises(ValueError, match=r"node 0 starts on wall 0 \(Plane\), where the wall's force is inf"):
        simulate(scene, jc.initial_state(scene, PAIR), 0.1)
    late = pair(walls=[jc.Sphere(np.zeros(3), lambda t: jnp.sqrt(t - 1.0))])
    with pytest.raises(ValueError, match=r"between node 0 and wall 0 \(Sphere\) is NaN at t = 0 s; give"):
        simulate(late, jc.initial_state(late, PAIR), 0.1)


def test_one_triangle_starts_alone_and_has_no_contact():
    mesh = jc.Mesh.from_arrays(PAIR[:3], FACES[:1])
    scene = jc.sheet(mesh, jc.Material(yield_curvature=None))
    check_start(scene, jc.initial_state(scene, mesh.vertices))
    with pytest.raises(ValueError, match=r"a sheet of one triangle cannot touch itself; leave contact out"):
        jc.sheet(mesh, jc.Material(yield_curvature=None), contact=jc.SelfContact())


def layers(apart):
    """A strip and positions in which it goes round in a loop, and the nodes of its end lie `apart` in m above
    those of its beginning."""
    mesh = jc.hexagonal(17, 3, 1e-3)
    corners = 1e-3 * np.array([[0, 0], [4, 0], [4.6, 0.8], [4, 1.6], [-1, 1.6], [-1.6, 0.8], [-1, 0], [5, 0]])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    along = mesh.vertices[:, 0] - mesh.vertices[:, 0].min()
    corners[-2:, 1] = apart
    x, z = (np.interp(along, way, corners[:, k]) for k in range(2))
    return mesh, np.stack([np.round(x, 9), mesh.vertices[:, 1], z], axis=1)


def named_triangles(message):
    """Nodes in brackets in a message."""
    return [[int(node) for node in nodes.split(",")] for nodes in re.findall(r"\(([\d, ]+)\)", message)]


@pytest.mark.parametrize("rest", ["flat", "as it starts"])
def test_coincident_layers_are_refused_by_their_triangles(uncompiled, rest):
    mesh, x = layers(0.0)
    mesh = mesh if rest == "flat" else mesh.with_rest_shape(x)
    scene = jc.sheet(mesh, jc.Material(), contact=jc.SelfContact(range=2e-4, level=5))
    state = jc.initial_state(scene, x)
    for use in (lambda: simulate(scene, state, 0.1), lambda: start_balance(scene, state)):
        with pytest.raises(ValueError, match=r"the sheet starts touching itself, at triangles") as caught:
            use()
        one, two = named_triangles(str(caught.value))
        assert not set(one) & set(two)
        # The end lies in the plane of the beginning.
        assert np.abs(x[[one, two], 2]).max(axis=1).min() == 0.0


def test_layers_that_start_in_one_another_are_refused_by_their_triangles(uncompiled):
    mesh, x = layers(1e-10)
    scene = jc.sheet(mesh, jc.Material(), contact=jc.SelfContact(range=2e-4, level=5))
    message = (
        r"the sheet starts 1e-10 m from itself, at triangles .*; contact of range 0.0002 m needs more th"
    )
    with pytest.raises(ValueError, match=message) as caught:
        simulate(scene, jc.initial_state(scene, x), 0.1)
    one, two = named_triangles(str(caught.value))
    assert x[one, 2].min() in (0.0, 1e-10) and x[two, 2].min() in (0.0, 1e-10)


def test_contact_within_whose_range_a_sheet_starts_is_reported():
    """Its energy and force are those of the scene's own, which have tests of their own."""
    mesh, x = layers(1.5e-4)
    scene = jc.sheet(mesh, jc.Material(), contact=jc.SelfContact(range=2e-4, level=5))
    state = jc.initial_state(scene, x)
    balance = start_balance(scene, state)
    listed = jc.with_contacts(scene, x)
    energy = 1e3 * float(jc.energies(listed, state.x, state.v, state.p, state.t).contact)
    assert not balance.in_balance
    line = next(line for line in balance.lines if line.startswith("contact"))
    assert line.startswith(f"contact: stores {energy:.3g} mJ, pushes node ")
    assert line.endswith("; layers start 0.15 mm apart, within its range of 0.2 mm")


def test_a_wall_within_whose_range_a_sheet_starts_is_reported():
    """The law of the wall, s^3 / (3 (1 - s)), with s = 1 - 0.09/0.25."""
    mesh = jc.hexagonal(5, 4, 0.01)
    scene = jc.sheet(mesh, jc.Material(), walls=[jc.Plane(np.array([0.0, 0.0, 1.0]), -9e-5)])
    balance = start_balance(scene, jc.initial_state(scene, mesh.vertices))
    s, wall = 1.0 - 0.09 / 0.25, scene.walls[0]
    stiffness, reach = np.asarray(wall.stiffness), float(wall.range)
    energy = stiffness.sum() * reach**2 * s**3 / (3 * (1 - s))
    slope = s**2 * (3 - 2 * s) / (3 * (1 - s) ** 2)
    force, node = stiffness.max() * reach * slope, int(np.argmax(stiffness))
    assert not balance.in_balance
    assert balance.lines == [
        f"largest net force on a free node: {force:.3g} N, at node {node}",
        f"wall 0 (Plane): stores {1e3 * energy:.3g} mJ, pushes node {node} with {force:.3g} N; the sheet "
        "starts 0.09 mm from it, within its range of 0.25 mm",
    ]


def test_supports_hold_what_pushes():
    mesh = jc.hexagonal(5, 4, 0.01)
    held = jc.Prescribed(np.ones((mesh.n_nodes, 3), bool), jc.LinearMotion(mesh.vertices, np.zeros(3)))
    scene = jc.sheet(mesh, jc.Material(), gravity=(0.0, 0.0, -9.81), prescribed=held)
    balance = start_balance(scene, jc.initial_state(scene, mesh.vertices))
    weight = 9.81 * float(scene.mass.max())
    assert balance.in_balance
    assert [line.split(", at")[0].split(" node")[0] for line in balance.lines] == [
        "gravity: pushes",
        f"supports: hold up to {weight:.3g} N",
    ]


def test_a_term_that_is_not_finite_is_refused_by_name():
    # A slope of sqrt at 0.
    energy = jc.ElementEnergy([[2]], lambda x, parameters, t: jnp.sqrt(x[0] @ jnp.array([0.0, 0.0, 1.0])))
    scene = pair(extra=[energy])
    with pytest.raises(ValueError, match=r"extra energy 0: the force on node 2 is \[.*inf.* N at the start"):
        start_balance(scene, jc.initial_state(scene, PAIR))


def test_a_campaign_refuses_what_its_runs_would():
    walls = [{"kind": "plane", "offset": "1 cm"}]
    config = configure("custom", nodes=60, t_end=0.1, settings={"walls": walls})
    with pytest.raises(ValueError, match=r"^low: node \d+ starts 0.01 m behind wall 0 \(Plane\)"):
        check_case("low", config)


def test_check_reports_a_start_out_of_balance(tmp_path):
    file = tmp_path / "a.toml"
    text = 'scene = "custom"\nnodes = 60\n[options.sheet]\nshape = "square"\nimperfection = 0\n'
    file.write_text(f'{text}[[options.walls]]\nkind = "plane"\noffset = "-0.09 mm"\n')
    result = CliRunner().invoke(cli.app, ["check", str(file)])
    assert result.exit_code == 0, result.output
    assert "starts out of balance" in result.output
    assert "starts 0.09 mm from it, within its range of 0.25 mm" in result.output.splitlines()[-1]
