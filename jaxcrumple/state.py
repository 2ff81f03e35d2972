"""The state of a run: all variables that evolve, and the step history of the implicit stages."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import Count, Flag, HingeValues, NodeValues, NodeVectors, NodeVectorsLike, Scalar
from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require
from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple._jax.tree import as_float, is_known, require_finite
from jaxcrumple.contact.lists import Reference, nowhere
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.history import History, Linearization, no_linearization, restart_history
from jaxcrumple.model.loads import check_supported
from jaxcrumple.scene import Scene, check_scene

# In contact ranges: largest skin of the first list of site pairs, and smallest skin of the first list of
# pairs that have entries in the matrix of a direct solver.
FIRST, FIRST_PLACED = 0.25, 0.75
QUASISTATIC, IMPLICIT, EXPLICIT = 0, 1, 2
STAGES = ("quasistatic", "implicit", "explicit")
CAUSES = ("error", "newton", "unstable", "fold", "nonfinite", "contact")


class RESULTS(eqx.Enumeration):
    """Name how a run ended: success, budget, collapsed, blocked, intersected or nonfinite.

    `RESULTS[state.result]` says in words what a member means, and what to do.
    """

    success = "the run reached its end time"
    budget = "the budget of step attempts or wall time is used up before the end time; resume to continue"
    collapsed = (
        "in every stage of the scheme the step size fell below the resolution of float64, or no contact list "
        "was valid for a whole step; the run keeps the last good state. Look at the causes of rejection, and "
        "try another scheme, a smaller rtol or more drag"
    )
    blocked = (
        "even the shortest step makes the sheet pass through itself or a wall; the run keeps the last good "
        "state. The prescribed motion leaves no room, or the start is too deep in contact, or layers meet "
        "faster than contact stops them: try a higher contact level, a finer mesh, or more drag"
    )
    intersected = (
        "the sheet passes through itself in the last frame; contact should have prevented this, please "
        "report it"
    )
    nonfinite = (
        "forces are not finite in the current state; the run keeps that state. Look for zero-length "
        "edges, layers within the core of a barrier, or a parameter that is NaN"
    )


class Monitor(eqx.Module):
    """Hold the acceleration monitor.

    `ratios`: the last ratios a_max/a_ref; `steps` and `since`: steps and time in s since the stage began;
    `measured`: whether the stability limit was measured after the last step; `futile`: number of consecutive
    implicit stages that ended after a few steps."""

    ratios: Float[Array, " window"]
    steps: Count
    since: Scalar
    measured: Flag
    futile: Count


class Counters(eqx.Module):
    """Count the work of a run.

    `steps`: accepted steps by stage; `rejected`: rejected steps by cause, in the order of `CAUSES`; `newton`:
    Newton iterations, of one linear solve each; `linear`: iterations of these solves; `factors`:
    factorisations; `switches`: changes of stage."""

    steps: Int[Array, " stages"]
    rejected: Int[Array, " causes"]
    newton: Count
    linear: Count
    factors: Count
    switches: Count


class Work(NamedTuple):
    """Hold the work on the sheet in J since the start, by source.

    `walls`: work of walls and time-dependent loads; `supports`: work of the prescribed motion; `drag`,
    `damping`, `plastic`: dissipation, negative; `numerical`: energy that the integration adds (positive) or
    loses (negative).
    """

    walls: Scalar
    supports: Scalar
    drag: Scalar
    damping: Scalar
    plastic: Scalar
    numerical: Scalar


def no_work() -> Work:
    """Return the work ledger of a start: zeros."""
    return Work(*(jnp.zeros(()) for _ in Work._fields))


class Slopes(NamedTuple):
    """Hold the derivatives at the state that the last explicit step computed.

    `acceleration` (n, 3) in m/s2; `flow` (h,) in 1/s: dp/dt; `known`: whether both are valid."""

    acceleration: NodeVectors
    flow: HingeValues | None
    known: Flag


class Listing(eqx.Module):
    """Record for which motions the contact lists were built, so that a saved state rebuilds the same lists.

    `candidates`, `pairs`, `active`, `matrix`: references of the four lists of `ContactLists`; `stale`:
    whether a pair lacks its entries in the matrix; `needed` (4,): 0, or the required capacities after an
    overflow: the three of `SitePairs.needed`, and that of the candidates.
    """

    candidates: Reference
    pairs: Reference
    active: Reference
    matrix: Reference
    stale: Flag
    needed: Int[Array, "4"]


class Limit(NamedTuple):
    """Hold the last measured stability limit: the largest stable explicit `step` in s, and the stiffness
    (n,) in N/m of `walls` at that measurement."""

    step: Scalar
    walls: NodeValues


class State(eqx.Module):
    """Hold all variables that evolve. Its structure is fixed, so that a checkpoint is the whole State.

    `initial_state` builds one. Users read the first four fields, `counters` and `work`.

    - `t` in s; `x` (n, 3) in m; `v` (n, 3) in m/s; `p` (h,): dimensionless rest curvatures, or None in an
      elastic scene.
    - `counters`: accepted and rejected steps, iterations and factorisations. `work`: the work ledger in J, or
      None. `result`: a member of `RESULTS`.
    - `h`, `h_explicit`: next step of the implicit stages and of the explicit stage in s; `limit`: stability
      limit of explicit steps, measured at intervals; `stage`: 0 quasistatic, 1 implicit, 2 explicit, -1 the
      first stage of the scheme.
    - `slopes`: derivatives that an explicit step passes to the next; `listing`: where the contact lists were
      built, None without contact; `history`: past points of the implicit stages; `kept`: where the last
      tangent of the implicit steps was computed; `monitor` of the accelerations.
    """

    t: Scalar
    x: NodeVectors
    v: NodeVectors
    p: HingeValues | None
    h: Scalar
    h_explicit: Scalar
    limit: Limit
    stage: Count
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
    scene: Scene,
    x: NodeVectorsLike,
    v: NodeVectorsLike | None = None,
    *,
    window: int = 5,
    ledger: bool = False,
) -> State:
    """Build the state at t = 0 with positions `x` (n, 3) in m and velocities `v` (n, 3) in m/s (default 0).

    **Arguments:** `window`: number of steps that the acceleration monitor averages; `ledger`: whether runs
    from the state keep the work ledger (`Work`), which costs little in implicit steps, and two force
    evaluations in each explicit step.

    **Raises:** ValueError for positions or velocities of another shape or not finite, positions that differ
    from those of the supports, an empty window, or an object that is not a Scene.

    >>> mesh = jc.hexagonal(4, 2, 2e-3)
    >>> state = jc.initial_state(jc.sheet(mesh, jc.Material()), mesh.vertices)
    >>> state.x.shape, state.p.shape, float(state.t)  # nodes, hinges, s
    ((12, 3), (13,), 0.0)
    """
    check_scene(scene)
    if not isinstance(window, int | np.integer) or window < 1:
        raise ValueError(f"window = {window!r} must be at least 1 step.")
    require(8.0 * window, f"a monitor of {window} steps", "choose a shorter window")
    x = as_float(x)
    v = as_float(np.zeros(x.shape)) if v is None else as_float(v)
    for name, value in (("x", x), ("v", v)):
        check_positions(name, value, scene.n_nodes)
    _check_supports(scene, x, as_float(0.0))
    return _first_state(scene, x, v, int(window), ledger)


@StoredJit
def _first_state(scene: Scene, x: NodeVectors, v: NodeVectors, window: int, ledger: bool) -> State:
    """Return the state at t = 0."""
    # Explicit types, because weakly typed leaves make the second call of a program compile again.
    nought, zero = jnp.asarray(0.0, float), jnp.asarray(0, int)
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


def fresh_monitor(window: int, futile: Count | int = 0) -> Monitor:
    """Build the monitor of the last `window` steps at the start of a stage, after `futile` futile stages."""
    zero, futile = jnp.asarray(0, int), jnp.asarray(futile, int)
    return Monitor(jnp.zeros(window), zero, jnp.asarray(0.0, float), jnp.asarray(False), futile)


@StoredJit
def _memory(
    scene: Scene, x: NodeVectors, v: NodeVectors, p: HingeValues | None
) -> tuple[Slopes, History, Linearization, Listing | None]:
    """Return the slopes, history, tangent record and listing of a state without a past."""
    slopes = Slopes(jnp.zeros_like(x), None if p is None else jnp.zeros_like(p), jnp.asarray(False))
    history = restart_history(x, v, p)
    listing = None if scene.contact is None else first_listing(scene.contact, x)
    return slopes, history, no_linearization(scene, history), listing


def first_listing(contact: Contact, x: NodeVectors) -> Listing:
    """Return the listing of a run that starts at positions `x` (n, 3)."""
    candidates = Reference(x, jnp.broadcast_to(contact.calm, x.shape[0]))
    pairs = Reference(x, jnp.minimum(candidates.skin, FIRST * contact.range))
    matrix = Reference(x, jnp.maximum(candidates.skin, FIRST_PLACED * contact.range))
    active = nowhere(x.shape[0])
    return Listing(candidates, pairs, active, matrix, jnp.asarray(False), jnp.zeros(4, int))


def restarted(scene: Scene, state: State, x: NodeVectors, v: NodeVectors) -> State:
    """Return the state at new positions `x` (n, 3) in m and velocities `v` (n, 3) in m/s.

    It keeps stage, step sizes, counters and p, and forgets history, tangent, listing and monitor."""
    return eqx.tree_at(
        lambda s: (s.x, s.v, s.slopes, s.history, s.kept, s.listing, s.monitor),
        state,
        (x, v, *_memory(scene, x, v, state.p), fresh_monitor(state.monitor.ratios.shape[0])),
        is_leaf=lambda leaf: leaf is None,
    )


def check_state(scene: Scene, state: State) -> None:
    """Check that a state fits a scene and satisfies the scene's supports.

    **Raises:** ValueError that states the difference.
    """
    check_fits(scene, state)
    _check_supports(scene, state.x, state.t)


def check_fits(scene: Scene, state: State) -> None:
    """Check that a state fits a scene, wherever its supports hold it.

    **Raises:** ValueError that states the difference.
    """
    check_scene(scene)
    if not isinstance(state, State):
        raise ValueError(f"state has type {type(state).__name__}; it must be a State from initial_state.")
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


def _check_supports(scene: Scene, x: NodeVectors, t: Scalar) -> None:
    if scene.prescribed is not None:
        check_supported(scene.prescribed, x, t, scene.length_scale)


def check_positions(name: str, value: Any, nodes: int) -> None:
    """Check that `value` has shape (nodes, 3) and is finite.

    **Raises:** ValueError that states the shape, or names the first node with a number that is not finite.
    """
    if np.shape(value) != (nodes, 3):
        raise ValueError(f"{name} has shape {np.shape(value)}; it must be ({nodes}, 3).")
    if not is_known(value):
        return
    array = np.asarray(value)
    bad = np.flatnonzero(~np.all(np.isfinite(array), axis=1))
    if bad.size:
        raise ValueError(f"{name} of node {bad[0]} is {array[bad[0]]}; it must be finite.")
