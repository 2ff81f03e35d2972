"""Report on the contact of a scene: what interacts, and whether and why the neighbour lists are valid."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.arrays import Count, NodeVectors, NodeVectorsLike, Scalar
from jaxcrumple._jax.door import door
from jaxcrumple.contact.adjacency import MOST_TURN
from jaxcrumple.contact.energy import closest_sites, energy
from jaxcrumple.contact.lists import ContactLists, Reference, motion
from jaxcrumple.contact.parameters import Contact
from jaxcrumple.scene import Scene, require_scene
from jaxcrumple.solvers.contact.crossings import unlisted_turn
from jaxcrumple.solvers.contact.reallocate import with_contacts
from jaxcrumple.state import check_positions

# Lists with a reference of their own; triangle pairs and sites are parts of the list of site pairs.
OWN_REFERENCE = ("candidate pairs", "site pairs")


class ListReport(NamedTuple):
    """Describe one list: its name, its number of entries and its capacity for them; the smallest skin of a
    node in m; and the node that used up the largest share of its skin, with that share.

    A share above 1 or an overflow makes the list invalid.
    """

    name: str
    entries: int
    capacity: int
    skin: float
    node: int
    share: float

    @property
    def fault(self) -> str:
        """Say why the list is not valid; empty if it is."""
        if self.entries > self.capacity:
            return f"{self.name} need a capacity of {self.entries}, not {self.capacity}"
        if not self.share <= 1.0 and self.name in OWN_REFERENCE:
            return f"node {self.node} moved {self.share:.3g} times its skin since the {self.name} were built"
        return ""


class ContactReport(NamedTuple):
    """Describe the contact of a sheet at given positions.

    - `valid`: whether energies and forces can be computed; `reasons`: why not.
    - `energy` in J; `interacting`: number of interacting site pairs; `gap` in m: the smallest distance of two
      of them, or infinity; `closest`: nodes of the two triangles of that pair, or None.
    - `turn` in rad: largest turn around a node of two triangles that the candidates leave out.
    - `lists`: the lists, coarse to fine.
    """

    valid: bool
    reasons: tuple[str, ...]
    energy: float
    interacting: int
    gap: float
    closest: tuple[tuple[int, ...], tuple[int, ...]] | None
    turn: float
    lists: tuple[ListReport, ...]

    def __str__(self) -> str:
        """Return the report as a table."""
        head = f"contact energy {self.energy:.6g} J, {self.interacting} interacting site pairs"
        if self.closest is not None:
            first, second = self.closest
            head += f", smallest gap {self.gap:.4g} m between triangles {first} and {second}"
        rows = [f"{'list':<16}{'entries':>10}{'capacity':>10}{'skin (m)':>12}{'skin used':>11}  node"]
        rows += [
            f"{name:<16}{entries:>10}{capacity:>10}{skin:>12.3g}{share:>11.1%}  {node if share else '-'}"
            for name, entries, capacity, skin, node, share in self.lists
        ]
        turn = f"largest turn left out: {np.rad2deg(self.turn):.0f} of {np.rad2deg(MOST_TURN):.0f} degrees"
        return "\n".join([head, *rows, turn, *self.reasons])


@door
def contact_report(scene: Scene, x: NodeVectorsLike) -> ContactReport:
    """Report on the contact of a scene at positions `x` (n, 3) in m; printed, it is a table.

    The lists are those of the scene, or new ones for `x` if the scene has none.

    **Raises:** ValueError for a scene without contact, or for positions of another shape or not finite.
    """
    require_scene(scene)
    if scene.contact is None:
        raise ValueError("the scene has no contact to report on; build it with contact=SelfContact().")
    check_positions("x", x, scene.n_nodes)
    scene = with_contacts(scene, x) if scene.lists is None else scene
    contact, lists, x = scene.contact, scene.own_lists, jnp.asarray(x, float)
    assert contact is not None
    numbers, place, turn = _measured(scene, x)
    reports = tuple(_reports(lists, x))
    reasons = tuple(report.fault for report in reports if report.fault)
    if turn > MOST_TURN:
        reasons += ("two triangles at a node came close by folding, and the candidates leave them out",)
    gap, interacting = float(numbers[1]), int(numbers[2])
    closest = _corners(contact, lists, int(place)) if interacting else None
    return ContactReport(
        not reasons, reasons, float(numbers[0]), interacting, gap, closest, float(turn), reports
    )


@eqx.filter_jit
def _measured(scene: Scene, x: NodeVectors) -> tuple[tuple[Scalar, Scalar, Count], Count, Scalar]:
    """Compute energy, smallest gap and number of interacting site pairs; the place of the closest pair; and
    the largest turn left out."""
    contact, lists = scene.contact, scene.own_lists
    assert contact is not None
    gap, count, place = closest_sites(contact, lists, x)
    return (energy(contact, lists, x), gap, count), place, unlisted_turn(scene, x)


def _reports(lists: ContactLists, x: NodeVectors) -> Iterator[ListReport]:
    """Yield the reports of the lists, coarse to fine."""
    candidates, pairs = lists.candidates, lists.pairs
    used = _used(candidates.reference, x)
    yield ListReport("candidate pairs", int(candidates.count), candidates.triangles.shape[0], *used)
    names = ("triangle pairs", "sites", "site pairs")
    used = _used(pairs.reference, x)
    for name, needed, capacity in zip(names, pairs.needed, pairs.capacity, strict=True):
        # The narrow phase counts more site pairs than it lists: neighbours at rest are among them.
        yield ListReport(name, int(needed), capacity, *used)


def _used(reference: Reference, x: NodeVectors) -> tuple[float, int, float]:
    """Return the smallest skin in m, and the node that used the largest share of its skin, with the share."""
    skin = np.asarray(reference.skin)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.asarray(motion(reference.x, x)) / skin
    # A list that was never built has positions NaN.
    share = np.where(np.isnan(share), np.inf, share)
    node = int(np.argmax(share))
    return float(skin.min()), node, float(share[node])


def _corners(contact: Contact, lists: ContactLists, place: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the nodes of both triangles of a listed pair."""
    faces = np.asarray(contact.faces)[np.asarray(lists.pairs.triangles)[place]]
    first, second = (tuple(int(node) for node in nodes) for nodes in faces)
    return first, second
