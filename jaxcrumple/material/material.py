"""Compute the constants of the discrete model from properties of the sheet in SI units.

Equation numbers refer to Andrejevic & Rycroft, J. Comput. Phys. (2022) 111607. The defaults describe the
sheet of its Fig. 3 (0.25 mm thick, 1 GPa) at the density of water.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcrumple._jax.tree import as_float, is_known
from jaxcrumple.mesh.mesh import Mesh

MAX_C0 = 1.99
"""Largest c0 of a hinge. |c| is at most 2, so c0 >= 2 would never yield, and (35) divides by 2 - c0."""

DEFAULT_YIELD_CURVATURE = 200.0
"""[1/m]: yield at a radius of 5 mm, 2.5 % strain at the surface of a sheet 0.25 mm thick."""


# Arrays of the host, or of JAX for a material with traced numbers.
_Nodes = Float[np.ndarray, " nodes"] | Float[Array, " nodes"]
_Edges = Float[np.ndarray, " edges"] | Float[Array, " edges"]
_Hinges = Float[np.ndarray, " hinges"] | Float[Array, " hinges"]
_Nodal = float | Float[np.ndarray, " nodes"]


class _Default:
    def __repr__(self) -> str:
        return f"{DEFAULT_YIELD_CURVATURE} unless yield_c0 is given"


_DEFAULT: Any = _Default()
_NONNEGATIVE = "a finite number >= 0"
_POSITIVE = "a finite number > 0"
_FIELDS = {
    "young_modulus": ("Pa", _POSITIVE),
    "thickness": ("m", _POSITIVE),
    "density": ("kg/m^3", _POSITIVE),
    "yield_curvature": ("1/m", _NONNEGATIVE),
    "yield_c0": ("dimensionless", _NONNEGATIVE),
    "gamma": ("dimensionless", _NONNEGATIVE),
    "plastic_time": ("s", _POSITIVE),
    "drag_rate": ("1/s", _NONNEGATIVE),
    "internal_damping_time": ("s", _NONNEGATIVE),
}
_PER_NODE = ("thickness", "yield_curvature", "yield_c0")


@dataclass(frozen=True, kw_only=True, eq=False)
class Material:
    """Properties of the sheet in SI units. `thickness` and the yield fields may be nodal arrays (n,).

    Fields: `young_modulus` Y in Pa; `thickness` h in m; `density` in kg/m3; `yield_curvature` in 1/m, or
    `yield_c0`; `gamma` of (35), dimensionless, and `plastic_time` in s, which enter only as plastic_time (1 +
    gamma), the time scale of the plastic flow that (34) omits; `drag_rate` b_iso / m of (24) in 1/s;
    `internal_damping_time` b_int / ks of (25) in s; `mass_lumping`: "uniform" node masses (the paper's
    choice), or by "area".

    `yield_curvature` is a physical curvature. `discretize` converts it hinge by hinge into the dimensionless
    yield curvature c0 of (35), so a refined mesh yields at the same curvature. `yield_c0` sets c0 itself, as
    the paper does; its physical meaning then depends on the mesh (Fig. 3b). Give only one of the two.
    `Material(yield_curvature=None)` is elastic. Traced numbers are not checked.

    **Raises:** ValueError naming field, value and unit if a value is not finite or has the wrong sign, if
    both yield fields are given, or for an unknown `mass_lumping`.

    >>> sheet = jc.Material(young_modulus=3e9, thickness=0.1e-3)
    >>> sheet.young_modulus_2d, round(sheet.bending_rigidity, 9)  # N/m, J
    (300000.0, 0.00028125)
    >>> sheet.yield_curvature, sheet.is_elastic, jc.Material(yield_curvature=None).is_elastic
    (200.0, False, True)
    >>> jc.Material(thickness=-1e-3)
    Traceback (most recent call last):
    ValueError: thickness = -0.001 [m] is not usable; give a finite number > 0
    """

    young_modulus: float = 1e9
    thickness: _Nodal = 0.25e-3
    density: float = 1000.0
    yield_curvature: _Nodal | None = _DEFAULT
    yield_c0: _Nodal | None = None
    gamma: float = 0.0
    plastic_time: float = 1e-3
    drag_rate: float = 1e3
    internal_damping_time: float = 2e-7
    mass_lumping: Literal["uniform", "area"] = "uniform"

    def __post_init__(self) -> None:
        if self.yield_curvature is _DEFAULT:
            default = DEFAULT_YIELD_CURVATURE if self.yield_c0 is None else None
            object.__setattr__(self, "yield_curvature", default)
        for name in _FIELDS:
            object.__setattr__(self, name, _checked(name, getattr(self, name)))
        if self.yield_curvature is not None and self.yield_c0 is not None:
            raise ValueError(
                "yield_curvature and yield_c0 both set the yield point; give one, None for the other"
            )
        if self.mass_lumping not in ("uniform", "area"):
            raise ValueError(f"mass_lumping = {self.mass_lumping!r} is unknown; give 'uniform' or 'area'")

    @property
    def is_elastic(self) -> bool:
        """Whether the sheet is elastic, that is, never yields."""
        return self.yield_curvature is None and self.yield_c0 is None

    @property
    def young_modulus_2d(self) -> _Nodal:
        """Y_2D = Y h in N/m, below (22)."""
        return self.young_modulus * self.thickness

    @property
    def spring_constant(self) -> _Nodal:
        """ks = sqrt(3)/2 Y_2D in N/m (eq. 10)."""
        return math.sqrt(3) / 2 * self.young_modulus_2d

    @property
    def bending_constant(self) -> _Nodal:
        """kb = ks h^2 / 8 in J (eq. 23 with h_eff = h)."""
        return self.spring_constant * self.thickness**2 / 8

    @property
    def bending_rigidity(self) -> _Nodal:
        """kappa = sqrt(3)/2 kb in J (eq. 14)."""
        return math.sqrt(3) / 2 * self.bending_constant

    def discretize(self, mesh: Mesh) -> ModelConstants:
        """Compute the constants of every spring, hinge and node of `mesh`, in SI units.

        Properties given per node are averaged over the two ends of a spring, and over the two ends of a
        hinge's shared edge.

        **Raises:** ValueError if an array does not have one value per node.
        """
        for name in _PER_NODE:
            _check_length(name, getattr(self, name), mesh.n_nodes)
        ks = _edge_mean(self.spring_constant, mesh)
        mass = self._node_mass(mesh)
        return ModelConstants(
            ks=ks,
            kb=_edge_mean(self.bending_constant, mesh)[mesh.hinge_edges],
            mass=mass,
            drag=self.drag_rate * mass,
            b_int=self.internal_damping_time * ks,
            c0=self._yield_point(mesh),
            plastic_time=self.plastic_time,
            gamma=self.gamma,
            sigma=_number(
                self._numpy.mean(self._numpy.sqrt(8 * self.bending_constant / self.spring_constant))
            ),
            a_ref=_number(ks.mean() / (mass.mean() * mesh.linear_density)),
        )

    def _node_mass(self, mesh: Mesh) -> _Nodes:
        mass = self.density * self.thickness * mesh.node_area
        if self.mass_lumping == "uniform":
            return self._numpy.broadcast_to(mass.mean(), mass.shape)
        return mass

    def _yield_point(self, mesh: Mesh) -> _Hinges | None:
        if self.yield_c0 is not None:
            return self._numpy.minimum(_edge_mean(self.yield_c0, mesh)[mesh.hinge_edges], MAX_C0)
        if self.yield_curvature is None:
            return None
        curvature = _edge_mean(self.yield_curvature, mesh)[mesh.hinge_edges]
        return self._numpy.minimum(curvature * mesh.hinge_height, MAX_C0)

    @property
    def _numpy(self) -> Any:
        """NumPy, or JAX's NumPy if a number is traced."""
        return np if is_known(*(getattr(self, name) for name in _FIELDS)) else jnp


@dataclass(frozen=True, eq=False)
class ModelConstants:
    """Constants of the discrete model on one mesh of n nodes, e springs and h hinges."""

    ks: _Edges
    """(e,) spring constants of (11) [N/m]."""
    kb: _Hinges
    """(h,) bending constants of (20) [J]."""
    mass: _Nodes
    """(n,) node masses [kg]."""
    drag: _Nodes
    """(n,) b_iso of (24) [kg/s]."""
    b_int: _Edges
    """(e,) b_int of (25) [kg/s]."""
    c0: _Hinges | None
    """(h,) dimensionless yield curvatures of (35), at most `MAX_C0`, or None for an elastic sheet."""
    plastic_time: float
    """Time scale of the plastic flow [s]."""
    gamma: float
    """gamma of (35)."""
    sigma: float
    """Interaction range of (26): the mean effective thickness h_eff of (23) [m]."""
    a_ref: float
    """Reference acceleration ks / (m lambda) with the means of ks and m and lambda = sqrt(n / A) [m/s^2]."""


def _edge_mean(nodal: _Nodal, mesh: Mesh) -> _Edges:
    numpy = np if is_known(nodal) else jnp
    return numpy.broadcast_to(nodal, mesh.n_nodes)[mesh.edges].mean(axis=1)


def _number(value: Any) -> Any:
    return float(value) if is_known(value) else value


def _checked(name: str, value: Any) -> Any:
    """Return a float or a read-only array (n,); traced values pass unchecked."""
    if value is None and name in ("yield_curvature", "yield_c0"):
        return None
    unit, rule = _FIELDS[name]
    if not is_known(value):
        return as_float(value)
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.array(math.nan)
    if array.ndim > (1 if name in _PER_NODE else 0):
        cure = "a number or an array (n,)" if name in _PER_NODE else "a single number"
        raise ValueError(f"{name} has shape {array.shape}; give {cure} in {unit}")
    good = np.isfinite(array) & ((array > 0) if rule is _POSITIVE else (array >= 0))
    if not good.all():
        bad = (
            f"{name} = {value!r}"
            if array.ndim == 0
            else f"{name}[{(i := int(np.argmin(good)))}] = {array[i]}"
        )
        raise ValueError(f"{bad} [{unit}] is not usable; give {rule}")
    array.flags.writeable = False
    return array if array.ndim else float(array)


def _check_length(name: str, value: Any, n: int) -> None:
    if np.ndim(value) and np.shape(value)[0] != n:
        raise ValueError(
            f"{name} has {np.shape(value)[0]} values but the mesh has {n} nodes; give one value per node"
        )


def changed(name: str, one: Material, other: Material) -> bool:
    """Return whether a property differs between two materials; a traced value counts as different."""
    values = [math.nan if value is None else value for value in (getattr(one, name), getattr(other, name))]
    return not (is_known(values) and np.array_equal(values[0], values[1], equal_nan=True))
