"""The record of a run for its replay."""

import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxcrumple._jax.arrays import Scalar
from jaxcrumple._jax.memory import gigabytes, times_that_fit
from jaxcrumple.contact.lists import doubled
from jaxcrumple.history import HISTORY
from jaxcrumple.replays.contacts import StretchLists, make_lists
from jaxcrumple.replays.snaps import snaps
from jaxcrumple.scene import Scene, with_lists
from jaxcrumple.solvers.explicit.base import AbstractExplicit
from jaxcrumple.solvers.implicit.bdf_pair import BDFPair
from jaxcrumple.solvers.implicit.variable_order import VariableOrder
from jaxcrumple.solvers.linear.base import AbstractLinearSolver
from jaxcrumple.solvers.log import Trail
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import EXPLICIT, State

# Steps of a stretch, and smallest capacity of a record in stretches.
STRETCH, FEWEST = 64, 4
# Newton tolerance of a recorded run as a share of the tolerated local error.
RECORDED_SHARE = 1e-4
# Memory of a record at the end of its run, in units of the memory of its steps: it also holds them joined and
# in stretches.
COPIES = 4.0


class Steps(eqx.Module):
    """Hold accepted steps in stretches (g, s); padding at the end is not `valid`.

    `t` s: time at the start of a step; `h` s: its size; `stage` and `order`; `past` (g, s, 6): sizes in s of
    the previous steps; `frame`: index of the frame at the end of the step, or the number of frames if there
    is none; `x` (g, s, n, 3) m: positions at the end of the step.
    """

    valid: Bool[Array, " *steps"]
    t: Float[Array, " *steps"]
    h: Float[Array, " *steps"]
    stage: Int[Array, " *steps"]
    order: Int[Array, " *steps"]
    past: Float[Array, "*steps points"]
    frame: Int[Array, " *steps"]
    x: Float[Array, "*steps nodes 3"]


class Record(eqx.Module):
    """Hold the accepted steps of a run; `simulate(..., record=True)` builds it for `replay`.

    `stack_records` stacks those of several runs: all arrays then have a leading axis (lanes,).

    - `scene` of the run, and its first state `start`; `t` (f,) in s: times of the frames.
    - `steps`: sizes, orders, stages and positions of all steps; `stages` that occur in them.
    - `lists`: contact lists of each stretch of steps, or None without contact.
    - `explicit`, `linear`, `rho_infinity`, `inertia`: as in the run's solver.
    - `snaps` (64,) in s: times at which snaps begin, padded with infinity.
    """

    scene: Scene
    start: State
    t: Float[Array, " frames"]
    steps: Steps
    lists: StretchLists | None
    explicit: AbstractExplicit | None
    linear: AbstractLinearSolver | None
    rho_infinity: Scalar
    snaps: Float[Array, " 64"]
    inertia: bool = eqx.field(static=True)
    stages: tuple[int, ...] = eqx.field(static=True)


class StepRecorder:
    """Collect the steps of one run from the state `start`.

    **Raises:** ValueError for a scheme that cannot be recorded.
    """

    def __init__(self, start: State, solver: Integrator):
        if isinstance(solver.implicit, BDFPair):
            raise ValueError("the scheme 'paper' cannot be recorded: choose another one, such as 'hybrid'.")
        self.start = start
        self.trails: list[list[Shaped[np.ndarray, " ..."]]] = []
        self.held, self.warned = 0, False
        self.frames: list[tuple[float, int]] = []

    def solver(self, solver: Integrator) -> Integrator:
        """Return the solver for the run, with a Newton tolerance so small that the lists fit the replay."""
        if solver.implicit is None:
            return solver
        return eqx.tree_at(lambda s: s.implicit.newton_share, solver, jnp.asarray(RECORDED_SHARE))

    def extend(self, trail: Trail | None) -> None:
        """Append the steps of one call; warn once if the record exceeds the memory.

        For a lane of a batch, give the trail of that lane, in arrays of JAX or NumPy."""
        assert trail is not None
        length = int(trail.length)
        # On the host, because JAX compiles a slice for every length; copied, to let the rest of the trail go.
        self.trails.append([np.array(np.asarray(part)[:length]) for part in trail[:-1]])
        self.held += sum(part.nbytes for part in self.trails[-1])
        if self.held and not self.warned and times_that_fit(COPIES * self.held) < 1.0:
            self.warned = True
            warnings.warn(
                f"the record of {sum(len(trail[0]) for trail in self.trails)} steps takes "
                f"{gigabytes(self.held)}, and {COPIES:g} times that at the end of the run, which exceeds the "
                "memory; end the run sooner, or choose fewer nodes.",
                stacklevel=2,
            )

    def frame(self, t: float) -> None:
        """Add a frame at time `t` s after the steps so far."""
        self.frames.append((t, sum(len(trail[0]) for trail in self.trails)))

    def finished(self, scene: Scene, solver: Integrator) -> Record | None:
        """Build the record, or return None for a run without steps. `scene`: the scene of the last call."""
        if not sum(len(trail[0]) for trail in self.trails):
            return None
        x, end, h, stage, order = (np.concatenate(parts) for parts in zip(*self.trails, strict=True))
        begins = snaps(scene, np.concatenate([[self.start.x], x]), np.append(float(self.start.t), end))
        frame = np.full(len(h), len(self.frames))
        for index, (_, made) in enumerate(self.frames):
            if made:
                frame[made - 1] = index
        past, t = _past_steps(self.start, h), np.append(float(self.start.t), end[:-1])
        parts = [_in_stretches(part) for part in (t, h, stage, order, past, frame, x)]
        valid = np.arange(parts[0].size).reshape(parts[0].shape) < len(h)
        parts[-2][~valid] = len(self.frames)
        lists = None
        if scene.contact is not None:
            start, explicit = np.asarray(self.start.x), parts[2] == EXPLICIT
            lists = make_lists(scene, start, parts[-1], explicit, solver.one_matrix)
        implicit = solver.implicit
        return Record(
            scene=with_lists(scene, None),
            start=self.start,
            t=jnp.asarray([t for t, _ in self.frames]),
            steps=Steps(jnp.asarray(valid), *map(jnp.asarray, parts)),
            lists=lists,
            explicit=solver.explicit,
            linear=None if implicit is None else implicit.linear,
            rho_infinity=implicit.rho_infinity if isinstance(implicit, VariableOrder) else jnp.zeros(()),
            snaps=jnp.asarray(begins),
            inertia=isinstance(implicit, VariableOrder) and implicit.inertia,
            stages=tuple(np.unique(stage).tolist()),
        )


def _past_steps(start: State, h: Float[np.ndarray, " steps"]) -> Float[np.ndarray, "steps points"]:
    """Return the sizes (k, 6) in s of the steps before each step, newest first, as in the run's history."""
    sizes = np.concatenate([np.array(start.history.steps)[::-1], h])
    return np.lib.stride_tricks.sliding_window_view(sizes, HISTORY)[:-1, ::-1]


def _in_stretches(part: Shaped[np.ndarray, " entries *axes"]) -> Shaped[np.ndarray, "stretches steps *axes"]:
    """Reshape an array (k, ...) to stretches (g, s, ...), padded with its last row; g is a power of two."""
    size = STRETCH * doubled(FEWEST, -(-len(part) // STRETCH))
    rest = np.broadcast_to(part[-1], (size - len(part), *part.shape[1:]))
    return np.concatenate([part, rest]).reshape(-1, STRETCH, *part.shape[1:])
