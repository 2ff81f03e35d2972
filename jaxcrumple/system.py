"""The equations of motion: energies, forces, and the residual of an implicit step."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from jaxcrumple._jax.arrays import (
    Flag,
    HingeValues,
    HingeValuesLike,
    NodeVectors,
    NodeVectorsLike,
    Scalar,
    ScalarLike,
)
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float, require_shape
from jaxcrumple.contact import energy as contact_energy
from jaxcrumple.geometry.hinge import Hinge
from jaxcrumple.history import ImplicitStep
from jaxcrumple.model.plasticity import implicit_update
from jaxcrumple.scene import Scene, require_scene
from jaxcrumple.state import State, check_state


class Energies(NamedTuple):
    """Hold the energies by term in J."""

    stretch: Scalar
    bending: Scalar
    contact: Scalar
    walls: Scalar
    gravity: Scalar
    extra: Scalar
    kinetic: Scalar


@door
def energies(
    scene: Scene, x: NodeVectorsLike, v: NodeVectorsLike, p: HingeValuesLike | None, t: ScalarLike
) -> Energies:
    """Compute the energies by term in J. `bending` is the stored bending energy, at rest curvature `p`.

    A scene with contact needs neighbour lists for `x`, see `with_contacts`.

    **Arguments:** `x` (n, 3): positions in m; `v` (n, 3): velocities in m/s; `p` (h,): dimensionless rest
    curvatures, or None for those of the mesh; `t`: time in s.

    **Returns:** `Energies`: `stretch` (eq. 11), `bending` (eq. 31), `contact` (eq. 26 for the penalty),
    `walls`, `gravity`, `extra`, `kinetic`.

    **Raises:** ValueError if positions or velocities are not of shape (n, 3), rest curvatures not of shape
    (h,), or the time is not one number; for a scene with contact but without lists.

    >>> mesh = jc.hexagonal(5, 4, 2e-3)
    >>> scene = jc.sheet(mesh, jc.Material())
    >>> x = 1.01 * mesh.vertices  # 1 % larger in both directions
    >>> found = jc.energies(scene, x, np.zeros_like(x), None, 0.0)
    >>> print(f"{found.stretch:.4e} J, {found.bending} J, {found.kinetic} J")
    2.4249e-03 J, 0.0 J, 0.0 J
    """
    x, v = nodal(scene, x=x, v=v)
    p, t = _others(scene, p, t)
    zero = jnp.zeros((), x.dtype)
    return Energies(
        stretch=scene.membrane.energy(x),
        bending=scene.bending.energy(x, scene.rest_curvature_of(p)),
        contact=zero if scene.contact is None else contact_energy.energy(scene.contact, scene.own_lists, x),
        walls=sum((w.energy(x, t) for w in scene.walls), zero),
        gravity=zero if scene.gravity is None else scene.gravity.energy(x),
        extra=sum((e.energy(x, t) for e in scene.extra), zero),
        kinetic=0.5 * jnp.sum(scene.mass[:, None] * v * v),
    )


def nodal(scene: Scene, **values: NodeVectorsLike) -> list[NodeVectors]:
    """Convert named values, NumPy arrays included, to float arrays (n, 3).

    **Raises:** ValueError that names a value of another shape, or if `scene` is not a Scene.
    """
    require_scene(scene)
    for name, value in values.items():
        require_shape(name, value, (scene.n_nodes, 3))
    return [as_float(value) for value in values.values()]


def _others(scene: Scene, p: HingeValuesLike | None, t: ScalarLike) -> tuple[HingeValues | None, Scalar]:
    """Convert rest curvatures (h,), or None, and the time to float arrays."""
    if p is not None:
        require_shape("p", p, scene.bending.rest_curvature.shape)
    require_shape("t", t, ())
    return None if p is None else as_float(p), as_float(t)


@door
def potential_energy(scene: Scene, x: NodeVectorsLike, p: HingeValuesLike | None, t: ScalarLike) -> Scalar:
    """Compute the total potential energy in J. Its gradient is the reference for the closed-form forces.

    **Arguments:** as of `energies`.

    **Raises:** ValueError as `energies` does.
    """
    (x,) = nodal(scene, x=x)
    parts = energies(scene, x, jnp.zeros_like(x), p, t)
    return sum(parts[:-1], jnp.zeros((), x.dtype))


def force_terms(scene: Scene, x: NodeVectors, p: HingeValues | None, t: Scalar) -> list[NodeVectors]:
    """Compute the forces (n, 3) in N on nodes at rest, term by term; their sum is `force` at v = 0."""
    bending = scene.bending.force(scene.bending.hinges(x), scene.rest_curvature_of(p), x.shape[0])
    terms = [scene.membrane.force(x), bending]
    terms += [] if scene.contact is None else [contact_energy.force(scene.contact, scene.own_lists, x)]
    terms += [wall.force(x, t) for wall in scene.walls]
    terms += [term.force(x, t) for term in scene.extra]
    return terms if scene.gravity is None else [*terms, scene.gravity.force()]


def _external_force(scene: Scene, x: NodeVectors, t: Scalar) -> NodeVectors:
    total = scene.membrane.force(x)
    if scene.contact is not None:
        total = total + contact_energy.force(scene.contact, scene.own_lists, x)
    for wall in scene.walls:
        total = total + wall.force(x, t)
    for term in scene.extra:
        total = total + term.force(x, t)
    return total if scene.gravity is None else total + scene.gravity.force()


@door
def force(
    scene: Scene, x: NodeVectorsLike, v: NodeVectorsLike, p: HingeValuesLike | None, t: ScalarLike
) -> NodeVectors:
    """Compute the net force F(x, v, p, t) on the nodes (n, 3) in N (eq. 2).

    It includes drag and internal damping, and the reactions of no support.

    **Arguments:** as of `energies`.

    **Raises:** ValueError as `energies` does.

    >>> mesh = jc.hexagonal(5, 4, 2e-3)
    >>> scene = jc.sheet(mesh, jc.Material(), gravity=(0, 0, -9.81))
    >>> rest = np.zeros_like(mesh.vertices)
    >>> weight = jc.force(scene, mesh.vertices, rest, None, 0.0).sum(axis=0)
    >>> print(jnp.round(weight / scene.mass.sum(), 6))  # m/s2
    [ 0.    0.   -9.81]
    """
    x, v = nodal(scene, x=x, v=v)
    p, t = _others(scene, p, t)
    return _force_and_rate(scene, x, v, p, t)[0]


@door
def reaction(
    scene: Scene, x: NodeVectorsLike, v: NodeVectorsLike, p: HingeValuesLike | None, t: ScalarLike
) -> NodeVectors:
    """Compute the forces (n, 3) in N that supports exert on the components they hold, 0 elsewhere.

    They are M a - F(x, v, p, t) (eq. 2), for the acceleration a of the prescribed motion.

    **Arguments:** as of `energies`.

    **Raises:** ValueError as `energies` does.

    >>> mesh = jc.hexagonal(5, 4, 2e-3)
    >>> hold = jc.Prescribed(np.ones((mesh.n_nodes, 3), bool), jc.LinearMotion(mesh.vertices, (0, 0, 0)))
    >>> scene = jc.sheet(mesh, jc.Material(), gravity=(0, 0, -9.81), prescribed=hold)
    >>> held = jc.reaction(scene, mesh.vertices, np.zeros_like(mesh.vertices), None, 0.0)
    >>> print(jnp.round(held.sum(axis=0) / scene.mass.sum(), 6) + 0.0)  # m/s2
    [0.   0.   9.81]
    """
    (x, v), (p, t) = nodal(scene, x=x, v=v), _others(scene, p, t)
    f = _force_and_rate(scene, x, v, p, t)[0]
    if scene.prescribed is None:
        return jnp.zeros_like(f)
    a = scene.prescribed.acceleration(jnp.zeros_like(f), t)
    return jnp.where(scene.prescribed.held(t), scene.mass[:, None] * a - f, 0.0)


def rates(
    scene: Scene, x: NodeVectors, v: NodeVectors, p: HingeValues | None, t: Scalar
) -> tuple[NodeVectors, NodeVectors, HingeValues | None]:
    """Compute the right-hand side of eq. (1) with plastic flow: (dx/dt, dv/dt, dp/dt)."""
    f, dp = _force_and_rate(scene, x, v, p, t)
    dx, dv = v, f / scene.mass[:, None]
    if scene.prescribed is not None:
        dx = scene.prescribed.velocity(dx, t)
        dv = scene.prescribed.acceleration(dv, t)
    return dx, dv, dp


def force_at_rest(
    scene: Scene, hinges: Hinge, x: NodeVectors, p: HingeValues | None, t: Scalar
) -> NodeVectors:
    """Compute the force (n, 3) in N on nodes at rest at positions `x` (n, 3), whose hinges are `hinges`."""
    return _external_force(scene, x, t) + scene.bending.force(hinges, scene.rest_curvature_of(p), x.shape[0])


def _force_and_rate(
    scene: Scene, x: NodeVectors, v: NodeVectors, p: HingeValues | None, t: Scalar
) -> tuple[NodeVectors, HingeValues | None]:
    hinges = scene.bending.hinges(x)
    total = force_at_rest(scene, hinges, x, p, t)
    if scene.drag is not None:
        total = total + scene.drag.force(v)
    if scene.damping is not None:
        total = total + scene.damping.force(x, v)
    if scene.plasticity is None or p is None:
        return total, None
    return total, scene.plasticity.rate(hinges.curvature, p)


def residual(scene: Scene, step: ImplicitStep, x: NodeVectors) -> tuple[NodeVectors, HingeValues | None]:
    """Compute the residual $Ma - F$ (n, 3) of the condensed system (51), and the new p.

    The formula eliminates v and p, so that x is Newton's only unknown. The plastic update of each hinge is
    solved to rounding instead of linearised. At the solution the system equals eqs. (47)-(49).
    """
    value, p, _ = condensed(scene, step, x)
    return value, p


def updated_rest_curvature(scene: Scene, step: ImplicitStep, x: NodeVectors) -> HingeValues | None:
    """Compute the new p (h,) of an implicit step that ends at positions `x` (n, 3), as in `residual`."""
    return _plastic_update(scene, step, scene.bending.hinges(x).curvature)[0]


def _plastic_update(
    scene: Scene, step: ImplicitStep, c: HingeValues
) -> tuple[HingeValues | None, HingeValues | None]:
    """Return the new p (h,) and its derivative by the curvature `c` (h,); None without plastic flow."""
    if scene.plasticity is None or step.p_memory is None:
        return None, None
    return implicit_update(scene.plasticity, c, step.p_memory, step.beta_h)


def condensed(
    scene: Scene, step: ImplicitStep, x: NodeVectors
) -> tuple[NodeVectors, HingeValues | None, HingeValues | None]:
    """Compute what `residual` does, and the derivative (h,) of the new p by the curvature."""
    hinges = scene.bending.hinges(x)
    p, softening = _plastic_update(scene, step, hinges.curvature)
    total = force_at_rest(scene, hinges, x, p, step.t)
    v = step.velocity(x)
    if scene.drag is not None:
        total = total + scene.drag.force(v)
    if scene.damping is not None:
        total = total + scene.damping.step_force(x, v, step.damping_memory, step.beta_h)
    if step.v_memory is not None:
        total = total - scene.mass[:, None] * step.acceleration(v)
    value = -total if scene.prescribed is None else scene.prescribed.free(-total, step.t)
    return value, p, softening


def linearize(
    scene: Scene, step: ImplicitStep, x: NodeVectors
) -> tuple[NodeVectors, Float[Array, " entries"]]:
    """Compute the residual (n, 3) and the values (size,) of its exact, symmetric tangent (eq. 51).

    The values are the entries of `scene.sparsity`."""
    value, p, softening = condensed(scene, step, x)
    return value, step_tangent(scene, step, x, p, softening)


def step_tangent(
    scene: Scene, step: ImplicitStep, x: NodeVectors, p: HingeValues | None, softening: HingeValues | None
) -> Float[Array, " entries"]:
    """Compute the values (size,) of the tangent, given the new p (h,) and its derivative by the curvature."""
    edge_blocks = scene.membrane.blocks(x)
    nodes = jnp.zeros((x.shape[0], 3, 3), x.dtype)
    if scene.damping is not None:
        v = step.velocity(x)
        edge_blocks = edge_blocks + scene.damping.step_blocks(x, v, step.damping_memory, step.beta_h)
    if scene.drag is not None:
        nodes = nodes + (scene.drag.coefficient / step.beta_h)[:, None, None] * jnp.eye(3)
    if step.v_memory is not None:
        nodes = nodes + (step.inertia * scene.mass / step.beta_h**2)[:, None, None] * jnp.eye(3)
    hinge_blocks = scene.bending.blocks(x, scene.rest_curvature_of(p), softening)
    return _assemble(scene, x, step.t, edge_blocks, hinge_blocks, nodes)


@door
def elastic_tangent(
    scene: Scene,
    x: NodeVectorsLike,
    p: HingeValuesLike | None,
    t: ScalarLike,
    shift: ScalarLike = 0.0,
    taut: Flag | Bool[Array, " edges"] | None = None,
) -> Float[Array, " entries"]:
    """Compute the values (size,) in N/m of the Hessian of the potential energy plus `shift` times the mass.

    Unlike `tangent`, JAX can trace and differentiate it. The values are the entries of the upper triangle in
    the order of `scene.sparsity`, for `linear_solve`. Prescribed components are decoupled.

    **Arguments:** `x`, `p`, `t` as of `energies`; `shift` in 1/s2; `taut`: whether to leave out the negative
    geometric stiffness of compressed springs, for all edges or for each (e,).

    **Raises:** ValueError as `energies` does.
    """
    (x,) = nodal(scene, x=x)
    p, t = _others(scene, p, t)
    nodes = (as_float(shift) * scene.mass)[:, None, None] * jnp.eye(3)
    hinge_blocks = scene.bending.blocks(x, scene.rest_curvature_of(p), None)
    return _assemble(scene, x, t, scene.membrane.blocks(x, taut), hinge_blocks, nodes)


def _assemble(
    scene: Scene,
    x: NodeVectors,
    t: Scalar,
    edge_blocks: Float[Array, "3 3 3 edges"],
    hinge_blocks: Float[Array, "10 3 3 hinges"],
    nodes: Float[Array, "nodes 3 3"],
) -> Float[Array, " entries"]:
    for wall in scene.walls:
        nodes = nodes + wall.blocks(x, t)
    extra = [term.blocks(x, t) for term in scene.extra]
    pattern, contact = scene.pattern, scene.contact
    blocks = pattern.assemble([edge_blocks, hinge_blocks, *extra], nodes)
    if contact is None or pattern.face_blocks is None:
        values = pattern.values(blocks)
    else:
        lists, faces = scene.own_lists, pattern.face_blocks
        blocks, cross, lift = contact_energy.add_tangent(contact, lists, x, blocks, faces)
        values = jnp.concatenate([pattern.values(blocks), cross.reshape(-1), lift])
    return values if scene.prescribed is None else _eliminate(scene, scene.prescribed.held(t), values)


def _eliminate(
    scene: Scene, held: Bool[Array, "nodes 3"], values: Float[Array, " entries"]
) -> Float[Array, " entries"]:
    """Replace rows and columns of the components `held` (n, 3) by the identity times a typical stiffness."""
    pattern, mask = scene.sparsity, held.reshape(-1)
    fixed = mask[pattern.rows] | mask[pattern.indices]
    unit = jnp.where(pattern.rows == pattern.indices, jnp.mean(scene.membrane.stiffness), 0.0)
    own = jnp.where(fixed, unit, values[: pattern.nnz])
    if pattern.contact is None:
        return own
    return jnp.concatenate([own, pattern.contact.free(values[pattern.nnz :], held)])


@door
def tangent(scene: Scene, state: State) -> "scipy.sparse.csr_array":
    """Compute the stiffness matrix (3n, 3n) in N/m: the Hessian of the potential energy at fixed p.

    It contains the exact second derivatives of appendix A, geometric stiffness included, so that it may be
    indefinite. Row and column numbers are 3 * node + component. Prescribed components are decoupled.

    **Arguments:** `scene`; `state`: for its positions, rest curvatures and time.

    **Raises:** ValueError for a state of another scene.

    >>> mesh = jc.hexagonal(4, 2, 2e-3)
    >>> scene = jc.sheet(mesh, jc.Material())
    >>> stiffness = jc.tangent(scene, jc.initial_state(scene, mesh.vertices))
    >>> moves = np.linalg.eigvalsh(stiffness.toarray()) < 1e-9 * stiffness.max()
    >>> stiffness.shape, int(moves.sum())  # a free sheet has six rigid motions
    ((36, 36), 6)
    """
    check_state(scene, state)
    values = np.asarray(eqx.filter_jit(elastic_tangent)(scene, state.x, state.p, state.t))
    size = 3 * scene.n_nodes
    pattern = scene.sparsity
    own = values[: pattern.nnz]
    upper = scipy.sparse.csr_array(
        (own, np.asarray(pattern.indices), np.asarray(pattern.indptr)), shape=(size, size)
    )
    if pattern.contact is not None:
        upper = upper + pattern.contact.upper(values[pattern.nnz :], size)
    return scipy.sparse.csr_array(upper + scipy.sparse.triu(upper, k=1).T)


@door
def mass_matrix(scene: Scene) -> "scipy.sparse.dia_array":
    """Return the lumped, diagonal mass matrix (3n, 3n) in kg, for the eigenmodes of `tangent`.

    **Raises:** ValueError if `scene` is not a Scene.
    """
    require_scene(scene)
    return scipy.sparse.diags_array(np.repeat(np.asarray(scene.mass), 3))
