"""Numbers and maps of a deformed sheet: strain, creases, energy density. NumPy on the host."""

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
from jaxcrumple.measure.intersections import count_intersections
from jaxcrumple.measure.strain import edge_strain, max_strain, rms_strain

__all__ = [
    "DAMAGE",
    "count_intersections",
    "crease_length",
    "damaged",
    "edge_strain",
    "face_bending_density",
    "face_plastic_curvature",
    "face_stretch_density",
    "folded_hinges",
    "hinge_angles",
    "hinge_curvature",
    "max_strain",
    "mean_curvature",
    "node_damage",
    "rms_strain",
]
