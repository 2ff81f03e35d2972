"""Sketches: a few numbers per array that distinguish trees of arrays, independent of the machine."""

import inspect
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxcrumple._jax.arrays import HingeValues
from jaxcrumple._jax.stored_programs import StoredJit
from jaxcrumple.model.plasticity import AbstractFlowRule
from jaxcrumple.scene import Scene

# Relative tolerance for equality of numbers that another process or machine computed.
SAME = 1e-9
# Independent parts of a scene except its mesh; the sparsity of the tangent and the contact lists follow.
PARTS = (
    "mass", "membrane", "bending", "plasticity", "drag", "damping", "walls", "gravity", "prescribed", "extra",
)  # fmt: skip
# Curvatures and rest curvatures at which flow rules are compared.
SAMPLES = ((0.0, 0.0), (0.3, 0.1), (-1.1, 0.2), (1.7, -0.4))
CONTACT_PARTS = ("stiffness", "range", "potential", "density")


def sketch(tree: Any) -> list[float]:
    """Return size, largest absolute value, norm and a projection of each array in a tree."""
    found: list[float] = []
    for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)):
        flat = np.nan_to_num(np.asarray(leaf, float).ravel(), nan=1e30, posinf=1e30, neginf=-1e30)
        largest = float(np.max(np.abs(flat), initial=0.0))
        flat, way = flat / (largest or 1.0), np.cos(np.arange(flat.size))  # no square overflows
        norm = float(np.linalg.norm(flat))
        # |shadow| <= norm, so 2 norm + shadow does not cancel and its relative rounding error is small.
        shadow = float(flat @ way) / max(float(np.linalg.norm(way)), 1e-30)
        found += [float(flat.size), largest, norm, 2.0 * norm + shadow]
    return found


def alike(one: Sequence[float], other: Sequence[float]) -> bool:
    """Return whether two sketches are equal up to rounding."""
    return len(one) == len(other) and np.allclose(one, other, rtol=SAME, atol=0.0, equal_nan=True)


def sketch_scene(scene: Scene, x: Any) -> dict[str, list[float]]:
    """Return the sketches of the parts of a scene, by name, and of its initial positions `x` (n, 3)."""
    parts = {name: getattr(scene, name) for name in PARTS}
    parts["contact"] = [getattr(scene.contact, name, None) for name in CONTACT_PARTS]
    found = {name: [*sketch(part), kinds(part)] for name, part in {**parts, "start": x}.items()}
    if scene.plasticity is not None:
        # Two laws may have the same name and numbers.
        found["plasticity"] += sketch(_rates(scene.plasticity, scene.bending.nodes.shape[0]))
    return found


@StoredJit
def _rates(law: AbstractFlowRule, hinges: int) -> list[HingeValues]:
    """Return the rates in 1/s of a flow rule at `SAMPLES`, for each hinge."""
    ones = jnp.ones(hinges)
    return [law.rate(c * ones, p * ones) for c, p in SAMPLES]


def kinds(tree: Any) -> float:
    """Return a checksum of the names of all classes and functions in a tree."""
    return float(zlib.crc32(" ".join(_names(tree)).encode()))


def _names(part: Any) -> Iterator[str]:
    if isinstance(part, eqx.Module):
        yield type(part).__qualname__
        part = [value for name, value in vars(part).items() if not name.startswith("__")]
    if isinstance(part, list | tuple):
        for one in part:
            yield from _names(one)
    elif inspect.isfunction(part):
        yield part.__qualname__


def first_difference(saved: Mapping[str, Sequence[float]], now: Mapping[str, Sequence[float]]) -> str:
    """Return the name of the first part in which two scenes differ, or an empty string."""
    return next((name for name in now if not alike(saved.get(name, ()), now[name])), "")
