"""Layers and cross-sections against stacks, spheres, isotropic arrangements and Cavalieri's principle."""

import numpy as np
import pytest
from elements import rotations
from shapes import RADIUS, icosphere

from jaxcrumple import measure
from jaxcrumple.measure.layers import crossings, parallel_crossings
from jaxcrumple.mesh.generate import hexagonal, rectangle

GAP, PLATE, PLATES = 1e-3, 0.02, 5


@pytest.fixture(scope="module")
def stack():
    """A long sheet folded to and fro in plates `GAP` apart, and the plate of each face, -1 near its ends."""
    mesh = rectangle(PLATE * PLATES, 0.02, 500, sweeps=20)
    along = mesh.vertices[:, 0] / PLATE + 0.5 * PLATES
    plate = np.clip(np.floor(along), 0, PLATES - 1)
    across = np.where(plate % 2 == 0, along - plate, 1 - (along - plate))
    x = np.column_stack([PLATE * across, mesh.vertices[:, 1], GAP * plate])
    middle = x[mesh.faces].mean(axis=1)
    inner = (np.ptp(x[mesh.faces][..., 2], axis=1) == 0) & (np.abs(middle[:, 0] / PLATE - 0.5) < 0.3)
    return mesh, x, np.where(inner, plate[mesh.faces[:, 0]].astype(int), -1)


def crumple(seed):
    """A mesh with random positions in a box, and the areas and normals of its triangles."""
    mesh = rectangle(1.0, 1.0, 60, sweeps=5)
    x = np.random.default_rng(seed).uniform(0, 0.02, size=(mesh.n_nodes, 3))
    corners = x[mesh.faces]
    twice = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(twice, axis=1)
    return mesh, x, area, twice / (2 * area[:, None])


@pytest.mark.parametrize(("reach", "seen"), [(0.9, 0), (1.5, 1), (2.5, 2), (4.5, 4)])
def test_layers_of_a_stack(stack, reach, seen):
    mesh, x, plate = stack
    layers = measure.stacked_layers(mesh, x, reach * GAP)
    for k in range(PLATES):
        assert set(layers[plate == k]) == {1 + min(seen, k) + min(seen, PLATES - 1 - k)}


def test_chords_through_a_stack(stack):
    mesh, x, _ = stack
    ends = np.array([[0.0, 0, -1.5], [0, 0, 10.5]]) * GAP  # five layers at 0, 1, ... 4
    chords = ends + np.array([0.0101, 3e-4, 0])
    chords = np.stack([chords, chords - [0.05, 0, 0], 0.25 * ends + np.array([0.0101, 3e-4, 0])])
    chords[1, 1] += [0.05, 0, 0]  # comes in beside the stack and ends inside, above all of it
    assert measure.chord_layers(mesh, x, chords).tolist() == [5, 0, 3]
    tilted = chords[:1] + np.array([[-5 * GAP, 0, 0], [5 * GAP, 0, 0]])
    assert measure.chord_layers(mesh, x, tilted).tolist() == [5]


def test_layers_of_a_flat_sheet_and_a_sphere():
    mesh = icosphere(2)
    assert set(measure.stacked_layers(mesh, mesh.vertices, 1.5 * RADIUS)) == {1}
    assert set(measure.stacked_layers(mesh, mesh.vertices, 2.5 * RADIUS)) == {2}
    flat = rectangle(0.1, 0.1, 200, sweeps=3)
    assert set(measure.stacked_layers(flat, flat.vertices, 0.05)) == {1}


@pytest.mark.parametrize("limit_deg", [30.0, 60.0, 90.0])
def test_isotropic_arrangement(limit_deg):
    """A line meets half of the area per volume, and sin^2 of the limit of that within the limit."""
    rng = np.random.default_rng(0)
    count, size, reach = 3000, 0.06, 0.08
    triangle = size * np.array([[1, 0, 0], [-0.5, np.sqrt(0.75), 0], [-0.5, -np.sqrt(0.75), 0]])
    middle = rng.uniform(size=(count, 3))
    found = parallel_crossings(
        middle[:, None] + triangle @ rotations(rng, count), reach, np.cos(np.deg2rad(limit_deg))
    )
    inside = np.all(np.abs(middle - 0.5) < 0.5 - reach - size, axis=1)
    per_volume = count * size**2 * np.sqrt(27) / 4
    expected = per_volume * reach * np.sin(np.deg2rad(limit_deg)) ** 2
    assert found[inside].mean() == pytest.approx(expected, rel=0.05)


def test_crossings_name_chord_and_triangle():
    corners = np.array([[[0.0, 0, z], [1, 0, z], [0, 1, z]] for z in (0.0, 1.0, 2.0)])
    chords = np.array([[[2.0, 2, -1], [2, 2, 3]], [[0.2, 0.2, 0.5], [0.2, 0.2, 3]]])
    assert sorted(crossings(chords, corners).tolist()) == [[1, 1], [1, 2]]


def test_radial_alignment():
    mesh = icosphere(3)
    assert measure.radial_alignment(mesh, mesh.vertices) == pytest.approx(1, abs=2e-3)
    flat = rectangle(0.1, 0.1, 100, sweeps=3)
    assert measure.radial_alignment(flat, flat.vertices) == pytest.approx(-0.5)
    mesh, x, _, n = crumple(1)
    outward = x[mesh.faces].mean(axis=1) - measure.center_of_mass(mesh, x)
    angle = np.arccos(np.sum(n * outward, axis=1) / np.linalg.norm(outward, axis=1))
    # Legendre's polynomial by the double angle.
    assert measure.radial_alignment(mesh, x) == pytest.approx(0.25 + 0.75 * np.cos(2 * angle))


def test_sections_of_a_sphere():
    mesh = icosphere(4)
    normal = np.array([1.0, -2, 0.5])
    for height in (-0.6, 0.1, 0.9):
        point = height * RADIUS * normal / np.linalg.norm(normal)
        section = measure.cross_section(mesh, mesh.vertices, point, normal)
        radius = RADIUS * np.sqrt(1 - height**2)
        assert section.length == pytest.approx(2 * np.pi * radius, rel=5e-3)
        assert np.linalg.norm(section.ends, axis=2) == pytest.approx(radius, rel=1e-2)
        assert np.cross(*section.axes) == pytest.approx(normal / np.linalg.norm(normal))
    # A plane cuts 2 pi R h of a shell of thickness h at any height.
    outlines = measure.thick_section(mesh, mesh.vertices, 1e-3, point, normal)
    assert polygon_areas(outlines).sum() == pytest.approx(2 * np.pi * RADIUS * 1e-3, rel=2e-2)


def polygon_areas(corners):
    after = np.roll(corners, -1, axis=1)
    return 0.5 * np.sum(corners[..., 0] * after[..., 1] - corners[..., 1] * after[..., 0], axis=1)


def test_sections_add_up_to_the_sheet():
    """Over all planes of one direction, lengths add up to the projected area, and outlines to the volume."""
    mesh, x, area, n = crumple(2)
    h, normal = 1e-3, np.array([0.3, 0.4, -0.8])
    direction = normal / np.linalg.norm(normal)
    low, high = (x @ direction).min() - h, (x @ direction).max() + h
    heights = np.linspace(low, high, 160, endpoint=False) + (high - low) / 320
    length, outlines = 0.0, 0.0
    for s in heights:
        length += measure.cross_section(mesh, x, s * direction, normal).length
        areas = polygon_areas(measure.thick_section(mesh, x, h, s * direction, normal))
        assert np.all(areas >= 0)
        outlines += areas.sum()
    step = (high - low) / 160
    assert length * step == pytest.approx(area @ np.sqrt(1 - (n @ direction) ** 2), rel=2e-3)
    assert outlines * step == pytest.approx(h * area.sum(), rel=2e-3)


def test_a_section_along_edges_is_there_once():
    mesh = hexagonal(8, 4, 1e-3)  # its middle row of nodes lies in the plane y = 0
    section = measure.cross_section(mesh, mesh.vertices, [0, 0, 0], [0, 1, 0])
    assert section.length == pytest.approx(7e-3)
    assert measure.cross_section(mesh, mesh.vertices, [0, 0, 1e-9], [0, 0, 1]).length == 0


@pytest.mark.parametrize("tilt", [0.0, 0.7, 1.2])
def test_a_section_has_the_thickness_of_the_sheet(tilt):
    mesh = hexagonal(8, 4, 1e-3)
    cut = [1e-5, 0, 0], [np.cos(tilt), 0, np.sin(tilt)]
    outlines = measure.thick_section(mesh, mesh.vertices, 2e-4, *cut)
    z = outlines @ measure.cross_section(mesh, mesh.vertices, *cut).axes[:, 2]
    assert (z.min(), z.max()) == pytest.approx((-1e-4, 1e-4))
    width = np.ptp(mesh.vertices[:, 1])
    assert polygon_areas(outlines).sum() == pytest.approx(2e-4 / np.cos(tilt) * width)


def test_what_is_refused(stack):
    mesh, x, _ = stack
    for reach in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="give a positive distance in metres"):
            measure.stacked_layers(mesh, x, reach)
    with pytest.raises(ValueError, match="degrees above 0, at most 90"):
        measure.stacked_layers(mesh, x, GAP, limit_deg=91)
    with pytest.raises(ValueError, match=r"chords have shape \(3,\)"):
        measure.chord_layers(mesh, x, [0, 0, 1])
    with pytest.raises(ValueError, match="has no direction"):
        measure.cross_section(mesh, x, [0, 0, 0], [0, 0, 0])
    with pytest.raises(ValueError, match=r"give \(3,\) for both"):
        measure.cross_section(mesh, x, [0, 0, 0], 1.0)
