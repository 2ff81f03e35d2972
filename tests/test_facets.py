"""Facets of patterns that are known, with noise, gaps, broad creases and faint damage, on meshes at random."""

import numpy as np
import pytest
from facet_patterns import adjusted_rand, damage, fragments, labels, lines, voronoi

from jaxcrumple import measure
from jaxcrumple.mesh import Mesh
from jaxcrumple.meshgen import disc, rectangle

SIZE = 0.1
SIZES = (1000, 3000)


@pytest.fixture(scope="module")
def meshes():
    return {n: rectangle(SIZE, SIZE, n, seed=n, sweeps=20) for n in SIZES}


def test_adjusted_rand_index():
    """Unequal areas: {1, 2 | 3} against {1 | 2, 3} with areas 1/2, 1/4, 1/4, by hand."""
    area = np.array([2.0, 1.0, 1.0])
    both, first, second = 0.25 + 2 / 16, (9 + 1) / 16, (4 + 4) / 16
    by_hand = (both - first * second) / ((first + second) / 2 - first * second)
    assert adjusted_rand(np.array([0, 0, 1]), np.array([0, 1, 1]), area) == pytest.approx(by_hand)
    assert adjusted_rand(np.array([0, 0, 1]), np.array([5, 5, 2]), area) == pytest.approx(1)


@pytest.mark.parametrize("pattern", [voronoi, lines, fragments])
@pytest.mark.parametrize(("n", "count"), [(1000, 6), (3000, 12)])
def test_known_facets_are_found(meshes, pattern, n, count):
    """At about 250 triangles for a facet, 15 % of the creases missing."""
    mesh, known = meshes[n], pattern(count, 0, SIZE)
    facets = measure.segment_facets(mesh, damage(mesh, known, seed=0))
    truth = labels(mesh, known)
    assert adjusted_rand(truth, facets.label, mesh.face_area) >= 0.95
    large = np.bincount(truth, weights=mesh.face_area) > 10 * mesh.area / len(mesh.faces)
    assert abs(len(facets.area) - large.sum()) <= 1


@pytest.mark.parametrize("pattern", [voronoi, fragments])
def test_clean_patterns_are_found_almost_to_the_triangle(meshes, pattern):
    mesh, known = meshes[3000], pattern(20, 1, SIZE)
    p = damage(mesh, known, seed=1, missing=0.0, broad=False, background=0.0, speckle=0.0)
    facets = measure.segment_facets(mesh, p)
    assert adjusted_rand(labels(mesh, known), facets.label, mesh.face_area) > 0.99
    assert len(facets.area) == 20


def test_areas_are_those_of_the_labels_and_sum_to_the_sheet(meshes):
    mesh, known = meshes[1000], voronoi(10, 3, SIZE)
    label, area = measure.segment_facets(mesh, damage(mesh, known, seed=3))
    assert label.shape == (len(mesh.faces),)
    assert area.sum() == pytest.approx(mesh.area, rel=1e-14)
    assert area == pytest.approx([mesh.face_area[label == k].sum() for k in range(len(area))])
    _, first = np.unique(label, return_index=True)
    assert (np.diff(first) > 0).all() and len(first) == len(area)  # numbered by their first triangle


@pytest.mark.parametrize("width", [None, 4e-3])
@pytest.mark.parametrize("pattern", [voronoi, lines, fragments])
def test_a_finer_mesh_finds_the_same_facets(meshes, pattern, width):
    """Seen at the same points, whether creases are as wide as the mesh makes them or 4 mm."""
    known = pattern(6, 2, SIZE)
    points = np.stack(np.meshgrid(*2 * [np.linspace(-0.499, 0.499, 150) * SIZE]), axis=-1).reshape(-1, 2)
    seen = []
    for mesh in meshes.values():
        facets = measure.segment_facets(mesh, damage(mesh, known, seed=2), width=width)
        seen.append(facets.label[face_at(mesh, points)])
    assert adjusted_rand(*seen, np.ones(len(points))) >= 0.95
    assert abs(len(np.unique(seen[0])) - len(np.unique(seen[1]))) <= 1


def face_at(mesh, points):
    from matplotlib.tri import Triangulation

    return Triangulation(*mesh.vertices[:, :2].T, mesh.faces).get_trifinder()(*points.T)


def halves(mesh, angle, part=1.0):
    """A crease of fold `angle` in rad over the `part` of the sheet's height, along x = 0."""
    centre, top = mesh.vertices[mesh.faces].mean(axis=1), SIZE * (part - 0.5)
    crossing = np.ptp((centre[:, 0] > 0)[mesh.hinge_faces], axis=1) > 0
    low = mesh.vertices[mesh.hinges[:, :2], 1].mean(axis=1) < top
    return 2 * np.sin(0.5 * angle) * (crossing & low)


def test_fold_and_closed_mean_what_they_say(meshes):
    for mesh in meshes.values():
        counted = lambda *a, mesh=mesh, **kw: len(measure.segment_facets(mesh, halves(mesh, *a), **kw).area)
        assert counted(0.5, fold=0.4) == 2
        assert counted(0.5, fold=0.8) == 1  # a zig-zag makes up to 1.3 times as much of an angle
        assert counted(0.5, threshold=0.6) == 1


def test_a_sheet_without_creases_is_one_facet():
    for mesh in (disc(0.05, 200, sweeps=5), rectangle(0.1, 0.02, 200, sweeps=5)):
        label, area = measure.segment_facets(mesh, mesh.rest_curvature)
        assert set(label) == {0}
        assert area == pytest.approx([mesh.area])
        assert len(measure.segment_facets(mesh, mesh.rest_curvature, width=1.0).area) == 1


def test_facets_finer_than_the_mesh_are_lost(meshes):
    """The limit that the docstring states, here at 20 triangles for a facet."""
    mesh, known = meshes[1000], voronoi(90, 0, SIZE)
    facets = measure.segment_facets(mesh, damage(mesh, known, seed=0))
    assert len(facets.area) < 80


def test_wrong_input_is_refused(meshes):
    mesh = meshes[1000]
    bent = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], [[0, 1, 2], [1, 3, 2]])
    with pytest.raises(ValueError, match="not flat"):
        measure.segment_facets(bent, bent.rest_curvature)
    with pytest.raises(ValueError, match=r"p has shape \(2,\)"):
        measure.segment_facets(mesh, np.zeros(2))
    for name, value in {"fold": 0.0, "width": 1e-6, "closed": 1.5}.items():
        with pytest.raises(ValueError, match=f"{name} = "):
            measure.segment_facets(mesh, mesh.rest_curvature, **{name: value})
