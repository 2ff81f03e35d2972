"""The public names, for `__init__.py` and for type checkers."""

from .avalanche_statistics import avalanches, power_law_exponent
from .confinement import wall_force
from .creases import (
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
from .density import face_bending_density, face_plastic_curvature, face_stretch_density
from .distributions import Distribution, curvature_distribution, fold_angle_distribution
from .energy_localization import localization, participation_ratio
from .ensembles import EnsembleGrowth, ensemble_growth
from .facets import Facets, segment_facets
from .fragmentation import AreaFit, area_cdf, area_density, fit_areas, maturity
from .growth import fit_growth
from .intersections import count_intersections
from .layers import chord_layers, radial_alignment, stacked_layers
from .sections import Section, cross_section, thick_section
from .shells import center_of_mass, radial_profile, shell_areas
from .strain import edge_strain, max_strain, rms_strain
from .volume import VolumeFraction, volume_fraction

__all__ = [
    "DAMAGE",
    "AreaFit",
    "Distribution",
    "EnsembleGrowth",
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
    "ensemble_growth",
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
