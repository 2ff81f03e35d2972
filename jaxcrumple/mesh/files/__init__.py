"""Triangulated surfaces from the files that other programs write.

trimesh reads STL, and meshio most other formats. This package reads OBJ, OFF, PLY and legacy VTK POLYDATA
itself, because trimesh splits nodes along texture seams and cuts every polygon into a fan, convex or not, and
meshio refuses texture coordinates, further elements and POLYDATA.
"""

from jaxcrumple.mesh.files.read import read_surface
from jaxcrumple.mesh.files.surface import MeshError, MeshWarning, Surface

__all__ = ["MeshError", "MeshWarning", "Surface", "read_surface"]
