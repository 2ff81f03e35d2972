"""Run members as lanes of one program, each with its own steps; ended lanes make room for waiting members."""

import time
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh as DeviceMesh
from jaxtyping import Float, Int

from jaxcrumple._jax.memory import require
from jaxcrumple._jax.program_cache import make_room
from jaxcrumple._jax.threads import limited_blas
from jaxcrumple.observers import tell_rows
from jaxcrumple.scene import Scene
from jaxcrumple.simulation import CALL, MOST_WAITS, RESULT_NAMES, SHORTEST, TRAIL, attempts_of
from jaxcrumple.solvers.contact.reallocate import batch_with_contacts, joined_with_contacts
from jaxcrumple.solvers.log import Log
from jaxcrumple.solvers.start import check_gap, pierced
from jaxcrumple.state import RESULTS, State
from jaxcrumple.sweeps import lanes
from jaxcrumple.sweeps.cases import blamed
from jaxcrumple.sweeps.lanes import AXIS, Inputs, Lanes, differing, lane_of, lanes_of, own_of, placed, spread
from jaxcrumple.sweeps.members import Member, Start
from jaxcrumple.sweeps.size_class import SizeClass, kind_of

# Bytes per node and lane of a scene and a state.
LANE = 6e3
# Most lanes of a batch by default: a GPU gains little beyond.
LANES = 256
# Shortest wall time in s between reports of the steps of a lane, except at its frames and its end.
REPORT = 30.0


def run_batch(
    members: Sequence[Member], devices: Sequence[jax.Device], most: int, attempts: float = np.inf
) -> None:
    """Run all members, at most `most` of them side by side, and tell each how it ends.

    Members of one kind share a program: those whose scenes and solvers have the same structure, numbers of
    nodes, edges and hinges, and contact level. Other kinds follow one another. A member that fails stops
    alone.

    **Arguments:** `attempts`: step attempts of a member, after which it ends with the result "budget".

    **Raises:** ValueError, before any step, if one of the first `most` members cannot begin or handles only
    one sheet at a time.
    """
    for member in members:
        if member.solver.one_matrix:
            raise ValueError(
                f"{member.name}: the direct solver handles one sheet at a time; choose linear='two-level' or "
                "backend='processes'."
            )
    queue = _Queue(members, most)
    with limited_blas():
        while queue.waiting:
            _Batch(queue, devices, most, attempts).run()


def require_lanes(lanes: object) -> None:
    """Refuse a number of lanes that is none.

    **Raises:** ValueError that quotes it.
    """
    if not isinstance(lanes, int | np.integer) or isinstance(lanes, bool) or lanes < 1:
        raise ValueError(f"lanes = {lanes!r} must be at least 1, a whole number.")


@dataclass
class _Lane:
    """One member while it runs: its `kind`, the frames it has `reached`, the attempts made before, `rows` not
    told yet, wall time in s of its calls, and calls without an attempt."""

    member: Member
    start: Start
    kind: Hashable
    reached: int
    before: int
    rows: list[Float[np.ndarray, "_ columns"]] = field(default_factory=list)
    told: float = field(default_factory=time.perf_counter)
    wall: float = 0.0
    waits: int = 0

    @property
    def due(self) -> float:
        """Time in s of the next frame."""
        return float(self.start.times[self.reached])

    @property
    def is_silent(self) -> bool:
        """Whether the last report is long ago."""
        return time.perf_counter() - self.told > REPORT

    def report(self, state: State) -> None:
        """Tell the observers the rows since the last report."""
        tell_rows(self.member.observers, state, self.rows, self.reached)
        self.rows, self.told = [], time.perf_counter()

    def frame(self, state: State) -> None:
        """Tell the observers a frame."""
        for observer in self.member.observers:
            observer.frame(self.reached, state)
        if self.start.recorder is not None:
            self.start.recorder.frame(self.due)
        self.reached += 1


class _Queue:
    """Members that wait, with their kinds as far as known. The first ones come from all parts of the list, so
    that they show in which arrays lanes differ."""

    def __init__(self, members: Sequence[Member], most: int):
        apart = -(-len(members) // most)
        self.waiting: list[tuple[Member, Hashable]] = [
            (member, None) for first in range(apart) for member in members[first::apart]
        ]
        self.started = False

    def next(self, kind: Hashable = None) -> _Lane | None:
        """Begin the next member, of this kind if given; return None if none waits."""
        place = 0
        while place < len(self.waiting):
            member, known = self.waiting[place]
            if kind is not None and known not in (None, kind):
                place += 1
                continue
            lane = self._begun(member)
            if lane is None or kind in (None, lane.kind):
                del self.waiting[place]
            else:
                self.waiting[place] = member, lane.kind
                member.pause()
                continue
            if lane is not None:
                return lane
        return None

    def _begun(self, member: Member) -> _Lane | None:
        try:
            start = member.begin()
            if start is None:
                return None
            # A run that goes on after its budget begins anew.
            state = eqx.tree_at(lambda s: s.result, start.state, RESULTS.success)
            start = start._replace(state=state)
            kind = kind_of(start.scene, (member.solver, state, start.recorder is None))
            return _Lane(member, start, kind, start.frames, int(attempts_of(state)))
        except Exception as error:
            if not self.started:
                raise
            member.fail(error)
            return None


class _Batch:
    """Lanes of one kind. Each advances from frame to frame with its own steps."""

    def __init__(self, queue: _Queue, devices: Sequence[jax.Device], most: int, attempts: float):
        self.queue, self.attempts = queue, attempts
        first = queue.next()
        found = [] if first is None else [first]
        if first is not None:
            self.kind = first.kind
            nodes = first.start.scene.n_nodes
            most = min(most, 1 + len(queue.waiting))
            what = f"a batch of {most} lanes of {nodes} nodes"
            require(LANE * most * nodes, what, "choose fewer lanes or nodes, or backend='processes'")
        while found and len(found) < most and (more := queue.next(self.kind)):
            found.append(more)
        count = max(1, min(len(devices), len(found)))
        self.devices = DeviceMesh(np.array(devices[:count]), (AXIS,))
        # Each device has the same number of lanes; spare ones repeat the last member and never start.
        self.seats: list[_Lane | None] = [*found, *[None] * (-len(found) % count)]
        if found:
            self._seat(found + found[-1:] * (len(self.seats) - len(found)))

    def _seat(self, filled: Sequence[_Lane]) -> None:
        """Prepare the first lanes.

        **Raises:** ValueError for a start whose layers overlap.
        """
        self.scenes = [lane.start.scene for lane in filled]
        self.solvers = [lane.member.solver for lane in filled]
        self.trail = 0 if filled[0].start.recorder is None else TRAIL
        self.states: State = spread(lanes.stacked([lane.start.state for lane in filled]), self.devices)
        self.sizes = SizeClass.of(self.scenes)
        self.mask: Inputs | None = None
        self.soon = SHORTEST
        make_room(len(filled), self.scenes[0], self.solvers[0])
        self._assemble()
        for index, lane in list(self._going()):
            try:
                _check_gap(lane, self.listed[index])
            except ValueError as error:
                if not self.queue.started:
                    raise
                self._free(index, error)

    def _assemble(self) -> None:
        """Build the arrays of all lanes anew; the next call compiles."""
        plain = [self.sizes.padded(scene) for scene in self.scenes]
        self.mask = differing(list(zip(plain, self.solvers, strict=True)), self.mask)
        self.plain = plain[0], self.solvers[0]
        self._list(plain)

    def _list(self, scenes: Sequence[Scene]) -> None:
        """Build the neighbour lists of all lanes, with the same capacities."""
        states = jax.device_get(self.states)
        each = [lane_of(states, index) for index in range(len(scenes))]
        self.listed = batch_with_contacts(scenes, each)
        assert self.mask is not None
        inputs = list(zip(self.listed, self.solvers, strict=True))
        self.lanes: Lanes = lanes_of(inputs, self.mask, self.devices)
        self.fresh = True

    def run(self) -> None:
        """Advance all lanes until they and all waiting members of their kind have ended."""
        self.queue.started = True
        try:
            while any(self.seats):
                self._advance()
                results, t = self._results(), np.asarray(self.states.t)
                for index, lane in self._going():
                    try:
                        self._follow(index, lane, results[index], float(t[index]))
                    except Exception as error:
                        self._free(index, error)
                self._refill()
        finally:
            for _, lane in self._going():
                lane.member.pause()

    def _free(self, index: int, error: Exception) -> None:
        """Free the seat of a lane that an exception ended."""
        lane, self.seats[index] = self.seats[index], None
        if lane is not None:
            lane.member.fail(error)

    def _going(self) -> Iterator[tuple[int, _Lane]]:
        return ((index, lane) for index, lane in enumerate(self.seats) if lane is not None)

    def _advance(self) -> None:
        """Call the program once for all lanes, and rebuild neighbour lists if a lane stopped for it."""
        made = attempts_of(self.states)
        stops, left = np.full(len(self.seats), -np.inf), np.zeros(len(self.seats))
        for index, lane in self._going():
            stops[index] = lane.due
            left[index] = min(self.attempts - (made[index] - lane.before), self.soon)
        if self.fresh:
            jax.block_until_ready(self._called(stops, 0.0 * left))
            self.fresh = False
        start = time.perf_counter()
        self.states, log = jax.block_until_ready(self._called(stops, left))
        seconds = time.perf_counter() - start
        steps = attempts_of(self.states) - made
        self.soon = max(SHORTEST, np.ceil(float(steps.max()) * CALL / seconds))
        self._account(steps, seconds, log)
        listing = self.states.listing
        if listing is not None and np.any(np.asarray(listing.needed)):
            self._list(self.listed)

    def _called(self, stops: Float[np.ndarray, " lanes"], left: Float[np.ndarray, " lanes"]) -> Any:
        # Use the same placement in every call: another placement would compile another program.
        moving = spread((self.states, jnp.asarray(stops), jnp.asarray(left)), self.devices)
        side_by_side = lanes.best_side_by_side(self.devices.devices[0])
        return lanes.advance(self.lanes, moving, self.devices, side_by_side, self.trail)

    def _account(self, steps: Int[np.ndarray, " lanes"], seconds: float, log: Log) -> None:
        """Give each lane what it did in a call that took `seconds`."""
        rows, lengths, trails = jax.device_get((log.rows, log.length, log.trail))
        for index, lane in self._going():
            lane.rows.append(rows[index, : lengths[index]].copy())
            if lane.start.recorder is not None:
                lane.start.recorder.extend(lane_of(trails, index))
            lane.wall += seconds
            lane.member.spend(seconds * float(steps[index]) / max(1.0, float(steps.sum())))
            lane.waits = 0 if steps[index] else lane.waits + 1

    def _results(self) -> list[str]:
        """Return the names of the results of all lanes so far."""
        now = self.states.result
        is_so = {name: np.asarray(now == getattr(RESULTS, name)) for name in RESULT_NAMES}
        results = [
            next(name for name in RESULT_NAMES if is_so[name][index]) for index in range(len(self.seats))
        ]
        made, t = attempts_of(self.states), np.asarray(self.states.t)
        for index, lane in self._going():
            if results[index] != "success" or t[index] >= lane.due:
                continue
            if lane.waits > MOST_WAITS:
                results[index] = "collapsed"
            elif made[index] - lane.before >= self.attempts or lane.wall > lane.start.seconds:
                results[index] = "budget"
        return results

    def _follow(self, index: int, lane: _Lane, result: str, t: float) -> None:
        """Tell the observers of a lane how it stands; free its seat if it has ended."""
        there = result == "success" and t >= lane.due
        ended = result != "success" or (there and lane.reached + 1 == len(lane.start.times))
        if not (there or ended or lane.is_silent):
            return
        state = lane_of(self.states, index)
        lane.report(state)
        if there:
            lane.frame(state)
            if lane.start.scene.contact is not None and len(pierced(lane.start.scene, state.x)):
                result, ended = "intersected", True
        if ended:
            final = eqx.tree_at(lambda s: s.result, state, getattr(RESULTS, result))
            lane.member.end(final, result, self.listed[index].lists)
            self.seats[index] = None

    def _refill(self) -> None:
        """Give free seats to waiting members."""
        fits = True
        for index, lane in enumerate(self.seats):
            if lane is None and (more := self.queue.next(self.kind)):
                fits = self._taken(index, more) and fits
        if not fits:
            self._assemble()

    def _taken(self, index: int, lane: _Lane) -> bool:
        """Put a lane in a seat; return whether the program and the arrays of the others fit."""
        start, solver = lane.start, lane.member.solver
        assert self.mask is not None
        sizes = SizeClass(*map(max, self.sizes, SizeClass.of([start.scene])))
        scene = sizes.padded(start.scene)
        fits = sizes == self.sizes
        if fits:
            wider = differing([self.plain, (scene, solver)], self.mask)
            fits = bool(eqx.tree_equal(wider, self.mask))
        listed = joined_with_contacts(scene, start.state, self.listed[0])
        try:
            _check_gap(lane, listed)
        except ValueError as error:
            lane.member.fail(error)
            return True
        fits = fits and _shapes(listed) == _shapes(self.listed[index])
        self.seats[index], self.sizes = lane, sizes
        self.scenes[index], self.solvers[index], self.listed[index] = start.scene, solver, listed
        self.states = placed(self.states, index, start.state, self.devices)
        if fits:
            own = placed(self.lanes.own, index, own_of((listed, solver), self.mask), self.devices)
            self.lanes = self.lanes._replace(own=own)
        return fits


def _check_gap(lane: _Lane, listed: Scene) -> None:
    """Refuse a start whose layers overlap, with the name of its member."""
    if listed.contact is not None:
        with blamed(lane.member.name):
            check_gap(listed, lane.start.state)


def _shapes(tree: Any) -> list[tuple[int, ...]]:
    return [leaf.shape for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]
