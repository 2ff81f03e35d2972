"""Measures of a deformed sheet, computed on the host: strain, creases, facets, energy, volume, stacking."""

from jaxcrumple.measure.avalanche_statistics import avalanches, power_law_exponent
from jaxcrumple.measure.confinement import wall_force
from jaxcrumple.measure.creases import (
    DAMAGE,
    crease_length,
    crease_pattern,
    damaged,
    folded_hinges,
    hinge_angles,
    hinge_curvature,
    mean_curvature,
    mountain_valley_length,
    node_damage,
)
from jaxcrumple.measure.density import face_bending_density, face_plastic_curvature, face_stretch_density
from jaxcrumple.measure.distributions import Distribution, curvature_distribution, fold_angle_distribution
from jaxcrumple.measure.energy_localization import localization, participation_ratio
from jaxcrumple.measure.facets import Facets, segment_facets
from jaxcrumple.measure.fragmentation import AreaFit, area_cdf, area_density, fit_areas, maturity
from jaxcrumple.measure.growth import fit_growth
from jaxcrumple.measure.intersections import count_intersections
from jaxcrumple.measure.layers import chord_layers, radial_alignment, stacked_layers
from jaxcrumple.measure.sections import Section, cross_section, thick_section
from jaxcrumple.measure.shells import center_of_mass, radial_profile, shell_areas
from jaxcrumple.measure.strain import edge_strain, max_strain, rms_strain
from jaxcrumple.measure.volume import VolumeFraction, volume_fraction

__all__ = [
    "DAMAGE",
    "AreaFit",
    "Distribution",
    "Facets",
    "Section",
    "VolumeFraction",
    "area_cdf",
    "area_density",
    "avalanches",
    "center_of_mass",
    "chord_layers",
    "count_intersections",
    "crease_length",
    "crease_pattern",
    "cross_section",
    "curvature_distribution",
    "damaged",
    "edge_strain",
    "face_bending_density",
    "face_plastic_curvature",
    "face_stretch_density",
    "fit_areas",
    "fit_growth",
    "fold_angle_distribution",
    "folded_hinges",
    "hinge_angles",
    "hinge_curvature",
    "localization",
    "maturity",
    "max_strain",
    "mean_curvature",
    "mountain_valley_length",
    "node_damage",
    "participation_ratio",
    "power_law_exponent",
    "radial_alignment",
    "radial_profile",
    "rms_strain",
    "segment_facets",
    "shell_areas",
    "stacked_layers",
    "thick_section",
    "volume_fraction",
    "wall_force",
]
