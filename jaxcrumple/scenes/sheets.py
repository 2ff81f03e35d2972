"""Sheets of the scenes (flat with a smooth imperfection, or curved at rest), and their setup with walls."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxcrumple._jax.memory import require
from jaxcrumple._jax.shared import shared
from jaxcrumple._jax.tree import as_array
from jaxcrumple.contact.parameters import SelfContact, default_level, is_range
from jaxcrumple.contact.potentials import DEFAULT_POTENTIAL, Potential
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import disc, rectangle
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.loads import ElementEnergy, Prescribed
from jaxcrumple.model.walls import AbstractShape
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.quantities import ContactLevel, Damping, Imperfection, Length, Sweeps
from jaxcrumple.scenes.setup import Setup

# Shortest wavelength of the initial imperfection in m.
IMPERFECTION_WAVELENGTH = 0.02
# A sheet with edges longer than COARSE contact ranges cannot fold as far as `axial` and `cylindrical`
# compress it. Its layers meet at up to 100 m/s, and pass between sites that are a range apart. Sites that
# are CLOSE_SPACING ranges apart stop them; with shorter edges they only cost time.
COARSE, CLOSE_SPACING = 11.0, 2.0 / 3.0
# Memory per mode in bytes.
MODE = 40.0


@dataclass(frozen=True, kw_only=True)
class SheetOptions:
    """Options that the scenes of crumpled sheets share.

    `imperfection`: largest height in m of a smooth, stress-free initial shape; `sweeps`: Lloyd sweeps of
    the random mesh; `damping`: "central" or "paper"; `contact`: "inverse-power", "penalty", "barrier", or
    None for a phantom sheet, which passes through itself, with `contact_range` and `contact_level` as in
    `SelfContact`; `material`: default `Material()`.
    """

    imperfection: Imperfection = 25e-6
    sweeps: Sweeps = 100
    damping: Damping = "central"
    contact: Potential | None = DEFAULT_POTENTIAL
    contact_range: Length | None = None
    contact_level: ContactLevel | None = None
    material: Material = field(default_factory=Material)

    def reaching(self, thicknesses: float) -> "SheetOptions":
        """Return the options with a contact range in `thicknesses`, if there is contact without a range."""
        if self.contact is None or self.contact_range is not None:
            return self
        return replace(self, contact_range=thicknesses * self.thickness)

    def finer(self, mesh: Mesh) -> "SheetOptions":
        """Return the options with closer sites on a coarse mesh, if there is contact without a level."""
        sigma = self.contact_range
        # `setup` refuses a range that is none.
        if self.contact is None or self.contact_level is not None or not is_range(sigma):
            return self
        assert sigma is not None
        if mesh.edge_length.mean() <= COARSE * sigma:
            return self
        return replace(self, contact_level=default_level(mesh, sigma, self.contact, CLOSE_SPACING))

    def square(self, size: float, nodes: int, seed: int) -> Mesh:
        """Mesh a square of edge `size` in m around the origin of the plane z = 0, with its imperfection."""
        flat = rectangle(size, size, nodes, seed=seed, sweeps=self.sweeps)
        return self.imperfect(flat, size, seed)

    def disc(self, radius: float, nodes: int, seed: int) -> Mesh:
        """Mesh a disc of `radius` in m around the origin of the plane z = 0, with its imperfection."""
        return self.imperfect(disc(radius, nodes, seed=seed, sweeps=self.sweeps), 2.0 * radius, seed)

    def imperfect(self, flat: Mesh, size: float, seed: int) -> Mesh:
        """Add the imperfection to a `flat` sheet within a square of edge `size` in m around the origin.

        **Raises:** ValueError for an imperfection that is negative or not finite.
        """
        if not (np.isfinite(self.imperfection) and self.imperfection >= 0):
            raise ValueError(f"imperfection = {self.imperfection!r} m must be zero or positive.")
        return _imperfect(flat, size, self.imperfection, seed)

    @property
    def thickness(self) -> float:
        """Mean thickness in m, also the range of walls."""
        return float(np.mean(self.material.thickness))

    @property
    def clearance(self) -> float:
        """Distance in m from a wall, just beyond its range."""
        return 1.1 * self.thickness

    def setup(
        self,
        mesh: Mesh,
        walls: Sequence[AbstractShape],
        *,
        x: Float[np.ndarray, "nodes 3"] | None = None,
        prescribed: Prescribed | None = None,
        extra: Sequence[ElementEnergy] = (),
    ) -> Setup:
        """Build the setup of a sheet with walls and initial positions `x` (n, 3) in m, default at rest."""
        contact = None
        if self.contact is not None:
            contact = SelfContact(self.contact, self.contact_range, self.contact_level)
        scene = sheet(
            mesh,
            self.material,
            walls=walls,
            prescribed=prescribed,
            extra=extra,
            damping=self.damping,
            contact=contact,
        )
        return Setup(mesh, scene, as_array(mesh.vertices if x is None else x), contact, self.material)


@shared
def _imperfect(flat: Mesh, size: float, amplitude: float, seed: int) -> Mesh:
    height = smooth_imperfection(flat.vertices[:, :2], size, amplitude, seed)
    return flat.with_rest_shape(flat.vertices + height[:, None] * np.array([0.0, 0.0, 1.0]))


def smooth_imperfection(
    points: Float[np.ndarray, "nodes 2"], size: float, amplitude: float, seed: int
) -> Float[np.ndarray, " nodes"]:
    """Return a smooth random height (n,) in m at `points` (n, 2) within a square of edge `size` in m.

    The largest absolute value is `amplitude` in m. The wavelengths are at least 2 cm; a smaller sheet has
    only the longest mode.
    """
    if amplitude == 0.0:
        return np.zeros(len(points))
    rng = np.random.default_rng([seed, 1])
    # At least one mode along each axis.
    highest = max(int(2.0 * size / IMPERFECTION_WAVELENGTH), 2)
    require(
        MODE * float(highest) ** 2 + 32.0 * len(points) * highest,
        f"an imperfection of {float(highest) ** 2:.2g} modes of {IMPERFECTION_WAVELENGTH:g} m on a sheet of "
        f"{size:g} m",
        "choose imperfection = 0, or check that the size is in metres",
    )
    waves = np.arange(1, highest + 1)
    x, y = (np.cos(np.pi * np.outer(points[:, i] / size + 0.5, waves)) for i in range(2))
    weights = rng.normal(size=(highest, highest))
    weights[np.hypot(*np.meshgrid(waves, waves)) > highest] = 0.0
    height = np.einsum("ni,ij,nj->n", x, weights, y)
    return amplitude * height / max(np.max(np.abs(height)), np.finfo(float).tiny)


def wrapped(
    vertices: Float[np.ndarray, "nodes 3"], radius: float, *, along: str | None = None
) -> Float[np.ndarray, "nodes 3"]:
    """Wrap a flat sheet over a ball of `radius` in m below it, or over a cylinder `along` "x" or "y".

    Return points (n, 3) in m. The map keeps heights over the sheet and distances from the origin (ball) or
    from the line of contact (cylinder).
    """
    flat, height = vertices[:, :2], vertices[:, 2]
    across = np.array([along != "x", along != "y"], float)
    angle = np.linalg.norm(flat * across, axis=1) / radius
    # np.sinc(x) is sin(pi x) / (pi x).
    stretch = (1.0 + height / radius) * np.sinc(angle / np.pi)
    sides = flat * (1.0 + (stretch - 1.0)[:, None] * across)
    return np.column_stack([sides, (radius + height) * np.cos(angle) - radius])


def upright(points: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3"]:
    """Rotate points (n, 3) of a sheet in the x-y plane into the x-z plane: y becomes z, and z becomes -y."""
    return points[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
