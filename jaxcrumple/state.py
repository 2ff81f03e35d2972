"""The state of a run: all that evolves, and what the implicit steps know of the past."""

from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require
from jaxcrumple._jax.tree import as_float, is_known, require_finite
from jaxcrumple.contact.energy import Contact
from jaxcrumple.contact.lists import Around, nowhere
from jaxcrumple.model.loads import check_supported
from jaxcrumple.scene import Scene, check_scene

# Reach in ranges of the first list of sites at most, and of the first places in the matrix at least.
FIRST, FIRST_PLACED = 0.25, 0.75
# Points the multistep history holds: BDF5 and the predictor that its error estimate needs.
HISTORY = 6
QUASISTATIC, IMPLICIT, EXPLICIT = 0, 1, 2
STAGES = ("quasistatic", "implicit", "explicit")
CAUSES = ("error", "newton", "unstable", "fold", "nonfinite", "contact")
# Age of a tangent that no step may use.
NEVER = 1_000_000


class RESULTS(eqx.Enumeration):  # type: ignore[misc]
    """How a run ended."""

    success = "the run reached its end time"
    budget = "the budget of step attempts or of wall time was used up before the end time; resume to go on"
    collapsed = (
        "the step size fell below what float64 resolves in every stage the scheme has, or no lists of "
        "contact held for a step; the last good state is kept. Look at the causes of rejection, and try "
        "another scheme, a smaller rtol or more drag"
    )
    blocked = (
        "no step, however short, keeps the sheet from passing through itself or a wall; the last good state "
        "is kept. The prescribed motion leaves no room, or a start lies in contact too deep, or layers meet "
        "faster than the penalty stops them: try contact by a barrier, a finer mesh, or more drag"
    )
    intersected = (
        "the sheet passes through itself in the last frame, which contact should have prevented; please "
        "report it"
    )
    nonfinite = (
        "forces are not finite in the current state; it is kept as it was. Look for zero-length "
        "edges, layers within the core of a barrier, or a parameter that is NaN"
    )


class History(eqx.Module):
    """Accepted points of the implicit stages, newest first.

    `x` and `v` (6, n, 3); `p` (6, h) or None; `steps` (6,): `steps[j]` is the time between
    points j and j+1; `count`: how many points are valid. 0 means that the one point's velocity need
    not balance the forces (a start, or the end of an explicit stage): a quasistatic step aligns it.
    `order`: order of the next step, where its stage allows it.
    """

    x: Array
    v: Array
    p: Array | None
    steps: Array
    count: Array
    order: Array


class ImplicitStep(eqx.Module):
    """What an implicit step knows of the past: $\\dot y = (y + \\sum_j \\alpha_j y_j)/(\\beta h)$ (eq. 39).

    `t` time of the equations; `beta_h` in s; `x_memory` (n, 3), `p_memory` (h,) and `damping_memory`
    hold $\\sum_j \\alpha_j y_j$; so does `v_memory` (n, 3), or it is None where no stage has inertia.
    `inertia` is 1 with the inertial force and 0 without.
    """

    t: Array
    beta_h: Array
    x_memory: Array
    v_memory: Array | None
    p_memory: Array | None
    damping_memory: Any
    inertia: Array

    def velocity(self, x: Array) -> Array:
        """Velocity (n, 3) that the formula gives for new positions `x`."""
        return (x + self.x_memory) / self.beta_h

    def acceleration(self, v: Array) -> Array:
        """Acceleration (n, 3) that the formula gives for new velocities `v`; 0 without inertia."""
        if self.v_memory is None:
            return jnp.zeros_like(v)
        return self.inertia * (v + self.v_memory) / self.beta_h


class Points(Protocol):
    """Points of the past, newest first: positions and velocities (6, n, 3), p (6, h) or None."""

    @property
    def x(self) -> Array:
        """Positions in m."""

    @property
    def v(self) -> Array:
        """Velocities in m/s."""

    @property
    def p(self) -> Array | None:
        """Rest curvatures."""


def implicit_step(
    scene: Scene, history: Points, alpha: Array, beta_h: Array, t: Array, inertia: Array | None = None
) -> ImplicitStep:
    """The implicit step with equations at time `t`, coefficients `alpha` (6,) over the history, and with
    `inertia` (0 or 1), or never any (None)."""
    return ImplicitStep(
        t=t,
        beta_h=beta_h,
        x_memory=jnp.tensordot(alpha, history.x, 1),
        v_memory=None if inertia is None else jnp.tensordot(alpha, history.v, 1),
        p_memory=None if history.p is None else alpha @ history.p,
        damping_memory=None if scene.damping is None else scene.damping.memory(history.x, alpha),
        inertia=jnp.zeros(()) if inertia is None else inertia,
    )


class Linearization(eqx.Module):
    """Where a tangent was taken: in which `step`, at which positions `x` (n, 3), `age` steps ago."""

    step: ImplicitStep
    x: Array
    age: Array


class Monitor(eqx.Module):
    """The acceleration monitor: last ratios a_max/a_ref, steps and time since the stage began, whether the
    stability limit was measured since the last step, and how many implicit stages in a row were `futile`:
    over at once."""

    ratios: Array
    steps: Array
    since: Array
    measured: Array
    futile: Array


class Counters(eqx.Module):
    """What has been spent: accepted `steps` by stage, `rejected` ones by cause in the order of `CAUSES`,
    `newton` iterations (each one linear solve), `linear` iterations of the solves, `factors` made."""

    steps: Array
    rejected: Array
    newton: Array
    linear: Array
    factors: Array
    switches: Array


class Work(NamedTuple):
    """Work on the sheet in J since the start, by what does it.

    `walls`: walls and loads that change with time; `supports`: prescribed motion; `drag`, `damping`,
    `plastic`: what these dissipate, negative; `numerical`: what the integration adds or, negative, loses.
    """

    walls: Array
    supports: Array
    drag: Array
    damping: Array
    plastic: Array
    numerical: Array


def no_work() -> Work:
    """The ledger at the start."""
    return Work(*(jnp.zeros(()) for _ in Work._fields))


class Slopes(NamedTuple):
    """Derivatives at the state as the last explicit step handed them on: `acceleration` (n, 3) in m/s2 and
    `flow` (h,) in 1/s, that of p; whether they are `known`."""

    acceleration: Array
    flow: Array | None
    known: Array


class Listing(eqx.Module):
    """What the lists of contact are made for, so that a saved state finds the same ones.

    `candidates`, `near`, `active`: as in `Contact`; `matrix`: pairs of triangles that have a place in the
    matrix of a direct solver, `stale` where one lacks it; `needed` (4,): 0, or what the lists must hold where
    one was too short: as `Near.needed`, and candidates.
    """

    candidates: Around
    near: Around
    active: Around
    matrix: Around
    stale: Array
    needed: Array


class Limit(NamedTuple):
    """Largest stable explicit `step` in s where it was measured, and the stiffness (n,) in N/m of `walls`
    there."""

    step: Array
    walls: Array


class State(eqx.Module):
    """All that evolves. Fixed structure, so that a checkpoint is the whole State.

    `t` s; `x` (n, 3) m; `v` (n, 3) m/s; `p` (h,) rest curvature or None in an elastic scene; `h`,
    `h_explicit`: next step of the implicit stages and of the explicit one in s; `limit`: of
    explicit steps, measured now and then; `stage`: `QUASISTATIC`, `IMPLICIT`, `EXPLICIT`, or -1 for that in
    which the scheme starts; `slopes`: what explicit steps hand on; `listing`: None without contact; `kept`:
    where the tangent was taken with which the last implicit step ended; `work`: the work ledger, None where
    none is kept.
    """

    t: Array
    x: Array
    v: Array
    p: Array | None
    h: Array
    h_explicit: Array
    limit: Limit
    stage: Array
    slopes: Slopes
    listing: Listing | None
    history: History
    kept: Linearization
    monitor: Monitor
    counters: Counters
    result: RESULTS
    work: Work | None


@door
def initial_state(
    scene: Scene, x: ArrayLike, v: ArrayLike | None = None, *, window: int = 5, ledger: bool = False
) -> State:
    """State at t = 0 with positions `x` (n, 3) in m and velocities `v` (n, 3) in m/s (default 0).

    `window` is the number of steps the acceleration monitor averages; `ledger`: whether runs from the state
    keep the work ledger (`Work`), which costs little in implicit steps and two forces in explicit ones.

    **Raises:** ValueError for positions or velocities of another shape or not finite, positions that are not
    where supports hold them, an empty window, or what is no scene.
    """
    check_scene(scene)
    if not isinstance(window, int | np.integer) or window < 1:
        raise ValueError(f"window = {window!r} must be at least 1 step.")
    require(8.0 * window, f"a monitor of {window} steps", "choose a shorter window")
    x = as_float(x)
    v = jnp.zeros_like(x) if v is None else as_float(v)
    for name, value in (("x", x), ("v", v)):
        check_positions(name, value, scene.n_nodes)
    nought = jnp.asarray(0.0, float)
    _check_supports(scene, x, nought)
    # Explicit types: weakly typed leaves would make the second call of a program compile again.
    zero = jnp.asarray(0, int)
    p = None if scene.plasticity is None else scene.bending.rest_curvature
    slopes, history, kept, listing = _memory(scene, x, v, p)
    return State(
        t=nought,
        x=x,
        v=v,
        p=p,
        h=nought,
        h_explicit=nought,
        limit=Limit(nought, jnp.zeros(scene.n_nodes)),
        stage=jnp.asarray(-1, int),
        slopes=slopes,
        listing=listing,
        history=history,
        kept=kept,
        monitor=fresh_monitor(window),
        counters=Counters(jnp.zeros(len(STAGES), int), jnp.zeros(len(CAUSES), int), zero, zero, zero, zero),
        result=RESULTS.success,  # type: ignore[arg-type]
        work=no_work() if ledger else None,
    )


def fresh_monitor(window: int, futile: ArrayLike = 0) -> Monitor:
    """Monitor at the start of a stage, of the last `window` steps, after so many `futile` stages."""
    zero, futile = jnp.asarray(0, int), jnp.asarray(futile, int)
    return Monitor(jnp.zeros(window), zero, jnp.asarray(0.0, float), jnp.asarray(False), futile)


def _memory(
    scene: Scene, x: Array, v: Array, p: Array | None
) -> tuple[Slopes, History, Linearization, Listing | None]:
    """What a state knows that begins here."""
    slopes = Slopes(jnp.zeros_like(x), None if p is None else jnp.zeros_like(p), jnp.asarray(False))
    history = restart_history(x, v, p)
    listing = None if scene.contact is None else first_listing(scene.contact, x)
    return slopes, history, _no_linearization(scene, history), listing


def _no_linearization(scene: Scene, history: History) -> Linearization:
    """One that no step may use."""
    nought, one = jnp.zeros(()), jnp.ones(())
    step = implicit_step(scene, history, jnp.zeros(HISTORY), one, nought, nought)
    return Linearization(step, history.x[0], jnp.asarray(NEVER, int))


def first_listing(contact: Contact, x: Array) -> Listing:
    """Where a run that starts at positions `x` (n, 3) searches."""
    around = Around(x, jnp.broadcast_to(contact.calm, x.shape[0]))
    near = Around(x, jnp.minimum(around.reach, FIRST * contact.range))
    matrix = Around(x, jnp.maximum(around.reach, FIRST_PLACED * contact.range))
    active = nowhere(x.shape[0])
    return Listing(around, near, active, matrix, jnp.asarray(False), jnp.zeros(4, int))


def restarted(scene: Scene, state: State, x: Array, v: Array) -> State:
    """The state at other positions `x` (n, 3) in m and velocities `v` (n, 3) in m/s: it remembers nothing of
    others but its stage and its steps."""
    return eqx.tree_at(
        lambda s: (s.x, s.v, s.slopes, s.history, s.kept, s.listing, s.monitor),
        state,
        (x, v, *_memory(scene, x, v, state.p), fresh_monitor(state.monitor.ratios.shape[0])),
        is_leaf=lambda leaf: leaf is None,
    )


def restart_history(x: Array, v: Array, p: Array | None) -> History:
    """History that holds the current point alone, with a velocity that nobody vouches for."""

    def repeat(a: Array, times: int) -> Array:
        return jnp.broadcast_to(a, (times, *a.shape))

    past = None if p is None else repeat(p, HISTORY)
    one = jnp.asarray(1, int)
    return History(repeat(x, HISTORY), repeat(v, HISTORY), past, jnp.ones(HISTORY), one - 1, one)


def check_state(scene: Scene, state: State) -> None:
    """Refuse a state of another scene, or one that is not where the scene's supports hold it.

    **Raises:** ValueError that says in what they differ.
    """
    check_scene(scene)
    if not isinstance(state, State):
        raise ValueError(f"state has type {type(state).__name__}; it must be what initial_state makes.")
    cure = "start from initial_state(scene, x) of the same scene."
    if state.x.shape != (scene.n_nodes, 3):
        raise ValueError(f"the state has positions {state.x.shape}, the scene {scene.n_nodes} nodes; {cure}")
    for kinds, its, wanted in (
        (("an elastic", "a plastic"), state.p is not None, scene.plasticity is not None),
        (("a phantom", "a self-avoiding"), state.listing is not None, scene.contact is not None),
    ):
        if its != wanted:
            raise ValueError(f"the state is of {kinds[its]} scene, the scene is {kinds[wanted]} one; {cure}")
    for name, value in (("x", state.x), ("v", state.v)):
        check_positions(f"the state's {name}", value, scene.n_nodes)
    hinges = scene.bending.rest_curvature.shape
    if state.p is not None and state.p.shape != hinges:
        raise ValueError(f"the state has {state.p.shape[0]} hinges, the scene {hinges[0]}; {cure}")
    if state.p is not None:
        require_finite("the state's p", state.p)
    _check_supports(scene, state.x, state.t)


def _check_supports(scene: Scene, x: Array, t: Array) -> None:
    if scene.prescribed is not None:
        check_supported(scene.prescribed, x, t, scene.length_scale)


def check_positions(name: str, value: Any, nodes: int) -> None:
    """Refuse what is not three finite numbers for each node.

    **Raises:** ValueError that names the first node in question.
    """
    if np.shape(value) != (nodes, 3):
        raise ValueError(f"{name} has shape {np.shape(value)}; it must be ({nodes}, 3).")
    if not is_known(value):
        return
    array = np.asarray(value)
    bad = np.flatnonzero(~np.all(np.isfinite(array), axis=1))
    if bad.size:
        raise ValueError(f"{name} of node {bad[0]} is {array[bad[0]]}; it must be finite.")
