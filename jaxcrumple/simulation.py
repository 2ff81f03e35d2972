"""`simulate`: the host loop around `integrate`, with frames, records, observers and named results."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pandas as pd
from jaxtyping import ArrayLike, Float, Int, Real

from jaxcrumple._jax.arrays import Scalar, ScalarLike
from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require, require_run
from jaxcrumple._jax.program_cache import give_back, make_room
from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple._jax.threads import limited_blas
from jaxcrumple._jax.tree import as_float, is_number, require_limit
from jaxcrumple.model.loads import check_motion
from jaxcrumple.observers import NO_ROWS, Observer, tell_phase, tell_rows
from jaxcrumple.replays.record import Record, StepRecorder
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.reallocate import Reallocation
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.log import Log
from jaxcrumple.solvers.scheme import Integrator, checked_solver, integrator
from jaxcrumple.solvers.start import check_gap, check_start, in_the_way, pierced
from jaxcrumple.solvers.tables import events_table, history_table, joined
from jaxcrumple.state import RESULTS, State, check_state

# Shortest time in s between reports to observers; calls of `integrate` may be shorter.
CHUNK = 1.0
# A call of `integrate` lasts CALL seconds or SHORTEST attempts, whichever is longer. Longer calls save work,
# because each call rebuilds the contact lists and refactorises. Shorter calls report and checkpoint sooner.
CALL, SHORTEST = 8.0, 32.0
# Most steps in a call of a recorded run: the loop copies their positions with its other variables.
TRAIL = 256
# A call without steps that takes longer than this, in s, has compiled, and leaves much free memory.
COMPILED = 1.0
# Most consecutive calls that wait for a larger list and make no attempt: more than the lists can double.
MOST_WAITS = 100


def _load_libraries(scene: Scene, state: State, t_stop: Scalar, solver: Integrator, *others: Any) -> None:
    if solver.implicit is not None:
        solver.implicit.linear.load_library()


_integrate = StoredJit(integrate, _load_libraries)

# Frame times in s, or the end time alone.
Times = ScalarLike | Real[ArrayLike, " times"] | Sequence[float]

RESULT_NAMES = ("success", "budget", "collapsed", "blocked", "intersected", "nonfinite")


class SimulationError(RuntimeError):
    """Report a run that did not end in success; `solution` holds its last good state."""

    def __init__(self, solution: "Solution"):
        super().__init__(f"{solution.result}: {solution.message}")
        self.solution = solution


@dataclass(repr=False)
class Solution:
    """Hold what `simulate` returns.

    - `state`: the last good state; `result`: one of the names of `RESULTS`; `message`: its meaning and cure.
    - Frames at the times `t` (f,) in s that the run reached: positions `x` (f, n, 3) in m, velocities `v` (f,
      n, 3) in m/s, rest curvatures `p` (f, h) or None.
    - `history`: table with one row per step, or per 16 explicit steps; `events`: table of changes of stage.
    - `compile_s`, `run_s`: wall time in s of compiling, also again for longer contact lists, and of the rest.
    - `record`: the accepted steps for `replay` with `record=True`, else None.
    """

    state: State
    result: str
    message: str
    t: Float[np.ndarray, " frames"]
    x: Float[np.ndarray, "frames nodes 3"]
    v: Float[np.ndarray, "frames nodes 3"]
    p: Float[np.ndarray, "frames hinges"] | None
    history: pd.DataFrame
    events: pd.DataFrame
    compile_s: float
    run_s: float
    record: Record | None = None

    def __repr__(self) -> str:
        spent = f"{int(np.sum(self.state.counters.steps))} steps in {self.run_s:.1f} s"
        return f"Solution({self.result}, n = {self.x.shape[1]}, {len(self.t)} frames, {spent})"


@dataclass
class Kept:
    """An observer that keeps all frames and rows of a run."""

    t: list[float] = field(default_factory=list)
    x: list[Float[np.ndarray, "nodes 3"]] = field(default_factory=list)
    v: list[Float[np.ndarray, "nodes 3"]] = field(default_factory=list)
    p: list[Float[np.ndarray, " hinges"]] = field(default_factory=list)
    history: list[pd.DataFrame] = field(default_factory=list)
    events: list[pd.DataFrame] = field(default_factory=list)

    def frame(self, index: int, state: State) -> None:
        """Keep a frame."""
        self.t.append(float(state.t))
        self.x.append(np.asarray(state.x))
        self.v.append(np.asarray(state.v))
        if state.p is not None:
            self.p.append(np.asarray(state.p))

    def chunk(self, state: State, history: pd.DataFrame, events: pd.DataFrame, frames: int) -> None:
        """Keep rows."""
        self.history.append(history)
        self.events.append(events)


@door
def simulate(
    scene: Scene,
    state: State,
    times: Times,
    *,
    solver: Integrator | None = None,
    observers: Sequence[Observer] = (),
    first_frame: int = 0,
    max_attempts: int | None = None,
    max_seconds: float | None = None,
    throw: bool = False,
    record: bool = False,
) -> Solution:
    """Run a scene from a state to the last of `times` (s), with a frame at each of them.

    **Arguments:**

    - `times`: increasing frame times in s, or the end time alone.
    - `solver`: `integrator(...)`, by default `integrator()`.
    - `observers`: receive every frame and every chunk of steps; a `PhaseObserver` also every change of phase.
    - `first_frame`: index of the first of `times` that the run has not reached (for a resumed run).
    - `max_attempts`, `max_seconds`: budget of step attempts and of wall time; a run that exceeds one
      stops with the result "budget".
    - `throw`: raise `SimulationError` when the result is not "success".
    - `record`: keep the accepted steps, so that `replay` can differentiate the run. A recorded run solves its
      equations to a smaller residual, and keeps positions (n, 3) for each step.

    **Raises:** ValueError for times that are not finite, not increasing or before the state's time; a state
    of another scene or one that violates its supports; a motion that is not finite at a frame time; an object
    that is not a solver; a limit that is negative or not a number; frames that exceed the memory; or a start
    that no run can leave: behind a wall, with a hinge at 180 degrees or, in a scene with contact, passing
    through itself. `SimulationError` with `throw`.

    >>> mesh = jc.hexagonal(3, 2, 5e-3)
    >>> scene = jc.sheet(mesh, jc.Material(yield_curvature=None), gravity=(0, 0, -9.81))
    >>> state = jc.initial_state(scene, mesh.vertices)
    >>> solution = jc.simulate(scene, state, [0.05, 0.1])
    >>> solution.result, solution.x.shape  # frames, nodes, 3
    ('success', (2, 9, 3))
    >>> print(f"{solution.v[-1, :, 2].mean():.5f} m/s")  # -g / drag_rate, as the air drags
    -0.00981 m/s
    """
    check_state(scene, state)
    check_start(scene, state)
    stops = checked_times(times, first_frame, float(state.t))
    require_run(scene.n_nodes, len(stops) - first_frame, scene.contact is not None)
    if scene.prescribed is not None:
        for stop in stops[first_frame:]:
            check_motion(scene.prescribed, stop)
    solver = integrator() if solver is None else checked_solver(solver)
    require_limit("max_attempts", max_attempts)
    require_limit("max_seconds", max_seconds)
    kept, recorder = Kept(), None
    if record:
        recorder = StepRecorder(state, solver)
        solver = recorder.solver(solver)
    watchers = (kept, *observers)
    if solver.one_matrix and recorder is None:
        scene = eqx.tree_at(lambda s: s.pattern, scene, scene.pattern.for_factors())
    with limited_blas():
        reallocation = None
        if scene.contact is not None:
            tell_phase(watchers, "searching")
            reallocation = Reallocation(scene, solver.one_matrix)
            scene = reallocation.first(scene, state)
            check_gap(scene, state)
        tell_phase(watchers, "compiling")
        first_s = _compile(scene, state, solver, recorder)
        tell_phase(watchers, "stepping")
        budget = _Budget(state, max_attempts, max_seconds)
        state = eqx.tree_at(lambda s: s.result, state, RESULTS.success)
        for index in range(first_frame, len(stops)):
            scene, state = _advance(
                scene, state, stops[index], solver, watchers, index, budget, reallocation, recorder
            )
            if _name(state) != "success":
                break
            for watcher in watchers:
                watcher.frame(index, state)
            if recorder is not None:
                recorder.frame(stops[index])
            if scene.contact is not None and len(pierced(scene, state.x)):
                state = eqx.tree_at(lambda s: s.result, state, RESULTS.intersected)
                break
        run_s = budget.spent()
    solution = solution_of(scene, state, kept, first_s + budget.compile_s, run_s)
    if recorder is not None:
        solution.record = recorder.finished(scene, solver)
    if throw and solution.result != "success":
        raise SimulationError(solution)
    return solution


def frame_times(t_end: float, frames: int) -> Float[np.ndarray, " times"]:
    """Return `frames` + 1 evenly spaced times from 0 to `t_end` in s.

    **Raises:** ValueError for an end time that is not positive, or fewer frames than 1.

    >>> jc.frame_times(1.0, 4)
    array([0.  , 0.25, 0.5 , 0.75, 1.  ])
    """
    if not (is_number(t_end) and np.isfinite(t_end) and t_end > 0):
        raise ValueError(f"t_end = {t_end!r} s must be a positive time.")
    if not isinstance(frames, int | np.integer) or frames < 1:
        raise ValueError(f"frames = {frames!r} must be at least 1, a whole number.")
    require(8.0 * frames, f"a list of {frames} frame times", "choose fewer frames")
    return np.linspace(0.0, t_end, frames + 1)


def checked_times(times: Times, first_frame: int = 0, now: float = 0.0) -> Float[np.ndarray, " times"]:
    """Return the frame times in s as an array.

    **Raises:** ValueError for times that are not finite, not increasing or before `now`.
    """
    given = np.atleast_1d(np.asarray(times))
    stops = given.astype(float) if given.dtype.kind in "iuf" else np.array([np.nan])
    sound = stops.ndim == 1 and np.all(np.isfinite(stops)) and np.all(np.diff(stops) > 0)
    if not (sound and stops.size and stops[0] >= 0 and stops[-1] > 0):
        raise ValueError(
            f"times = {times!r} must be finite, increasing and end after 0: frame times in seconds, "
            "or the end time."
        )
    if not isinstance(first_frame, int | np.integer):
        raise ValueError(f"first_frame = {first_frame!r} must be a whole number.")
    if not 0 <= first_frame <= len(stops):
        raise ValueError(f"first_frame = {first_frame} lies outside the {len(stops)} frame times.")
    if first_frame < len(stops) and stops[first_frame] < now:
        raise ValueError(
            f"time {stops[first_frame]:g} s lies before the state's, {now:g} s; leave out times before it."
        )
    return stops


class _Budget:
    """Limit the attempts and the wall time of a run, without the `compile_s` of longer contact lists."""

    def __init__(self, state: State, attempts: int | None, seconds: float | None):
        self.first = int(attempts_of(state))
        self.attempts = np.inf if attempts is None else attempts
        self.seconds = np.inf if seconds is None else seconds
        self.start, self.compile_s = time.perf_counter(), 0.0

    def spent(self) -> float:
        """Return the wall time in s so far, without compiling."""
        return time.perf_counter() - self.start - self.compile_s

    def left(self, state: State) -> float:
        """Return how many attempts to make before the next check of the clock; 0 or less at a limit."""
        made, spent = int(attempts_of(state)) - self.first, self.spent()
        if spent >= self.seconds:
            return 0.0
        rate = made / spent
        soon = max(SHORTEST, rate * CALL)
        if np.isfinite(self.seconds):
            soon = min(soon, 1 + rate * (self.seconds - spent))
        return min(self.attempts - made, np.ceil(soon))


def attempts_of(states: State) -> Int[np.ndarray, " *lanes"]:
    """Return the number of step attempts of a state, or of each lane of stacked states."""
    steps, rejected = np.asarray(states.counters.steps), np.asarray(states.counters.rejected)
    return np.asarray(steps.sum(axis=-1) + rejected.sum(axis=-1))


def _compile(scene: Scene, state: State, solver: Integrator, recorder: StepRecorder | None) -> float:
    """Compile by a call without steps, and return its wall time in s."""
    make_room(scene, state, solver, recorder is None)
    start = time.perf_counter()
    jax.block_until_ready(_called(scene, state, state.t, solver, as_float(0.0), recorder))
    took = time.perf_counter() - start
    if took > COMPILED:
        give_back()
    return took


def _called(
    scene: Scene,
    state: State,
    t_stop: Scalar,
    solver: Integrator,
    left: Scalar,
    recorder: StepRecorder | None,
) -> tuple[State, Log]:
    """Call `integrate` once."""
    if recorder is None:
        return _integrate(scene, state, t_stop, solver, left)
    state, log = _integrate(scene, state, t_stop, solver, left, TRAIL)
    recorder.extend(log.trail)
    return state, log


def _advance(
    scene: Scene,
    state: State,
    t_stop: float,
    solver: Integrator,
    watchers: Sequence[Observer],
    frames: int,
    budget: _Budget,
    reallocation: Reallocation | None,
    recorder: StepRecorder | None,
) -> tuple[Scene, State]:
    rows, told, waits = [], time.perf_counter(), 0
    while float(state.t) < t_stop:
        left, made = budget.left(state), int(attempts_of(state))
        if left <= 0:
            state = eqx.tree_at(lambda s: s.result, state, RESULTS.budget)
        else:
            state, log = _called(scene, state, as_float(t_stop), solver, as_float(left), recorder)
            rows.append(np.asarray(log.rows)[: int(log.length)].copy())
            waits = waits + 1 if int(attempts_of(state)) == made else 0
        if waits > MOST_WAITS and _name(state) == "success":
            state = eqx.tree_at(lambda s: s.result, state, RESULTS.collapsed)
        over = _name(state) != "success" or float(state.t) >= t_stop
        if over or time.perf_counter() - told > CHUNK:
            tell_rows(watchers, state, rows, frames)
            rows, told = [], time.perf_counter()
        if over:
            break
        if reallocation is not None:
            grows = reallocation.overflows(state)
            if grows:
                tell_phase(watchers, "compiling")
            scene = reallocation(scene, state)
            if grows:
                budget.compile_s += _compile(scene, state, solver, recorder)
                tell_phase(watchers, "stepping")
    return scene, state


def _name(state: State) -> str:
    """Return the name of the state's result."""
    for name in RESULT_NAMES:
        if bool(state.result == getattr(RESULTS, name)):
            return name
    raise AssertionError("unknown result")


def message_of(scene: Scene, state: State, name: str) -> str:
    """Return the meaning of the result `name` of a run that ended in a state."""
    message: str = RESULTS[getattr(RESULTS, name)]  # type: ignore[misc]
    place = in_the_way(scene, state) if name == "blocked" else ""
    return f"{message}. Here {place}" if place else message


def solution_of(scene: Scene, state: State, kept: Kept, compile_s: float, run_s: float) -> Solution:
    """Return the solution of a run that ended in a state, with all that was kept of it."""
    name = _name(state)
    shape = state.x.shape
    return Solution(
        state=state,
        result=name,
        message=message_of(scene, state, name),
        t=np.array(kept.t),
        x=np.array(kept.x).reshape(-1, *shape),
        v=np.array(kept.v).reshape(-1, *shape),
        p=None if state.p is None else np.array(kept.p).reshape(-1, state.p.shape[0]),
        history=joined(kept.history, history_table(NO_ROWS)),
        events=joined(kept.events, events_table(NO_ROWS)),
        compile_s=compile_s,
        run_s=run_s,
    )
