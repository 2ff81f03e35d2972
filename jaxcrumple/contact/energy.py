"""Self-contact between refined sites (Section 2.5): the potential, its forces and its tangent.

Every triangle carries a lattice of sites (Fig. 2), and each site represents an area. The paper's sum over
site pairs then becomes a quadrature of $\\int\\int U(r)\\,dA\\,dA/a_0^2$. Here $a_0 = \\sqrt 3\\sigma^2/2$ is
the area of a site in a lattice of spacing $\\sigma$. The stiffness per area therefore does not depend on the
refinement or on the triangle. On a lattice of triangles of height $\\sigma$ these are the paper's (26)-(28).
"""

import warnings
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple._jax.padded import accumulate
from jaxcrumple._jax.tree import as_float, is_known
from jaxcrumple.contact.active_set import (
    CLOSER,
    Active,
    SitePairs,
    interacting,
    likely,
    separation,
    site_pairs,
    with_push,
)
from jaxcrumple.contact.adjacency import DUE_TURN, Fans, build_fans, largest_turn
from jaxcrumple.contact.ccd import crosses
from jaxcrumple.contact.flatness import Chart, build_chart
from jaxcrumple.contact.lists import Candidates, Near, no_candidates, no_neighbors
from jaxcrumple.contact.sites import build_sites, require_candidates, require_sites, site_density
from jaxcrumple.material.material import ModelConstants
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.elements import upper_pairs

Potential = Literal["penalty", "barrier"]
# Largest site spacing of the penalty in ranges, on average over a triangle and along its sides. With a wider
# spacing, layers could rest between each other's sites.
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
# Sites that may interact are at least EXCLUSION ranges apart at rest. No pair interacts if every distance is
# more than half of its value at rest: APART adds a margin, APART_AHEAD a larger one for a predicted step.
APART, APART_AHEAD = 0.55, 0.6
# Site pairs per chunk of a sum.
ADDED = 512


def pair_energy(distance: Array, stiffness: Array, sigma: Array, core: Array | float | None = None) -> Array:
    """Return the energy of two sites in J.

    It is $k_s \\sigma^2 \\exp(\\sigma/(r - \\sigma))$ for $r < \\sigma$, else 0. Its negative gradient is
    the force of eq. (26). The energy is finite at $r = 0$, so that it does not exclude penetration. With a
    `core` $r_0$ in m, the exponential measures r and $\\sigma$ from $r_0$, and a factor $(\\sigma -
    r_0)/(r - r_0)$ makes the energy infinite at $r_0$ and inside.
    """
    inside = distance < sigma
    gap = jnp.where(inside, sigma - distance, sigma)
    if core is None:
        return jnp.where(inside, stiffness * sigma * sigma * jnp.exp(-sigma / gap), 0.0)
    width, depth = sigma - core, jnp.where(distance > core, distance - core, 0.0)
    growth = jnp.where(depth > 0, width / jnp.where(depth > 0, depth, 1.0), jnp.inf)
    return jnp.where(inside, stiffness * sigma * sigma * jnp.exp(-width / gap) * growth, 0.0)


class SelfContact(NamedTuple):
    """Set the options of a sheet's self-contact.

    - `potential`: "penalty" is the paper's (26); it is finite at r = 0, and steps that would pass through it
      are rejected. "barrier" becomes infinite before layers touch; it needs four times as many sites.
    - `range`: $\\sigma$ in m, by default $h_{eff}$.
    - `level`: number of sites on an edge between its ends; by default the lowest level whose sites are no
      further apart than the range.
    """

    potential: Potential = "penalty"
    range: float | None = None
    level: int | None = None


class Contact(eqx.Module):
    """Hold the repulsion between the sites of one sheet.

    - `faces` (f, 3); `rest` (n, 3) in m: rest positions; neighbours at rest never interact.
    - `weights` (s, 3), `share` (s,), `place` (s,): as in `Sites`; `density` (f, 7): of `site_density`.
    - `stiffness` $k_s$ in N/m; `range` $\\sigma$ in m; `core` in m, or None for the penalty.
    - `calm` in m: skin with which the lists of a flat sheet stay empty.
    - `fans`: triangles that share a node, and the hinges between them.
    - `chart`: proves that a nearly flat sheet has no contact and needs no valid lists; or None.
    - `candidates`, `near`: neighbour lists of `jaxcrumple.contact.lists`.
    - `active`: active set of `jaxcrumple.contact.active_set` for several explicit steps, or None.
    """

    faces: Array
    rest: Array
    weights: Array
    share: Array
    place: Array
    density: Array
    stiffness: Array = eqx.field(converter=as_float)
    range: Array = eqx.field(converter=as_float)
    core: Array | None
    calm: Array = eqx.field(converter=as_float)
    fans: Fans
    chart: Chart | None
    candidates: Candidates
    near: Near
    active: Active | None = None

    def energy(self, x: Array) -> Array:
        """Return the energy in J at positions `x` (n, 3); NaN if the neighbour lists are not valid there."""

        def add(total: Array, contact: "Contact", x: Array, pairs: SitePairs) -> Array:
            _, distance = separation(pairs, x)
            return total + jnp.sum(pairs.strength * contact._potential(distance))

        return self._sum(x, interacting(self, x), add, jnp.zeros((), x.dtype))

    def force(self, x: Array) -> Array:
        """Return the nodal forces (n, 3) in N, (27)-(28); NaN if the neighbour lists are not valid at `x`."""

        def add(total: Array, contact: "Contact", x: Array, pairs: SitePairs) -> Array:
            r, distance = separation(pairs, x)
            push = (-pairs.strength * contact._slope(distance) / distance)[:, None] * r
            return with_push(total, pairs, push)

        return self._sum(x, likely(self, x), add, jnp.zeros_like(x))

    def add_tangent(self, x: Array, own: Array, face_blocks: Array) -> tuple[Array, Array, Array]:
        """Compute the Hessian in N/m at positions `x` (n, 3): (A.10) with corrected sign.

        A compressed pair adds negative transverse (geometric) stiffness. It cancels if both layers move
        together, but not in the block of one layer alone.

        **Arguments:** `own` (b, 9): blocks of the sheet; `face_blocks` (f, 6): index in `own` of the blocks
        within each triangle.

        **Returns:** `own` with the contact stiffness within triangles added; blocks (T, 9, 9) between the
        nodes of the two triangles of each listed pair; and a diagonal (n,) that compensates the negative
        stiffness in `own` where the solver uses `own` without the blocks.
        """
        one, two = np.array(upper_pairs(3)).T

        def add(total: tuple[Array, Array, Array], contact: "Contact", x: Array, pairs: SitePairs):
            own, cross, lift = total
            r, distance = separation(pairs, x)
            matrix, tension = contact._matrices(pairs, r / distance[:, None], distance)
            matrix = matrix.reshape(-1, 1, 9)
            for side in range(2):
                blocks = face_blocks[contact.near.triangles[pairs.owner, side]]
                weights = pairs.weights[:, 3 * side : 3 * side + 3]
                own = own.at[blocks].add((weights[:, one] * weights[:, two])[:, :, None] * matrix)
            both = (pairs.weights[:, :3, None] * pairs.weights[:, None, 3:]).reshape(-1, 9, 1)
            soft = jnp.abs(pairs.weights) * jnp.maximum(-tension, 0.0)[:, None]
            return own, cross.at[pairs.owner].add(both * matrix), lift.at[pairs.nodes].add(soft)

        cross = jnp.zeros((self.near.triangles.shape[0], 9, 9), x.dtype)
        nothing = own, cross, jnp.zeros(x.shape[0], x.dtype)
        return self._sum(x, interacting(self, x), add, nothing)

    def nearer_product(self, x: Array) -> Callable[[Array], Array]:
        """Return the product of the Hessian with displacements (n, 3) in m, as a function; it gives N.

        The Hessian is that at positions `x` (n, 3), but with all distances reduced by `CLOSER`, since motion
        may reduce them.
        """
        found, holds = interacting(self, x, CLOSER), self.covers(x)

        def add(total: Array, contact: "Contact", both: tuple[Array, Array], pairs: SitePairs) -> Array:
            (r, distance), (change, _) = separation(pairs, both[0]), separation(pairs, both[1])
            matrix, _ = contact._matrices(pairs, r / distance[:, None], contact._closer(distance))
            return with_push(total, pairs, jnp.sum(matrix * change[:, None], axis=2))

        def product(u: Array) -> Array:
            return jnp.where(holds, self._added((x, u), found, add, jnp.zeros_like(x)), jnp.nan)

        return product

    def gaps(self, x: Array) -> tuple[Array, Array]:
        """Return the smallest distance in m of two interacting sites (infinite if none), and how many site
        pairs interact."""
        return self.nearest(x)[:2]

    @eqx.filter_jit
    def nearest(self, x: Array) -> tuple[Array, Array, Array]:
        """Return `gaps`, and the place in `Near.triangles` of the pair with the smallest distance."""
        near = self.near
        pairs = site_pairs(self, near.picked, jnp.arange(near.room.pairs) < near.site_count)
        _, distance = separation(pairs, x)
        pushing = (pairs.strength > 0) & (distance < self.range)
        gaps = jnp.where(pushing, distance, jnp.inf)
        return jnp.min(gaps), jnp.sum(pushing), pairs.owner[jnp.argmin(gaps)]

    def _closer(self, distance: Array) -> Array:
        """Reduce `distance` (p,) in m by `CLOSER`, but at most halfway to the core of a barrier."""
        closer = CLOSER * distance
        return closer if self.core is None else jnp.maximum(closer, 0.5 * (self.core + distance))

    def _potential(self, distance: Array) -> Array:
        return pair_energy(distance, self.stiffness, self.range, self.core)

    def _slope(self, distance: Array) -> Array:
        return jax.vmap(jax.grad(self._potential))(distance)

    def _stiffness(self, distance: Array) -> Array:
        return jax.vmap(jax.grad(jax.grad(self._potential)))(distance)

    def _matrices(self, pairs: SitePairs, direction: Array, distance: Array) -> tuple[Array, Array]:
        """Return the stiffness (p, 3, 3) in N/m of site pairs, and the transverse stiffness (p,).

        `direction` (p, 3): unit vectors between the sites; `distance` (p,) in m.
        """
        tension = pairs.strength * self._slope(distance) / distance
        along = direction[:, :, None] * direction[:, None, :]
        stiffness = (pairs.strength * self._stiffness(distance) - tension)[:, None, None]
        return stiffness * along + tension[:, None, None] * jnp.eye(3), tension

    def _sum(self, x: Array, found: tuple[Array, Array], add: Callable[..., Any], nothing: Any) -> Any:
        """Add the contributions of the pairs `found` to `nothing`; NaN if the lists are not valid at `x`."""
        value, holds = self._added(x, found, add, nothing), self.covers(x)
        return jax.tree.map(lambda total: jnp.where(holds, total, jnp.nan), value)

    def _added(self, x: Any, found: tuple[Array, Array], add: Callable[..., Any], nothing: Any) -> Any:
        """Add the contributions of the site pairs `found`, as `likely` returns them, to `nothing`.

        `x`: array (n, 3), or a tuple of such arrays.
        """
        picked, count = found

        def add_at(total: Any, arguments: tuple["Contact", Any, Array], at: Array, held: Array) -> Any:
            contact, x, picked = arguments
            # An unused entry could lie in the core of a barrier, and infinity times 0 is NaN.
            return add(total, contact, x, site_pairs(contact, picked[jnp.where(held, at, 0)], held))

        return accumulate(add_at, nothing, (self, x, picked), count, picked.shape[0], ADDED)

    def sharpest(self, theta: Array) -> Array:
        """Return the largest turn in rad of the ways at nodes that the candidates do not list.

        `theta` (h,): hinge angles in rad. If an upper bound is below `DUE_TURN`, the result is that bound.
        """
        old = self.candidates
        bound = old.turn + self.fans.longest * jnp.max(jnp.abs(theta - old.theta))
        return jax.lax.cond(
            bound < DUE_TURN, lambda: bound, lambda: largest_turn(self.fans.turning(theta), old.folded)
        )

    def crosses(self, start: Array, end: Array) -> Array:
        """Return whether the sheet might touch itself if nodes move straight from `start` to `end` (n, 3)."""
        return crosses(self, start, end)

    def covers(self, x: Array, start: Array | None = None) -> Array:
        """Return whether the neighbour lists are valid at positions `x` (n, 3) in m.

        They are if no node has left its skin, or if the sheet is so flat that it needs no lists at `x` and on
        the straight path from `start` (n, 3).
        """
        listed = self.candidates.around.covers(x) & self.near.covers(x)
        listed = listed if self.active is None else listed & self.active.around.covers(x)
        return jax.lax.cond(listed, lambda: listed, lambda: self.apart(x if start is None else start, x))

    def apart(self, start: Array, end: Array, share: float = APART) -> Array:
        """Return whether `chart` proves that no sites interact on a straight path between two positions.

        `start`, `end` (n, 3): ends of the path; `share`: least ratio of distances to those at rest that the
        proof requires. Without a proof the result is False.
        """
        if self.chart is None:
            return jnp.asarray(False)
        start, end = jax.lax.stop_gradient((start, end))
        frame = self.chart.frame(start)
        return (self.chart.least(start, frame) > share) & (self.chart.least(end, frame) > share)


def _is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and np.issubdtype(np.asarray(value).dtype, np.number)


def build_contact(
    mesh: Mesh, constants: ModelConstants, options: SelfContact, like: Contact | None = None
) -> Contact:
    """Build the contact of a sheet. Its stiffness is the mean spring constant.

    With `like`, refinement and lists are those of `like`.

    **Raises:** ValueError for an unknown potential, a range that is not positive, a level below 0, a traced
    range without `like`, a sheet of one triangle, or sites or pairs of triangles that exceed the memory.
    """
    sigma = constants.sigma if options.range is None else options.range
    if options.potential not in get_args(Potential):
        names = ", ".join(get_args(Potential))
        raise ValueError(f"contact potential {options.potential!r} is unknown; choose one of {names}.")
    known = is_known(sigma)
    if known and not (_is_number(sigma) and np.isfinite(sigma) and sigma > 0):
        raise ValueError(f"contact range = {sigma!r} m must be a positive length; leave it out for h_eff.")
    if not len(mesh.hinges):
        raise ValueError("a sheet of one triangle cannot touch itself; leave contact out.")
    barrier = options.potential == "barrier"
    if like is None:
        if not known:
            raise ValueError(
                "the contact level depends on the contact range, which JAX traces here: build the scene "
                "once with plain numbers, and give it as `like`."
            )
        level = _level(mesh, sigma, options)
        require_sites(len(mesh.faces), level, float(sigma), chosen=options.level is not None)
        require_candidates(mesh, float(sigma))
        sites, fans, chart = build_sites(level), build_fans(mesh), build_chart(mesh)
        weights, share, place = map(jnp.asarray, sites)
        candidates = no_candidates(mesh.n_nodes, len(mesh.hinges), len(fans.triangles))
        near = no_neighbors(mesh.n_nodes, len(sites.share))
        core = as_float(CORE * _longest(mesh) / (level + 1)) if barrier else None
    else:
        weights, share, place, fans, chart = like.weights, like.share, like.place, like.fans, like.chart
        candidates, near, core = like.candidates, like.near, like.core
    least = 0.5 * (CALM * mesh.hinge_height.min() - sigma)
    return Contact(
        faces=jnp.asarray(mesh.faces, jnp.int32),
        rest=jnp.asarray(mesh.vertices),
        weights=weights,
        share=share,
        place=place,
        density=site_density(mesh, sigma),
        stiffness=as_float(constants.ks.mean()),
        range=as_float(sigma),
        core=core,
        calm=as_float(jnp.maximum(least, LEAST * sigma)),
        fans=fans,
        chart=chart,
        candidates=candidates,
        near=near,
    )


def check_options_of(options: SelfContact, contact: Contact) -> None:
    """Refuse a `contact` whose potential or level differs from `options`.

    **Raises:** ValueError that names both.
    """
    potential = "penalty" if contact.core is None else "barrier"
    # A lattice with `level` + 1 intervals per side has (level + 2) (level + 3) / 2 sites.
    level = int(np.sqrt(2 * len(contact.share) + 0.25) - 2.5 + 0.5)
    if options.potential != potential or options.level not in (None, level):
        raise ValueError(
            f"the scene `like` has contact by {potential} of level {level}, not by "
            f"{options.potential} of level {options.level}; leave `like` out."
        )


def _longest(mesh: Mesh) -> float:
    return float(mesh.edge_length.max())


def _level(mesh: Mesh, sigma: float, options: SelfContact) -> int:
    """Return the refinement level of `options`, or the default; refuse or warn of one that is too coarse.

    **Raises:** ValueError for a level that is no integer from 0 on, or too coarse for a barrier.
    """
    barrier, longest = options.potential == "barrier", _longest(mesh)
    # The penalty limits the mean site spacing in the largest triangle; `widest` is the side of an equilateral
    # one of the same area. A barrier needs the longest edge covered.
    widest = np.sqrt(float(mesh.face_area.max()) * 4.0 / np.sqrt(3.0))
    penalty = max(widest / (SPACING * sigma), longest / (LONGEST_SPACING * sigma))
    parts = longest / (BARRIER_SPACING * sigma) if barrier else penalty
    needed = max(int(np.ceil(parts)) - 1, 0)
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
