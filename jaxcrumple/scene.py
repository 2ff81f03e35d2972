"""Scene: the parameters of the equations of motion, and the input of derivatives."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Real

from jaxcrumple._jax.arrays import HingeValues, NodeValues, Scalar
from jaxcrumple._jax.door import door, own_modes
from jaxcrumple._jax.shared import kept_with_first
from jaxcrumple._jax.tree import as_array, is_known, require_finite, require_numbers, shown
from jaxcrumple.assembly.contact_blocks import ContactBlocks
from jaxcrumple.assembly.sparsity import Pattern, build_pattern
from jaxcrumple.contact.lists import ContactLists
from jaxcrumple.contact.parameters import Contact, SelfContact, build_contact, check_options_of
from jaxcrumple.material.material import Material, ModelConstants
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.bending import Bending
from jaxcrumple.model.checks import check_surroundings
from jaxcrumple.model.damping import AbstractDashpot, CentralDashpot, Drag, PaperDashpot
from jaxcrumple.model.loads import ElementEnergy, Gravity, Prescribed
from jaxcrumple.model.membrane import Membrane
from jaxcrumple.model.plasticity import AbstractFlowRule, SmoothstepFlow
from jaxcrumple.model.walls import AbstractShape, Wall

# Default wall stiffness as a share of the mean spring constant, for a sheet of WALL_NODES nodes.
WALL_SHARE = 0.05
WALL_NODES = 3000


class Scene(eqx.Module):
    """Describe a sheet, its surroundings and its scales, as `sheet` builds it.

    A term that is None costs nothing.

    - `mass` (n,) in kg; `area` in m2; `reference_acceleration` in m/s2: a_ref = ks / (m lambda), with lambda
      = sqrt(n / A); `velocity_scale` in m/s: unit of the velocity error in the error test of the explicit
      stage.
    - `membrane`, `bending`: always present. `plasticity`, `drag`, `damping`, `gravity`,
      `prescribed`, `contact`: may be None. `walls`, `extra`: tuples, possibly empty.
    - `pattern`: sparsity pattern of the tangent of the sheet.
    - `lists`: neighbour lists of `with_contacts`, or None. Runs build their own.
    """

    mass: NodeValues
    area: Scalar
    reference_acceleration: Scalar
    velocity_scale: Scalar
    membrane: Membrane
    bending: Bending
    plasticity: AbstractFlowRule | None
    drag: Drag | None
    damping: AbstractDashpot | None
    walls: tuple[Wall, ...]
    gravity: Gravity | None
    prescribed: Prescribed | None
    extra: tuple[ElementEnergy, ...]
    contact: Contact | None
    pattern: Pattern
    lists: ContactLists | None = None

    @property
    def n_nodes(self) -> int:
        """Return the number of nodes."""
        return self.mass.shape[0]

    @property
    def length_scale(self) -> Scalar:
        """Return sqrt(A) in m, the unit of the position error."""
        return jnp.sqrt(self.area)

    @property
    def inertial_time(self) -> Scalar:
        """Return m/b_iso in s, the time scale below which inertia exceeds drag; infinite without drag."""
        if self.drag is None:
            return jnp.asarray(jnp.inf)
        return jnp.mean(self.mass) / jnp.mean(self.drag.coefficient)

    @property
    def own_lists(self) -> ContactLists:
        """Return the neighbour lists.

        **Raises:** ValueError if the scene has none.
        """
        if self.lists is None:
            raise ValueError(
                "the scene has contact but no neighbour lists; build them for the positions: "
                "scene = jaxcrumple.with_contacts(scene, x)."
            )
        return self.lists

    @property
    def sparsity(self) -> Pattern:
        """Return the pattern of the tangent, with the blocks of the pairs in `lists`."""
        if self.contact is None or self.lists is None:
            return self.pattern
        with own_modes():
            blocks = ContactBlocks.of(self.lists.pairs, self.contact.faces, self.lists.matrix)
        return eqx.tree_at(lambda p: p.contact, self.pattern, blocks, is_leaf=lambda leaf: leaf is None)

    def rest_curvature_of(self, p: HingeValues | None) -> HingeValues:
        """Return the rest curvature `p` of a state, or the initial one in an elastic scene (`p` None)."""
        return self.bending.rest_curvature if p is None else p


def require_scene(scene: Any) -> None:
    """Check that an object is a Scene.

    **Raises:** ValueError that names the type of another object.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"scene has type {type(scene).__name__}; it must be a Scene from jaxcrumple.sheet.")


def check_scene(scene: Any) -> None:
    """Check the parts and numbers of a scene, which a caller may have replaced.

    Numbers that JAX traces are not checked.

    **Raises:** ValueError that names the type of another object, or the invalid part of the scene.
    """
    require_scene(scene)
    hinges = scene.bending.nodes.shape[0]
    gravity = None if scene.gravity is None else scene.gravity.g
    surroundings = (scene.walls, gravity, scene.prescribed, scene.extra, scene.plasticity)
    check_surroundings(scene.n_nodes, hinges, *surroundings)
    for name, value in (
        ("mass", scene.mass), ("area", scene.area), ("membrane.rest_length", scene.membrane.rest_length)
    ):  # fmt: skip
        require_numbers(f"scene.{name}", value, positive=True)
    for name, value in (
        ("membrane.stiffness", scene.membrane.stiffness),
        ("bending.stiffness", scene.bending.stiffness),
        ("drag.coefficient", None if scene.drag is None else scene.drag.coefficient),
        ("damping.coefficient", None if scene.damping is None else scene.damping.coefficient),
    ):
        if value is not None:
            require_numbers(f"scene.{name}", value)
    require_finite("scene.bending.rest_curvature", scene.bending.rest_curvature)


def with_lists(scene: Scene, lists: ContactLists | None) -> Scene:
    """Replace the neighbour lists."""
    return eqx.tree_at(lambda s: s.lists, scene, lists, is_leaf=lambda leaf: leaf is None)


@door
def sheet(
    mesh: Mesh,
    material: Material,
    *,
    walls: Sequence[Wall | AbstractShape] = (),
    gravity: Sequence[float] | Real[ArrayLike, "3"] | None = None,
    prescribed: Prescribed | None = None,
    extra: Sequence[ElementEnergy] = (),
    plasticity: AbstractFlowRule | None = None,
    damping: str = "central",
    contact: SelfContact | None = None,
    like: Scene | None = None,
) -> Scene:
    """Build the scene of one sheet.

    With `like`, the result is differentiable with respect to the material.

    **Arguments:**

    - `mesh`, `material`: the sheet.
    - `walls`: list of `Wall` objects or shapes. A shape gets the default stiffness (0.05 ks at n = 3000,
      scaled with node area) and the default range, which is the mean thickness.
    - `gravity`: acceleration (3,) in m/s2, or None.
    - `prescribed`: supports, a `Prescribed`. `extra`: user-defined energies, each an `ElementEnergy`.
    - `plasticity`: user-defined `AbstractFlowRule` that replaces the material's.
    - `damping`: "central" (default) or "paper" (eq. 25).
    - `contact`: `SelfContact(...)`, or None for a phantom sheet, which passes through itself.
    - `like`: a scene of the same mesh, stencils and contact. The new scene takes from it all data that the
      host builds: the tangent's pattern, the refinement of contact and the contact lists.

    **Returns:** a `Scene`.

    **Raises:** ValueError when x64 is off or an option is unknown; for walls, supports, energies or a flow
    rule of the wrong type, with shapes that do not fit the mesh, with node numbers outside the mesh, or with
    numbers that are not finite; or when `like` has another mesh, stencils or contact.

    >>> mesh = jc.hexagonal(5, 4, 2e-3)
    >>> paper = jc.Material(thickness=0.2e-3, density=800.0)
    >>> scene = jc.sheet(mesh, paper, walls=[jc.Plane((0, 0, 1), -0.01)], gravity=(0, 0, -9.81))
    >>> print(f"{scene.mass.sum() / mesh.area:.3f} kg/m2")
    0.160 kg/m2
    """
    if not isinstance(mesh, Mesh):
        raise ValueError(
            f"mesh = {shown(mesh)} must be a Mesh: Mesh.from_arrays(vertices, faces), disc(...)."
        )
    if not isinstance(material, Material):
        raise ValueError(f"material = {shown(material)} must be a Material, e.g. Material(thickness=1e-4).")
    if damping not in ("central", "paper"):
        raise ValueError(f"damping={damping!r} is unknown; choose 'central' or 'paper'.")
    _check_walls(walls)
    check_surroundings(mesh.n_nodes, len(mesh.hinges), walls, gravity, prescribed, extra, plasticity)
    if contact is not None and not isinstance(contact, SelfContact):
        raise ValueError(f"contact = {contact!r} must be SelfContact(...), or None for a phantom sheet.")
    if like is not None:
        _check_alike(mesh, contact, extra, like)
    constants = material.discretize(mesh)
    edges, hinges = as_array(mesh.edges), as_array(mesh.hinges)
    mass = as_array(constants.mass)
    b_int = as_array(constants.b_int)
    rest_length = as_array(mesh.edge_length)
    dashpot: AbstractDashpot | None
    if not _is_present(constants.b_int):
        dashpot = None
    elif damping == "central":
        dashpot = CentralDashpot(edges, b_int)
    else:
        dashpot = PaperDashpot(edges, b_int, rest_length)
    if plasticity is None and constants.c0 is not None:
        c0 = as_array(constants.c0)
        plasticity = SmoothstepFlow(c0, as_array(constants.plastic_time), as_array(constants.gamma))
    pattern = _pattern(mesh, extra, contact is not None) if like is None else like.pattern
    return Scene(
        mass=mass,
        area=as_array(mesh.area),
        reference_acceleration=as_array(constants.a_ref),
        velocity_scale=_velocity_scale(mesh, material),
        membrane=Membrane(edges, as_array(constants.ks), rest_length),
        bending=Bending(
            hinges,
            as_array(constants.kb * mesh.hinge_weight),
            as_array(mesh.rest_curvature),
        ),
        plasticity=plasticity,
        drag=Drag(as_array(constants.drag)) if _is_present(constants.drag) else None,
        damping=dashpot,
        walls=tuple(_wall(w, mesh, constants) for w in walls),
        gravity=None if gravity is None else Gravity(jnp.asarray(gravity, float), mass),
        prescribed=prescribed,
        extra=tuple(extra),
        contact=_contact(mesh, constants, contact, like),
        pattern=pattern,
        lists=None if like is None else like.lists,
    )


def _pattern(mesh: Mesh, extra: Sequence[ElementEnergy], contact: bool) -> Pattern:
    if not extra:
        return _pattern_of_mesh(mesh, contact)
    stencils = [mesh.edges, mesh.hinges, *(np.asarray(term.nodes) for term in extra)]
    return build_pattern(mesh.vertices, stencils, mesh.faces if contact else None)


@kept_with_first
def _pattern_of_mesh(mesh: Mesh, contact: bool) -> Pattern:
    return build_pattern(mesh.vertices, [mesh.edges, mesh.hinges], mesh.faces if contact else None)


def _contact(
    mesh: Mesh, constants: ModelConstants, options: SelfContact | None, like: Scene | None
) -> Contact | None:
    if options is None:
        return None
    return build_contact(mesh, constants, options, None if like is None else like.contact)


def _check_alike(mesh: Mesh, contact: SelfContact | None, extra: Sequence[ElementEnergy], like: Any) -> None:
    if not isinstance(like, Scene):
        raise ValueError(f"like has type {type(like).__name__}; it must be a Scene.")
    pairs = [(mesh.edges, like.membrane.nodes), (mesh.hinges, like.bending.nodes)]
    same = all(np.array_equal(*pair) for pair in pairs if is_known(pair))
    if not same or like.n_nodes != mesh.n_nodes or (contact is None) != (like.contact is None):
        raise ValueError(
            "the scene `like` has another mesh, or only one of the two scenes has contact; leave `like` out."
        )
    own, its = ([term.nodes for term in terms] for terms in (extra, like.extra))
    if len(own) != len(its) or (is_known(own, its) and not all(map(np.array_equal, own, its))):
        raise ValueError("the scene `like` has an `extra` with other nodes; leave `like` out.")
    if contact is not None and like.contact is not None:
        check_options_of(contact, like.contact)


def _check_walls(walls: Any) -> None:
    if not isinstance(walls, Sequence) or not all(isinstance(w, Wall | AbstractShape) for w in walls):
        raise ValueError(
            f"walls = {shown(walls)} must be a list of shapes or walls: [Sphere(center, radius)]."
        )


def _wall(wall: Wall | AbstractShape, mesh: Mesh, constants: ModelConstants) -> Wall:
    if isinstance(wall, Wall):
        return wall
    share = WALL_SHARE * constants.ks.mean() * WALL_NODES / mesh.area
    return Wall(wall, as_array(share * mesh.node_area), as_array(constants.sigma))


def _velocity_scale(mesh: Mesh, material: Material) -> Scalar:
    """Return the velocity in m/s whose error counts as much as a position error of the sheet's size.

    Before drag removes a velocity error, it moves a node by the error divided by the drag rate. Without drag
    the scale is the speed of sound in the sheet.
    """
    if _is_present(material.drag_rate):
        return as_array(np.sqrt(mesh.area) * material.drag_rate)
    return jnp.sqrt(as_array(material.young_modulus / material.density))


def _is_present(values: Any) -> bool:
    """Return whether any value differs from 0. Values that JAX traces count as nonzero."""
    return not is_known(values) or bool(np.any(values))
