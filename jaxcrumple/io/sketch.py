"""A few numbers that tell trees of arrays apart, and are the same on any machine."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxcrumple.scene import Scene

# Relative difference up to which numbers are the same, computed again or on another machine.
SAME = 1e-9
# What a scene is built from beside its mesh; the tangent's pattern and the lists of contact follow from it.
PARTS = (
    "mass", "membrane", "bending", "plasticity", "drag", "damping", "walls", "gravity", "prescribed", "extra",
)  # fmt: skip
CONTACT_PARTS = ("stiffness", "range", "core", "density")


def sketch(tree: Any) -> list[float]:
    """Size, largest number, norm and a projection of each array in a tree."""
    found: list[float] = []
    for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)):
        flat = np.nan_to_num(np.asarray(leaf, float).ravel(), nan=1e30, posinf=1e30, neginf=-1e30)
        largest = float(np.max(np.abs(flat), initial=0.0))
        flat, way = flat / (largest or 1.0), np.cos(np.arange(flat.size))  # no square overflows
        norm = float(np.linalg.norm(flat))
        # The sum does not cancel, so that rounding is small beside it.
        shadow = float(flat @ way) / max(float(np.linalg.norm(way)), 1e-30)
        found += [float(flat.size), largest, norm, 2.0 * norm + shadow]
    return found


def alike(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether two sketches are of the same numbers, but for rounding."""
    return len(one) == len(other) and np.allclose(one, other, rtol=SAME, atol=0.0, equal_nan=True)


def sketch_scene(scene: Scene, x: Any) -> dict[str, list[float]]:
    """Sketches of the parts of a scene by name, and of the positions `x` (n, 3) it starts from."""
    parts = {name: getattr(scene, name) for name in PARTS}
    parts["contact"] = [getattr(scene.contact, name, None) for name in CONTACT_PARTS]
    return {name: sketch(part) for name, part in {**parts, "start": x}.items()}


def first_difference(saved: Mapping[str, Sequence[float]], now: Mapping[str, Sequence[float]]) -> str:
    """Name of the first part in which two scenes differ; empty where they are the same."""
    return next((name for name in now if not alike(saved.get(name, ()), now[name])), "")
