"""Scenes: where walls, supports and sheets are at the moments of their protocols."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxcrumple as jc
from jaxcrumple.measure import mean_curvature
from jaxcrumple.scenes.axial import AxialTimes
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.scenes.options import SheetModel
from jaxcrumple.scenes.sheets import SheetOptions, wrapped

SHEETS = [name for name, entry in SCENES.items() if issubclass(entry.options, SheetModel)]


@pytest.fixture(scope="module")
def setups():
    """A small one of each scene of a crumpled sheet."""
    return {name: SCENES[name].build(80, sweeps=5, contact=None) for name in SHEETS}


@pytest.mark.parametrize("name", SHEETS)
def test_a_sheet_starts_clear_of_walls_and_without_stress(setups, name):
    setup = setups[name]
    assert all(float(wall.gap(setup.x, 0.0).min()) >= float(wall.range) for wall in setup.scene.walls)
    state = jc.initial_state(setup.scene, setup.x)
    parts = jc.energies(setup.scene, state.x, state.v, state.p, state.t)
    # Springs and hinges are those of the rest shape, however that is placed.
    assert parts.walls == 0.0
    if name in ("cylindrical", "axial"):
        radius = 0.017 - 1.1 * 0.25e-3 - 25e-6 if name == "cylindrical" else 0.2
        rigidity = float(setup.material.bending_rigidity)
        assert parts.bending == pytest.approx(0.5 * rigidity * setup.mesh.area / radius**2, rel=0.25)
        # Chords are shorter than arcs, by more the coarser the mesh; what lies off the middle is not as long.
        assert np.all(np.asarray(setup.scene.membrane.strain(setup.x)) < 1.1 * 25e-6 / radius)
    else:
        assert abs(parts.stretch) + abs(parts.bending) + abs(parts.extra) < 1e-20


@pytest.mark.parametrize("name", SHEETS)
def test_scenes_end_when_their_walls_have_arrived(setups, name):
    """No wall moves any more at the end but those of `radial`; all have moved before."""
    end, setup = SCENES[name].t_end, setups[name]
    if name in ("radial", "ridge"):
        return
    origin = jnp.array([1e-3, 2e-3, 3e-3])

    def gaps(t):
        return np.array([float(wall.shape.gap(origin, t)) for wall in setup.scene.walls])

    np.testing.assert_allclose(gaps(1.02 * end), gaps(1.2 * end), atol=1e-12)
    if name == "conical":
        held = np.argmax(np.asarray(setup.scene.prescribed.mask)[:, 2])
        down = [
            float(setup.scene.prescribed.motion(t)[held, 2]) for t in (0.0, 0.5 * end, 1.02 * end, 1.2 * end)
        ]
        np.testing.assert_allclose(down[0] - np.array(down[2:]), 0.025, rtol=1e-9)
        assert 0.01 < down[0] - down[1] < 0.015
    else:
        assert np.abs(gaps(0.0) - gaps(0.7 * end)).max() > 1e-3


@pytest.mark.parametrize("die", [0.0506, 0.053, 0.07, 0.2])
def test_a_disc_starts_clear_of_any_die(die):
    setup = jc.stamping(80, die=die, sweeps=5, contact=None)
    assert all(float(wall.gap(setup.x, 0.0).min()) >= float(wall.range) for wall in setup.scene.walls)


@pytest.mark.parametrize("size", [3e-3, 0.015, 0.025, 0.1])
def test_a_sheet_of_any_size_is_imperfect(size):
    mesh = jc.radial(80, size=size, radius=0.71 * size, sweeps=5, contact=None).mesh
    height = mesh.vertices[:, 2]
    assert np.abs(height).max() == pytest.approx(25e-6)
    assert np.std(height) > 5e-6


def test_options_that_are_none_are_refused():
    with pytest.raises(TypeError, match="unexpected keyword argument 'speeed'"):
        jc.stamping(80, speeed=1.0)
    for field in dataclasses.fields(SheetOptions):
        assert field.name in SCENES["stamping"].options.model_fields or field.name == "material"


def test_axial_walls_roll_compress_open_and_flatten_again_and_again():
    size, radius, height, gap = 0.1, 0.02, 0.03, 3e-3
    setup = jc.axial(80, cycles=2, size=size, radius=radius, height=height, gap=gap, sweeps=2, contact=None)
    cylinder, low, _, front, back = (wall.shape for wall in setup.scene.walls)
    middle, times = jnp.zeros(3), AxialTimes()
    for begin in (0.0, times.cycle):
        roll, compress, open_, _, flatten, rest = begin + np.cumsum(times)
        assert float(cylinder.gap(middle, roll)) == pytest.approx(radius, abs=1e-9)
        assert float(low.gap(middle, compress)) == pytest.approx(0.5 * height)
        assert float(cylinder.gap(middle, compress)) == pytest.approx(radius, abs=1e-9)
        assert float(front.gap(middle, flatten) + back.gap(middle, flatten)) == pytest.approx(gap)
        for t in (open_, rest):
            assert min(float(wall.gap(middle, t)) for wall in (cylinder, low, front)) > 0.5 * size
        # The edge is pulled home while the sheet is unfolded and flattened, more and more, and then let go.
        ends = jnp.array([open_, flatten - 0.01, rest])
        pull = [setup.scene.extra[0].energy(setup.x + 1e-3, t) for t in ends]
        assert pull[0] < 1e-4 * pull[1] and pull[2] == 0.0
    assert SCENES["axial"].ends({**times._asdict(), "cycles": 2}) == pytest.approx(2 * times.cycle)


def test_a_sphere_that_is_let_go_grows_back():
    setup = jc.unload(80, least=0.05, speed=0.01, hold=0.2, sweeps=2, contact=None)
    radius = setup.scene.walls[0].shape.radius
    found = [float(radius(t)) for t in (0.0, 1.05, 2.1, 2.3, 3.35, 4.4, 9.0)]
    assert found == pytest.approx([0.071, 0.0605, 0.05, 0.05, 0.0605, 0.071, 0.071])


def test_a_shell_is_a_cap_of_a_ball():
    setup = jc.shell(400, radius=0.05, curvature_radius=0.06, imperfection=0.0, contact=None)
    mesh = setup.mesh
    distance = np.linalg.norm(mesh.vertices + np.array([0.0, 0.0, 0.06]), axis=1)
    np.testing.assert_allclose(distance, 0.06, rtol=1e-12)
    assert mesh.area == pytest.approx(2.0 * np.pi * 0.06**2 * (1.0 - np.cos(0.05 / 0.06)), rel=2e-2)
    # Its mean curvature is that of the ball, and distances from the apex are those of the flat disc.
    curvature = mean_curvature(mesh, mesh.vertices)
    inner = np.setdiff1d(np.arange(mesh.n_nodes), mesh.boundary_nodes)
    assert np.median(curvature[inner]) == pytest.approx(2.0 / 0.06, rel=2e-2)
    flat = jc.disc(0.05, 400).vertices
    angle = np.arccos(np.clip(wrapped(flat, 0.06)[:, 2] / 0.06 + 1.0, -1.0, 1.0))
    np.testing.assert_allclose(0.06 * angle, np.linalg.norm(flat, axis=1), atol=1e-9)


@pytest.mark.slow
def test_stamping_leaves_the_sheet_between_ball_and_die():
    setup = jc.stamping(
        80, radius=0.05, gap=8e-3, speed=0.1, contact=None, material=jc.Material(drag_rate=1e4)
    )
    end = float(setup.scene.walls[1].shape.height.times[-1])
    solution = jc.simulate(setup.scene, jc.initial_state(setup.scene, setup.x), end)
    assert solution.result == "success"
    distance = np.linalg.norm(solution.x[-1], axis=1)
    assert np.all((distance > 0.053 - 8e-3) & (distance < 0.053))


@pytest.mark.slow
def test_what_is_pulled_through_a_hole_has_passed_it():
    setup = jc.conical(120, pull=0.02, speed=0.2, contact=None, material=jc.Material(drag_rate=1e4))
    solution = jc.simulate(setup.scene, jc.initial_state(setup.scene, setup.x), 0.1)
    assert solution.result == "success"
    held = np.asarray(setup.scene.prescribed.mask)[:, 2]
    np.testing.assert_allclose(solution.x[-1][held, 2], np.asarray(setup.x)[held, 2] - 0.02, atol=1e-12)
    assert float(setup.scene.walls[0].gap(solution.state.x, solution.state.t).min()) > 0
    assert solution.x[-1][:, 2].max() > 5e-3


@pytest.mark.parametrize(
    ("scene", "options", "message"),
    [
        (jc.cylindrical, {"height": 0.2}, "height = 0.2 m must be less than the size"),
        (jc.cylindrical, {"radius": 0.015}, "too small for a sheet of 0.1 m .* choose at least 0.01626"),
        (jc.axial, {"cycles": 0}, "cycles = 0 must be at least 1"),
        (jc.cylindrical, {"contact_range": 0.0}, "contact range = 0.0 m must be a positive length"),
        (jc.axial, {"gap": 4e-4}, "gap = 0.0004 m must be more than twice the thickness"),
        (jc.unload, {"least": 0.08}, "must be less than the radius"),
        (jc.stamping, {"die": 0.05}, "has no room for a disc of 0.05 m; choose at least 0.05055"),
        (jc.stamping, {"gap": 1e-4}, "gap = 0.0001 m must be more than twice"),
        (jc.stamping, {"gap": 0.04}, "less than the depth of the die under the disc, 0.0354"),
        (jc.shell, {"gap": 0.02}, "less than the height of the shell, 0.0197"),
        (jc.shell, {"curvature_radius": 0.02}, "more than half of a ball; choose at least 0.0318"),
        (jc.conical, {"opening": 0.004}, "does not pass a hole"),
        (jc.conical, {"opening": 0.049}, "lets the disc of 0.05 m fall through"),
        (jc.ridge, {"turn": 3.2}, "closes the corner"),
        (jc.dcone, {"slope": -0.1}, "slope = -0.1 must be a positive number"),
    ],
)
def test_scenes_that_cannot_be_are_refused(scene, options, message):
    with pytest.raises(ValueError, match=message):
        scene(80, **options)


def test_the_curvature_of_a_rolled_sheet_is_that_of_its_ridge():
    setup, radius = jc.ridge(1500, contact=None), 0.03
    x, y, _ = setup.mesh.vertices.T
    rolled = np.column_stack([radius * np.sin(x / radius), y, radius * (1.0 - np.cos(x / radius))])
    assert jc.ridge_curvature(setup.mesh, rolled) == pytest.approx(1.0 / radius, rel=3e-2)


def test_corners_of_a_ridge_keep_the_lengths_of_their_halves():
    setup = jc.ridge(300, turn=2.0, close=0.2, contact=None)
    turned = np.asarray(setup.scene.prescribed.motion(0.2))
    start, right = np.asarray(setup.x), np.asarray(setup.x)[:, 0] > 0
    for half in (right, ~right):
        one, two = turned[half], start[half]
        np.testing.assert_allclose(
            np.linalg.norm(one - one[0], axis=1), np.linalg.norm(two - two[0], axis=1), atol=1e-12
        )
    ways = [turned[half][:, [0, 2]].T @ np.abs(start[half, 0]) for half in (right, ~right)]
    cosine = ways[0] @ ways[1] / np.prod(np.linalg.norm(ways, axis=1))
    # Up to the imperfection, of 25 um over 5 cm.
    assert np.pi - np.arccos(cosine) == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(("nodes", "slope"), [(200, 0.1), (1500, 0.12), (1500, 0.3)])
def test_the_tip_of_a_cone_rises_to_a_thickness_below_the_node_that_is_held(nodes, slope):
    """Beside the axis it would come nearer; on a coarse mesh it passed through the node."""
    setup = jc.dcone(nodes, slope=slope, contact=None, sweeps=5)
    held = np.asarray(setup.scene.prescribed.mask).all(axis=1)
    assert held.sum() == 1 and np.linalg.norm(setup.x[held, :2]) == 0
    gap = setup.scene.walls[0].gap(setup.x, 100.0)[held]
    np.testing.assert_allclose(gap, setup.material.thickness, rtol=1e-9)
    assert float(setup.scene.walls[0].gap(setup.x, 0.0).min()) >= 1.0999 * setup.material.thickness


@pytest.mark.parametrize("degrees", [110.0, 139.0])
def test_the_free_sector_of_a_surface_that_lifts_off_as_a_cube(degrees):
    setup = jc.dcone(1500, slope=0.1, imperfection=0.0, contact=None)
    x, y, _ = setup.mesh.vertices.T
    reach, half = np.hypot(x, y), np.deg2rad(degrees) / 2
    angle = np.abs(np.angle(np.exp(1j * (np.arctan2(y, x) - 2.0))))
    lifted = 0.5 * reach * np.maximum(half**2 - angle**2, 0.0) ** 3 / half**3
    shape = np.column_stack([x, y, 0.1 * reach + lifted])
    found = np.rad2deg(jc.free_sector(setup, shape, 10.0))
    assert found == pytest.approx(degrees, abs=4.0)


@pytest.mark.parametrize(
    ("nodes", "options", "spacing"),
    [
        (200, {}, 2.0 / 3.0),
        (600, {}, 1.0),
        (200, {"contact_level": 40}, None),
        (200, {"contact": None}, None),
    ],
)
def test_sites_are_closer_on_a_rolled_sheet_with_long_edges(nodes, options, spacing):
    setup = jc.cylindrical(nodes, sweeps=5, **options)
    if "contact" in options:
        assert setup.contact is None
        return
    # A lattice of p intervals on each side of a triangle has (p + 1) (p + 2) / 2 sites.
    parts = round((2 * len(setup.scene.contact.share) + 0.25) ** 0.5 - 1.5)
    side = (4.0 / 3.0**0.5 * setup.mesh.face_area.max()) ** 0.5
    longest = max(side, setup.mesh.edge_length.max() / 1.5) / float(setup.scene.contact.range)
    if spacing is None:
        assert parts == 41
    else:
        assert longest / parts <= spacing < longest / (parts - 1)
