"""A square sheet that is folded in half, pressed, let go, and springs open to its final angle (Fig. 3b)."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float
from jaxcrumple.geometry.hinge import cross, gather, sub
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.loads import AbstractMotion, Prescribed
from jaxcrumple.model.walls import Corners, Plane
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.snap import check_gap, check_positive

# Strips along two edges that are held, as a share of the sheet's size.
GRIP = 0.08
# Edge of the sheet in m.
SIZE = 0.1
# The gap between the plates in m, and the least one in mean distances between nodes of a coarse mesh, which
# snaps from one zigzag of edges to the next where it is bent to a sharper crease.
GAP, COARSEST = 6e-3, 2.0
# Height of the upper plate when the sheet is closed, and after the release, as a share of the size.
OPEN = 0.6
# Time in which plates move away in s.
RETREAT = 0.02
# Of the halves' triangles, those further from the fold than this share of the size tell its angle.
FLAT = 0.2


class FoldTimes(NamedTuple):
    """How long each part of a fold lasts, in s: to `close` it, to `press` it, to `hold` it, to `relax`."""

    close: float = 0.5
    press: float = 0.25
    hold: float = 0.05
    relax: float = 0.3

    @property
    def release(self) -> float:
        """Time of the release."""
        return self.close + self.press + self.hold

    @property
    def end(self) -> float:
        """Time at which all is over."""
        return self.release + self.relax


TIMES = FoldTimes()


class Closing(AbstractMotion):
    """The right half turns about the line x = 0 at a height until it lies over the left one.

    **Arguments:** `position` (n, 3) in m at t = 0; `height` of the line in m; `time` in s that it takes.
    """

    position: Array = eqx.field(converter=as_float)
    height: Array = eqx.field(converter=as_float)
    time: Array = eqx.field(converter=as_float)

    def __call__(self, t: Array) -> Array:
        """Positions at time `t`."""
        angle = 0.5 * jnp.pi * (1.0 - jnp.cos(jnp.pi * jnp.clip(t / self.time, 0.0, 1.0)))
        x, y, z = self.position.T
        up, sine, cosine = z - self.height, jnp.sin(angle), jnp.cos(angle)
        turned = [x * cosine - up * sine, y, self.height + x * sine + up * cosine]
        return jnp.where((x > 0)[:, None], jnp.stack(turned, axis=1), self.position)


@door
def fold(
    nodes: int = 1000,
    seed: int = 0,
    *,
    size: float = SIZE,
    gap: float | None = None,
    close: float = TIMES.close,
    press: float = TIMES.press,
    hold: float = TIMES.hold,
    relax: float = TIMES.relax,
    sweeps: int = 100,
    material: Material | None = None,
) -> Setup:
    """A square sheet of edge `size` whose halves are brought together, pressed between plates a `gap` apart,
    held, and let go.

    Strips along two opposite edges are held: one rests, the other turns about the middle line until it lies
    over the first, for the time `close`. Then the upper plate comes down for the time `press` and flattens
    the loop between them to a crease. After the time `hold` strips and plates let go, and the sheet springs
    open; drag brings it to rest within the time `relax`. `fold_angle` measures what is left.

    **Arguments:** `nodes` of the random mesh made with `seed` and `sweeps` Lloyd sweeps; `size` in m; `gap`
    in m, by default 6 mm, or twice the distance between nodes of a mesh that is too coarse for it; `close`,
    `press`, `hold`, `relax` in s; `material`: default `Material()`.

    **Raises:** ValueError for lengths or times that are not positive, or a gap that the sheet fills.
    """
    times = FoldTimes(close, press, hold, relax)
    check_positive(size=size, **times._asdict())
    gap = default_gap(nodes, size) if gap is None else gap
    check_positive(gap=gap)
    material = material or Material()
    thickness = float(np.mean(material.thickness))
    check_gap(gap, thickness)
    lift = 0.5 * gap - thickness
    flat = rectangle(size, size, nodes, seed=seed, sweeps=sweeps)
    mesh = flat.with_rest_shape(flat.vertices - np.array([0.0, 0.0, lift]))
    held = np.abs(mesh.vertices[:, 0]) > (0.5 - GRIP) * size
    motion = Closing(jnp.asarray(mesh.vertices), as_float(0.0), as_float(times.close))
    grip = Prescribed(jnp.asarray(np.repeat(held[:, None], 3, axis=1)), motion, as_float(times.release))
    scene = sheet(mesh, material, walls=plates(size, gap, times), prescribed=grip)
    return Setup(mesh, scene, jnp.asarray(mesh.vertices), material=material)


def default_gap(nodes: int, size: float = SIZE) -> float:
    """Gap in m between the plates for a mesh of as many nodes."""
    check_positive(nodes=nodes, size=size)
    return max(GAP, COARSEST * size * math.sqrt(2.0 / (math.sqrt(3.0) * nodes)))


def plates(size: float, gap: float, times: FoldTimes) -> list[Plane]:
    """The lower plate, and the upper one that comes down; both move away after the release."""
    high, low = OPEN * size, 0.5 * gap
    moments = jnp.cumsum(jnp.array([0.0, times.close, times.press, times.hold, RETREAT]))
    lower = Corners(moments, -jnp.array([low, low, low, low, high]))
    upper = Corners(moments, -jnp.array([high, high, low, low, high]))
    up = jnp.array([0.0, 0.0, 1.0])
    return [Plane(up, lower), Plane(-up, upper)]


@door
def fold_angle(mesh: Mesh, x: Array) -> Array:
    """Angle in rad between the two halves of a folded sheet at positions `x` (n, 3): pi where it is flat.

    From the mean normals of the triangles of either half away from the fold; a smooth function of `x`.
    """
    side = np.sign(mesh.vertices[mesh.faces, 0])
    away = np.abs(mesh.vertices[mesh.faces, 0]).min(axis=1) > FLAT * np.ptp(mesh.vertices[:, 0])
    one, two = (_normal(x, mesh.faces[away & np.all(side == sign, axis=1)]) for sign in (-1.0, 1.0))
    turned = jnp.linalg.norm(jnp.cross(one, two))
    return jnp.pi - jnp.arctan2(turned, one @ two)


def _normal(x: Array, faces: np.ndarray) -> Array:
    """Sum (3,) of the normals of triangles, weighed by their areas."""
    a, b, c = gather(x, jnp.asarray(faces))
    return jnp.stack([jnp.sum(part) for part in cross(sub(b, a), sub(c, a))])
