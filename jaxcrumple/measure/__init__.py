"""Numbers and maps of a deformed sheet: strain, creases, facets, energy density. NumPy on the host."""

from jaxcrumple.measure.creases import (
    DAMAGE,
    crease_length,
    damaged,
    folded_hinges,
    hinge_angles,
    hinge_curvature,
    mean_curvature,
    node_damage,
)
from jaxcrumple.measure.density import face_bending_density, face_plastic_curvature, face_stretch_density
from jaxcrumple.measure.facets import Facets, segment_facets
from jaxcrumple.measure.fragmentation import AreaFit, area_cdf, area_density, fit_areas, maturity
from jaxcrumple.measure.growth import fit_growth
from jaxcrumple.measure.intersections import count_intersections
from jaxcrumple.measure.strain import edge_strain, max_strain, rms_strain

__all__ = [
    "DAMAGE",
    "AreaFit",
    "Facets",
    "area_cdf",
    "area_density",
    "count_intersections",
    "crease_length",
    "damaged",
    "edge_strain",
    "face_bending_density",
    "face_plastic_curvature",
    "face_stretch_density",
    "fit_areas",
    "fit_growth",
    "folded_hinges",
    "hinge_angles",
    "hinge_curvature",
    "maturity",
    "max_strain",
    "mean_curvature",
    "node_damage",
    "rms_strain",
    "segment_facets",
]
