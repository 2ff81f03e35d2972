"""Derivatives of a run of `radial` by every kind of number, against differences of its replay.

Sheet of 300 nodes, self-avoiding, elastoplastic, scheme `alternating`: from 2.289 s to 2.2945 s, with a snap,
with all three stages, plastic flow and contact. The measure is a sum of all frames with random weights.
Every number is changed by a common factor (of the start: by a random field). The table shows the derivative
in reverse mode, how far forward mode and the best of central differences of the replay, extrapolated to no
change, are from it, and what differences of runs that choose their own steps give, for two sizes of the
change.

    python scripts/gradient_check.py
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchlib import markdown, options, save
from jax import Array

import jaxcrumple as jc
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.scheme import Integrator
from jaxcrumple.state import State

RTOL, BEGIN, FRAMES = 1e-4, 2.289, (2.292, 2.2945)
Inputs = tuple[Scene, State]
# Kinds of numbers: by name, which of scene and start.
KINDS: dict[str, Callable[[Inputs], Array]] = {
    "stretching stiffness": lambda i: i[0].membrane.stiffness,
    "rest lengths": lambda i: i[0].membrane.rest_length,
    "bending stiffness": lambda i: i[0].bending.stiffness,
    "yield curvature": lambda i: i[0].plasticity.yield_threshold,
    "plastic time": lambda i: i[0].plasticity.time,
    "mass": lambda i: i[0].mass,
    "drag": lambda i: i[0].drag.coefficient,
    "internal damping": lambda i: i[0].damping.coefficient,
    "wall stiffness": lambda i: i[0].walls[0].stiffness,
    "wall radius": lambda i: i[0].walls[0].shape.radius.start,
    "wall rate": lambda i: i[0].walls[0].shape.radius.rate,
    "contact stiffness": lambda i: i[0].contact.stiffness,
    "contact range": lambda i: i[0].contact.range,
    "start: positions": lambda i: i[1].x,
    "start: velocities": lambda i: i[1].v,
    "start: rest curvatures": lambda i: i[1].p,
}
# Of differences the best is taken, or the first one that is as good as this.
ENOUGH = 1e-6
# Relative changes of which differences are taken: of the replay, each 1/sqrt(10) of the one before, and of
# free runs.
CHANGES, FREE = tuple(10.0 ** -np.arange(1.5, 8.0, 0.5)), (1e-3, 1e-5)


class Window(NamedTuple):
    """A recorded run: scene and start, its solver, its solution, and weights of the measure."""

    inputs: Inputs
    solver: Integrator
    solution: jc.Solution
    weights: tuple[Array, Array, Array]


class Line(NamedTuple):
    """Derivative by one kind of number in reverse mode, the relative deviations of forward mode and of
    differences of the replay, and differences of free runs."""

    kind: str
    reverse: float
    forward: float
    difference: float
    free: tuple[float, ...]


def recorded_window(nodes: int = 300) -> Window:
    """The run that is differentiated."""
    setup, solver = jc.radial(nodes), jc.integrator(RTOL, scheme="alternating")
    start = jc.simulate(setup.scene, jc.initial_state(setup.scene, setup.x), BEGIN, solver=solver).state
    solution = jc.simulate(setup.scene, start, FRAMES, solver=solver, record=True)
    rng = np.random.default_rng(1)
    x, v, p = (jnp.asarray(rng.normal(size=np.shape(a))) for a in (solution.x, solution.v, solution.p))
    return Window((setup.scene, start), solver, solution, (x, 1e-3 * v, 1e-3 * p))


def measure(window: Window, frames: Any) -> Array:
    """The weighed sum of frames."""
    parts = zip(window.weights, (frames.x, frames.v, frames.p), strict=True)
    return sum((jnp.sum(weight * part) for weight, part in parts), jnp.zeros(()))


def direction(name: str, inputs: Inputs) -> Array:
    """What the numbers of a kind are changed by, at a relative change of 1."""
    numbers = KINDS[name](inputs)
    if not name.startswith("start"):
        return numbers
    field = np.random.default_rng(2).normal(size=numbers.shape)
    scale = 1e-3 * float(inputs[0].length_scale) if name.endswith("positions") else jnp.max(jnp.abs(numbers))
    return jnp.asarray(field) * scale


def changed(name: str, inputs: Inputs, size: float) -> Inputs:
    """Scene and start with the numbers of a kind changed."""
    return eqx.tree_at(KINDS[name], inputs, KINDS[name](inputs) + size * direction(name, inputs))


def checks(window: Window, free: bool) -> list[Line]:
    """A line for each kind of number that the scene has; with differences of `free` runs, or without."""
    record = window.solution.record
    assert record is not None

    def replayed(inputs: Inputs) -> Array:
        return measure(window, jc.replay(inputs[0], record, inputs[1]))

    value = eqx.filter_jit(replayed)
    gradient = eqx.filter_jit(eqx.filter_grad(replayed))(window.inputs)
    push = eqx.filter_jit(lambda by: eqx.filter_jvp(replayed, (window.inputs,), (by,))[1])
    still = jax.tree.map(lambda a: jnp.zeros_like(a) if eqx.is_inexact_array(a) else None, window.inputs)

    def run(inputs: Inputs) -> Array:
        scene, start = inputs
        # A replay takes its start for the last point of the history too.
        history = [old.at[0].set(new) for old, new in zip(points(start.history), points(start), strict=True)]
        start = eqx.tree_at(lambda s: points(s.history), start, history)
        return measure(window, jc.simulate(scene, start, FRAMES, solver=window.solver))

    lines = []
    for name, numbers in KINDS.items():
        way = direction(name, window.inputs)
        reverse = float(jnp.sum(numbers(gradient) * way))
        forward = float(push(eqx.tree_at(numbers, still, way)))
        best = closest(lambda size, name=name: difference(value, name, window.inputs, size), reverse)
        runs = tuple(difference(run, name, window.inputs, size) for size in FREE) if free else ()
        lines.append(Line(name, reverse, deviation(forward, reverse), best, runs))
        print(lines[-1], flush=True)
    return lines


def deviation(found: float, value: float) -> float:
    """The relative deviation from `value`, or the absolute one from zero."""
    return abs(found - value) / (abs(value) or 1.0)


def closest(found: Callable[[float], float], value: float) -> float:
    """The least relative deviation from `value` of differences, and of their extrapolations to no change."""
    best, before = np.inf, np.nan
    for size in CHANGES:
        now = found(size)
        # The error of a difference falls to a tenth, so that this combination of two is of fourth order.
        guesses = now, (10.0 * now - before) / 9.0
        best = min([best, *(deviation(guess, value) for guess in guesses if np.isfinite(guess))])
        if best < ENOUGH:
            break
        before = now
    return float(best)


def points(state: Any) -> list[Array]:
    """Positions, velocities and rest curvatures of a state or its history."""
    return [state.x, state.v, state.p]


def difference(value: Callable[[Inputs], Any], name: str, inputs: Inputs, size: float) -> float:
    """Central difference of second order."""
    high, low = (float(value(changed(name, inputs, way * size))) for way in (1.0, -1.0))
    return (high - low) / (2.0 * size)


def main() -> None:
    """Check, and write the table."""
    opts = options(__doc__, (300,)).parse_args()
    window = recorded_window(opts.nodes[0])
    record = window.solution.record
    assert record is not None
    lines = checks(window, True)
    header = ["by", "reverse mode", "forward mode off by", "difference of the replay off by"]
    header += [f"difference of free runs, change {size:g}" for size in FREE]
    rows = [
        [line.kind, f"{line.reverse:.6g}", f"{line.forward:.1e}", f"{line.difference:.1e}"]
        + [f"{found:.3g}" for found in line.free]
        for line in lines
    ]
    stages = np.bincount(np.asarray(record.steps.stage)[np.asarray(record.steps.valid)], minlength=3)
    counts = ", ".join(
        f"{n} {name}" for n, name in zip(stages, ("quasistatic", "implicit", "explicit"), strict=True)
    )
    text = f"{markdown(header, rows)}\n\n{counts} steps, rtol = {RTOL:g}, n = {opts.nodes[0]}.\n"
    save(opts, "gradient_check", text, None, {}, [line._asdict() for line in lines])


if __name__ == "__main__":
    main()
