"""Integration schemes: the stages of a scheme and their options."""

from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp

from jaxcrumple._jax.arrays import HingeValues, NodeVectors, Scalar, ScalarLike
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float, is_number
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.explicit.base import AbstractExplicit
from jaxcrumple.solvers.explicit.stability import beside_walls, fastest, wall_stiffness
from jaxcrumple.solvers.explicit.verlet import Verlet
from jaxcrumple.solvers.implicit.base import AbstractImplicit
from jaxcrumple.solvers.implicit.bdf_pair import BDFPair
from jaxcrumple.solvers.implicit.variable_order import VariableOrder
from jaxcrumple.solvers.linear.base import AbstractLinearSolver
from jaxcrumple.solvers.linear.registry import choose_linear_solver
from jaxcrumple.solvers.switch import Switch
from jaxcrumple.state import EXPLICIT, IMPLICIT, QUASISTATIC, Limit, State

Scheme = Literal["hybrid", "dynamic", "alternating", "quasistatic", "explicit", "paper"]
SCHEMES = get_args(Scheme)
# Thresholds of the switch in units of rtol. Thresholds ten times higher cost the same and triple the error.
SWITCH_UP, SWITCH_DOWN = 3.0, 1.0

# Share of the tolerance that the local error of a step with inertia may use. SNAP_SHARE applies to inertia in
# snaps only: a snap damps most of its local errors. REFERENCE_SHARE applies to inertia throughout: it keeps
# the error of a run below rtol at order 2.
SNAP_SHARE, REFERENCE_SHARE = 0.1, 0.0008


class Integrator(eqx.Module):
    """Hold the stages of a scheme and their options; `integrator` builds one.

    - `stages`: the stages of the scheme; a new state starts in the first one.
    - `implicit`, `explicit`: methods of the implicit and explicit steps; None if no stage needs them.
    - `switch`: thresholds for changes of stage.
    - `first_step`: first implicit step of a run in s.
    - `restart_steps`: first quasistatic step after an explicit stage, in explicit stability limits.
    - `max_step`: largest step in s.
    """

    stages: tuple[int, ...] = eqx.field(static=True)
    implicit: AbstractImplicit | None
    explicit: AbstractExplicit | None
    switch: Switch
    first_step: Scalar = eqx.field(default=1e-4, converter=as_float)
    restart_steps: Scalar = eqx.field(default=10.0, converter=as_float)
    max_step: Scalar | float = eqx.field(default=jnp.inf, converter=as_float)

    def has(self, stage: int) -> bool:
        """Return whether the scheme has a `stage`: 0 quasistatic, 1 implicit, 2 explicit."""
        return stage in self.stages

    def stability_limit(
        self, scene: Scene, x: NodeVectors, t: ScalarLike, p: HingeValues | None = None
    ) -> Scalar:
        """Compute the largest stable explicit step in s.

        **Arguments:** `x` (n, 3): positions in m; `t`: time in s; `p` (h,): rest curvatures or None.
        """
        return self._method.stable(fastest(scene, x, t, p))

    def measured(self, scene: Scene, x: NodeVectors, t: ScalarLike, p: HingeValues | None) -> Limit:
        """Compute the stability limit and the stiffness of the walls, for `State.limit`.

        Arguments as of `stability_limit`.
        """
        return Limit(self.stability_limit(scene, x, t, p), wall_stiffness(scene, x, t))

    def limit(self, scene: Scene, state: State) -> Scalar:
        """Return the largest stable explicit step in s at a state.

        It is the scale of the shortest steps, also in schemes without explicit steps."""
        return beside_walls(scene, state.limit, state.x, state.t, self._method.stable)

    @property
    def _method(self) -> type[AbstractExplicit]:
        return Verlet if self.explicit is None else type(self.explicit)

    @property
    def one_matrix(self) -> bool:
        """Return whether the linear solver needs sheet and contact merged into one matrix."""
        return self.implicit is not None and self.implicit.linear.one_matrix


def switch_of(scheme: str, rtol: float, **options: Any) -> Switch:
    """Return the default switch of a scheme at tolerance `rtol`; `options` replace its fields.

    If `options` has `up` only, `down` keeps its ratio to `up`. The scheme "paper" has fixed thresholds, on
    another measure.
    """
    up = options.get("up", SWITCH_UP * rtol)
    own: dict[str, Any] = {"up": up, "down": up * SWITCH_DOWN / SWITCH_UP}
    if scheme == "paper":
        own = {"up": 1e-3, "down": 1e-6, "dwell": 0.0, "measure": "acceleration"}
    return Switch(**own | options)


def checked_solver(solver: Any) -> Integrator:
    """Return the solver of a run.

    **Raises:** ValueError for an object that is not an Integrator.
    """
    if not isinstance(solver, Integrator):
        raise ValueError(f"solver = {solver!r} must come from jaxcrumple.integrator(rtol, scheme=...).")
    return solver


@door
def integrator(
    rtol: float = 1e-2,
    *,
    scheme: str = "hybrid",
    linear: str | AbstractLinearSolver | None = None,
    switch: Switch | None = None,
    max_order: int = 5,
    rho_infinity: float = 0.0,
    max_step: Scalar | float = jnp.inf,
) -> Integrator:
    """Build an integrator with relative tolerance `rtol` and steps up to `max_step` s.

    Implicit steps are BDF of order 1 to 5 with variable steps (section 3.2 of the paper for its pair of
    orders 3 and 4), and a two-step family at order 2 with inertia. Explicit steps are velocity Verlet, in the
    scheme "paper" Runge-Kutta of order 4 (section 3.4).

    **Arguments:**

    - `rtol`: tolerance in the maximum norm, of positions relative to sqrt(A), and of rest curvatures relative
      to 2.
    - `scheme`: "hybrid" (inertia throughout, by implicit steps, or by explicit steps when the implicit steps
      become as short), "dynamic" (implicit with inertia), "alternating" (quasistatic; as "hybrid" when
      the accelerations require inertia), "quasistatic" (no inertia), "explicit", "paper" (the paper's scheme:
      BDF pair, explicit snaps, its thresholds and its preconditioner).
    - `linear`: a linear solver or its name; the default is "auto", and "block-cg" in the scheme "paper".
    - `switch`: thresholds for changes of stage; None for the scheme's defaults.
    - `max_order`: largest order of an implicit step, 1 to 5; steps with inertia have at least order 2.
    - `rho_infinity`: spectral radius at infinite frequency of implicit steps with inertia, from 0 to 1: the
      share of such a mode's amplitude that one step leaves.

    **Raises:** ValueError for a tolerance outside (0, 1), a step limit that is not positive, an unknown
    scheme, linear solver or switch, or an order or `rho_infinity` out of range.
    """
    if isinstance(rtol, str) or not 0 < rtol < 1:
        raise ValueError(f"rtol = {rtol!r} must be a number between 0 and 1; 1e-2 is a good start.")
    if isinstance(max_step, str) or not max_step > 0:
        raise ValueError(f"max_step = {max_step!r} s must be positive; leave it out for no limit.")
    if max_order not in (1, 2, 3, 4, 5):
        raise ValueError(f"max_order = {max_order!r} must be 1, 2, 3, 4 or 5.")
    if not is_number(rho_infinity) or not 0 <= rho_infinity <= 1:
        raise ValueError(f"rho_infinity = {rho_infinity!r} must lie between 0 and 1.")
    if scheme not in SCHEMES:
        raise ValueError(f"scheme {scheme!r} is unknown; choose one of {', '.join(SCHEMES)}.")
    if not (switch is None or isinstance(switch, Switch)):
        raise ValueError(f"switch = {switch!r} must be a jaxcrumple.Switch, or None for the scheme's own.")
    if linear is None:
        linear = "block-cg" if scheme == "paper" else "auto"
    solver = choose_linear_solver(linear)
    tolerance, rho = jnp.asarray(float(rtol)), jnp.asarray(float(rho_infinity))
    switch = switch or switch_of(scheme, rtol)
    explicit: AbstractExplicit = Verlet(tolerance)
    if scheme in ("explicit", "paper"):
        # Diffrax takes 0.3 s to import, and the default scheme does not need it once it is compiled.
        from jaxcrumple.solvers.explicit.runge_kutta import RungeKutta

        explicit = RungeKutta(tolerance)
    if scheme == "paper":
        return Integrator(
            (QUASISTATIC, EXPLICIT), BDFPair(tolerance, solver), explicit, switch, max_step=max_step
        )
    if scheme == "explicit":
        return Integrator((EXPLICIT,), None, explicit, switch, max_step=max_step)
    inertia = scheme != "quasistatic"
    share = jnp.asarray(SNAP_SHARE if scheme == "alternating" else REFERENCE_SHARE)
    steps = VariableOrder(tolerance, solver, rho, share, inertia=inertia, max_order=max_order)
    stages = {
        "hybrid": (IMPLICIT, EXPLICIT),
        "dynamic": (IMPLICIT,),
        # A start may have any velocity, so that it needs inertia.
        "alternating": (IMPLICIT, QUASISTATIC, EXPLICIT),
        "quasistatic": (QUASISTATIC,),
    }[scheme]
    return Integrator(stages, steps, explicit if EXPLICIT in stages else None, switch, max_step=max_step)
