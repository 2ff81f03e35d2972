"""Contact of a scene with its lists, as functions of positions alone."""

import equinox as eqx

from jaxcrumple.contact import ccd, coverage, energy
from jaxcrumple.contact.lists import ContactLists
from jaxcrumple.contact.parameters import Contact


class Bound(eqx.Module):
    """Parameters and lists of contact."""

    contact: Contact
    lists: ContactLists | None

    def energy(self, x):
        return energy.energy(self.contact, self.lists, x)

    def force(self, x):
        return energy.force(self.contact, self.lists, x)

    def gaps(self, x):
        """Smallest gap, and number of interacting site pairs."""
        return energy.closest_sites(self.contact, self.lists, x)[:2]

    def covers(self, x):
        return coverage.covers(self.lists, x)

    def crosses(self, start, end):
        return ccd.crosses(self.contact, self.lists, start, end)


def bound(scene):
    """The contact of a scene, with its lists."""
    return Bound(scene.contact, scene.lists)
