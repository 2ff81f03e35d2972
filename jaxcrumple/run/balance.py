"""Evaluate energies and forces at a start, term by term: find values that are not finite, and imbalance."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxcrumple._jax.arrays import HingeValues, NodeVectors, Scalar
from jaxcrumple.contact import energy as contact
from jaxcrumple.scene import Scene
from jaxcrumple.solvers.contact.reallocate import batch_with_contacts
from jaxcrumple.solvers.start import check_gap, check_start, has_near_layers
from jaxcrumple.state import State

# A sheet counts as in balance if no nodal force exceeds that of a spring at this strain. Rounding of
# positions causes at most 1e-12 of that force.
STRAIN = 1e-9


class Balance(NamedTuple):
    """Balance of forces at a start.

    `in_balance`: whether no net force above rounding acts on a free node; `lines`: text on the largest net
    force and on each term that exerts a force, with its energy.
    """

    in_balance: bool
    lines: list[str]


class _Term(NamedTuple):
    """Energy in J, or None if its zero is arbitrary; nodal forces (n, 3) in N."""

    name: str
    energy: float | None
    force: Float[np.ndarray, "nodes 3"]


def start_balance(scene: Scene, state: State) -> Balance:
    """Evaluate energies and forces of a start at rest.

    This compiles one small program. It builds neighbour lists only if layers lie within the range of contact.

    **Raises:** ValueError if `check_start` or `check_gap` refuses the start, or if the energy or force of a
    term is not finite; the message names the term and, for a force, the node.
    """
    check_start(scene, state)
    if scene.contact is not None:
        if has_near_layers(scene, state):
            scene = batch_with_contacts([scene], [state])[0]
            check_gap(scene, state)
        else:
            scene = dataclasses.replace(scene, contact=None, lists=None)
    terms = _terms(scene, state)
    for term in terms:
        _check_finite(term)
    return _balance(scene, state, terms)


def _terms(scene: Scene, state: State) -> list[_Term]:
    values = _evaluated(scene, state.x, state.p, state.t)
    found = []
    for name, (energy, force) in values.items():
        shown = None if name == "gravity" else float(energy)
        found.append(_Term(name, shown, np.asarray(force)))
    return found


@eqx.filter_jit
def _evaluated(
    scene: Scene, x: NodeVectors, p: HingeValues | None, t: Scalar
) -> dict[str, tuple[Scalar, NodeVectors]]:
    """Return energies in J and nodal forces (n, 3) in N by name of the term."""
    hinges, rest = scene.bending.hinges(x), scene.rest_curvature_of(p)
    terms = {
        "stretch": (scene.membrane.energy(x), scene.membrane.force(x)),
        "bending": (scene.bending.energy(x, rest), scene.bending.force(hinges, rest, x.shape[0])),
    }
    if scene.contact is not None:
        terms["contact"] = (
            contact.energy(scene.contact, scene.own_lists, x),
            contact.force(scene.contact, scene.own_lists, x),
        )
    for index, wall in enumerate(scene.walls):
        terms[f"wall {index} ({type(wall.shape).__name__})"] = wall.energy(x, t), wall.force(x, t)
    for index, term in enumerate(scene.extra):
        terms[f"extra energy {index}"] = term.energy(x, t), term.force(x, t)
    if scene.gravity is not None:
        terms["gravity"] = jnp.zeros(()), scene.gravity.force()
    return terms


def _check_finite(term: _Term) -> None:
    bad = np.flatnonzero(~np.all(np.isfinite(term.force), axis=1))
    if bad.size:
        raise ValueError(
            f"{term.name}: the force on node {bad[0]} is {term.force[bad[0]]} N at the start; move that "
            "node, or change the numbers of this term."
        )
    if term.energy is not None and not np.isfinite(term.energy):
        raise ValueError(
            f"{term.name}: the energy is {term.energy} J at the start; change the numbers of this term."
        )


def _balance(scene: Scene, state: State, terms: list[_Term]) -> Balance:
    net = sum((term.force for term in terms), np.zeros(state.x.shape))
    held = np.zeros(net.shape, bool)
    if scene.prescribed is not None:
        held = np.asarray(scene.prescribed.held(state.t))
    least = STRAIN * float(jnp.mean(scene.membrane.stiffness) * jnp.mean(scene.membrane.rest_length))
    lines = [_pushes(scene, state, term) for term in terms if _largest(term.force)[1] > least]
    node, reaction = _largest(np.where(held, net, 0.0))
    if reaction > least:
        lines.append(f"supports: hold up to {reaction:.3g} N, at node {node}")
    node, left = _largest(np.where(held, 0.0, net))
    if left <= least:
        return Balance(True, lines)
    return Balance(False, [f"largest net force on a free node: {left:.3g} N, at node {node}", *lines])


def _largest(force: Float[np.ndarray, "nodes 3"]) -> tuple[int, float]:
    """Return the node with the largest of the forces (n, 3), and its magnitude in N."""
    size = np.linalg.norm(force, axis=1)
    return int(np.argmax(size)), float(size.max())


def _pushes(scene: Scene, state: State, term: _Term) -> str:
    node, force = _largest(term.force)
    stored = "" if term.energy is None else f"stores {_energy(term.energy)}, "
    return f"{term.name}: {stored}pushes node {node} with {force:.3g} N{_why(scene, state, term.name)}"


def _why(scene: Scene, state: State, name: str) -> str:
    """Describe how close to a wall or to itself the sheet starts."""
    if name == "contact":
        assert scene.contact is not None
        gap = float(contact.closest_sites(scene.contact, scene.own_lists, state.x)[0])
        reach = float(scene.contact.range)
        return f"; layers start {_length(gap)} apart, within its range of {_length(reach)}"
    if name.startswith("wall"):
        wall = scene.walls[int(name.split()[1])]
        gap, reach = float(jnp.min(wall.gap(state.x, state.t))), float(wall.range)
        return f"; the sheet starts {_length(gap)} from it, within its range of {_length(reach)}"
    return ""


def _energy(value: float) -> str:
    return f"{value * 1e3:.3g} mJ"


def _length(value: float) -> str:
    return f"{value * 1e3:.3g} mm"
