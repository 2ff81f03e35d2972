"""Confinement by smooth rigid walls that may move.

A wall consists of a shape, which gives the signed gap d of a point, and one law: with
$s = \\langle 1 - d/\\sigma\\rangle$, $U = k_w \\sigma^2 s^3 / (3 (1 - s))$. The force along the inward normal
starts smoothly at $d = \\sigma$, as $k_w \\sigma s^2$, and grows without bound towards the wall.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import NodeValues, NodeVectors, Scalar, ScalarLike
from jaxcrumple._jax.tree import as_float, is_known, require_numbers, require_shape
from jaxcrumple.geometry.hinge import dot

# Nearness s above which the second-order Taylor polynomial continues the law. Newton iterates may then lie
# behind the wall and return. The force at this nearness is 832 k_w sigma. The integrator rejects steps that
# end behind a wall.
NEAREST = 0.98
NEAREST_SLOPE = NEAREST**2 * (3.0 - 2.0 * NEAREST) / (3.0 * (1.0 - NEAREST) ** 2)
NEAREST_CURVATURE = 2.0 * (1.0 / (1.0 - NEAREST) ** 3 - 1.0) / 3.0
# Keeps the distance to a centre or an axis differentiable, m^2; far below any relevant squared length.
TINY = 1e-30
# Tolerance on the length of a unit vector.
UNIT_ROUNDING = 1e-6

OfTime = Callable[[Scalar | float], Scalar]


class Ramp(eqx.Module):
    """A linear function of time, `start` + `rate` * t, constant after the time `until` in s.

    Any callable module of t may replace it.

    **Raises:** ValueError if an argument is not one number.

    >>> radius = jc.Ramp(0.05, -0.01, until=1.0)  # from 5 cm, shrinking at 1 cm/s for 1 s
    >>> [round(float(radius(t)), 3) for t in (0.0, 0.5, 3.0)]
    [0.05, 0.045, 0.04]
    """

    start: Scalar = eqx.field(converter=as_float)
    rate: Scalar = eqx.field(converter=as_float)
    until: Scalar = eqx.field(default=jnp.inf, converter=as_float)

    def __check_init__(self) -> None:
        for name in ("start", "rate", "until"):
            require_shape(f"{name} of Ramp", getattr(self, name), ())

    def __call__(self, t: Scalar | float) -> Scalar:
        """Value at time `t`."""
        return self.start + self.rate * jnp.minimum(t, self.until)


class PiecewiseLinear(eqx.Module):
    """A piecewise linear function of time with `values` (m,) at `times` (m,) in s.

    It is constant before the first and after the last time.

    **Raises:** ValueError if `values` and `times` differ in shape, or times decrease.

    >>> radius = jc.PiecewiseLinear([0.0, 1.0, 3.0], [0.05, 0.04, 0.05])
    >>> [round(float(radius(t)), 3) for t in (0.5, 2.0, 9.0)]
    [0.045, 0.045, 0.05]
    """

    times: Float[Array, " corners"] = eqx.field(converter=as_float)
    values: Float[Array, " corners"] = eqx.field(converter=as_float)

    def __check_init__(self) -> None:
        require_shape("times of PiecewiseLinear", self.times, (self.times.size,))
        require_shape("values of PiecewiseLinear", self.values, self.times.shape)
        times = self.times
        if times.size == 0 or (is_known(times) and not np.all(np.diff(np.asarray(times)) >= 0)):
            raise ValueError(
                "times of PiecewiseLinear must be at least one time in s, and must not decrease."
            )

    def __call__(self, t: Scalar | float) -> Scalar:
        """Value at time `t`."""
        return jnp.interp(t, self.times, self.values)


def of_time(value: ScalarLike | OfTime) -> OfTime:
    """Make a constant number a function of time; return a callable unchanged."""
    return value if callable(value) else Ramp(as_float(value), as_float(0.0))


class AbstractShape(eqx.Module):
    """The geometry of a wall: subclass it with one method, `gap`.

    `gap` needs two derivatives near the wall, and slope 1 at its surface.
    """

    @abc.abstractmethod
    def gap(self, point: Float[Array, "3"], t: Scalar | float) -> Scalar:
        """Signed distance in m from `point` (3,) in m to the wall at time `t` in s.

        It is positive on the side of the sheet.
        """


def _check_vectors(shape: AbstractShape, *points: str, unit: str | None = None) -> None:
    """Refuse fields that are not vectors (3,), and a field `unit` whose length is not 1."""
    names = points if unit is None else (*points, unit)
    for name in names:
        require_shape(f"{name} of {type(shape).__name__}", getattr(shape, name), (3,))
    if unit is None or not is_known(getattr(shape, unit)):
        return
    size = float(np.linalg.norm(np.asarray(getattr(shape, unit))))
    if abs(size - 1.0) > UNIT_ROUNDING:
        raise ValueError(
            f"{unit} of {type(shape).__name__} has length {size:.6g}; it must be a unit vector: divide it by "
            "its length."
        )


class Sphere(AbstractShape):
    """The inside of a sphere: `center` (3,) in m, `radius` in m, a number or a callable of time.

    **Raises:** ValueError if `center` is not of shape (3,).

    >>> sphere = jc.Sphere((0.0, 0.0, 0.0), jc.Ramp(0.05, -0.01))
    >>> point = jnp.array([0.0, 0.03, 0.0])
    >>> round(float(sphere.gap(point, 1.0)), 6)  # m to the wall, after 1 s
    0.01
    """

    center: Float[Array, "3"] = eqx.field(converter=as_float)
    radius: OfTime = eqx.field(converter=of_time)

    def __check_init__(self) -> None:
        _check_vectors(self, "center")

    # Of the shape of `radius(t)`: `check_surroundings` refuses all but one number.
    def gap(self, point: Float[Array, "3"], t: Scalar | float) -> Float[Array, "..."]:
        """Radius minus distance of `point` (3,) from the centre at time `t`, in m."""
        offset = point - self.center
        return self.radius(t) - jnp.sqrt(dot(offset, offset) + TINY)


class Cylinder(AbstractShape):
    """The inside of an infinite cylinder through `center` (3,) along the unit vector `axis` (3,).

    Lengths are in m; `radius` is a number or a callable of time.

    **Raises:** ValueError for a vector that is not of shape (3,), or an `axis` whose length is not 1.
    """

    center: Float[Array, "3"] = eqx.field(converter=as_float)
    axis: Float[Array, "3"] = eqx.field(converter=as_float)
    radius: OfTime = eqx.field(converter=of_time)

    def __check_init__(self) -> None:
        _check_vectors(self, "center", unit="axis")

    def gap(self, point: Float[Array, "3"], t: Scalar | float) -> Scalar:
        """Radius minus distance of `point` (3,) from the axis at time `t`, in m."""
        offset = point - self.center
        radial = offset - dot(offset, self.axis) * self.axis
        return self.radius(t) - jnp.sqrt(dot(radial, radial) + TINY)


class Plane(AbstractShape):
    """The half space `normal` . x > `offset`, whose unit vector `normal` (3,) points to the sheet.

    `offset` in m is a number or a callable of time.

    **Raises:** ValueError for a `normal` that is not of shape (3,), or whose length is not 1.
    """

    normal: Float[Array, "3"] = eqx.field(converter=as_float)
    offset: OfTime = eqx.field(converter=of_time)

    def __check_init__(self) -> None:
        _check_vectors(self, unit="normal")

    def gap(self, point: Float[Array, "3"], t: Scalar | float) -> Scalar:
        """Height of `point` (3,) above the plane at time `t`, in m."""
        return dot(self.normal, point) - self.offset(t)


class Cone(AbstractShape):
    """The inside of a cone of half angle `half_angle` (rad), opening from its tip along `axis`.

    The tip is at `center` + `height` * `axis`, with `center` (3,) in m and the unit vector `axis` (3,).
    `height` in m is a number or a callable of time.

    **Raises:** ValueError for a vector that is not of shape (3,), an `axis` whose length is not 1, or an
    angle outside (0, pi/2).
    """

    center: Float[Array, "3"] = eqx.field(converter=as_float)
    axis: Float[Array, "3"] = eqx.field(converter=as_float)
    half_angle: Scalar = eqx.field(converter=as_float)
    height: OfTime = eqx.field(converter=of_time)

    def __check_init__(self) -> None:
        _check_vectors(self, "center", unit="axis")
        require_shape("half_angle of Cone", self.half_angle, ())
        if is_known(self.half_angle) and not 0.0 < float(self.half_angle) < 0.5 * np.pi:
            raise ValueError(
                f"half_angle = {float(self.half_angle):g} rad of Cone must lie between 0 and pi/2; use "
                "numpy.radians for degrees."
            )

    def gap(self, point: Float[Array, "3"], t: Scalar | float) -> Scalar:
        """Signed distance of `point` (3,) from the cone's surface at time `t`, in m."""
        offset = point - self.center
        along = dot(offset, self.axis)
        radial = offset - along * self.axis
        distance = jnp.sqrt(dot(radial, radial) + TINY)
        return (along - self.height(t)) * jnp.sin(self.half_angle) - distance * jnp.cos(self.half_angle)


class Ball(AbstractShape):
    """The outside of a ball of `radius` in m with its centre at `center` + `height` * `axis`.

    `height` in m is a number or a callable of time, `center` (3,) is in m, `axis` a unit vector (3,).

    **Raises:** ValueError for a vector that is not of shape (3,), an `axis` whose length is not 1, or a
    `radius` that is not positive.
    """

    center: Float[Array, "3"] = eqx.field(converter=as_float)
    axis: Float[Array, "3"] = eqx.field(converter=as_float)
    radius: Scalar = eqx.field(converter=as_float)
    height: OfTime = eqx.field(converter=of_time)

    def __check_init__(self) -> None:
        _check_vectors(self, "center", unit="axis")
        require_numbers("radius of Ball", self.radius, positive=True)

    def gap(self, point: Float[Array, "3"], t: Scalar | float) -> Scalar:
        """Distance of `point` (3,) from the centre minus radius at time `t`, in m."""
        offset = point - self.center - self.height(t) * self.axis
        return jnp.sqrt(dot(offset, offset) + TINY) - self.radius


class HoledPlate(AbstractShape):
    """A plate with a round hole whose rim is rounded.

    The mid-plane of the plate passes through `center` (3,) in m, normal to the unit vector `axis` (3,). The
    rim has the rounding radius `edge` in m, and the plate the thickness 2 * `edge`. `radius` in m is the
    clear radius of the hole, a number or a callable of time.

    **Raises:** ValueError for a vector that is not of shape (3,), an `axis` whose length is not 1, or a
    negative `edge`.
    """

    center: Float[Array, "3"] = eqx.field(converter=as_float)
    axis: Float[Array, "3"] = eqx.field(converter=as_float)
    radius: OfTime = eqx.field(converter=of_time)
    edge: Scalar = eqx.field(converter=as_float)

    def __check_init__(self) -> None:
        _check_vectors(self, "center", unit="axis")
        require_numbers("edge of HoledPlate", self.edge)

    def gap(self, point: Float[Array, "3"], t: Scalar | float) -> Scalar:
        """Signed distance of `point` (3,) from the plate's surface at time `t`, in m."""
        offset = point - self.center
        along = dot(offset, self.axis)
        radial = offset - along * self.axis
        inside = jnp.maximum(self.radius(t) + self.edge - jnp.sqrt(dot(radial, radial) + TINY), 0.0)
        return jnp.sqrt(inside**2 + along**2 + TINY) - self.edge


def wall_law(nearness: Scalar) -> Scalar:
    """$s^3 / (3 (1 - s))$ at the `nearness` s >= 0, and its Taylor polynomial beyond `NEAREST`."""
    s = jnp.minimum(nearness, NEAREST)
    law = s**3 / (3.0 * (1.0 - s))
    beyond = nearness - s
    return law + beyond * (NEAREST_SLOPE + 0.5 * beyond * NEAREST_CURVATURE)


class Wall(eqx.Module):
    """A shape, its stiffness and its range.

    At the gap d a node has the energy kw sigma^2 s^3 / (3 (1 - s)) with the nearness s = 1 - d/sigma > 0. The
    force starts smoothly at d = sigma, as kw sigma s^2, and grows without bound towards the wall. The paper
    gives no law for its walls.

    **Arguments:**

    - `shape`: an `AbstractShape`.
    - `stiffness`: (n,) kw of each node in N/m; scale it with the node's area.
    - `range`: sigma in m, the gap at which the wall starts to push.

    >>> wall = jc.Wall(jc.Plane((0.0, 0.0, 1.0), 0.0), [100.0], 1e-3)
    >>> x = jnp.array([[0.0, 0.0, 0.5e-3]])  # one node, half a range above the plane
    >>> print(f"{wall.gap(x, 0.0)[0]:.4f} m, {wall.force(x, 0.0)[0, 2]:.4f} N")
    0.0005 m, 0.0667 N
    """

    shape: AbstractShape
    stiffness: NodeValues = eqx.field(converter=as_float)
    range: Scalar = eqx.field(converter=as_float)

    def node_energy(self, x: NodeVectors, t: Scalar | float) -> NodeValues:
        """Energy of each node (n,) in J at positions `x` (n, 3) in m and time `t` in s."""
        return jax.vmap(self._energy, (0, 0, None))(x, self.stiffness, t)

    def _energy(self, point: Float[Array, "3"], stiffness: Scalar, t: Scalar | float) -> Scalar:
        nearness = jnp.maximum(1.0 - self.shape.gap(point, t) / self.range, 0.0)
        return stiffness * self.range**2 * wall_law(nearness)

    def energy(self, x: NodeVectors, t: Scalar | float) -> Scalar:
        """Energy in J at positions `x` (n, 3) in m and time `t` in s."""
        return jnp.sum(self.node_energy(x, t))

    def gap(self, x: NodeVectors, t: Scalar | float) -> NodeValues:
        """Signed gap of each node (n,) in m; a node with a negative gap is behind the wall."""
        return jax.vmap(self.shape.gap, (0, None))(x, t)

    def force(self, x: NodeVectors, t: Scalar | float) -> NodeVectors:
        """Nodal forces (n, 3) in N at positions `x` (n, 3) in m and time `t` in s."""
        return -jax.vmap(jax.grad(self._energy), (0, 0, None))(x, self.stiffness, t)

    def stiffness_bound(self, x: NodeVectors, t: Scalar | float) -> NodeValues:
        """Largest eigenvalue of the Hessian of each node (n,) in N/m, along the wall's normal."""
        nearness = jnp.maximum(1.0 - self.gap(x, t) / self.range, 0.0)
        return self.stiffness * jax.vmap(jax.grad(jax.grad(wall_law)))(nearness)

    def blocks(self, x: NodeVectors, t: Scalar | float) -> Float[Array, "nodes 3 3"]:
        """Hessian of each node (n, 3, 3) in N/m."""
        return jax.vmap(jax.hessian(self._energy), (0, 0, None))(x, self.stiffness, t)
