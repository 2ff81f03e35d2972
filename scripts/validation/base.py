"""Registry of the benchmarks, and the sheets, supports and reductions that several of them share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq
from scipy.sparse.linalg import eigsh, spsolve

jax.config.update("jax_enable_x64", True)

import jaxcrumple as jc  # noqa: E402

# Distance between lattice rows, in units of the node spacing.
ROW = np.sqrt(3.0) / 2.0
# Poisson ratios of the lattice: in the plane, and in bending at free edges (Seung & Nelson 1988).
POISSON, BENDING_POISSON = 1.0 / 3.0, -1.0 / 3.0
# An elastic sheet without losses, 0.25 mm thick.
PLAIN = jc.Material(yield_curvature=None, drag_rate=0.0, internal_damping_time=0.0)
KAPPA, YOUNG = PLAIN.bending_rigidity, PLAIN.young_modulus_2d

force = eqx.filter_jit(jc.force)
energies = eqx.filter_jit(jc.energies)


@dataclass(frozen=True)
class Outcome:
    """One expected and one measured number.

    `tolerance`: accepted relative deviation; `mesh`: mesh and tolerance of the solver; `why`: the cause of a
    deviation above 1 %.
    """

    quantity: str
    unit: str
    expected: float
    measured: float
    tolerance: float
    mesh: str
    why: str = ""

    @property
    def deviation(self) -> float:
        """Relative deviation of the measured number."""
        return float(self.measured / self.expected - 1.0)

    @property
    def accepted(self) -> bool:
        """Whether the deviation is within the tolerance."""
        return bool(abs(self.deviation) <= self.tolerance)


@dataclass(frozen=True)
class Benchmark:
    """A benchmark: its `name`, `group` and `source`, and the function that runs it.

    `quick`: whether it takes less than three seconds once its programs are compiled.
    """

    name: str
    group: str
    source: str
    run: Callable[[], list[Outcome]]
    quick: bool

    @property
    def title(self) -> str:
        """First sentence of the description."""
        return (self.run.__doc__ or "").split("\n")[0].rstrip(".")


BENCHMARKS: dict[str, Benchmark] = {}


def benchmark(group: str, source: str, *, quick: bool = True) -> Callable:
    """Register a function as the benchmark of its name."""

    def register(function: Callable[[], list[Outcome]]) -> Callable[[], list[Outcome]]:
        name = function.__name__
        BENCHMARKS[name] = Benchmark(name, group, source, function, quick)
        return function

    return register


class Strip(NamedTuple):
    """A lattice strip along x: its mesh, spacing a in m, and stiffness and mass per length.

    A hinge needs two triangles, so that `rows` rows of triangles bend, and a spring lies in each of the
    `rows` + 1 rows of nodes. `bending` in N m2: narrow strip with free edges, (1 - nu^2) kappa per width.
    `stretching` in N; `twisting` in N m2: 2 kappa (1 - nu) per width; `mass` in kg/m.
    """

    mesh: jc.Mesh
    spacing: float
    rows: int

    @property
    def width(self) -> float:
        """Width in m over which the strip bends."""
        return self.rows * ROW * self.spacing

    @property
    def bending(self) -> float:
        """Bending stiffness in N m2."""
        return (1.0 - BENDING_POISSON**2) * KAPPA * self.width

    @property
    def twisting(self) -> float:
        """Torsional stiffness in N m2."""
        return 2.0 * (1.0 - BENDING_POISSON) * KAPPA * self.width

    @property
    def stretching(self) -> float:
        """Stretching stiffness in N."""
        return YOUNG * (self.rows + 1) * ROW * self.spacing

    @property
    def mass(self) -> float:
        """Mass per length in kg/m. All nodes have the same mass."""
        density = PLAIN.density * PLAIN.thickness * self.mesh.area
        return density / self.mesh.n_nodes * (self.rows + 1) / self.spacing

    def clamp(self, both: bool) -> tuple[np.ndarray, float]:
        """Return the nodes (n,) that clamp one end or `both` ends, and the free length in m.

        Two zigzag columns are held. The hinges across a bond between a held and a free column bend, and stand
        for a length of a/2, so that the clamp lies a/2 behind the last held node. The mass of a free end
        reaches, on the mean of its rows, a/4 beyond the last node.
        """
        along = self.mesh.vertices[:, 0]
        first, last = along.min() + 1.6 * self.spacing, along.max() - 1.6 * self.spacing
        held = along < first
        start = along[held].max() - 0.5 * self.spacing
        if not both:
            return held, along.max() + 0.25 * self.spacing - start
        other = along > last
        return held | other, along[other].min() + 0.5 * self.spacing - start

    def __str__(self) -> str:
        return f"lattice, {self.mesh.n_nodes} nodes"


def strip(columns: int, rows: int, width: float) -> Strip:
    """Make a lattice strip of `columns` nodes in each row, `width` m wide."""
    spacing = width / (rows * ROW)
    return Strip(jc.hexagonal(columns, rows, spacing, reorder=False), spacing, rows)


def fixed(mask: np.ndarray, x: np.ndarray) -> jc.Prescribed:
    """Hold nodes (n,) or components (n, 3) at positions `x` (n, 3) in m."""
    mask = np.repeat(mask[:, None], 3, axis=1) if mask.ndim == 1 else mask
    return jc.Prescribed(mask, jc.LinearMotion(x, (0.0, 0.0, 0.0)))


def at_rest(scene: jc.Scene, x: np.ndarray, p: np.ndarray | None = None) -> np.ndarray:
    """Return the equilibrium (n, 3) in m that `relax` finds from positions `x`."""
    state = jc.initial_state(scene, x)
    if p is not None:
        state = eqx.tree_at(lambda s: s.p, state, jnp.asarray(p))
    rest = jc.relax(scene, state)
    if not rest.converged:
        raise RuntimeError(f"no equilibrium: {rest.reason}")
    return np.asarray(rest.state.x)


def forces(scene: jc.Scene, x: np.ndarray) -> np.ndarray:
    """Return the net forces (n, 3) in N on nodes at rest; at supports they balance the reactions."""
    return np.asarray(force(scene, x, np.zeros_like(x), None, 0.0))


def modes(scene: jc.Scene, x: np.ndarray, count: int, shift: float = -1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return `count` eigenvalues in 1/s2 (m,) of the tangent near `shift`, and the modes (3n, m)."""
    stiffness = jc.tangent(scene, jc.initial_state(scene, x)).tocsc()
    start = np.random.default_rng(0).normal(size=stiffness.shape[0])
    mass = jc.mass_matrix(scene).tocsc()
    values, shapes = eigsh(stiffness, k=count, M=mass, sigma=shift, v0=start)
    order = np.argsort(values)
    return values[order], shapes[:, order]


def response(scene: jc.Scene, x: np.ndarray) -> np.ndarray:
    """Return the displacement (n, 3) in m that the net force at positions `x` causes, to first order."""
    stiffness = jc.tangent(scene, jc.initial_state(scene, x)).tocsc()
    net = forces(scene, x)
    if scene.prescribed is not None:
        net = np.where(scene.prescribed.mask, 0.0, net)
    return spsolve(stiffness, net.ravel()).reshape(-1, 3)


def critical_load(loaded: Callable[[float], tuple[jc.Scene, np.ndarray]], guess: float) -> float:
    """Return the load at which the smallest eigenvalue of the tangent vanishes.

    `loaded(load)`: scene and equilibrium (n, 3). The load must lie within 0.6 to 1.4 times `guess`.
    """
    # Below all eigenvalues at these loads: those of a loaded plate fall about linearly.
    shift = -2.0 * modes(*loaded(0.0), 2)[0][0]
    return brentq(
        lambda load: modes(*loaded(load), 2, shift)[0][0], 0.6 * guess, 1.4 * guess, xtol=1e-4 * guess
    )


def buckling_load(under: Callable[[float], jc.Scene], x: np.ndarray, guess: float) -> float:
    """Return the critical load of a sheet that deforms in proportion to the load before it buckles.

    `under(load)`: scene under a load; `x` (n, 3) in m: rest shape.
    """
    step = response(under(1e-3 * guess), x) / (1e-3 * guess)
    return critical_load(lambda load: (under(load), x + load * step), guess)
