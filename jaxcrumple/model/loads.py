"""Loads and supports: gravity, prescribed motion, and user-defined energies."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Integer, Real

from jaxcrumple._jax.arrays import NodeValues, NodeVectors, NodeVectorsLike, Scalar, ScalarLike
from jaxcrumple._jax.tree import as_float, as_numbers, is_known, require_finite, require_shape
from jaxcrumple.model.elements import upper_pairs

# Relative rounding error allowed between the end of a step and a release time.
ROUNDING = 1e-12
# Rounding error allowed between a start and its supports, relative to the size of the sheet.
START_ROUNDING = 1e-9


class Gravity(eqx.Module):
    """Uniform acceleration `g` (3,) in m/s2 on the nodal masses `mass` (n,) in kg.

    **Raises:** ValueError if `g` is not of shape (3,) or not finite.
    """

    g: Float[Array, "3"] = eqx.field(converter=as_float)
    mass: NodeValues = eqx.field(converter=as_float)

    def __check_init__(self) -> None:
        require_shape("g of Gravity", self.g, (3,))
        require_finite("g of Gravity", self.g)

    def energy(self, x: NodeVectors) -> Scalar:
        """Potential energy in J at positions `x` (n, 3) in m, zero for nodes at the origin."""
        return -jnp.sum(self.force() * x)

    def force(self) -> NodeVectors:
        """Nodal forces (n, 3) in N."""
        return self.mass[:, None] * self.g[None, :]


class AbstractMotion(eqx.Module):
    """Positions of the nodes as a smooth function of time: subclass it with `__call__(t)`.

    `__call__` returns the positions (n, 3) in m at time t in s. `Prescribed` takes velocities and
    accelerations from its derivatives.
    """

    @abc.abstractmethod
    def __call__(self, t: Scalar | float) -> NodeVectors:
        """Positions (n, 3) in m at time `t` in s; only prescribed components are used."""


class LinearMotion(AbstractMotion):
    """Uniform motion: `position` (n, 3) in m at t = 0 and `velocity` (n, 3) or (3,) in m/s.

    **Raises:** ValueError for another shape, or a number that is not finite.
    """

    position: NodeVectors = eqx.field(converter=as_float)
    velocity: NodeVectors | Float[Array, "3"] = eqx.field(converter=as_float)

    def __check_init__(self) -> None:
        if self.position.ndim != 2 or self.position.shape[1] != 3:
            raise ValueError(
                f"position of LinearMotion has shape {self.position.shape}; it must be (n, 3), for all "
                "nodes of the sheet: only those in the mask of Prescribed are used."
            )
        require_shape("velocity of LinearMotion", self.velocity, (3,), self.position.shape)
        require_finite("position of LinearMotion", self.position)
        require_finite("velocity of LinearMotion", self.velocity)

    def __call__(self, t: Scalar | float) -> NodeVectors:
        """Positions at time `t`."""
        return self.position + jnp.broadcast_to(self.velocity, self.position.shape) * t


def _as_mask(value: Bool[ArrayLike, "nodes 3"]) -> Bool[Array, "nodes 3"]:
    mask = value if isinstance(value, Array) else np.asarray(value)
    if mask.dtype != bool:
        raise ValueError(
            f"the mask of Prescribed has type {mask.dtype}; it must be bool, True where a component is held."
        )
    if mask.ndim != 2 or mask.shape[1] != 3:
        raise ValueError(
            f"the mask of Prescribed has shape {mask.shape}; it must be (n, 3): for whole nodes use "
            "numpy.repeat(mask[:, None], 3, axis=1)."
        )
    with jax.transfer_guard("allow"):
        return jnp.asarray(mask)


class Prescribed(eqx.Module):
    """Node components with prescribed motion (fixed nodes: zero velocity), always or until a release time.

    **Arguments:** `mask` (n, 3) bool, True where prescribed; `motion`: an `AbstractMotion`; `until`: release
    time in s of all nodes, or (n, 1) of each node, after which they are free. Choose frame times, so that a
    step ends there.

    A start must lie on the motion: `position(x, t)` moves it there. Velocities follow the motion.

    **Raises:** ValueError for a mask that is not bool or not (n, 3), a motion of another shape, or a release
    time that is NaN or of another shape.

    >>> mesh = jc.hexagonal(5, 4, 2e-3)
    >>> left = mesh.vertices[:, 0] < mesh.vertices[:, 0].min() + 2.5e-3
    >>> mask = np.repeat(left[:, None], 3, axis=1)
    >>> clamp = jc.Prescribed(mask, jc.LinearMotion(mesh.vertices, (0.0, 0.0, 0.0)), until=1.0)
    >>> int(clamp.held(0.5).sum()), int(clamp.held(2.0).sum())  # components, released after 1 s
    (24, 0)
    """

    mask: Bool[Array, "nodes 3"] = eqx.field(converter=_as_mask)
    motion: AbstractMotion
    until: Scalar | Float[Array, "nodes 1"] = eqx.field(default=jnp.inf, converter=as_float)

    def __check_init__(self) -> None:
        nodes = self.mask.shape[0]
        if not callable(self.motion):
            raise ValueError(
                f"the motion of Prescribed has type {type(self.motion).__name__}; it must be a "
                "LinearMotion(position, velocity) or a subclass of AbstractMotion."
            )
        require_shape("until of Prescribed", self.until, (), (nodes, 1))
        if is_known(self.until) and np.any(np.isnan(self.until)):
            raise ValueError("until of Prescribed is NaN; give the time of release in s, or leave it out.")
        shape = jax.eval_shape(self.motion, jax.ShapeDtypeStruct((), jnp.result_type(float))).shape
        if shape != self.mask.shape:
            raise ValueError(
                f"the motion of Prescribed gives positions {shape}; its mask is {self.mask.shape}: make both "
                "(n, 3)."
            )

    def held(self, t: Scalar | float) -> Bool[Array, "nodes 3"]:
        """Components (n, 3) that are prescribed at time `t` in s, with a tolerance for rounding."""
        return self.mask & (t <= (1.0 + ROUNDING) * self.until)

    def position(self, x: NodeVectorsLike, t: Scalar | float) -> NodeVectors:
        """Positions `x` (n, 3) in m with those of the components prescribed at time `t` inserted."""
        return jnp.where(self.held(t), self.motion(t), x)

    def velocity(self, v: NodeVectors, t: Scalar) -> NodeVectors:
        """Velocities `v` (n, 3) in m/s with those of the components prescribed at time `t` inserted."""
        return jnp.where(self.held(t), _derivative(self.motion, t), v)

    def acceleration(self, a: NodeVectors, t: Scalar) -> NodeVectors:
        """Accelerations `a` (n, 3) in m/s2 with those of the prescribed components inserted."""
        return jnp.where(self.held(t), _derivative(lambda s: _derivative(self.motion, s), t), a)

    def free(self, residual: NodeVectors, t: Scalar) -> NodeVectors:
        """`residual` (n, 3) with the entries of components prescribed at time `t` set to zero."""
        return jnp.where(self.held(t), 0.0, residual)


def check_motion(prescribed: Prescribed, t: Scalar | float) -> None:
    """Refuse a motion that is not finite at time `t` in s where it holds a node.

    Traced values are not checked.

    **Raises:** ValueError that names the node.
    """
    held, there, velocity = _held_motion(prescribed, t)
    if not is_known(held, there, velocity):
        return
    for name, value in (("position", there), ("velocity", velocity)):
        bad = np.argwhere(np.asarray(held) & ~np.isfinite(np.asarray(value)))
        if len(bad):
            node = bad[0][0]
            raise ValueError(
                f"the motion of prescribed gives node {node} the {name} {np.asarray(value)[node]} at t = "
                f"{float(t):g} s; it must be finite where the mask holds it."
            )


def check_supported(
    prescribed: Prescribed, x: NodeVectorsLike, t: Scalar | float, size: Scalar | float
) -> None:
    """Refuse positions `x` (n, 3) in m that differ from the prescribed motion at time `t` in s.

    The tolerance is `START_ROUNDING` times the sheet's `size` in m. Traced values are not checked.

    **Raises:** ValueError that names the farthest node, its distance and the cure.
    """
    check_motion(prescribed, t)
    held, there, _ = _held_motion(prescribed, t)
    if not is_known(held, there, x, size):
        return
    away = np.where(held, np.asarray(there) - np.asarray(x), 0.0)
    distance = np.linalg.norm(away, axis=1)
    node = int(np.argmax(distance))
    if distance[node] > START_ROUNDING * float(size):
        raise ValueError(
            f"node {node} starts {distance[node]:.3g} m from where its support holds it at t = {float(t):g} "
            "s; start from scene.prescribed.position(x, t), or let the motion begin at the sheet."
        )


def _held_motion(
    prescribed: Prescribed, t: Scalar | float
) -> tuple[Bool[Array, "nodes 3"], NodeVectors, NodeVectors]:
    """Return the components held at time `t`, and the motion's positions and velocities (n, 3)."""
    now = as_float(t)
    return prescribed.held(now), prescribed.motion(now), _derivative(prescribed.motion, now)


def _derivative(function: Callable[[Scalar], NodeVectors], t: Scalar) -> NodeVectors:
    return jax.jvp(function, (t,), (jnp.ones_like(t),))[1]


def _as_elements(value: Integer[ArrayLike, "elements corners"]) -> Integer[Array, "elements corners"]:
    nodes = as_numbers("nodes of ElementEnergy", value)
    if nodes.ndim != 2:
        raise ValueError(
            f"nodes of ElementEnergy has shape {nodes.shape}; it must be (m, k), a row of k nodes for each "
            "element: nodes[:, None] for single nodes."
        )
    sorted_rows = np.sort(np.asarray(nodes), axis=1) if is_known(nodes) else np.arange(1)[None]
    twice = np.flatnonzero(np.any(np.diff(sorted_rows, axis=1) == 0, axis=1))
    if twice.size:
        raise ValueError(
            f"element {twice[0]} of ElementEnergy has a node twice: {np.asarray(nodes)[twice[0]]}; drop one."
        )
    return nodes


class ElementEnergy(eqx.Module):
    """A user-defined energy, as a sum over elements; autodiff gives forces and tangent.

    **Arguments:**

    - `nodes`: (m, k) node numbers of the m elements.
    - `function`: `function(x, parameters, t)` -> energy in J of one element, with `x` (k, 3) in m.
    - `parameters`: any pytree of arrays with leading axis m, sliced for each element (or None).

    **Raises:** ValueError for node numbers that are not integers (m, k) or repeat a node in one element, a
    function that is not callable, or parameters of another length.

    >>> def spring(x, stiffness, t):
    ...     return 0.5 * stiffness * jnp.sum((x[1] - x[0]) ** 2)
    >>> tie = jc.ElementEnergy([[0, 2]], spring, jnp.array([3.0]))  # nodes 0 and 2, 3 N/m
    >>> x = jnp.array([[0.0, 0.0, 0.0], [0.5, 1.0, 0.0], [1.0, 0.0, 0.0]])
    >>> print(tie.energy(x, 0.0), tie.force(x, 0.0)[:, 0])
    1.5 [ 3.  0. -3.]
    """

    nodes: Integer[Array, "elements corners"] = eqx.field(converter=_as_elements)
    function: Callable[[Float[Array, "corners 3"], Any, Scalar], ScalarLike] = eqx.field(static=True)
    parameters: Any = None

    def __check_init__(self) -> None:
        if not callable(self.function):
            raise ValueError(
                f"the function of ElementEnergy is {self.function!r}; it must be function(x, parameters, t)."
            )
        m = self.nodes.shape[0]
        for path, leaf in jax.tree_util.tree_leaves_with_path(self.parameters):
            if np.shape(leaf)[:1] != (m,):
                name = f"parameters{jax.tree_util.keystr(path)}"
                raise ValueError(
                    f"{name} of ElementEnergy has shape {np.shape(leaf)}; its first axis must be the {m} "
                    "elements."
                )

    def _map(
        self, transform: Callable[[Callable], Callable], x: NodeVectors, t: Scalar | float
    ) -> Float[Array, "elements ..."]:
        return jax.vmap(transform(self.function), (0, 0, None))(x[self.nodes], self.parameters, t)

    def energy(self, x: NodeVectors, t: Scalar | float) -> Scalar:
        """Energy in J at positions `x` (n, 3) in m and time `t` in s."""
        return jnp.sum(self._map(lambda f: f, x, t))

    def force(self, x: NodeVectors, t: Scalar | float) -> NodeVectors:
        """Nodal forces (n, 3) in N at positions `x` (n, 3) in m and time `t` in s."""
        return jnp.zeros_like(x).at[self.nodes].add(-self._map(jax.grad, x, t))

    def blocks(self, x: NodeVectors, t: Scalar | float) -> Float[Array, "pairs 3 3 elements"]:
        """Element Hessians (pairs, 3, 3, m) in N/m.

        Pairs of corners are in the order of the upper triangle: (0, 0), (0, 1), ..., (1, 1), ...
        """
        hessian = self._map(jax.hessian, x, t)
        pairs = upper_pairs(self.nodes.shape[1])
        return jnp.stack([jnp.moveaxis(hessian[:, a, :, b, :], 0, -1) for a, b in pairs])


def dead_load(
    nodes: Integer[ArrayLike, " loaded"], force: Real[ArrayLike, "loaded 3"], ramp: float
) -> ElementEnergy:
    """Make forces of fixed direction that grow linearly from zero at t = 0 and are constant after `ramp` s.

    **Arguments:** `nodes` (m,) node numbers; `force` (m, 3) their final forces in N; `ramp` > 0.

    **Returns:** the load as an energy, $-\\sum f(t) \\cdot x$, zero for nodes at the origin.

    **Raises:** ValueError if node numbers are not integers, forces have another shape or are not finite, or
    the ramp is not positive.
    """
    numbers, final = as_numbers("nodes of a dead load", nodes), as_float(force)
    require_shape("nodes of a dead load", numbers, (numbers.size,))
    require_shape("force of a dead load", final, (*numbers.shape, 3))
    require_finite("force of a dead load", final)
    if is_known(ramp) and not (np.isfinite(ramp) and ramp > 0):
        raise ValueError(f"ramp = {ramp!r} s of a dead load must be positive and finite.")
    ramps = jnp.broadcast_to(as_float(ramp), numbers.shape)
    return ElementEnergy(numbers[:, None], _dead_energy, (final, ramps))


def _dead_energy(x: Float[Array, "1 3"], parameters: tuple[Float[Array, "3"], Scalar], t: Scalar) -> Scalar:
    force, ramp = parameters
    return -jnp.clip(t / ramp, 0.0, 1.0) * (force @ x[0])
