"""Out-of-plane elasticity: hinges with a rest curvature (Sections 2.2 and 2.6)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import HingeValues, NodeVectors, Scalar
from jaxcrumple.geometry.hinge import (
    HalfAngle,
    Hinge,
    curvature,
    gather,
    hinge,
    hinge_gradient,
    hinge_hessian,
)
from jaxcrumple.model.elements import scatter

# Onset in rad of the fold stop, which keeps faces from passing through each other, and its width.
FOLD_STOP = jnp.pi * 170.0 / 180.0
STOP_WIDTH = jnp.pi - FOLD_STOP
# Coefficients of arcsin(s)/s in s^2: for s up to the sine of half the width the rest is below rounding.
ARCSINE = (1.0, 1.0 / 6.0, 3.0 / 40.0, 5.0 / 112.0, 35.0 / 1152.0, 63.0 / 2816.0, 231.0 / 13312.0)


def fold_stop(theta: Float[Array, " *axes"]) -> Float[Array, " *axes"]:
    """Barrier $u^3/(1-u)$ with $u = (|\\theta| - \\theta_s)/(\\pi - \\theta_s)$, $\\theta_s$ = 170 degrees.

    It is zero below the onset, where it is twice continuously differentiable. It is infinite at 180 degrees,
    where the torque of the elastic energy vanishes and the sign of $\\theta$ would flip.
    """
    u = jnp.maximum(jnp.abs(theta) - FOLD_STOP, 0.0) / STOP_WIDTH
    return u * u * u / (1.0 - u)


def hinge_energy(
    theta: Float[Array, " *axes"], rest_curvature: Float[Array, " *axes"], stiffness: Float[Array, " *axes"]
) -> Float[Array, " *axes"]:
    """Energy of a hinge in J: $\\frac{K}{2} (c - p)^2$ (eq. 31) plus the fold stop.

    `stiffness` is $K = k_b \\sqrt3 |e_0|^2 / (2 \\bar A)$, `rest_curvature` is $p$.
    """
    elastic = curvature(theta) - rest_curvature
    return stiffness * (0.5 * elastic * elastic + fold_stop(theta))


def stop_derivatives(half: HalfAngle) -> tuple[Float[Array, " *axes"], Float[Array, " *axes"]]:
    """First and second derivative of `fold_stop` with respect to the angle, given its half."""
    # What is left of the width. The series is exact within it, and only has to exceed it elsewhere.
    square = half.cosine * half.cosine
    series = jnp.full_like(square, ARCSINE[-1])
    for coefficient in reversed(ARCSINE[:-1]):
        series = coefficient + square * series
    left = jnp.minimum(2.0 / STOP_WIDTH * half.cosine * series, 1.0)
    u, w = 1.0 - left, 1.0 / left
    first = u * u * (3.0 - 2.0 * u) * w * w / STOP_WIDTH
    second = 2.0 * u * (3.0 - 3.0 * u + u * u) * w * w * w / (STOP_WIDTH * STOP_WIDTH)
    return jnp.sign(half.sine) * first, second


class Bending(eqx.Module):
    """Hinges on all interior edges.

    **Arguments:**

    - `nodes`: (h, 4) node numbers x0 ... x3 of Fig. 3a.
    - `stiffness`: (h,) $K = k_b \\sqrt3 |e_0|^2/(2 \\bar A)$ in J; weights frozen in the rest shape (eq. 20).
    - `rest_curvature`: (h,) dimensionless rest curvature of the undamaged sheet.
    """

    nodes: Int[Array, "hinges 4"]
    stiffness: HingeValues
    rest_curvature: HingeValues

    def hinges(self, x: NodeVectors) -> Hinge:
        """Geometry of all hinges at positions `x` (n, 3)."""
        return hinge(*gather(x, self.nodes))

    def element_energy(self, x: NodeVectors, p: HingeValues) -> HingeValues:
        """Energy of each hinge (h,) in J, with rest curvature `p` (h,)."""
        return hinge_energy(self.hinges(x).theta, p, self.stiffness)

    def energy(self, x: NodeVectors, p: HingeValues) -> Scalar:
        """Bending energy in J (eq. 31)."""
        return jnp.sum(self.element_energy(x, p))

    def force(self, hinges: Hinge, p: HingeValues, n: int) -> NodeVectors:
        """Nodal forces (n, 3) in N from the hinges' geometry; minus the gradient of `energy`."""
        torque, _ = self._derivatives(hinges, p, 0.0)
        gradient = hinge_gradient(hinges, -torque)
        return scatter(self.nodes, (gradient.g0, gradient.g1, gradient.g2, gradient.g3), n)

    def blocks(
        self, x: NodeVectors, p: HingeValues, softening: HingeValues | None
    ) -> Float[Array, "10 3 3 hinges"]:
        """Element Hessians (10, 3, 3, h) in N/m, blocks ordered as `upper_pairs(4)`.

        `softening` (h,) is dp/dc of the implicit plastic update (PHYSICS: $\\beta h f'/(1 + \\beta h f')$).
        It lowers the stiffness along the gradient of c. Give None for an elastic sheet.
        """
        hinges = self.hinges(x)
        first, second = self._derivatives(hinges, p, 0.0 if softening is None else softening)
        return hinge_hessian(hinges, first, second)

    def _derivatives(
        self, hinges: Hinge, p: HingeValues, softening: HingeValues | float
    ) -> tuple[HingeValues, HingeValues]:
        """First and second derivative of the energies with respect to the angle, with dp/dc = `softening`."""
        stop1, stop2 = stop_derivatives(hinges.half)
        c, slope = hinges.curvature, hinges.slope
        first = (c - p) * slope + stop1
        second = (1.0 - softening) * slope * slope - 0.25 * (c - p) * c + stop2
        return self.stiffness * first, self.stiffness * second
