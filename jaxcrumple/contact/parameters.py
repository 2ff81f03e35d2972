"""Parameters of self-contact: options of the user, and the refined sites of one sheet."""

import warnings
from typing import Any, NamedTuple, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import NodeVectors, Scalar
from jaxcrumple._jax.tree import as_array, as_float, is_known
from jaxcrumple.contact.adjacency import Fans, build_fans
from jaxcrumple.contact.potentials import (
    DEFAULT_POTENTIAL,
    AbstractPairPotential,
    Barrier,
    InversePower,
    Penalty,
    Potential,
)
from jaxcrumple.contact.sites import build_sites, require_candidates, require_sites, site_density
from jaxcrumple.material.material import ModelConstants
from jaxcrumple.mesh.mesh import Mesh

# Largest site spacing in ranges, on average over a triangle and along its sides. With a wider spacing, layers
# could rest between each other's sites; a closer one costs time: two thirds, twice as much an iteration.
SPACING, LONGEST_SPACING = 1.0, 1.5
# Above this spacing in ranges, some points of a sheet are out of range of all its sites.
WIDEST_SPACING = np.sqrt(3.0)
# Largest site spacing of the barrier in ranges. Any point of a triangle lies within spacing/sqrt(3) of a
# site, so two layers that touch have two sites within twice that distance, which is the core.
BARRIER_SPACING = 0.5
# Core of the barrier in spacings: 2/sqrt(3) covers the sheet; the factor is a margin for stretching.
CORE = 1.05 * 2.0 / np.sqrt(3.0)
# Largest core in ranges: the barrier rises over the rest of the range.
WIDEST_CORE = 0.75
# Share of the smallest triangle height that separates triangles without a common node in a flat sheet.
CALM = 0.8
# Lower limit in ranges of the skin `calm` that follows from it.
LEAST = 0.25


class SelfContact(NamedTuple):
    """Set the options of a sheet's self-contact: a repulsion between sites on its triangles (eqs. 26-28).

    `sheet` checks them.

    - `potential`: "inverse-power" rises slowly and is infinite at r = 0. "penalty" is the paper's (26); it
      rises faster, so that steps must be shorter, and is finite at r = 0. "barrier" becomes infinite before
      layers touch; it needs four times as many sites. Steps that would pass through are rejected.
    - `range`: sigma in m, the distance at which two sites start to push; by default the mean thickness.
    - `level`: number of sites on an edge between its ends; by default the lowest level whose sites are no
      further apart than the range.
    """

    potential: Potential = DEFAULT_POTENTIAL
    range: float | None = None
    level: int | None = None


class Contact(eqx.Module):
    """Hold the parameters of the repulsion between the sites of one sheet, without any neighbour list.

    - `faces` (f, 3); `rest` (n, 3) in m: rest positions; neighbours at rest never interact.
    - `weights` (s, 3), `share` (s,), `place` (s,): as in `Sites`; `density` (f, 7): of `site_density`.
    - `stiffness` $k_s$ in N/m; `range` $\\sigma$ in m; `potential`: of two sites.
    - `calm` in m: skin with which the lists of a flat sheet stay empty.
    - `fans`: triangles that share a node, and the hinges between them.
    """

    faces: Int[Array, "faces 3"]
    rest: NodeVectors
    weights: Float[Array, "sites 3"]
    share: Float[Array, " sites"]
    place: Int[Array, " sites"]
    density: Float[Array, "faces 7"]
    stiffness: Scalar = eqx.field(converter=as_float)
    range: Scalar = eqx.field(converter=as_float)
    potential: AbstractPairPotential
    calm: Scalar = eqx.field(converter=as_float)
    fans: Fans


def is_range(value: Any) -> bool:
    """Return whether a value is a positive length, which JAX does not trace."""
    if not is_known(value) or np.ndim(value) > 0 or not np.issubdtype(np.asarray(value).dtype, np.number):
        return False
    return bool(np.isfinite(value) and value > 0)


def build_contact(
    mesh: Mesh, constants: ModelConstants, options: SelfContact, like: Contact | None = None
) -> Contact:
    """Build the contact of a sheet. Its stiffness is the mean spring constant.

    With `like`, the refinement is that of `like`.

    **Raises:** ValueError for an unknown potential, a range that is not positive, a level below 0, a traced
    range without `like`, a sheet of one triangle, or sites or pairs of triangles that exceed the memory.
    """
    sigma = constants.sigma if options.range is None else options.range
    if options.potential not in get_args(Potential):
        names = ", ".join(get_args(Potential))
        raise ValueError(f"contact potential {options.potential!r} is unknown; choose one of {names}.")
    known = is_known(sigma)
    if known and not is_range(sigma):
        raise ValueError(f"contact range = {sigma!r} m must be a positive length; leave it out for h_eff.")
    if not len(mesh.hinges):
        raise ValueError("a sheet of one triangle cannot touch itself; leave contact out.")
    if like is None:
        if not known:
            raise ValueError(
                "the contact level depends on the contact range, which JAX traces here: build the scene "
                "once with plain numbers, and give it as `like`."
            )
        level = _level(mesh, sigma, options)
        require_sites(len(mesh.faces), level, float(sigma), chosen=options.level is not None)
        require_candidates(mesh, float(sigma))
        sites, fans = build_sites(level), build_fans(mesh)
        weights, share, place = map(as_array, sites)
        potential = _potential(options.potential, mesh, level)
    else:
        weights, share, place, fans = like.weights, like.share, like.place, like.fans
        potential = like.potential
    least = 0.5 * (CALM * mesh.hinge_height.min() - sigma)
    return Contact(
        faces=as_array(mesh.faces, jnp.int32),
        rest=as_array(mesh.vertices),
        weights=weights,
        share=share,
        place=place,
        density=site_density(mesh, sigma),
        stiffness=as_float(constants.ks.mean()),
        range=as_float(sigma),
        potential=potential,
        calm=as_float(jnp.maximum(least, LEAST * sigma)),
        fans=fans,
    )


def check_options_of(options: SelfContact, contact: Contact) -> None:
    """Refuse a `contact` whose potential or level differs from `options`.

    **Raises:** ValueError that names both.
    """
    potential = contact.potential.name
    # A lattice with `level` + 1 intervals per side has (level + 2) (level + 3) / 2 sites.
    level = int(np.sqrt(2 * len(contact.share) + 0.25) - 2.5 + 0.5)
    if options.potential != potential or options.level not in (None, level):
        raise ValueError(
            f"the scene `like` has contact by {potential} of level {level}, not by "
            f"{options.potential} of level {options.level}; leave `like` out."
        )


def _potential(name: Potential, mesh: Mesh, level: int) -> AbstractPairPotential:
    if name == "barrier":
        return Barrier(CORE * _longest(mesh) / (level + 1))
    return Penalty() if name == "penalty" else InversePower()


def _longest(mesh: Mesh) -> float:
    return float(mesh.edge_length.max())


def default_level(mesh: Mesh, sigma: float, potential: Potential, spacing: float = SPACING) -> int:
    """Return the lowest level whose sites are at most `spacing` ranges apart, for a range `sigma` in m.

    A barrier has a spacing of its own."""
    # The mean site spacing in the largest triangle counts; `widest` is the side of an equilateral one of the
    # same area. A barrier needs the longest edge covered.
    if potential == "barrier":
        side, spacing = _longest(mesh), BARRIER_SPACING
    else:
        widest = np.sqrt(float(mesh.face_area.max()) * 4.0 / np.sqrt(3.0))
        side = max(widest, _longest(mesh) * SPACING / LONGEST_SPACING)
    return max(int(np.ceil(side / (spacing * sigma))) - 1, 0)


def _level(mesh: Mesh, sigma: float, options: SelfContact) -> int:
    """Return the refinement level of `options`, or the default; refuse or warn of one that is too coarse.

    **Raises:** ValueError for a level that is no integer from 0 on, or too coarse for a barrier.
    """
    barrier, longest = options.potential == "barrier", _longest(mesh)
    needed = default_level(mesh, sigma, options.potential)
    level = needed if options.level is None else options.level
    if not isinstance(level, int | np.integer) or isinstance(level, bool) or level < 0:
        raise ValueError(
            f"contact level = {level!r} must be a whole number from 0 on; leave it out for {needed}, whose "
            "sites are about a range apart."
        )
    if barrier and CORE * longest / (level + 1) > WIDEST_CORE * sigma:
        raise ValueError(
            f"contact level = {level} leaves sites too far apart for a barrier of range {sigma:.3g} m; "
            f"choose level {needed} or leave it out."
        )
    if not barrier and longest / (level + 1) > WIDEST_SPACING * sigma:
        warnings.warn(
            f"contact level = {level} leaves sites so far apart that layers may meet between them without a "
            f"force, which ends a run as blocked; choose level {needed} or leave it out.",
            stacklevel=6,
        )
    return int(level)
