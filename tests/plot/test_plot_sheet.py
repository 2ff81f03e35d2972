"""A sheet in space is drawn where it is: areas, hidden parts, sides and walls have closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from pictures import colors

from jaxcrumple.io import RunDirectoryError
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.model.walls import Ball, Cone, HoledPlate, Plane, Ramp, Sphere
from jaxcrumple.plot import sheet as sheet_module
from jaxcrumple.plot.camera import Camera, camera_for
from jaxcrumple.plot.draw import draw_sheet
from jaxcrumple.plot.figure import new_figure, save_figure
from jaxcrumple.plot.light import linear, srgb
from jaxcrumple.plot.normals import CREASE, corner_normals, face_normals
from jaxcrumple.plot.sheet import Walls, camera_of, color_scale
from jaxcrumple.plot.wall_layers import surface_points, wall_layers

raycast = pytest.importorskip("jaxcrumple.plot.raycast", reason="Embree has no wheel here")

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 0.1
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def grey(hits):
    return np.full((len(hits.rays), 3), 0.5)


def from_above(points, width=0.2):
    return Camera(np.mean(points, axis=0), np.eye(3), width, width, 1.0)


def cast(faces, x, camera, pixels=400, color=grey, layers=()):
    return raycast.cast(raycast.Caster(faces, x, camera), color, pixels, layers=layers)


@pytest.mark.parametrize("view", [(0, 0.001, 1), (-0.45, -0.8, 0.55), (1, 0.5, 0.1)])
def test_coverage_is_the_projected_area(view):
    camera = camera_for(SQUARE, view)
    image = cast(HALVES, SQUARE, camera, 600)
    expected = 0.01 * abs(camera.axes[2, 2]) / (camera.width * camera.height)
    assert image[..., 3].mean() == pytest.approx(expected, rel=3e-3)
    assert image[0, :, 3].max() == image[:, 0, 3].max() == 0.0


def test_hits_are_on_the_sheet(mesh, bent):
    camera = camera_for(bent)
    caster = raycast.Caster(mesh.faces, bent, camera)
    shape = camera.shape(200)
    origins = camera.origins(shape, np.full((*shape, 2), 0.5))
    hits = caster.hits(origins)
    along = origins[hits.rays] - hits.distances[:, None] * camera.axes[2]
    np.testing.assert_allclose(hits.points, along, atol=1e-5)
    # Single precision moves points along their triangle, not off it: rays to the lamp start above it.
    height = hits.points - (bent[mesh.faces[hits.faces, 0]] - camera.center)
    np.testing.assert_allclose(np.einsum("hi,hi->h", height, hits.flat), 0.0, atol=3e-8)
    assert hits.shares.min() > -1e-5
    np.testing.assert_allclose(hits.shares.sum(axis=1), 1.0, rtol=1e-6)
    assert np.einsum("hi,i->h", hits.flat, camera.axes[2]).min() >= 0


def test_the_nearer_layer_hides_the_other():
    """Two squares, 0.1 mm apart: only the upper one is seen from above, only the lower one from below."""
    x = np.concatenate([SQUARE, SQUARE + np.array([0, 0, 1e-4])])
    faces = np.concatenate([HALVES, HALVES + 4])
    for axes, expected in ((np.eye(3), {2, 3}), (np.diag([1.0, -1.0, -1.0]), {0, 1})):
        camera = Camera(x.mean(axis=0), axes, 0.2, 0.2, 1.0)
        caster = raycast.Caster(faces, x, camera)
        hits = caster.hits(camera.origins((300, 300), np.full((300, 300, 2), 0.5)))
        assert set(np.unique(hits.faces)) == expected


def test_light_on_a_flat_sheet_is_that_of_lamp_and_sky():
    image = cast(HALVES, SQUARE, from_above(SQUARE))
    lamp = np.array(raycast.LAMP) / np.linalg.norm(raycast.LAMP)
    inside = image[150:250, 150:250]
    # Mean of the cosine over the disc: 1/sqrt(1 + r^2) between directions to its rim and its middle.
    square = raycast.LAMP_RADIUS**2
    disc = 2.0 * (np.sqrt(1.0 + square) - 1.0) / square
    expected = 0.5 * (raycast.AMBIENT + raycast.DIRECT * lamp[2] * disc)
    assert inside[..., :3].mean() == pytest.approx(expected, rel=1e-3)
    assert inside[..., :3].std() < 0.02 * expected


def test_a_wall_of_the_sheet_hides_half_the_sky():
    """Next to a high wall, half of the sky is open; where the wall stands between, the lamp is hidden too."""
    wall = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]]) * [1.0, 100.0, 100.0] + [0, -50.0, 0]
    floor = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 100.0
    x, faces = np.concatenate([floor, wall]), np.concatenate([HALVES, HALVES + 4])
    camera = Camera(np.zeros(3), np.eye(3), 2.0, 2.0, 300.0)
    image = cast(faces, x, camera, 200)
    lamp = np.array(raycast.LAMP) / np.linalg.norm(raycast.LAMP)
    open_half = 0.5 * (0.5 * raycast.AMBIENT + raycast.DIRECT * lamp[2])
    assert image[60:140, 80:95, 0].mean() == pytest.approx(open_half, rel=0.02)
    assert image[60:140, 105:120, 0].mean() == pytest.approx(0.25 * raycast.AMBIENT, rel=0.02)


def test_sides_differ(mesh):
    normal = face_normals(mesh.faces, mesh.vertices)[0, 2]
    seen = []
    for sign in (1.0, -1.0):
        camera = Camera(np.zeros(3), np.diag([1.0, sign * normal, sign * normal]), 0.2, 0.2, 1.0)
        seen.append(cast(mesh.faces, mesh.vertices, camera)[200, 200, :3])
    front, back = seen
    assert np.ptp(front) < 1e-6 and back.mean() < 0.8 * front.mean()
    assert back[2] > 1.05 * back[0]


def test_normals_of_a_sphere():
    """On a smooth surface the normals at corners converge to those of the surface."""
    errors = []
    for nodes in (300, 1200):
        flat = rectangle(0.1, 0.1, nodes, sweeps=20)
        x = flat.vertices.copy()
        x[:, 2] = np.sqrt(0.1**2 - x[:, 0] ** 2 - x[:, 1] ** 2)
        normals = corner_normals(flat.faces, x)
        exact = (x / 0.1)[flat.faces] * np.sign(normals[0, 0, 2])
        inner = ~np.isin(flat.faces, flat.boundary_nodes)
        errors.append(np.linalg.norm(normals - exact, axis=2)[inner].mean())
    assert errors[1] < 0.7 * errors[0] < 0.02


def test_creases_stay_sharp():
    """A roof steeper than the limit has the normals of its two faces, a flatter one their mean."""
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    for turn, sharp in ((1.1 * CREASE, True), (0.9 * CREASE, False)):
        half = 0.5 * turn
        x = np.array(
            [[0, 0, 0], [0, 1, 0], [-np.cos(half), 0.5, -np.sin(half)], [np.cos(half), 0.5, -np.sin(half)]]
        )
        normals, flat = corner_normals(faces, x), face_normals(faces, x)
        on_crease = normals[0, :2]
        expected = flat[0] if sharp else flat.sum(axis=0) / np.linalg.norm(flat.sum(axis=0))
        np.testing.assert_allclose(on_crease, [expected, expected], atol=1e-12)
        np.testing.assert_allclose(normals[0, 2], flat[0], atol=1e-12)


def layers_of(wall, camera, pixels=200, radius=0.12, t=0.0):
    shape = camera.shape(pixels)
    origins = camera.center + camera.origins(shape, np.full((*shape, 2), 0.5))
    layers = wall_layers([wall], t, np.zeros(3), radius, origins, -camera.axes[2])
    return origins, layers


def test_walls_are_where_their_gap_vanishes():
    camera = camera_for(0.08 * np.concatenate([np.eye(3), -np.eye(3)]))
    tilted = np.array([0.6, 0.0, 0.8])
    walls = [
        Sphere(np.zeros(3), Ramp(0.08, -0.01)),
        Plane(tilted, 0.01),
        Ball(np.zeros(3), tilted, 0.04, 0.02),
        Cone(np.zeros(3), -tilted, 0.5, -0.03),
        HoledPlate(np.zeros(3), tilted, 0.03, 0.005),
    ]
    for wall in walls:
        origins, layers = layers_of(wall, camera, t=1.0)
        seen = 0
        for layer in layers:
            found = np.isfinite(layer.distance)
            points = origins[found] - layer.distance[found, None] * camera.axes[2]
            gaps = np.append(jax.vmap(wall.gap, (0, None))(jnp.asarray(points), 1.0), 0.0)
            # Newton's method does not converge on rims, where rays graze the surface.
            assert np.quantile(np.abs(gaps), 0.98) < 1e-6 and np.abs(gaps).max() < 2e-3
            assert np.all(layer.opacity[~found] == 0)
            seen += found.sum()
        assert seen > 1000


def test_a_sphere_covers_its_disc_and_a_plane_is_crossed_once():
    camera = Camera(np.zeros(3), np.eye(3), 0.2, 0.2, 1.0)
    _, (front, back) = layers_of(Sphere(np.zeros(3), 0.08), camera, 500)
    for layer in (front, back):
        assert np.isfinite(layer.distance).mean() * 0.04 == pytest.approx(np.pi * 0.08**2, rel=5e-3)
    middle = np.argmin(np.where(np.isfinite(front.distance), front.distance, np.inf))
    assert back.distance[middle] - front.distance[middle] == pytest.approx(0.16, rel=1e-3)
    assert front.opacity[middle] < 0.1 * front.opacity.max()
    _, (front, back) = layers_of(Plane(np.array([0.0, 0.0, 1.0]), 0.0), camera, 500)
    assert np.isfinite(front.distance).any() and not np.isfinite(back.distance).any()


def test_a_wall_in_front_covers_the_sheet_and_one_behind_does_not():
    camera = from_above(SQUARE)
    plain = cast(HALVES, SQUARE, camera)
    for offset, same in ((-0.02, True), (0.02, False)):
        shape = camera.shape(400)
        origins = camera.center + camera.origins(shape, np.full((*shape, 2), 0.5))
        wall = Plane(np.array([0.0, 0.0, 1.0]), offset)
        layers = wall_layers([wall], 0.0, camera.center, 0.12, origins, -camera.axes[2])
        image = cast(HALVES, SQUARE, camera, layers=layers)
        assert (image[200, 200] == plain[200, 200]).all() == same
        assert image[40, 200, 3] > 0 == plain[40, 200, 3]


def test_the_camera_sees_the_walls(bent):
    sphere = Walls([Sphere(np.zeros(3), Ramp(0.08, -0.01))], 1.0)
    points = surface_points(sphere.shapes, 1.0, np.zeros(3), 0.1)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.07, atol=1e-5)
    assert len(points) > 400
    assert camera_of(bent, sphere).width > 2 * 0.069 > camera_of(bent).width


def test_colours_are_those_of_the_scale(mesh):
    """In light of one, a picture has the colours of the colour bar."""
    values = mesh.vertices[:, 0]
    scale = color_scale(values, signed=False)
    expected = np.array(scale.to_rgba(0.02)[:3])
    image = np.concatenate([0.5 * linear(expected), [0.5]]).reshape(1, 1, 4)
    np.testing.assert_allclose(srgb(image)[0, 0], [*expected, 0.5], atol=1e-12)


def test_plot(tmp_path, mesh, bent):
    path = tmp_path / "sheet.png"
    drawn = draw_sheet(mesh, bent, caption="n = 300, rtol = 1e-4", pixels=300)
    assert drawn.save(path) == path
    assert colors(path) > 100
    axes, bar = drawn.figure.axes
    assert drawn.figure.get_suptitle() == "n = 300, rtol = 1e-4"
    assert bar.get_ylabel() == sheet_module.CURVATURE_LABEL
    camera = camera_of(bent)
    assert np.ptp(axes.get_xlim()) == pytest.approx(1e3 * camera.width)
    assert axes.get_aspect() == 1.0
    (line,) = axes.lines
    assert np.ptp(line.get_xdata()) == 20.0 and axes.texts[0].get_text() == "2 cm"


@pytest.mark.parametrize("sorted_", [False, True])
def test_other_colours(tmp_path, mesh, bent, monkeypatch, sorted_):
    """A value of a node or triangle is seen, also where Embree has no wheel; zeros and a colour are plain."""
    if sorted_:
        monkeypatch.setattr(sheet_module.importlib.util, "find_spec", lambda name: None)
    hues = []
    for color in (mesh.vertices[:, 0], mesh.face_area, np.zeros(mesh.n_nodes), "tab:red"):
        figure = draw_sheet(mesh, bent, color, label="m2", pixels=300).figure
        save_figure(figure, tmp_path / "a.png")
        assert colors(tmp_path / "a.png") > 50
        axes = figure.axes[0]
        if sorted_:
            shown = axes.collections[0].get_facecolor()[:, :3]
        else:
            picture = np.asarray(axes.images[0].get_array())
            shown = picture[picture[..., 3] == 1.0][:, :3]
        hues.append(len(np.unique(np.round(shown / shown.sum(axis=1, keepdims=True), 2), axis=0)))
        assert [bar.get_ylabel() for bar in figure.axes[1:]] == ["m2"] * (not isinstance(color, str))
    assert min(hues[:2]) > 5 * max(hues[2:])


def test_two_sheets_share_a_figure_its_scale_and_the_space_they_show(mesh, bent):
    """The same node has the same colour and the same scale of length in both axes."""
    figure = new_figure((4.0, 2.0), "")
    left, right = figure.subplots(1, 2)
    scale = ScalarMappable(Normalize(0.0, 1.0), "viridis")
    drawn = [
        draw_sheet(
            mesh, bent, np.full(mesh.n_nodes, value), axes=axes, scale=scale, within=2 * bent, pixels=200
        )
        for axes, value in ((left, 0.0), (right, 1.0))
    ]
    assert [one.figure for one in drawn] == [figure, figure] and figure.axes == [left, right]
    hues = []
    for axes in (left, right):
        assert np.ptp(axes.get_xlim()) > 1.9e3 * camera_of(bent).width
        image = np.asarray(axes.images[0].get_array())
        shown = image[image[..., 3] == 1.0][:, :3].mean(axis=0)
        hues.append(np.argmax(shown))
    assert hues == [2, 0]  # the ends of viridis are violet and yellow


def test_wrong_input_is_refused(tmp_path, mesh, bent):
    with pytest.raises(ValueError, match="one value per node or per face"):
        draw_sheet(mesh, bent, np.zeros(3))
    with pytest.raises(ValueError, match="must not be zero or parallel"):
        draw_sheet(mesh, bent, view=(0, 0, 1))
    with pytest.raises(ValueError, match="'bmpp' is not supported"):
        draw_sheet(mesh, bent, pixels=50).save(tmp_path / "a.bmpp")
    with pytest.raises(RunDirectoryError, match="cannot write"):
        draw_sheet(mesh, bent, pixels=50).save(tmp_path / "nowhere" / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_a_scale_of_frames_is_that_of_the_largest_one():
    """Most frames of a run are flat; over all their values the largest 2 % may be rounding errors."""
    rng = np.random.default_rng(0)
    frames = [1e-17 * rng.random(500) for _ in range(60)]
    frames[-1][:40] = np.linspace(0.1, 0.5, 40)
    expected = np.quantile(frames[-1], 0.98)
    assert color_scale(*frames, signed=False).get_clim()[1] == pytest.approx(expected)
    assert color_scale(*frames, signed=True).get_clim() == pytest.approx((-expected, expected))
    # Rounding errors alone get no colours.
    assert color_scale(*frames[:-1], signed=False, least=0.05).get_clim()[1] == 0.05


def test_a_logarithmic_scale_begins_at_zero():
    scale = color_scale(np.array([0.0, 5.0, 2000.0]), signed=False, decades=3.0)
    below, above = scale.norm([0.0, 2.0]), scale.norm([2.0, 20.0, 200.0, 2000.0])
    assert below[0] == 0 and above[-1] == 1
    # A decade takes the same share of the colours everywhere above the linear part.
    assert above[3] - above[2] == pytest.approx(above[2] - above[1], rel=0.02)
    assert color_scale(np.zeros(3), signed=False, decades=3.0).get_clim() == (0.0, 1.0)
