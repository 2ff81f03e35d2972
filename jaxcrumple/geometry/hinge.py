"""Lengths, areas and signed hinge angles, with derivatives that exist from flat to the fold.

Vectors are tuples of three arrays (one per Cartesian component). XLA on CPU compiles such scalar
kernels two to three times faster than the same formulas on `(m, 3)` arrays, and the formulas
broadcast over any number of elements.

Hinge convention (Fig. 3a, A.12-A.16): $e_0 = x_1 - x_0$ is the shared edge, $e_1 = x_2 - x_0$,
$e_2 = x_3 - x_0$, $n_1 = e_0 \\times e_1$, $n_2 = -e_0 \\times e_2$. The signed angle is
$\\theta = \\mathrm{atan2}((n_1 \\times n_2) \\cdot \\hat e_0,\\; n_1 \\cdot n_2)$ and the dimensionless
curvature $c = 2 \\sin(\\theta/2)$: equal to eq. (33) to rounding, but smooth through flat, where
(33) is 0/0. It follows from the normals by square roots, which a processor computes for several hinges at
once, unlike sines: $c = s / \\sqrt{r (r + n_1 \\cdot n_2) / 2}$ with $s = (n_1 \\times n_2) \\cdot \\hat e_0$
and $r = |n_1| |n_2|$, and beyond 90 degrees $c = \\pm\\sqrt{2 (r - n_1 \\cdot n_2) / r}$.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Real

from jaxcrumple._jax.arrays import NodeVectors, Scalar
from jaxcrumple._jax.device import mapped

Vec = tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]


def sub(a: Vec, b: Vec) -> Vec:
    """Difference of two vectors."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def add(a: Vec, b: Vec) -> Vec:
    """Sum of two vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def scale(s: Real[Array, "..."] | float, a: Vec) -> Vec:
    """Scalar times vector."""
    return (s * a[0], s * a[1], s * a[2])


def dot(a: Vec | Float[Array, "3 ..."], b: Vec | Float[Array, "3 ..."]) -> Float[Array, "..."]:
    """Scalar product, also of arrays whose first axis counts the components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec, b: Vec) -> Vec:
    """Vector product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def outer(a: Vec, b: Vec) -> Float[Array, "3 3 ..."]:
    """Outer product $a b^T$, shape (3, 3, ...)."""
    return dyad(jnp.stack(a), jnp.stack(b))


def dyad(a: Float[Array, " 3 *axes"], b: Float[Array, " 3 *axes"]) -> Float[Array, " 3 3 *axes"]:
    """Outer product $a b^T$ of vectors that are arrays (3, ...), shape (3, 3, ...)."""
    return a[:, None] * b[None]


def gather(x: NodeVectors, nodes: Int[Array, "elements corners"]) -> tuple[Vec, ...]:
    """Node positions `x` (n, 3) of elements `nodes` (m, k), as k vectors of components (m,)."""
    # One gather for all k nodes: separate kernels take twice as long to run, and also to compile.
    parts = x.T[:, nodes.T]
    return tuple((parts[0, k], parts[1, k], parts[2, k]) for k in range(nodes.shape[1]))


def unpack(x: Float[Array, "corners 3"]) -> tuple[Vec, ...]:
    """Positions of one element `x` (k, 3) as k vectors."""
    return tuple((row[0], row[1], row[2]) for row in x)


def length(e: Vec) -> Float[Array, "..."]:
    """Euclidean length; its gradient is finite except at zero length."""
    return jnp.sqrt(dot(e, e))


def longest(vectors: NodeVectors) -> Scalar:
    """Return the length of the longest of the `vectors` (n, 3)."""
    return jnp.sqrt(jnp.max(jnp.sum(vectors * vectors, axis=1)))


class HalfAngle(NamedTuple):
    """Sine and cosine of half a hinge's angle.

    They say what an angle does without an arc tangent. A processor computes arc tangents one at a time: they
    were a third of the time of the bending forces.
    """

    sine: Float[Array, "..."]
    cosine: Float[Array, "..."]

    @property
    def angle(self) -> Float[Array, "..."]:
        """Signed angle in rad, in [-pi, pi]."""
        return 2.0 * jnp.arctan2(self.sine, self.cosine)

    def minus(self, other: "HalfAngle") -> "HalfAngle":
        """Return half the difference of two angles; its cosine is negative beyond 180 degrees."""
        return HalfAngle(
            self.sine * other.cosine - self.cosine * other.sine,
            self.cosine * other.cosine + self.sine * other.sine,
        )


class Hinge(NamedTuple):
    """Intermediate quantities of a hinge's angle and its derivatives (all arrays (m,) or Vec)."""

    e0: Vec
    e1: Vec
    e2: Vec
    n1: Vec
    n2: Vec
    edge_length: Float[Array, "..."]
    theta: Float[Array, "..."]
    # c = 2 sin(theta / 2), and its derivative cos(theta / 2).
    curvature: Float[Array, "..."]
    slope: Float[Array, "..."]

    @property
    def half(self) -> HalfAngle:
        """Half of the signed angle."""
        return HalfAngle(0.5 * self.curvature, self.slope)


def hinge(x0: Vec, x1: Vec, x2: Vec, x3: Vec) -> Hinge:
    """Edges, normals and signed angle of a hinge (Fig. 3a)."""
    e0, e1, e2 = sub(x1, x0), sub(x2, x0), sub(x3, x0)
    n1, n2 = cross(e0, e1), cross(e2, e0)
    edge_length = length(e0)
    # (n1 x n2).e0_hat = -|e0| (n2.e1): one product instead of a cross product (eq. 30).
    sine, cosine = -edge_length * dot(n2, e1), dot(n1, n2)
    size = jnp.sqrt(sine * sine + cosine * cosine)
    # Of size + cosine and size - cosine, one would cancel. The other gives sine and cosine of the half angle,
    # which change places at 90 degrees. Quotients, because XLA on CPU recomputes products (`hinge_gradient`).
    larger = size + jnp.abs(cosine)
    root = jnp.sqrt(0.5 * size * larger)
    bent = jnp.where(cosine > 0, sine, jnp.where(sine < 0, -larger, larger)) / root
    slope = jnp.where(cosine > 0, larger, jnp.abs(sine)) / (2.0 * root)
    return Hinge(e0, e1, e2, n1, n2, edge_length, jnp.arctan2(sine, cosine), bent, slope)


def hinge_angle(x0: Vec, x1: Vec, x2: Vec, x3: Vec) -> Float[Array, "..."]:
    """Signed angle between the face normals of a hinge, in (-pi, pi]."""
    return hinge(x0, x1, x2, x3).theta


def curvature(theta: Float[Array, " *axes"]) -> Float[Array, " *axes"]:
    """Signed dimensionless curvature $c = 2 \\sin(\\theta/2)$ (eq. 33)."""
    return 2.0 * jnp.sin(0.5 * theta)


class HingeGradient(NamedTuple):
    """Gradient at the four nodes of a function of the angle, and the foot points $a_i$."""

    g0: Vec
    g1: Vec
    g2: Vec
    g3: Vec
    a1: Float[Array, "..."]
    a2: Float[Array, "..."]


def hinge_gradient(hg: Hinge, slope: Float[Array, "..."] | float = 1.0) -> HingeGradient:
    """Gradient of a function of the angle with derivative `slope`; by default of the angle itself.

    With $u_i = |e_0| n_i / |n_i|^2$ and the foot points $a_i = (e_i \\cdot e_0)/|e_0|^2$:
    $\\nabla_2 \\theta = -u_1$, $\\nabla_3 \\theta = -u_2$ and, by invariance under rigid motions,
    $\\nabla_1 = -a_1 \\nabla_2 - a_2 \\nabla_3$ and $\\nabla_0 = -\\nabla_1 - \\nabla_2 - \\nabla_3$.
    """
    edge_sq = hg.edge_length * hg.edge_length
    a1, a2 = dot(hg.e1, hg.e0) / edge_sq, dot(hg.e2, hg.e0) / edge_sq
    # XLA on CPU stores the result of a division, but recomputes a product and its operands in each of the
    # twelve components. So the slope goes into the quotient.
    weight = -slope * hg.edge_length
    g2 = scale(weight / dot(hg.n1, hg.n1), hg.n1)
    g3 = scale(weight / dot(hg.n2, hg.n2), hg.n2)
    g1 = add(scale(-a1, g2), scale(-a2, g3))
    g0 = add(scale(a1 - 1.0, g2), scale(a2 - 1.0, g3))
    return HingeGradient(g0, g1, g2, g3, a1, a2)


# Node pairs (a, b) of a hinge whose 3x3 blocks hinge_hessian returns, in this order.
HINGE_PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
# Derivative of e0 with respect to the four nodes.
_EDGE_SIGNS = np.array([-1.0, 1.0, 0.0, 0.0])


def hinge_hessian(
    hg: Hinge, first: Float[Array, " *axes"], second: Float[Array, " *axes"]
) -> Float[Array, " 10 3 3 *axes"]:
    """Hessian of a function of the angle with derivatives `first` and `second`.

    With the height $h$ of a face over the shared edge, unit vectors $\\hat m$ along it and $\\hat n$
    normal to the face, $\\nabla_a \\theta = g_a = -\\sum_{faces} w_a \\hat n/h$, where w are the four
    coefficients of `hinge_gradient`. Differentiated again, with $s_a = \\partial e_0/\\partial x_a$:

    $\\nabla_a \\nabla_b \\theta = \\sum_{faces} (w_a w_b/h^2 + s_a s_b/(2|e_0|^2))
    (\\hat n \\hat m^T + \\hat m \\hat n^T) - (s_a\\, g_b e_0^T + s_b\\, e_0 g_a^T)/|e_0|^2$.

    **Returns:** the blocks (10, 3, 3, ...) of the node pairs `HINGE_PAIRS`.
    """
    gr = hinge_gradient(hg)
    weights, shared, planes = _faces(hg, gr)
    g = jnp.stack([jnp.stack(v) for v in (gr.g0, gr.g1, gr.g2, gr.g3)])
    along = jnp.stack(scale(1.0 / (hg.edge_length * hg.edge_length), hg.e0))

    def block(
        pair: tuple[
            Float[Array, " 2 *axes"], Float[Array, " 3 *axes"], Float[Array, " 3 *axes"], Scalar, Scalar
        ],
    ) -> Float[Array, " 3 3 *axes"]:
        c, ga, gb, sa, sb = pair
        bend = c[0] * planes[0] + c[1] * planes[1] - dyad(sa * gb, along) - dyad(sb * along, ga)
        return first * bend + dyad(second * ga, gb)

    a, b = np.array(HINGE_PAIRS).T
    sa, sb = jnp.asarray(_EDGE_SIGNS[a], first.dtype), jnp.asarray(_EDGE_SIGNS[b], first.dtype)
    c = weights[a] * weights[b] + jnp.multiply.outer(sa * sb, shared)
    # Not unrolled: XLA on CPU would fuse everything above into a single expression and recompute it for each
    # of the ninety entries.
    return mapped(block, (c, g[a], g[b], sa, sb))


def _faces(
    hg: Hinge, gr: HingeGradient
) -> tuple[Float[Array, " 4 2 *axes"], Float[Array, " 2 *axes"], Float[Array, " 2 3 3 *axes"]]:
    """Return the coefficients of `hinge_hessian` for both faces.

    These are w (4, 2, ...), $h^2/(2|e_0|^2)$ (2, ...) and, one (3, 3, ...) array for each face,
    $(\\hat n \\hat m^T + \\hat m \\hat n^T)/h^2$.
    """
    edge_sq = hg.edge_length * hg.edge_length
    one, zero = jnp.ones_like(gr.a1), jnp.zeros_like(gr.a1)
    foot = jnp.stack([gr.a1, gr.a2])
    weights = jnp.stack([foot - 1.0, -foot, jnp.stack([one, zero]), jnp.stack([zero, one])])
    shared, planes = [], []
    for g, n, e, a in ((gr.g2, hg.n1, hg.e1, gr.a1), (gr.g3, hg.n2, hg.e2, gr.a2)):
        height_sq = dot(n, n) / edge_sq
        normal = jnp.stack(g)  # -n/h, as in the gradient of the angle
        inward = jnp.stack(scale(-1.0 / height_sq, sub(e, scale(a, hg.e0))))
        shared.append(0.5 * height_sq / edge_sq)
        planes.append(dyad(normal, inward) + dyad(inward, normal))
    return weights, jnp.stack(shared), jnp.stack(planes)
