"""What a scene's function makes: all that a run needs but its solver."""

from typing import NamedTuple

from jax import Array

from jaxcrumple.material import Material
from jaxcrumple.mesh import Mesh
from jaxcrumple.model.contact import SelfContact
from jaxcrumple.model.damping import PaperDashpot
from jaxcrumple.model.scene import Scene, sheet


class Setup(NamedTuple):
    """A scene ready to run: the sheet's `mesh`, the `scene`, where its nodes `x` (n, 3) start, options of its
    self-`contact`, if it has any, and the `material` it is made of, if that is known."""

    mesh: Mesh
    scene: Scene
    x: Array
    contact: SelfContact | None = None
    material: Material | None = None

    def made_of(self, material: Material) -> Scene:
        """The scene with the sheet of another material, and walls and contact as they follow from that: a
        function with derivatives."""
        scene = self.scene
        return sheet(
            self.mesh,
            material,
            walls=[wall.shape for wall in scene.walls],
            gravity=None if scene.gravity is None else tuple(scene.gravity.g),
            prescribed=scene.prescribed,
            extra=scene.extra,
            damping="paper" if isinstance(scene.damping, PaperDashpot) else "central",
            contact=self.contact,
            like=scene,
        )
