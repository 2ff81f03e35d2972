"""Square sheet folded in half, pressed and released; it springs open to its final angle (Fig. 3b)."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxcrumple._jax.arrays import NodeVectors, NodeVectorsLike, Scalar
from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_float, require_shape
from jaxcrumple.geometry.hinge import cross, gather, sub
from jaxcrumple.material.material import Material
from jaxcrumple.mesh.generate import rectangle
from jaxcrumple.mesh.mesh import Mesh
from jaxcrumple.model.loads import AbstractMotion, Prescribed
from jaxcrumple.model.walls import PiecewiseLinear, Plane
from jaxcrumple.scene import sheet
from jaxcrumple.scenes.quantities import Duration, Length, Sweeps
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.snap import check_gap, check_positive

# Width of the held strips along two edges, in units of the sheet size.
GRIP = 0.08
# Edge of the sheet in m.
SIZE = 0.1
# Default gap between the plates in m, and the least gap in mean node distances. A coarse mesh bent to a
# sharper crease snaps from one zigzag of edges to the next.
GAP, COARSEST = 6e-3, 2.0
# Height of the upper plate while the sheet closes and after the release, in units of the sheet size.
OPEN = 0.6
# Time in s in which the plates retract.
RETREAT = 0.02
# Least distance from the fold of the triangles that define the fold angle, in units of the sheet size.
FLAT = 0.2


class FoldTimes(NamedTuple):
    """Durations in s of the parts of a fold: `close`, `press`, `hold` and `relax`."""

    close: float = 0.5
    press: float = 0.25
    hold: float = 0.05
    relax: float = 0.3

    @property
    def release(self) -> float:
        """Time of the release in s."""
        return self.close + self.press + self.hold

    @property
    def end(self) -> float:
        """Time in s at which the relaxation ends."""
        return self.release + self.relax


TIMES = FoldTimes()


class Closing(AbstractMotion):
    """Rotation of the right half about a line at x = 0 and z = `height`, until it lies over the left half.

    **Arguments:** `position` (n, 3) in m at t = 0; `height` of the line in m; `time`: duration in s.
    """

    position: NodeVectors = eqx.field(converter=as_float)
    height: Scalar = eqx.field(converter=as_float)
    time: Scalar = eqx.field(converter=as_float)

    def __call__(self, t: Scalar | float) -> NodeVectors:
        """Return the positions (n, 3) in m at time `t`."""
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
    size: Length = SIZE,
    gap: Length | None = None,
    close: Duration = TIMES.close,
    press: Duration = TIMES.press,
    hold: Duration = TIMES.hold,
    relax: Duration = TIMES.relax,
    sweeps: Sweeps = 100,
    material: Material | None = None,
) -> Setup:
    """Build a square sheet that is folded in half, pressed between two plates, held, and released.

    Strips along two opposite edges are held. One strip is fixed; the other rotates about the middle line
    during `close` until it lies over the first. The upper plate then descends during `press` and flattens the
    loop to a crease. After the time `hold` strips and plates release the sheet, and it springs open. Drag
    brings it to rest during ``relax``. `fold_angle` measures the remaining angle, as in Fig. 3b.

    **Arguments:** `nodes`, `seed`, `sweeps`: number of nodes, seed and Lloyd sweeps of the random mesh;
    `size`: edge of the sheet in m; `gap` between the plates in m, by default 6 mm, or twice the node distance
    if that is larger; `close`, `press`, `hold`, ``relax`` in s; `material`: default `Material()`.

    **Raises:** ValueError for lengths or times that are not positive, or a gap of at most two thicknesses.
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
    """Return the default gap in m between the plates for a mesh of `nodes` nodes."""
    check_positive(nodes=nodes, size=size)
    return max(GAP, COARSEST * size * math.sqrt(2.0 / (math.sqrt(3.0) * nodes)))


def plates(size: float, gap: float, times: FoldTimes) -> list[Plane]:
    """Build the fixed lower and the descending upper plate; both retract after the release."""
    high, low = OPEN * size, 0.5 * gap
    moments = jnp.cumsum(jnp.array([0.0, times.close, times.press, times.hold, RETREAT]))
    lower = PiecewiseLinear(moments, -jnp.array([low, low, low, low, high]))
    upper = PiecewiseLinear(moments, -jnp.array([high, high, low, low, high]))
    up = jnp.array([0.0, 0.0, 1.0])
    return [Plane(up, lower), Plane(-up, upper)]


@door
def fold_angle(mesh: Mesh, x: NodeVectorsLike) -> Scalar:
    """Return the angle in rad between the halves of a folded sheet at `x` (n, 3) in m: pi for a flat sheet.

    It is the angle phi_f of Fig. 3b. The `mesh` is that of the scene `fold`, whose fold lies at x = 0. The
    angle is that between the mean normals of both halves, away from the fold, and is smooth in `x`.

    **Raises:** ValueError for a wrong shape of `x`.
    """
    require_shape("x", x, (mesh.n_nodes, 3))
    x = jnp.asarray(x)
    side = np.sign(mesh.vertices[mesh.faces, 0])
    away = np.abs(mesh.vertices[mesh.faces, 0]).min(axis=1) > FLAT * np.ptp(mesh.vertices[:, 0])
    one, two = (_normal(x, mesh.faces[away & np.all(side == sign, axis=1)]) for sign in (-1.0, 1.0))
    turned = jnp.linalg.norm(jnp.cross(one, two))
    return jnp.pi - jnp.arctan2(turned, one @ two)


def _normal(x: NodeVectors, faces: Int[np.ndarray, "faces 3"]) -> Float[Array, " 3"]:
    """Return the area-weighted sum (3,) of triangle normals."""
    a, b, c = gather(x, jnp.asarray(faces))
    return jnp.stack([jnp.sum(part) for part in cross(sub(b, a), sub(c, a))])
