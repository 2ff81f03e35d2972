"""Setup: the output of a scene function, all that a run needs except the solver."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxcrumple._jax.arrays import NodeVectors, Scalar
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import is_known
from jaxcrumple.contact.parameters import SelfContact
from jaxcrumple.material.material import Material, changed
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.damping import PaperDashpot
from jaxcrumple.model.plasticity import AbstractFlowRule
from jaxcrumple.model.walls import AbstractShape, Wall
from jaxcrumple.scene import Scene, sheet

# Relative tolerance for rounding errors.
ROUNDING = 1e-12
# Values of a scene that follow from its mesh (values changed by the user are kept), and those that follow
# from its material.
_SHAPE = ("bending.rest_curvature", "membrane.rest_length")
_MATERIAL = (
    "mass", "area", "reference_acceleration", "velocity_scale", "membrane.stiffness", "bending.stiffness",
    "drag", "damping", "gravity.mass", "contact.stiffness", "contact.range", "contact.density",
)  # fmt: skip
_YIELD = ("yield_curvature", "yield_c0", "gamma", "plastic_time")


class Setup(NamedTuple):
    """A scene ready to run: what scene functions such as `radial` return, and `start_run` and `sweep` take.

    - `mesh` of the sheet; `scene`; `x` (n, 3): initial positions in m.
    - `contact`: options of self-contact, None without it; `material`: None if unknown.
    - `t_end` in s, `frames`: end time and number of frames of a run that gives none.
    """

    mesh: Mesh
    scene: Scene
    x: NodeVectors
    contact: SelfContact | None = None
    material: Material | None = None
    t_end: float | None = None
    frames: int | None = None

    @door
    def made_of(self, material: Material) -> Scene:
        """Return the scene with a sheet of another material; recompute walls and contact for it.

        The function is differentiable. It keeps values that do not follow from the material of the setup:
        walls with their own stiffness or range, a user-defined flow rule, rest curvatures and rest lengths.

        **Raises:** ValueError for a setup without a material, or with a scene whose values do not follow from
        it; or for a new yield point if the flow rule is user-defined.

        >>> setup = jc.radial(60)
        >>> thick = setup.made_of(jc.Material(thickness=0.5e-3))  # instead of 0.25 mm
        >>> print(f"{thick.mass.sum() / setup.scene.mass.sum():.6f}")
        2.000000
        >>> print(f"{thick.bending.stiffness.sum() / setup.scene.bending.stiffness.sum():.6f}")
        8.000000
        """
        scene, own = self.scene, self._as_its_material_makes_it()
        for name in _MATERIAL:
            if not _alike(_part(scene, name), _part(own, name)):
                raise ValueError(
                    f"{name} of the setup's scene does not follow from its material, so made_of cannot "
                    "change it: build the scene by jaxcrumple.sheet(mesh, material, ...), and replace "
                    f"{name} there."
                )
        rule = None if _alike(scene.plasticity, own.plasticity) else scene.plasticity
        if rule is None and scene.plasticity is None and own.plasticity is not None:
            raise ValueError(
                "the setup's scene has no plasticity, but its material yields: give the setup an elastic "
                "material, Material(yield_curvature=None)."
            )
        assert self.material is not None
        for name in _YIELD:
            if rule is not None and changed(name, self.material, material):
                raise ValueError(
                    f"{name} changes, but the setup's flow rule, {type(rule).__name__}, does not follow from "
                    "its material; change the values of the rule with eqx.tree_at."
                )
        pairs = zip(scene.walls, own.walls, strict=True)
        walls = [wall.shape if _alike(_law(wall), _law(its)) else wall for wall, its in pairs]
        made = self._made(material, walls, rule)
        for name in _SHAPE:
            if not _alike(_part(scene, name), _part(own, name)):
                made = eqx.tree_at(functools.partial(_part, name=name), made, _part(scene, name))
        return made

    def _as_its_material_makes_it(self) -> Scene:
        """Return the scene that follows from the material of the setup alone."""
        if self.material is None:
            raise ValueError(
                "the setup has no material, so made_of cannot tell which values follow from it: use "
                "Setup(mesh, scene, x, contact, material)."
            )
        if not is_known(*vars(self.material).values(), self.scene.mass):
            raise ValueError("made_of needs a setup of plain numbers: make it outside of jit, grad and vmap.")
        with jax.ensure_compile_time_eval():
            return self._made(self.material, [wall.shape for wall in self.scene.walls], None)

    def _made(
        self, material: Material, walls: list[Wall | AbstractShape], plasticity: AbstractFlowRule | None
    ) -> Scene:
        scene = self.scene
        return sheet(
            self.mesh,
            material,
            walls=walls,
            gravity=None if scene.gravity is None else scene.gravity.g,
            prescribed=scene.prescribed,
            extra=scene.extra,
            plasticity=plasticity,
            damping="paper" if isinstance(scene.damping, PaperDashpot) else "central",
            contact=self.contact,
            like=scene,
        )


def _part(scene: Scene, name: str) -> Any:
    """Return a part of the scene by its dotted name, or None if the scene lacks it."""
    found: Any = scene
    for step in name.split("."):
        found = getattr(found, step, None)
    return found


def _law(wall: Wall) -> tuple[type, Float[Array, " ..."], Scalar]:
    """Return the parameters of a wall that follow from the material."""
    return type(wall), wall.stiffness, wall.range


def _alike(one: Any, other: Any) -> bool:
    """Return whether two trees are equal up to rounding; False if a value is a JAX tracer."""
    numbers, rest = eqx.partition((one, other), eqx.is_array)
    if not (eqx.tree_equal(*rest) is True and is_known(numbers)):
        return False
    pairs = zip(*map(jax.tree.leaves, numbers), strict=True)
    return all(np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=ROUNDING, atol=0.0) for a, b in pairs)
