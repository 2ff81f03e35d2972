"""`simulate_batch`: run many sheets side by side."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from jaxcrumple._jax.door import door
from jaxcrumple._jax.memory import require_run
from jaxcrumple._jax.tree import require_limit
from jaxcrumple.contact.lists import ContactLists
from jaxcrumple.observers import Observer
from jaxcrumple.replays.record import Record, StepRecorder
from jaxcrumple.scene import Scene, check_scene, with_lists
from jaxcrumple.simulation import Kept, Solution, Times, checked_times, solution_of
from jaxcrumple.solvers.scheme import Integrator, checked_solver, integrator
from jaxcrumple.solvers.start import check_start
from jaxcrumple.state import State, check_state
from jaxcrumple.sweeps.batch import LANES, require_lanes, run_batch
from jaxcrumple.sweeps.cases import blamed
from jaxcrumple.sweeps.members import Start


@door
def simulate_batch(
    scenes: Sequence[Scene],
    states: Sequence[State],
    times: Times,
    *,
    solver: Integrator | None = None,
    lanes: int = LANES,
    devices: Sequence[jax.Device] | None = None,
    max_attempts: int | None = None,
    max_seconds: float | None = None,
    record: bool = False,
) -> list[Solution]:
    """Run scenes from their states to the last of `times` (s) as lanes of one program.

    Each lane has its own steps, and equals its single run to rounding. Scenes of one kind (the same terms,
    and numbers of nodes, edges and hinges) share a program; others follow. On a GPU lanes run side by side,
    on a CPU one after the other.

    **Arguments:**

    - `scenes`, `states`: one state for each scene, at the same time or before the first frame.
    - `times`: as of `simulate`, the same for all.
    - `solver`: `integrator(...)` with a linear solver that supports batches, by default
      `integrator(linear="two-level")`.
    - `lanes`: most sheets side by side; ended ones make room for the others. `devices`: by default all of
      the default kind.
    - `max_attempts`, `max_seconds`: budget of each sheet, as of `simulate`; the wall time is that of the
      calls in which it took part.
    - `record`: keep the accepted steps of each sheet for `replay`.

    **Returns:** a `Solution` for each scene. A sheet that fails stops alone, with its last good state.

    **Raises:** ValueError for scenes and states that do not fit each other, or what `simulate` refuses.

    >>> import equinox as eqx
    >>> mesh = jc.hexagonal(3, 2, 5e-3)
    >>> scene = jc.sheet(mesh, jc.Material(yield_curvature=None), gravity=(0, 0, -9.81))
    >>> slow = eqx.tree_at(lambda s: s.gravity.g, scene, scene.gravity.g / 2)
    >>> state = jc.initial_state(scene, mesh.vertices)
    >>> fallen = jc.simulate_batch([scene, slow], [state, state], 0.1)
    >>> [f"{one.x[-1, :, 2].mean():.3e}" for one in fallen]  # m
    ['-9.712e-04', '-4.856e-04']
    """
    if not len(scenes) or len(scenes) != len(states):
        raise ValueError(f"{len(scenes)} scenes and {len(states)} states: give one state for each scene.")
    require_lanes(lanes)
    require_limit("max_attempts", max_attempts)
    require_limit("max_seconds", max_seconds)
    solver = integrator(linear="two-level") if solver is None else checked_solver(solver)
    stops = checked_times(times, 0, float(max(float(state.t) for state in states)))
    contact = scenes[0].contact is not None
    require_run(scenes[0].n_nodes, len(stops) * len(scenes), contact)
    seconds = np.inf if max_seconds is None else max_seconds
    members = [
        _Sheet(f"sheet {number}", scene, state, stops, solver, seconds, record)
        for number, (scene, state) in enumerate(zip(scenes, states, strict=True))
    ]
    place = jax.devices() if devices is None else devices
    run_batch(members, place, lanes, np.inf if max_attempts is None else max_attempts)
    return [member.solution() for member in members]


class _Sheet:
    """A scene and its state as a member of a batch."""

    def __init__(
        self,
        name: str,
        scene: Scene,
        state: State,
        times: Float[np.ndarray, " times"],
        solver: Integrator,
        seconds: float,
        record: bool,
    ):
        self.name, self.scene, self.state, self.times, self.seconds = name, scene, state, times, seconds
        self.kept, self.spent = Kept(), 0.0
        self.recorder = StepRecorder(state, solver) if record else None
        self.solver = solver if self.recorder is None else self.recorder.solver(solver)
        self.record: Record | None = None
        self.error: Exception | None = None

    @property
    def observers(self) -> Sequence[Observer]:
        """What keeps the frames."""
        return [self.kept]

    def begin(self) -> Start:
        """Check scene and state."""
        with blamed(self.name):
            check_scene(self.scene)
            check_state(self.scene, self.state)
            check_start(self.scene, self.state)
        return Start(self.scene, self.state, self.times, seconds=self.seconds, recorder=self.recorder)

    def pause(self) -> None:
        """Keep all: the sheet holds nothing."""

    def spend(self, seconds: float) -> None:
        """Add to the time of the sheet."""
        self.spent += seconds

    def end(self, state: State, result: str, lists: ContactLists | None) -> None:
        """Keep the last state, which has the result, and build the record."""
        self.state = state
        if self.recorder is not None:
            self.record = self.recorder.finished(with_lists(self.scene, lists), self.solver)

    def fail(self, error: Exception) -> None:
        """Keep an exception, which stops the caller after all others have ended."""
        self.error = error

    def solution(self) -> Solution:
        """Return the solution.

        **Raises:** the exception that ended the sheet.
        """
        if self.error is not None:
            raise self.error
        found = solution_of(self.scene, self.state, self.kept, 0.0, self.spent)
        found.record = self.record
        return found
