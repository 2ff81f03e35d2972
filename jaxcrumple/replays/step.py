"""One recorded step as a differentiable function: the solution of its equations, and its derivative."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import Count, Flag, NodeVectors, Scalar
from jaxcrumple.history import ImplicitStep as Equations
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.implicit.bdf import Formula
from jaxcrumple.solvers.implicit.newton import FORCING
from jaxcrumple.solvers.linear.base import AbstractLinearSolver, Factor
from jaxcrumple.solvers.linear.solve import solve_once
from jaxcrumple.system import linearize, residual, updated_rest_curvature

# Newton's iteration ends with an update below TIGHT of the sheet's size, or below SETTLED if rounding stops
# its decrease. It refactorises when an update exceeds CONTRACTION times the previous one.
TIGHT, SETTLED, CONTRACTION, MOST_ITERATIONS = 1e-12, 1e-8, 0.05, 40
# Relative residual of the linear systems of derivatives.
LINEAR = 1e-12


class Point(NamedTuple):
    """Hold positions `x` m and velocities `v` m/s (n, 3), and rest curvatures `p` (h,) or None."""

    x: Float[Array, "*points nodes 3"]
    v: Float[Array, "*points nodes 3"]
    p: Float[Array, "*points hinges"] | None


class RecordedStep(NamedTuple):
    """Hold a recorded implicit step of `h` s from time `t` with a `formula`.

    Methods take `past` points along a leading axis (6,), newest first.
    """

    formula: Formula
    t: Scalar
    h: Scalar

    def unknown(self, scene: Scene, old: NodeVectors, new: NodeVectors) -> NodeVectors:
        """Return the unknown (n, 3) of the formula for positions `old` and `new`; supports are satisfied."""
        return self._supported(scene, old, self.formula.theta * new + (1.0 - self.formula.theta) * old)

    def residual(self, scene: Scene, past: Point, unknown: NodeVectors) -> NodeVectors:
        """Compute the residual (n, 3) in N; it is zero for components that supports prescribe."""
        x = self._supported(scene, newest(past).x, unknown)
        return residual(scene, self._equations(scene, past), x)[0]

    def point(self, scene: Scene, past: Point, unknown: NodeVectors) -> Point:
        """Return the point after the step."""
        old, step = newest(past), self._equations(scene, past)
        x = self._supported(scene, old.x, unknown)
        p = None if old.p is None else updated_rest_curvature(scene, step, x)
        mean = Point(x, step.velocity(x), p)
        return jax.tree.map(lambda mean, old: old + (mean - old) / self.formula.theta, mean, old)

    def tangent(self, scene: Scene, past: Point, unknown: NodeVectors) -> Float[Array, " entries"]:
        """Compute the values (size,) of the residual's tangent."""
        return linearize(scene, self._equations(scene, past), unknown)[1]

    def _equations(self, scene: Scene, past: Point) -> Equations:
        return self.formula.equations(scene, past, self.t, self.h)

    def _supported(self, scene: Scene, old: NodeVectors, x: NodeVectors) -> NodeVectors:
        if scene.prescribed is None:
            return x
        theta, prescribed, end = self.formula.theta, scene.prescribed, self.t + self.h
        there = theta * prescribed.motion(end) + (1.0 - theta) * old
        return jnp.where(prescribed.held(end), there, x)


def newest(past: Point) -> Point:
    """Return the newest of the points."""
    return Point(*jax.tree.map(lambda a: a[0], tuple(past)))


class _Carry(NamedTuple):
    x: NodeVectors
    factor: Factor
    update: Scalar
    own: Flag
    renew: Flag
    settled: Flag
    iterations: Count


def solved(
    scene: Scene,
    step: RecordedStep,
    past: Point,
    guess: NodeVectors,
    linear: AbstractLinearSolver,
    last: Factor,
    needed: Flag,
) -> tuple[Point, Scalar, Factor]:
    """Solve a step by Newton's iteration from the positions `guess` (n, 3), if it is `needed`.

    The iteration starts with the factor `last` of the previous step, which suffices for a good guess. A batch
    also calls this function for lanes that do not need it, and iterates until the others have converged.

    **Returns:** the point after the step; the last update in units of the sheet's size, an upper bound of the
    error, infinite without convergence; and the last factor."""

    def body(carry: _Carry) -> _Carry:
        def renewed() -> Factor:
            return linear.factor(scene.sparsity, step.tangent(scene, past, carry.x), carry.factor)

        factor = jax.lax.cond(carry.renew, renewed, lambda: carry.factor)
        values = None if linear.exact else step.tangent(scene, past, carry.x)
        value = step.residual(scene, past, carry.x)
        solution = linear.solve(scene.sparsity, factor, values, -value.reshape(-1), FORCING)
        update = jnp.max(jnp.abs(solution.x)) / scene.length_scale
        contraction = update / carry.update
        # A large update with the factor of the previous step is not reliable.
        astray = (carry.iterations == 0) & ~carry.renew & ~(update < SETTLED)
        moved = carry.x + solution.x.reshape(carry.x.shape)
        stalled = (update < SETTLED) & (contraction > 0.5) & carry.own
        return _Carry(
            jnp.where(astray, carry.x, moved),
            factor,
            jnp.where(astray, jnp.inf, update),
            carry.own | carry.renew,
            astray | (contraction > CONTRACTION),
            ~astray & ((update < TIGHT) | stalled | ~jnp.isfinite(update)),
            carry.iterations + 1,
        )

    def unfinished(carry: _Carry) -> Flag:
        return ~carry.settled & (carry.iterations < MOST_ITERATIONS)

    no, start = jnp.asarray(False), step.unknown(scene, newest(past).x, guess)
    renew = jnp.asarray(not linear.exact)
    first = _Carry(start, last, jnp.asarray(jnp.inf), no, renew, ~needed, jnp.asarray(0))
    end = jax.lax.while_loop(unfinished, body, first)
    point = step.point(scene, past, end.x)
    good = end.settled & jnp.isfinite(end.update)
    return point, jnp.where(good, end.update, jnp.inf), end.factor


def changed(
    here: Callable[[Scene], Scene],
    scenes: tuple[Scene, Scene],
    step: RecordedStep,
    pasts: tuple[Point, Point],
    new: NodeVectors,
    linear: AbstractLinearSolver,
    start: Factor,
) -> Point:
    """Compute the tangent of the point after a step by the implicit function theorem.

    `scenes` and `pasts`: pairs of a value and its tangent, in which the result is linear; `here`: function
    that inserts the contact lists in a scene; `new` (n, 3): positions after the step.
    """
    (scene, by_scene), (past, by_past) = scenes, pasts
    listed = here(scene)
    unknown = step.unknown(listed, newest(past).x, new)
    values = step.tangent(listed, past, unknown)

    def residual(scene: Scene, past: Point) -> NodeVectors:
        return step.residual(here(scene), past, unknown)

    force = eqx.filter_jvp(residual, (scene, past), (by_scene, by_past))[1]
    moved = solve_once(linear, listed.sparsity, start, values, -force.reshape(-1), LINEAR)
    changes = (by_scene, by_past, moved.reshape(unknown.shape))

    def point(scene: Scene, past: Point, unknown: NodeVectors) -> Point:
        return step.point(here(scene), past, unknown)

    return eqx.filter_jvp(point, (scene, past, unknown), changes)[1]
