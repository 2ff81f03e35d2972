"""`replay`: repeat recorded steps as one function with forward and reverse derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, NodeVectors, Scalar
from jaxcrumple._jax.door import door, own_modes
from jaxcrumple.history import HISTORY
from jaxcrumple.replays.contacts import StretchLists, in_step, in_stretch
from jaxcrumple.replays.record import Record, Steps
from jaxcrumple.replays.step import Point, RecordedStep, changed, newest, solved
from jaxcrumple.scene import Scene, with_lists
from jaxcrumple.solvers.implicit.bdf import step_formula
from jaxcrumple.solvers.linear.base import Factor
from jaxcrumple.state import EXPLICIT, IMPLICIT, State, check_state

# Relative difference that rounding causes between two builds of the same scene.
SAME = 1e-9

Result = TypeVar("Result")


class Replay(NamedTuple):
    """Hold frames at times `t` (f,) s.

    Positions `x` (f, n, 3) m, velocities `v` (f, n, 3) m/s, rest curvatures `p` (f, h) or None; `error`: over
    all steps, the largest last Newton update in units of the sheet's size."""

    t: Float[Array, " frames"]
    x: Float[Array, "frames nodes 3"]
    v: Float[Array, "frames nodes 3"]
    p: Float[Array, "frames hinges"] | None
    error: Scalar


@door
def replay(
    scene: Scene,
    record: Record,
    start: State | None = None,
    *,
    solve: bool = True,
    checkpoint: bool = False,
) -> Replay:
    """Repeat the steps of a recorded run in a scene with other numbers, or from another `start`.

    Step sizes, orders, stages and contact lists are those of the record. The result is a function of every
    number in `scene` and of the positions, velocities and rest curvatures of `start`, with forward and
    reverse derivatives. The derivatives hold all decisions of the run fixed: step sizes, and times of stage
    changes and of buckling, have none. After the times in `record.snaps` they follow one of several possible
    paths through a snap. All results are NaN if a step has no solution, if the sheet is more than a quarter
    of a contact range from its recorded position, or if `solve` is False and scene or start differ from the
    run's.

    **Arguments:**

    - `scene`: the scene of the run, or one of the same mesh and terms with other numbers.
    - `record`: of `simulate(..., record=True)`, or inside `jax.vmap` a lane of `stack_records`.
    - `start`: first state; by default that of the run.
    - `solve`: solve each step again, to rounding. If False, `scene` and `start` must be those of the run,
      and positions are the recorded ones. Derivatives then cost less, and also exist if errors grow so fast
      that the run cannot be repeated.
    - `checkpoint`: keep for derivatives only positions (n, 3) of each step, and a state for each stretch of
      64 steps. Velocities and rest curvatures are recomputed from these.

    **Returns:** a `Replay`; after a run that ended early, with the frames that the run reached.

    **Raises:** ValueError for an object that is not a scene or not a record, for a stack of records outside
    `jax.vmap`, or for a state of another scene.

    >>> import equinox as eqx
    >>> mesh = jc.hexagonal(3, 2, 5e-3)
    >>> scene = jc.sheet(mesh, jc.Material(yield_curvature=None), gravity=(0, 0, -9.81))
    >>> run = jc.simulate(scene, jc.initial_state(scene, mesh.vertices), 0.1, record=True)
    >>> def height(g):  # m, of the sheet that falls in air, from its acceleration in m/s2
    ...     falling = eqx.tree_at(lambda s: s.gravity.g, scene, g)
    ...     return jc.replay(falling, run.record).x[-1, :, 2].mean()
    >>> print(f"{jax.grad(height)(scene.gravity.g)[2]:.3e}")  # s2: (t - m/b) m/b with m/b = 1 ms
    9.900e-05
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"scene must be a Scene, not {type(scene).__name__}.")
    if not isinstance(record, Record):
        raise ValueError(
            f"record must be the record of simulate(..., record=True), not {type(record).__name__}; a run "
            "without steps has no record."
        )
    if record.t.ndim != 1:
        raise ValueError(
            f"the record is a stack of {len(record.t)} records: call replay inside jax.vmap or jax.lax.map, "
            "with the scene of one lane."
        )
    start = record.start if start is None else start
    check_state(scene, start)
    here = Point(start.x, start.v, start.p)
    before = Point(start.history.x, start.history.v, start.history.p)
    past = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[1:]]), here, before)
    frames, error = _frames(scene, past, record, _Way(solve, checkpoint))
    if not solve:
        error = jnp.where(_differ((scene, here), record), jnp.inf, error)
    frames = jax.tree.map(lambda a: jnp.where(jnp.isfinite(error), a, jnp.nan), frames)
    return Replay(record.t, frames.x, frames.v, frames.p, error)


def _differ(run: tuple[Scene, Point], record: Record) -> Flag:
    """Return whether scene and start have numbers that differ from the recorded ones."""
    scene, here = run
    start = record.start
    recorded = record.scene, Point(start.x, start.v, start.p)
    pairs = zip(*map(_numbers, ((with_lists(scene, None), here), recorded)), strict=True)
    differ = [
        jnp.max(jnp.abs(a - b), initial=0.0) > SAME * jnp.max(jnp.abs(b), initial=0.0) for a, b in pairs
    ]
    return jnp.any(jnp.stack(differ))


def _numbers(tree: Any) -> list[Float[Array, " ..."]]:
    numbers = jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))
    return [jax.lax.stop_gradient(a) for a in numbers]


class _Way(NamedTuple):
    """Hold the options `solve` and `checkpoint` of `replay`."""

    solve: bool
    checkpoint: bool


@eqx.filter_custom_jvp
def _frames(scene: Scene, past: Point, record: Record, way: _Way) -> tuple[Point, Scalar]:
    _, frames, error = _forward(scene, past, record, way)
    return frames, error


@_frames.def_jvp
@own_modes()
def _frames_jvp(
    primals: tuple[Scene, Point, Record, _Way], tangents: tuple[Any, ...]
) -> tuple[tuple[Point, Scalar], tuple[Point, Scalar]]:
    scene, past, record, way = primals
    by_scene, by_past, _, _ = tangents
    kept, frames, error = _forward(scene, past, record, way)
    moved = _tangent(scene, by_scene, past, by_past, record, kept)
    return (frames, error), (moved, jnp.zeros_like(error))


class _Kept(NamedTuple):
    """Hold the points of each stretch for derivatives.

    Either `rows` (g, 6 + s, ...): all points, oldest first; or `past` (g, 6, ...): the points before the
    stretch, newest first, and positions `x` (g, s, n, 3)."""

    rows: Point | None
    past: Point | None
    x: Float[Array, "*stretches steps nodes 3"] | None


def _forward(scene: Scene, past: Point, record: Record, way: _Way) -> tuple[_Kept, Point, Scalar]:
    """Compute the points of each stretch, the frames, and the largest error."""

    def stretch(
        carry: tuple[Point, Point, Scalar], part: tuple[Steps, StretchLists | None]
    ) -> tuple[tuple[Point, Point, Scalar], _Kept]:
        past, frames, error = carry
        steps, lists = part
        here = in_stretch(scene, lists)
        if way.solve:
            points, left = _solved(here, past, steps, record)
        else:
            points, left = _taken(here, past, steps, steps.x, record), jnp.zeros(())
        rows = _rows(past, points)
        count = jnp.sum(steps.valid)
        last = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, count, HISTORY)[::-1], rows)
        kept = _Kept(None, past, points.x) if way.checkpoint else _Kept(rows, None, None)
        return (last, _filled(frames, steps, points), jnp.maximum(error, left)), kept

    frames = _first_frames(newest(past), record)
    carry = (past, frames, jnp.zeros(()))
    (_, frames, error), kept = jax.lax.scan(stretch, carry, (record.steps, record.lists))
    return kept, frames, error


def _solved(scene: Scene, past: Point, steps: Steps, record: Record) -> tuple[Point, Scalar]:
    """Solve the steps of a stretch; return the points (s, ...) at their ends, and the largest error."""

    def advance(
        carry: tuple[Point, Scalar, Factor | None], step: Steps
    ) -> tuple[tuple[Point, Scalar, Factor | None], Point]:
        past, error, factor = carry
        new, left, factor = jax.lax.cond(
            step.valid,
            lambda: _step(scene, past, step, record, factor),
            lambda: (newest(past), jnp.zeros(()), factor),
        )
        return (_pushed(past, new), jnp.maximum(error, left), factor), new

    carry = past, jnp.zeros(()), _workspace(scene, record)
    (_, error, _), points = jax.lax.scan(advance, carry, steps)
    return points, error


def _taken(
    scene: Scene, past: Point, steps: Steps, x: Float[Array, "steps nodes 3"], record: Record
) -> Point:
    """Compute the points (s, ...) at the ends of a stretch's steps from their positions `x` (s, n, 3)."""

    def advance(past: Point, part: tuple[Steps, NodeVectors]) -> tuple[Point, Point]:
        step, x = part
        new = jax.lax.cond(step.valid, lambda: _point(scene, past, step, x, record), lambda: newest(past))
        return _pushed(past, new), new

    return jax.lax.scan(advance, past, (steps, x))[1]


def _rows(past: Point, points: Point) -> Point:
    """Join the `past` points (6, ...), newest first, and the later `points` (s, ...); oldest first."""
    return jax.tree.map(lambda old, new: jnp.concatenate([old[::-1], new]), past, points)


def _tangent(scene: Scene, by_scene: Scene, past: Point, by_past: Any, record: Record, kept: _Kept) -> Point:
    """Compute the tangents of the frames, linear in the tangents `by_scene` and `by_past`."""
    filled = jax.tree.map(lambda a: jnp.zeros_like(a), past)
    moved = jax.tree.map(
        lambda zero, by: zero if by is None else by, filled, by_past, is_leaf=lambda leaf: leaf is None
    )

    @jax.checkpoint
    def stretch(
        carry: tuple[Point, Point], part: tuple[Steps, StretchLists | None, _Kept]
    ) -> tuple[tuple[Point, Point], None]:
        moved, frames = carry
        steps, lists, kept = part
        listed = in_stretch(scene, lists)
        workspace, rows = _workspace(listed, record), kept.rows
        if rows is None:
            assert kept.past is not None and kept.x is not None
            rows = _rows(kept.past, _taken(listed, kept.past, steps, kept.x, record))

        @jax.checkpoint
        def advance(moved: Point, part: tuple[Count, Steps]) -> tuple[Point, Point]:
            at, step = part
            seen = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, at, HISTORY + 1)[::-1], rows)
            past, new = jax.tree.map(lambda a: a[1:], seen), newest(seen)

            def change() -> Point:
                return _step_change(scene, by_scene, listed, past, moved, new, step, record, workspace)

            by_new = jax.lax.cond(step.valid, change, lambda: newest(moved))
            return _pushed(moved, by_new), by_new

        last, points = jax.lax.scan(advance, moved, (jnp.arange(len(steps.h)), steps))
        # Only empty stretches follow one that ends early, so that `last` is not used after it.
        return (last, _filled(frames, steps, points)), None

    frames = _first_frames(newest(moved), record)
    (_, frames), _ = jax.lax.scan(stretch, (moved, frames), (record.steps, record.lists, kept))
    return frames


def _workspace(scene: Scene, record: Record) -> Factor | None:
    return None if record.linear is None else record.linear.start(scene.sparsity)


def _pushed(past: Point, new: Point) -> Point:
    """Insert a new point at the front of the points (6, ...)."""
    return jax.tree.map(lambda old, new: jnp.concatenate([new[None], old[:-1]]), past, new)


def _first_frames(point: Point, record: Record) -> Point:
    """Return frames that all hold the first point."""
    count = len(record.t)
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), point)


def _filled(frames: Point, steps: Steps, points: Point) -> Point:
    """Insert in the frames those of `points` (s, ...) whose steps end at a frame."""

    def fill(
        frames: Float[Array, " frames *axes"], points: Float[Array, " steps *axes"]
    ) -> Float[Array, " frames *axes"]:
        ends = jnp.arange(len(frames))[:, None] == steps.frame
        mine = jnp.any(ends, axis=1).reshape(-1, *[1] * (points.ndim - 1))
        return jnp.where(mine, points[jnp.argmax(ends, axis=1)], frames)

    return jax.tree.map(fill, frames, points)


def _implicit(step: Steps, record: Record) -> RecordedStep:
    moves = step.stage == IMPLICIT if record.inertia else None
    return RecordedStep(
        step_formula(step.h, step.past, step.order, moves, record.rho_infinity), step.t, step.h
    )


def _by_stage(
    step: Steps, record: Record, implicit: Callable[[], Result], explicit: Callable[[], Result]
) -> Result:
    """Call the function of the step's stage; stages without steps in the run are not compiled."""
    if EXPLICIT not in record.stages:
        return implicit()
    if record.stages == (EXPLICIT,):
        return explicit()
    return jax.lax.cond(step.stage == EXPLICIT, explicit, implicit)


def _step(
    scene: Scene, past: Point, step: Steps, record: Record, factor: Factor | None
) -> tuple[Point, Scalar, Factor | None]:
    """Return the point after a step, the error of its solution, and the last factor."""
    old, explicit = newest(past), step.stage == EXPLICIT
    scene = in_step(scene, old.x, step.x, explicit)

    def implicit() -> tuple[Point, Scalar, Factor | None]:
        assert record.linear is not None and factor is not None
        needed = step.valid & ~explicit
        return solved(scene, _implicit(step, record), past, step.x, record.linear, factor, needed)

    def explicit_step() -> tuple[Point, Scalar, Factor | None]:
        assert record.explicit is not None
        point = Point(*record.explicit.advance(scene, step.t, step.h, *old))
        finite = jnp.isfinite(jnp.sum(point.x)) & jnp.isfinite(jnp.sum(point.v))
        return point, jnp.where(finite, 0.0, jnp.inf), factor

    return _by_stage(step, record, implicit, explicit_step)


def _point(scene: Scene, past: Point, step: Steps, x: NodeVectors, record: Record) -> Point:
    """Return the point after a step that ends at positions `x` (n, 3)."""
    old = newest(past)

    def implicit() -> Point:
        equations = _implicit(step, record)
        return equations.point(scene, past, equations.unknown(scene, old.x, x))

    def explicit_step() -> Point:
        assert record.explicit is not None
        near = in_step(scene, old.x, x, True)
        return Point(*record.explicit.advance(near, step.t, step.h, *old))._replace(x=x)

    return _by_stage(step, record, implicit, explicit_step)


def _step_change(
    scene: Scene,
    by_scene: Scene,
    listed: Scene,
    past: Point,
    moved: Point,
    new: Point,
    step: Steps,
    record: Record,
    workspace: Factor | None,
) -> Point:
    """Compute the tangent of the point `new` after a step; `listed`: the scene with its stretch's lists."""
    old = newest(past)
    listed = in_step(listed, old.x, new.x, step.stage == EXPLICIT)

    def here(scene: Scene) -> Scene:
        return with_lists(scene, listed.lists)

    def implicit() -> Point:
        assert record.linear is not None and workspace is not None
        return changed(
            here, (scene, by_scene), _implicit(step, record), (past, moved), new.x, record.linear, workspace
        )

    def explicit_step() -> Point:
        assert record.explicit is not None
        step_on = record.explicit.advance

        def advance(scene: Scene, old: Point) -> Point:
            return Point(*step_on(here(scene), step.t, step.h, *old))

        return eqx.filter_jvp(advance, (scene, old), (by_scene, newest(moved)))[1]

    return _by_stage(step, record, implicit, explicit_step)
