"""The closed-form derivatives of Appendix A, transcribed to NumPy as a reference for the tests.

Andrejevic & Rycroft, J. Comput. Phys. 2022, 111607. Nothing here is used by the package, and nothing
here is derived from it. Arrays carry one element per leading index: vectors (m, 3), positions of hinges
(m, 4, 3), blocks (m, 3, 3). As in (A.2), the rows of a block belong to the differentiated vector and
its columns to the node differentiated by: block (i, j) is $\\nabla_{x_j} (\\nabla_{x_i} \\cdot)^T$.

Two departures from the printed text: (A.10) has its sign corrected, and the plastic force and Hessian,
which the paper omits, are added at the end. The broken parenthesis in the last term of A.4.1 is read as
one coefficient of $(\\hat n_1 \\hat n_2^T + \\hat n_2 \\hat n_1^T)$, as in the line of its derivation.
"""

from types import SimpleNamespace

import numpy as np

EYE = np.eye(3)


def dot(a, b):
    """Scalar products, shape (m, 1, 1): ready to multiply blocks."""
    return np.sum(a * b, axis=-1)[..., None, None]


def outer(a, b):
    """Outer products $a b^T$."""
    return a[..., :, None] * b[..., None, :]


def norm(a):
    """Euclidean norms, shape (m, 1, 1)."""
    return np.sqrt(dot(a, a))


# --- A.1 In-plane elasticity ---------------------------------------------------------------------


def spring_force(r, k, s):
    """(A.1): force on node i, $r = x_i - x_j$; `k`, `s` of shape (m,)."""
    length = np.linalg.norm(r, axis=-1)
    return (k * (s / length - 1.0))[:, None] * r


def spring_block(r, k, s):
    """(A.3), case k = i; the block for node j has the opposite sign."""
    k, s, length = k[:, None, None], s[:, None, None], norm(r)
    return k * ((1.0 - s / length) * EYE + s / length**3 * outer(r, r))


# --- A.2 Internal damping ------------------------------------------------------------------------


def dashpot_force(r, u, b, s):
    """(A.5): force on node i, $u = v_i - v_j$."""
    b, s, length = b[:, None], s[:, None], np.linalg.norm(r, axis=-1)[:, None]
    ru = np.sum(r * u, axis=-1)[:, None]
    return -b * ((1.0 - s / length) * u + s / length**3 * ru * r)


def dashpot_block_x(r, u, b, s):
    """(A.6), case k = i."""
    b, s, length = b[:, None, None], s[:, None, None], norm(r)
    ru = dot(r, u)
    bracket = outer(r, u) + outer(u, r) - 3.0 * ru / length**2 * outer(r, r)
    return b * (s / length**3 * ru * EYE + s / length**3 * bracket)


def dashpot_block_v(r, b, s):
    """(A.7), case k = i."""
    return spring_block(r, b, s)


# --- A.3 Self-contact ----------------------------------------------------------------------------


def contact_force(r12, ks, sigma):
    """(A.9): force $F_1$ on site 1, $r_{12} = x_1 - x_2$, for distances below sigma."""
    length = np.linalg.norm(r12, axis=-1)[:, None]
    rho = sigma / (length - sigma)
    return ks * sigma / length * rho**2 * np.exp(rho) * r12


def contact_block(r12, ks, sigma):
    """(A.10) with the corrected sign and without weights: $-\\nabla_{x_2} F_1$."""
    length = norm(r12)
    rho = sigma / (length - sigma)
    bracket = EYE - 1.0 / (sigma * length) * (rho**2 + 2.0 * rho + sigma / length) * outer(r12, r12)
    return ks * sigma / length * rho**2 * np.exp(rho) * bracket


# --- A.4 Out-of-plane elasticity -----------------------------------------------------------------


def hinge_terms(x):
    """Vectors, scalars (m, 1, 1) and outer products of (A.12)-(A.16), (A.21)."""
    e0, e1, e2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], x[:, 3] - x[:, 0]
    n1, n2 = np.cross(e0, e1), -np.cross(e0, e2)
    N1, N2 = norm(n1), norm(n2)
    h1, h2 = n1 / N1[..., 0], n2 / N2[..., 0]
    normal = np.cross(h1, h2)
    return SimpleNamespace(
        e0=e0, e1=e1, e2=e2, h1=h1, h2=h2, N1=N1, N2=N2,
        e00=dot(e0, e0), e11=dot(e1, e1), e22=dot(e2, e2),
        e01=dot(e0, e1), e02=dot(e0, e2), e12=dot(e1, e2),
        nu=dot(h1, h2), n2e1=dot(h2, e1), n1e2=dot(h1, e2),
        t0=dot(normal, e0), t1=dot(normal, e1), t2=dot(normal, e2),
        e0n1=outer(e0, h1), e1n1=outer(e1, h1), n1e0=outer(h1, e0), n1e1=outer(h1, e1),
        e0n2=outer(e0, h2), e2n2=outer(e2, h2), n2e0=outer(h2, e0), n2e2=outer(h2, e2),
        n1n1=outer(h1, h1), n1n2=outer(h1, h2), n2n1=outer(h2, h1), n2n2=outer(h2, h2),
    )  # fmt: skip


def nu_gradient(t):
    """(A.17)-(A.20): gradients of $\\nu = \\hat n_1 \\cdot \\hat n_2$ at the four nodes, (m, 4, 3)."""
    N1, N2, t0, t1, t2 = (a[..., 0] for a in (t.N1, t.N2, t.t0, t.t1, t.t2))
    g0 = (t1 * t.h1 - t0 * t.h1) / N1 + (t2 * t.h2 - t0 * t.h2) / N2
    g1 = -t1 * t.h1 / N1 - t2 * t.h2 / N2
    g2 = t0 * t.h1 / N1
    g3 = t0 * t.h2 / N2
    return np.stack([g0, g1, g2, g3], axis=1)


def a_4_1(t):
    """$\\nabla_{x_0}(C_{11} - C_{01} + C_{22} - C_{02})$."""
    return (
        t.t0 / (t.e00 * t.N1**3) * (t.e01 - t.e00)
        * ((t.e11 - t.e01) * t.e0n1 + (t.e00 - t.e01) * t.e1n1
           + (t.e11 - t.e01) * t.n1e0 + (t.e00 - t.e01) * t.n1e1)
        + t.t0 / (t.e00 * t.N2**3) * (t.e02 - t.e00)
        * ((t.e22 - t.e02) * t.e0n2 + (t.e00 - t.e02) * t.e2n2
           + (t.e22 - t.e02) * t.n2e0 + (t.e00 - t.e02) * t.n2e2)
        + (2 * t.e01 * t.nu - t.e00 * t.nu - t.e11 * t.nu) / t.N1**2 * t.n1n1
        + (2 * t.e02 * t.nu - t.e00 * t.nu - t.e22 * t.nu) / t.N2**2 * t.n2n2
        + ((t.n2e1 * t.n1e2 - t.e00 * t.nu) / (t.N1 * t.N2)
           + (t.e01 * t.nu + t.e02 * t.nu - t.e12 * t.nu) / (t.N1 * t.N2)) * (t.n1n2 + t.n2n1)
    )  # fmt: skip


def a_4_2(t):
    """$\\nabla_{x_1}(C_{11} - C_{01} + C_{22} - C_{02})$."""
    d1, d2, d12 = t.e00 * t.N1**3, t.e00 * t.N2**3, t.N1 * t.N2
    return (
        t.t0 * ((t.e00 * t.e11 - t.e01 * t.e11) / d1 * t.e0n1 + (t.e01**2 - t.e01 * t.e00) / d1 * t.e1n1
                + (t.e01**2 - t.e01 * t.e11) / d1 * t.n1e0 + (t.e01**2 - t.e01 * t.e00) / d1 * t.n1e1
                + (t.e00 * t.e22 - t.e02 * t.e22) / d2 * t.e0n2 + (t.e02**2 - t.e02 * t.e00) / d2 * t.e2n2
                + (t.e02**2 - t.e02 * t.e22) / d2 * t.n2e0 + (t.e02**2 - t.e02 * t.e00) / d2 * t.n2e2)
        + t.e12 * t.nu / d12 * t.n1n2 - t.n2e1 * t.n1e2 / d12 * t.n1n2 + t.e11 * t.nu / t.N1**2 * t.n1n1
        - t.e02 * t.nu / d12 * t.n1n2 - t.e01 * t.nu / t.N1**2 * t.n1n1
        + t.e22 * t.nu / t.N2**2 * t.n2n2 + t.e12 * t.nu / d12 * t.n2n1 - t.n2e1 * t.n1e2 / d12 * t.n2n1
        - t.e02 * t.nu / t.N2**2 * t.n2n2 - t.e01 * t.nu / d12 * t.n2n1
    )  # fmt: skip


def a_4_3(t):
    """$\\nabla_{x_2}(C_{11} - C_{01} + C_{22} - C_{02})$."""
    return (
        t.t0 * ((t.e01**2 - t.e01 * t.e00) / (t.e00 * t.N1**3) * t.e0n1
                + (t.e00 - t.e01) / t.N1**3 * t.e1n1
                + (t.e11 - t.e01) / t.N1**3 * t.n1e0 + (t.e00 - t.e01) / t.N1**3 * t.n1e1)
        - t.e01 * t.nu / t.N1**2 * t.n1n1 + t.e00 * t.nu / t.N1**2 * t.n1n1
        - t.e02 * t.nu / (t.N1 * t.N2) * t.n2n1 + t.e00 * t.nu / (t.N1 * t.N2) * t.n2n1
    )  # fmt: skip


def a_4_4(t):
    """$\\nabla_{x_3}(C_{11} - C_{01} + C_{22} - C_{02})$."""
    return (
        t.t0 * ((t.e02**2 - t.e02 * t.e00) / (t.e00 * t.N2**3) * t.e0n2
                + (t.e00 - t.e02) / t.N2**3 * t.e2n2
                + (t.e22 - t.e02) / t.N2**3 * t.n2e0 + (t.e00 - t.e02) / t.N2**3 * t.n2e2)
        - t.e01 * t.nu / (t.N1 * t.N2) * t.n1n2 + t.e00 * t.nu / (t.N1 * t.N2) * t.n1n2
        - t.e02 * t.nu / t.N2**2 * t.n2n2 + t.e00 * t.nu / t.N2**2 * t.n2n2
    )  # fmt: skip


def a_4_5(t):
    """$\\nabla_{x_0}(-C_{11} - C_{22})$."""
    d1, d2, d12 = t.e00 * t.N1**3, t.e00 * t.N2**3, t.N1 * t.N2
    return (
        t.t0 * ((t.e01**2 - t.e01 * t.e11) / d1 * t.e0n1 + (t.e01**2 - t.e01 * t.e00) / d1 * t.e1n1
                + (t.e00 * t.e11 - t.e01 * t.e11) / d1 * t.n1e0 + (t.e01**2 - t.e01 * t.e00) / d1 * t.n1e1
                + (t.e02**2 - t.e02 * t.e22) / d2 * t.e0n2 + (t.e02**2 - t.e02 * t.e00) / d2 * t.e2n2
                + (t.e00 * t.e22 - t.e02 * t.e22) / d2 * t.n2e0 + (t.e02**2 - t.e02 * t.e00) / d2 * t.n2e2)
        - t.e01 * t.nu / d12 * t.n1n2 + t.e12 * t.nu / d12 * t.n1n2 - t.n2e1 * t.n1e2 / d12 * t.n1n2
        - t.e01 * t.nu / t.N1**2 * t.n1n1 + t.e11 * t.nu / t.N1**2 * t.n1n1
        - t.e02 * t.nu / t.N2**2 * t.n2n2 + t.e22 * t.nu / t.N2**2 * t.n2n2 - t.e02 * t.nu / d12 * t.n2n1
        + t.e12 * t.nu / d12 * t.n2n1 - t.n1e2 * t.n2e1 / d12 * t.n2n1
    )  # fmt: skip


def a_4_6(t):
    """$\\nabla_{x_1}(-C_{11} - C_{22})$."""
    return (
        t.t0 / (t.e00 * t.N1**3) * t.e01
        * (t.e11 * t.e0n1 - t.e01 * t.e1n1 + t.e11 * t.n1e0 - t.e01 * t.n1e1)
        + t.t0 / (t.e00 * t.N2**3) * t.e02
        * (t.e22 * t.e0n2 - t.e02 * t.e2n2 + t.e22 * t.n2e0 - t.e02 * t.n2e2)
        - t.e12 * t.nu / (t.N1 * t.N2) * (t.n1n2 + t.n2n1)
        + t.n2e1 * t.n1e2 / (t.N1 * t.N2) * (t.n1n2 + t.n2n1)
        - t.e11 * t.nu / t.N1**2 * t.n1n1 - t.e22 * t.nu / t.N2**2 * t.n2n2
    )  # fmt: skip


def a_4_7(t):
    """$\\nabla_{x_2}(-C_{11} - C_{22})$."""
    return (
        -t.t0 / (t.e00 * t.N1**3)
        * (t.e01**2 * t.e0n1 + t.e00 * t.e11 * t.n1e0 - t.e01 * t.e00 * t.e1n1 - t.e01 * t.e00 * t.n1e1)
        + t.e01 * t.nu / t.N1**2 * t.n1n1 + t.e02 * t.nu / (t.N1 * t.N2) * t.n2n1
    )  # fmt: skip


def a_4_8(t):
    """$\\nabla_{x_3}(-C_{11} - C_{22})$."""
    return (
        t.t0 / (t.e00 * t.N2**3)
        * (-t.e02**2 * t.e0n2 - t.e00 * t.e22 * t.n2e0 + t.e02 * t.e00 * t.e2n2 + t.e02 * t.e00 * t.n2e2)
        + t.e02 * t.nu / t.N2**2 * t.n2n2 + t.e01 * t.nu / (t.N1 * t.N2) * t.n1n2
    )  # fmt: skip


def a_4_9(t):
    """$\\nabla_{x_0} C_{01}$."""
    return (
        t.t0 * ((t.e11 - t.e01) / t.N1**3 * t.e0n1 + (t.e00 - t.e01) / t.N1**3 * t.e1n1
                + (t.e01**2 - t.e01 * t.e00) / (t.e00 * t.N1**3) * t.n1e0
                + (t.e00 - t.e01) / t.N1**3 * t.n1e1)
        + t.e00 * t.nu / (t.N1 * t.N2) * t.n1n2 - t.e02 * t.nu / (t.N1 * t.N2) * t.n1n2
        + t.e00 * t.nu / t.N1**2 * t.n1n1 - t.e01 * t.nu / t.N1**2 * t.n1n1
    )  # fmt: skip


def a_4_10(t):
    """$\\nabla_{x_1} C_{01}$."""
    return (
        -t.t0 / (t.e00 * t.N1**3)
        * (t.e00 * t.e11 * t.e0n1 + t.e01**2 * t.n1e0 - t.e01 * t.e00 * t.e1n1 - t.e01 * t.e00 * t.n1e1)
        + t.e01 * t.nu / t.N1**2 * t.n1n1 + t.e02 * t.nu / (t.N1 * t.N2) * t.n1n2
    )  # fmt: skip


def a_4_11(t):
    """$\\nabla_{x_2} C_{01}$."""
    bracket = t.e01 * t.e0n1 - t.e00 * t.e1n1 + t.e01 * t.n1e0 - t.e00 * t.n1e1
    return t.t0 / t.N1**3 * bracket - t.e00 * t.nu / t.N1**2 * t.n1n1


def a_4_12(t):
    """$\\nabla_{x_3} C_{01}$."""
    return -t.e00 * t.nu / (t.N1 * t.N2) * t.n1n2


def a_4_13(t):
    """$\\nabla_{x_0} C_{02}$."""
    return (
        t.t0 * ((t.e22 - t.e02) / t.N2**3 * t.e0n2 + (t.e00 - t.e02) / t.N2**3 * t.e2n2
                + (t.e02**2 - t.e02 * t.e00) / (t.e00 * t.N2**3) * t.n2e0
                + (t.e00 - t.e02) / t.N2**3 * t.n2e2)
        + t.e00 * t.nu / t.N2**2 * t.n2n2 - t.e02 * t.nu / t.N2**2 * t.n2n2
        + t.e00 * t.nu / (t.N1 * t.N2) * t.n2n1 - t.e01 * t.nu / (t.N1 * t.N2) * t.n2n1
    )  # fmt: skip


def a_4_14(t):
    """$\\nabla_{x_1} C_{02}$."""
    return (
        t.t0 / (t.e00 * t.N2**3)
        * (-t.e00 * t.e22 * t.e0n2 - t.e02**2 * t.n2e0 + t.e02 * t.e00 * t.e2n2 + t.e02 * t.e00 * t.n2e2)
        + t.e02 * t.nu / t.N2**2 * t.n2n2 + t.e01 * t.nu / (t.N1 * t.N2) * t.n2n1
    )  # fmt: skip


def a_4_15(t):
    """$\\nabla_{x_2} C_{02}$."""
    return -t.e00 * t.nu / (t.N1 * t.N2) * t.n2n1


def a_4_16(t):
    """$\\nabla_{x_3} C_{02}$."""
    bracket = t.e02 * t.e0n2 - t.e00 * t.e2n2 + t.e02 * t.n2e0 - t.e00 * t.n2e2
    return t.t0 / t.N2**3 * bracket - t.e00 * t.nu / t.N2**2 * t.n2n2


# Block (i, j) of the Hessian of nu, numbered as in (A.27)-(A.42) and A.4.1-A.4.16.
NU_BLOCKS = (
    (a_4_1, a_4_2, a_4_3, a_4_4),
    (a_4_5, a_4_6, a_4_7, a_4_8),
    (a_4_9, a_4_10, a_4_11, a_4_12),
    (a_4_13, a_4_14, a_4_15, a_4_16),
)


def nu_hessian(t):
    """All sixteen blocks, shape (m, 4, 3, 4, 3)."""
    rows = [np.stack([block(t) for block in row], axis=2) for row in NU_BLOCKS]
    return np.stack(rows, axis=1)


def curvature(t):
    """(33): signed dimensionless curvature (m,); 0/0 for a flat hinge."""
    sign = -(t.n2e1 / np.abs(t.n2e1))[:, 0, 0]
    return sign * np.linalg.norm(t.h1 - t.h2, axis=-1)


def hinge_stiffness(kb, x):
    """$K = k_b \\sqrt3 |e_0|^2 / (2 \\bar A)$ of (A.11), $\\bar A = A_1 + A_2$ in the rest shape."""
    t = hinge_terms(x)
    area = 0.5 * (t.N1 + t.N2)
    return (kb * np.sqrt(3.0) * t.e00 / (2.0 * area))[:, 0, 0]


def elastic_force(t, K):
    """(A.11): bending force without plasticity, (m, 4, 3)."""
    return K[:, None, None] * nu_gradient(t)


def elastic_hessian(t, K):
    """Hessian of the bending energy (29), (m, 4, 3, 4, 3)."""
    return -K[:, None, None, None, None] * nu_hessian(t)


# --- Plasticity (omitted by the paper) -----------------------------------------------------------


def plastic_force(t, K, p):
    """$K (1 - p/c) \\nabla\\nu$: the force of the energy (31)."""
    return (K * (1.0 - p / curvature(t)))[:, None, None] * nu_gradient(t)


def plastic_hessian(t, K, p, softening=0.0):
    """Hessian of (31) at fixed p, or with dp/dc = `softening` the condensed matrix of step 1 of (51).

    $-K (1 - p/c) \\nabla^2\\nu + K (p/c^3) \\nabla\\nu^T \\nabla\\nu$, less `softening` times
    $K \\nabla c^T \\nabla c$ with $\\nabla c = -\\nabla\\nu / c$.
    """
    c, g = curvature(t), nu_gradient(t)
    gg = g[:, :, :, None, None] * g[:, None, None, :, :]
    geometric = (-K * (1.0 - p / c))[:, None, None, None, None] * nu_hessian(t)
    return geometric + (K * (p / c**3 - softening / c**2))[:, None, None, None, None] * gg


def flow_slope(excess, c0, scale):
    """$f'$ of (35), (36) at $\\lambda$ = `excess`, with `scale` $= T (1 + \\gamma)$."""
    u = np.clip((excess - c0) / (2.0 - c0), 0.0, 1.0)
    return (30.0 * u**4 - 60.0 * u**3 + 30.0 * u**2) / ((2.0 - c0) * scale)


def softening(elastic, c0, scale, beta_h):
    """Share $\\beta h f' / (1 + \\beta h f')$ of the stiffness that plastic flow takes away in (51)."""
    slope = beta_h * flow_slope(np.abs(elastic), c0, scale)
    return slope / (1.0 + slope)
