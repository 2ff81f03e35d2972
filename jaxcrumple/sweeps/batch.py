"""Run all cases of a sweep as one program: lanes with individual step sizes, stages and results."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh as DeviceMesh
from jaxtyping import Bool, Float, Int, Shaped

from jaxcrumple._jax.memory import require
from jaxcrumple._jax.program_cache import make_room
from jaxcrumple._jax.threads import limited_blas
from jaxcrumple.scene import Scene
from jaxcrumple.simulation import MOST_WAITS, RESULT_NAMES
from jaxcrumple.solvers.contact.reallocate import batch_with_contacts
from jaxcrumple.solvers.start import check_gap, check_start, pierced
from jaxcrumple.state import RESULTS, State, initial_state
from jaxcrumple.sweeps import lanes
from jaxcrumple.sweeps.cases import Case, Limits, blamed
from jaxcrumple.sweeps.lanes import AXIS, Inputs, differing, lane, lanes_of, spread, stacked
from jaxcrumple.sweeps.size_class import SizeClass
from jaxcrumple.sweeps.table import Frames, Measure, Outcome, Tell

# Bytes per node and lane of a scene and a state.
LANE = 6e3


def run_batch(
    cases: Sequence[Case],
    times: Float[np.ndarray, " times"],
    measure: Measure,
    limits: Limits,
    devices: Sequence[jax.Device],
    tell: Tell,
) -> list[Outcome]:
    """Run the cases side by side and return their outcomes.

    **Raises:** ValueError if the cases differ in mesh or kind, or if a start is impossible.
    """
    if any(case.solver.one_matrix for case in cases):
        raise ValueError(
            "the direct solver handles one sheet at a time; choose linear='two-level' or backend='processes'."
        )
    with limited_blas():
        batch = _Batch(cases, times, limits, devices)
        make_room(len(cases), batch.setups[0].scene, cases[0].solver)
        frames = [Frames(measure, setup) for setup in batch.setups]
        while np.any(batch.going):
            batch.advance()
            for index, state in batch.arrived():
                if not frames[index].take(state):
                    batch.stop(index)
            for index in batch.ended():
                tell(cases[index].name, frames[index].outcome(batch.results[index]).result)
    states = jax.device_get(batch.states)
    return [own.outcome(batch.results[index], lane(states, index)) for index, own in enumerate(frames)]


class _Batch:
    """State of all lanes; each lane advances from frame to frame with its own steps."""

    def __init__(
        self,
        cases: Sequence[Case],
        times: Float[np.ndarray, " times"],
        limits: Limits,
        devices: Sequence[jax.Device],
    ):
        self.times, self.limits = times, limits
        self.setups = [cases[0].build()]
        _check_size(len(cases), self.setups[0].mesh.n_nodes)
        self.setups += [case.build() for case in cases[1:]]
        sizes = SizeClass.of([setup.scene for setup in self.setups])
        self.setups = [setup._replace(scene=sizes.padded(setup.scene)) for setup in self.setups]
        states = [initial_state(setup.scene, setup.x) for setup in self.setups]
        self.solvers = [case.solver for case in cases]
        for case, setup, state in zip(cases, self.setups, states, strict=True):
            with blamed(case.name):
                check_start(setup.scene, state)
        scenes = [setup.scene for setup in self.setups]
        self.own = differing(list(zip(scenes, self.solvers, strict=True)))
        self.scenes = _listed(cases, scenes, states)
        count = min(len(devices), len(cases))
        self.devices = DeviceMesh(np.array(devices[:count]), (AXIS,))
        # Each device has the same number of lanes; spare lanes repeat the last case and never start.
        self.spare = -len(cases) % count
        self.lanes = lanes_of(self._inputs(), self.own, self.devices)
        self.states: State = stacked(states + states[-1:] * self.spare)
        size = len(cases) + self.spare
        self.reached, self.waits = np.zeros(size, int), np.zeros(size, int)
        self.going = np.arange(size) < len(cases)
        self.start = 0.0

    def _inputs(self) -> list[Inputs]:
        pairs = list(zip(self.scenes, self.solvers, strict=True))
        return pairs + pairs[-1:] * self.spare

    @property
    def results(self) -> Shaped[np.ndarray, " lanes"]:
        """Names of the results of all lanes."""
        names = np.full(len(self.going), "", dtype=object)
        for name in RESULT_NAMES:
            names[np.asarray(self.states.result == getattr(RESULTS, name))] = name
        return names

    def advance(self) -> None:
        """Call the program once for all active lanes; rebuild neighbour lists if a lane stopped for it."""
        if self.start and time.perf_counter() - self.start > self.limits.seconds:
            self._end(self.going, RESULTS.budget)
            return
        made = self._attempts()
        stops = np.where(self.going, self._due, -np.inf)
        left = self.limits.attempts - made
        # Use the same placement in every call: another placement would compile another program.
        moving = spread((self.states, jnp.asarray(stops), jnp.asarray(left)), self.devices)
        side_by_side = lanes.best_side_by_side(self.devices.devices[0])
        self.states = lanes.advance(self.lanes, moving, self.devices, side_by_side)
        waited = self.going & (self._attempts() == made) & (left > 0)
        self.waits = np.where(waited, self.waits + 1, 0)
        unfinished = self.going & (np.asarray(self.states.t) < stops)
        self._end(unfinished & (self.limits.attempts <= self._attempts()), RESULTS.budget)
        # The first call compiles; compile time does not count.
        self.start = self.start or time.perf_counter()
        self._end(self.waits > MOST_WAITS, RESULTS.collapsed)
        listing = self.states.listing
        if listing is not None and np.any(np.asarray(listing.needed)):
            states = jax.device_get(self.states)
            each = [lane(states, index) for index in range(len(self.scenes))]
            self.scenes = batch_with_contacts(self.scenes, each)
            self.lanes = lanes_of(self._inputs(), self.own, self.devices)

    def arrived(self) -> Iterator[tuple[int, State]]:
        """Yield each lane that reached its next frame, with its state; then advance its target frame."""
        sound = self.results == "success"
        there = np.asarray(self.states.t) >= self._due
        for index in np.flatnonzero(self.going & sound & there).tolist():
            state = lane(self.states, index)
            yield index, state
            self.reached[index] += 1
            if self.scenes[index].contact is not None and len(pierced(self.scenes[index], state.x)):
                self._end(np.arange(len(self.going)) == index, RESULTS.intersected)

    def stop(self, index: int) -> None:
        """Stop a lane."""
        self.reached[index] = len(self.times)

    def ended(self) -> Int[np.ndarray, " ended"]:
        """Return the lanes that ended since the last call."""
        ended = self.going & ((self.results != "success") | (self.reached >= len(self.times)))
        self.going = self.going & ~ended
        return np.flatnonzero(ended)

    @property
    def _due(self) -> Float[np.ndarray, " lanes"]:
        """Time in s of the next frame of each lane."""
        return self.times[np.minimum(self.reached, len(self.times) - 1)]

    def _attempts(self) -> Int[np.ndarray, " lanes"]:
        counters = self.states.counters
        return np.sum(np.asarray(counters.steps), axis=1) + np.sum(np.asarray(counters.rejected), axis=1)

    def _end(self, which: Bool[np.ndarray, " lanes"], result: Any) -> None:
        """Set the result of the selected lanes."""
        if np.any(which):
            given = jax.vmap(lambda here, old: RESULTS.where(here, result, old))(which, self.states.result)
            self.states = eqx.tree_at(lambda s: s.result, self.states, given)


def _check_size(lanes: int, nodes: int) -> None:
    """Refuse more lanes than fit into memory."""
    what = f"a batch of {lanes} lanes of {nodes} nodes"
    require(LANE * lanes * nodes, what, "give fewer cases or nodes, or choose backend='processes'")


def _listed(cases: Sequence[Case], scenes: Sequence[Scene], states: Sequence[State]) -> list[Scene]:
    """Build the neighbour lists of all scenes, and refuse a start whose layers overlap."""
    scenes = batch_with_contacts(scenes, states)
    for case, scene, state in zip(cases, scenes, states, strict=True):
        if scene.contact is not None:
            with blamed(case.name):
                check_gap(scene, state)
    return scenes
