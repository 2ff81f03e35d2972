"""Values that pictures of a run can show as colours."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable

from jaxcrumple.contact.energy import force
from jaxcrumple.io.run import Run
from jaxcrumple.measure import DAMAGE, edge_strain, mean_curvature, node_damage
from jaxcrumple.measure.density import face_edges
from jaxcrumple.options.suggest import nearest
from jaxcrumple.plot.sheet import CURVATURE_LABEL, color_scale
from jaxcrumple.run.config import RunConfig
from jaxcrumple.scene import Scene
from jaxcrumple.scenes.catalogue import SCENES
from jaxcrumple.scenes.functions import is_function
from jaxcrumple.solvers.contact.reallocate import with_contacts

Values = Float[np.ndarray, " ..."]


class FieldKind(NamedTuple):
    """Describe a field: its `label` with unit, whether its colours are symmetric about 0 (`signed`), its
    values per node (n,) or triangle (f,) at a frame of a run, by index, over how many `decades` its colours
    are logarithmic, if they are, and the `least` end of its scale."""

    label: str
    signed: bool
    values: Callable[[Run, int], Values]
    decades: float | None = None
    least: float = 0.0

    def scale(self, *frames: Values) -> ScalarMappable:
        """Return the colour scale of its values in some frames."""
        return color_scale(*frames, signed=self.signed, decades=self.decades, least=self.least)


def _curvature(run: Run, frame: int) -> Values:
    return mean_curvature(run.mesh, run.x[frame])


def _damage(run: Run, frame: int) -> Values:
    return node_damage(run.mesh, run.p[frame])


def _strain(run: Run, frame: int) -> Values:
    """Return the strain (f,) in % of the side of each triangle that is strained most."""
    strain = 100.0 * edge_strain(run.mesh, run.x[frame])[face_edges(run.mesh)]
    return np.take_along_axis(strain, np.argmax(np.abs(strain), axis=1)[:, None], axis=1)[:, 0]


def _contact(run: Run, frame: int) -> Values:
    """Return the contact force on each node, in its area, in kPa."""
    name = run.config.get("scene")
    if run.scene is None and not (name in SCENES or is_function(name)):
        raise ValueError(
            "the contact force needs the scene of the run: dataclasses.replace(run, scene=setup.scene)."
        )
    with jax.enable_x64(True):
        x, scene = jnp.asarray(run.x[frame]), run.scene or _scene(json.dumps(run.config))
        contact = scene.contact
        if contact is None:
            return np.zeros(run.mesh.n_nodes)
        lists = with_contacts(scene, x).own_lists
        push = np.linalg.norm(np.asarray(force(contact, lists, x)), axis=1)
    return 1e-3 * push / run.mesh.node_area


@functools.lru_cache(maxsize=1)
def _scene(config: str) -> Scene:
    """Return the scene of a configuration as JSON, which all frames of a film share."""
    return RunConfig(**json.loads(config)).build().scene


# The first one is the default. "paper" shows the shape alone.
FIELDS: dict[str, FieldKind | None] = {
    "curvature": FieldKind(CURVATURE_LABEL, True, _curvature, least=1.0),
    "damage": FieldKind(
        "damage: largest change of $p = 2 \\sin(\\theta_{rest} / 2)$ [-]", False, _damage, least=DAMAGE
    ),
    "strain": FieldKind("largest edge strain [%]", True, _strain, least=1e-3),
    "contact": FieldKind("contact force per area [kPa]", False, _contact, decades=3.0),
    "paper": None,
}


def field_kind(name: str) -> FieldKind | None:
    """Return the field of a name.

    **Raises:** ValueError for an unknown name.
    """
    if name not in FIELDS:
        raise ValueError(f"field {name!r} is unknown{nearest(name, FIELDS)}")
    return FIELDS[name]
