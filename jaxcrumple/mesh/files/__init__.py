"""Triangulated surfaces from the files that other programs write.

trimesh reads STL and meshio most other formats. OBJ, OFF, PLY and legacy VTK POLYDATA have readers of our
own: trimesh splits nodes along the seams of textures and cuts every polygon into a fan, convex or not, and
meshio refuses texture coordinates, further elements and POLYDATA.
"""

from jaxcrumple.mesh.files.read import read_surface
from jaxcrumple.mesh.files.surface import MeshError, MeshWarning, Surface

__all__ = ["MeshError", "MeshWarning", "Surface", "read_surface"]
