"""Checks that walls, supports, energies and flow rules fit a sheet."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.tree import is_known, require_numbers, require_shape, shown
from jaxcrumple.model.loads import ElementEnergy, Prescribed
from jaxcrumple.model.plasticity import AbstractFlowRule
from jaxcrumple.model.walls import AbstractShape, Wall


def check_surroundings(
    nodes: int,
    hinges: int,
    walls: Sequence[Wall | AbstractShape],
    gravity: Any,
    prescribed: Prescribed | None,
    extra: Sequence[ElementEnergy],
    plasticity: AbstractFlowRule | None,
) -> None:
    """Refuse walls, loads, supports and flow rules that do not fit the sheet.

    `nodes` and `hinges` are its numbers of nodes and hinges. Traced numbers are not checked.

    **Raises:** ValueError that names the wall, the support, the energy or the rule, and the cure.
    """
    for index, wall in enumerate(walls):
        _check_wall(f"wall {index} ({type(wall).__name__})", wall, nodes)
    if gravity is not None:
        _check_gravity(gravity)
    if prescribed is not None:
        _check_prescribed(prescribed, nodes)
    if not isinstance(extra, Sequence) or not all(isinstance(term, ElementEnergy) for term in extra):
        raise ValueError(
            f"extra = {shown(extra)} must be a list of energies: [ElementEnergy(nodes, function)]."
        )
    for index, term in enumerate(extra):
        _check_element_energy(f"extra {index}", term, nodes)
    if plasticity is not None:
        _check_flow_rule(plasticity, hinges)


def _check_no_nan(name: str, part: Any) -> None:
    numbers = jax.tree.leaves(eqx.filter(part, eqx.is_inexact_array))
    if any(is_known(array) and np.any(np.isnan(array)) for array in numbers):
        raise ValueError(f"{name} has NaN among its numbers; replace it.")


def _check_wall(name: str, wall: Wall | AbstractShape, nodes: int) -> None:
    _check_no_nan(name, wall)
    shape = wall
    if isinstance(wall, Wall):
        shape = wall.shape
        if not isinstance(shape, AbstractShape):
            raise ValueError(
                f"{name} has shape = {shape!r}; it must be a shape such as Sphere(center, radius)."
            )
        require_shape(f"stiffness of {name}", wall.stiffness, (nodes,))
        require_shape(f"range of {name}", wall.range, ())
        require_numbers(f"stiffness of {name}", wall.stiffness)
        require_numbers(f"range of {name}", wall.range, positive=True)
    gap = _shape(f"the gap of {name}", shape.gap, _numbers(3), _numbers())
    if gap != ():
        raise ValueError(f"the gap of {name} has shape {gap}; it must be one number: give a scalar radius.")


def _check_gravity(gravity: Any) -> None:
    if np.shape(gravity) != (3,):
        raise ValueError(f"gravity = {gravity!r} must be three accelerations in m/s2, e.g. (0, 0, -9.81).")
    if is_known(gravity) and not np.all(np.isfinite(gravity)):
        raise ValueError(f"gravity = {gravity!r} must be finite.")


def _check_prescribed(prescribed: Any, nodes: int) -> None:
    if not isinstance(prescribed, Prescribed):
        raise ValueError(
            f"prescribed has type {type(prescribed).__name__}; it must be one Prescribed(mask, motion): join "
            "several supports in one mask and one motion."
        )
    if prescribed.mask.shape != (nodes, 3):
        raise ValueError(
            f"the mask of prescribed has shape {prescribed.mask.shape}; it must be ({nodes}, 3)."
        )


def _check_element_energy(name: str, term: ElementEnergy, nodes: int) -> None:
    if is_known(term.nodes) and term.nodes.size:
        numbers = np.asarray(term.nodes)
        outside = np.argwhere((numbers < 0) | (numbers >= nodes))
        if len(outside):
            element, place = outside[0]
            raise ValueError(
                f"element {element} of {name} has node {numbers[element, place]}; the sheet has nodes 0 to "
                f"{nodes - 1}."
            )
    k = term.nodes.shape[1]
    own = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf)[1:], leaf.dtype), term.parameters)
    found = _shape(f"the function of {name}", term.function, _numbers(k, 3), own, _numbers())
    if found != ():
        raise ValueError(f"the function of {name} returns shape {found}; it must be one energy in J.")


def _check_flow_rule(rule: Any, hinges: int) -> None:
    if not isinstance(rule, AbstractFlowRule):
        raise ValueError(
            f"plasticity has type {type(rule).__name__}; it must be an AbstractFlowRule, e.g. SmoothstepFlow."
        )
    _check_no_nan(f"plasticity ({type(rule).__name__})", rule)
    found = _shape("the rate of plasticity", rule.rate, _numbers(hinges), _numbers(hinges))
    if found != (hinges,):
        raise ValueError(
            f"the rate of plasticity has shape {found}; it must be ({hinges},), a number for each hinge: "
            "give its parameters as single numbers or as one value per hinge."
        )


def _numbers(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.result_type(float))


def _shape(what: str, function: Callable, *arguments: Any) -> tuple[int, ...]:
    """Return the shape of the output of a user-defined `function` without computing it."""
    leaves, tree = jax.tree.flatten((function, arguments))
    sizes = tuple(_numbers(*leaf.shape) if eqx.is_inexact_array(leaf) else leaf for leaf in leaves)
    # Walls of many scenes have the same structure. A function may hold on to whatever it was made from.
    alike = all(isinstance(size, jax.ShapeDtypeStruct) for size in sizes)
    try:
        return (_traced if alike else _traced.__wrapped__)(tree, sizes)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} cannot be computed: {error}") from error


@functools.lru_cache(maxsize=64)
def _traced(tree: jax.tree_util.PyTreeDef, sizes: tuple[Any, ...]) -> tuple[int, ...]:
    function, arguments = jax.tree.unflatten(tree, sizes)
    return np.shape(eqx.filter_eval_shape(function, *arguments))
