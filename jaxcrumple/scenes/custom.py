"""User-defined scene from tables: sheet, walls, supports and gravity."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.contact.parameters import SelfContact
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.files import read_surface
from jaxcrumple.mesh.files.sheet import unit_length
from jaxcrumple.mesh.generate import disc, rectangle
from jaxcrumple.mesh.isotropy import warn_of_anisotropy
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.mesh.remesh import remeshed
from jaxcrumple.model.loads import LinearMotion, Prescribed
from jaxcrumple.options.validation import validated
from jaxcrumple.scene import sheet as scene_of
from jaxcrumple.scenes.custom_options import (
    Bend,
    Box,
    CustomOptions,
    Disc,
    FileSheet,
    Square,
    Support,
    Taper,
)
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.sheets import smooth_imperfection, wrapped
from jaxcrumple.scenes.wall_options import unit_vector


@door
def custom(nodes: int = 1000, seed: int = 0, *, material: Material | None = None, **options: Any) -> Setup:
    """Build a scene whose sheet, walls and supports are options.

    If the thickness varies, the surface strain at yield is the same everywhere: that of `material` at its own
    thickness. `yield_c0` overrides this.

    **Arguments:** `nodes`, `seed`: number of nodes and seed of a generated mesh; `material`: default
    `Material()`; `options`: those of `CustomOptions`, as its models or mappings, e.g.
    `walls=[{"kind": "sphere", "radius": 0.07}]`.

    **Raises:** `ConfigError` for unknown or invalid options; ValueError for a sheet that bends all the way
    round, a support that holds no node, a file without the named thickness, or a mesh unsuitable for
    simulation.
    """
    asked: CustomOptions = validated(CustomOptions, options)
    mesh = _mesh(asked.sheet, nodes, seed)
    material = _varied(material or Material(), asked.sheet, mesh)
    touching = (
        None
        if asked.contact is None
        else SelfContact(asked.contact, asked.contact_range, asked.contact_level)
    )
    scene = scene_of(
        mesh,
        material,
        walls=[wall.shape() for wall in asked.walls],
        gravity=asked.gravity,
        prescribed=_supports(asked.supports, mesh),
        damping=asked.damping,
        contact=touching,
    )
    return Setup(mesh, scene, jnp.asarray(mesh.vertices), touching, material)


def _mesh(sheet: Square | Disc | FileSheet, nodes: int, seed: int) -> Mesh:
    if isinstance(sheet, FileSheet):
        return _of_file(sheet, nodes, seed)
    if isinstance(sheet, Disc):
        size, flat = 2.0 * sheet.radius, disc(sheet.radius, nodes, seed=seed, sweeps=sheet.sweeps)
    else:
        size, flat = sheet.size, rectangle(sheet.size, sheet.size, nodes, seed=seed, sweeps=sheet.sweeps)
    x = bent(flat.vertices[:, :2], sheet.bend)
    x[:, 2] += smooth_imperfection(flat.vertices[:, :2], size, sheet.imperfection, seed)
    return flat.with_rest_shape(x)


def _of_file(sheet: FileSheet, nodes: int, seed: int) -> Mesh:
    mesh = Mesh.from_file(sheet.path, merge=sheet.merge, unit=sheet.unit)
    if sheet.remesh:
        return remeshed(mesh, nodes, seed=seed)
    warn_of_anisotropy(mesh, sheet.path)
    return mesh


def bent(points: Float[np.ndarray, "nodes 2"], bend: Bend | None) -> Float[np.ndarray, "nodes 3"]:
    """Map flat points (n, 2) in m to points (n, 3) on a sphere or a cylinder below the plane z = 0.

    The map keeps distances from the origin (sphere) or from the line through it along the axis (cylinder).

    **Raises:** ValueError if the sheet reaches the opposite side.
    """
    flat = np.column_stack([points, np.zeros(len(points))])
    if bend is None:
        return flat
    along = bend.axis if bend.kind == "cylinder" else None
    reach = np.linalg.norm(points * [along != "x", along != "y"], axis=1).max()
    if reach >= np.pi * bend.radius:
        raise ValueError(
            f"sheet.bend.radius = {bend.radius:g} m bends the sheet all the way round; choose more than "
            f"{reach / np.pi:.4g} m."
        )
    return wrapped(flat, bend.radius, along=along)


def _varied(material: Material, sheet: Square | Disc | FileSheet, mesh: Mesh) -> Material:
    """Return the material with the thickness (n,) at the nodes, if the sheet defines one."""
    if sheet.taper is not None:
        thickness = tapered(mesh.vertices, sheet.taper)
    elif isinstance(sheet, FileSheet) and sheet.thickness is not None:
        thickness = _point_data(sheet.path, sheet.thickness)[mesh.source_nodes] * unit_length(sheet.unit)
    else:
        return material
    curvature = material.yield_curvature
    if curvature is not None:
        curvature = curvature * material.thickness / thickness
    return replace(material, thickness=thickness, yield_curvature=curvature)


def tapered(x: Float[np.ndarray, "nodes 3"], taper: Taper) -> Float[np.ndarray, " nodes"]:
    """Return the thickness (n,) in m at `x` (n, 3) in m, linear along the direction of `taper`."""
    along = x @ np.asarray(unit_vector(taper.direction))
    if np.ptp(along) == 0:
        raise ValueError("sheet.taper.direction is normal to the sheet; choose a direction within it.")
    share = (along - along.min()) / np.ptp(along)
    return taper.between[0] + share * (taper.between[1] - taper.between[0])


def _point_data(path: str, name: str) -> Float[np.ndarray, " points"]:
    surface = read_surface(path)
    data = {key: values for key, values in surface.data.items() if len(values) == len(surface.points)}
    if name not in data or np.ndim(data[name]) != 1:
        known = ", ".join(map(repr, data)) or "none"
        raise ValueError(f"sheet.thickness = {name!r} is not among the point data of {path}: {known}.")
    return np.asarray(data[name], float)


def _supports(supports: Sequence[Support], mesh: Mesh) -> Prescribed | None:
    if not supports:
        return None
    held = np.zeros(mesh.n_nodes, bool)
    velocity, until = np.zeros((mesh.n_nodes, 3)), np.full((mesh.n_nodes, 1), np.inf)
    for number, support in enumerate(supports):
        here = _inside(support.nodes, mesh)
        if not here.any():
            raise ValueError(f"supports[{number}] holds no node of the sheet; give a larger box.")
        held |= here
        velocity[here] = support.velocity
        until[here] = np.inf if support.until is None else support.until
    mask = jnp.asarray(np.repeat(held[:, None], 3, axis=1))
    return Prescribed(mask, LinearMotion(jnp.asarray(mesh.vertices), as_float(velocity)), as_float(until))


def _inside(nodes: str | Box, mesh: Mesh) -> Bool[np.ndarray, " nodes"]:
    """Return a mask (n,) of the nodes that a support holds."""
    if isinstance(nodes, Box):
        return np.all((mesh.vertices >= nodes.lower) & (mesh.vertices <= nodes.upper), axis=1)
    return np.isin(np.arange(mesh.n_nodes), mesh.boundary_nodes)
