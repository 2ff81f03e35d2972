"""`stack_records`: the records of several runs as the lanes of one program."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxcrumple._jax.door import door
from jaxcrumple._jax.tree import as_array, is_known, shown, size_difference
from jaxcrumple.contact.lists import Capacity
from jaxcrumple.replays.contacts import StretchLists
from jaxcrumple.replays.record import Record

# A batch has 1 to 2**SIZES stretches of steps, or one of 2**(SIZES - 1) numbers in each octave above. A finer
# scale needs more programs, a coarser one computes more steps that no lane uses.
SIZES = 3


@door
def stack_records(records: Sequence[Record]) -> Record:
    """Stack the records of several runs, so that `jax.vmap` or `jax.lax.map` replays them as one program.

    Every array gets a leading axis (lanes,), also those of `scene` and `start`. Records with fewer steps,
    shorter contact lists or fewer stages are padded; the replay of a lane is that of its own record. In the
    function of one lane, build the scene from `record.scene`: it is the scene of that lane.

    Differentiate inside `jax.vmap`, as the example does: JAX cannot transpose a replay that is already
    batched. On a CPU `jax.lax.map` is faster. Under `jax.vmap` every lane computes as many steps as the
    longest run, and each step in every kind, implicit or explicit, that occurs in the batch. Use
    `equinox.filter_vmap` for scenes that contain functions, such as the radius of a sphere over time.

    **Arguments:** `records`: of `simulate(..., record=True)`, of scenes with equal array sizes and terms, by
    the same scheme, with equal numbers of frames.

    **Returns:** a `Record` of all lanes.

    **Raises:** ValueError for an empty list; an object that is not a record of one run, such as None of a run
    without steps; records of the direct solver; or records that differ in scheme, frames, array sizes or
    terms.

    >>> import equinox as eqx
    >>> mesh = jc.hexagonal(3, 2, 5e-3)
    >>> material = jc.Material(yield_curvature=None)
    >>> scenes = [jc.sheet(mesh, material, gravity=(0, 0, -g)) for g in (1.62, 9.81)]  # moon, earth
    >>> state = jc.initial_state(scenes[0], mesh.vertices)
    >>> fallen = jc.simulate_batch(scenes, [state, state], 0.1, record=True)
    >>> records = jc.stack_records([run.record for run in fallen])
    >>> def height(g, record):  # m
    ...     scene = eqx.tree_at(lambda s: s.gravity.g, record.scene, g)
    ...     return jc.replay(scene, record).x[-1, :, 2].mean()
    >>> slopes = jax.jit(jax.vmap(jax.grad(height)))(records.scene.gravity.g, records)
    >>> print(slopes.shape, *(f"{slope:.3e}" for slope in slopes[:, 2]))  # s2
    (2, 3) 9.900e-05 9.900e-05
    """
    _check_records(records)
    sizes = _sizes(records)
    padded = [_padded(record, sizes) for record in records]
    arrays, others = zip(*(eqx.partition(record, eqx.is_array_like) for record in padded), strict=True)
    stacked: Record = jax.tree.map(lambda *leaves: as_array(np.stack(leaves)), *arrays)
    return eqx.combine(stacked, others[0])


class _Sizes(NamedTuple):
    """Hold the sizes of a batch: numbers of stretches and of pairs of triangles, capacity of the site pairs,
    and stages."""

    stretches: int
    triangles: int
    capacity: Capacity
    stages: tuple[int, ...]


def _sizes(records: Sequence[Record]) -> _Sizes:
    used = [int(np.any(record.steps.valid, axis=1).sum()) for record in records]
    lists = [record.lists for record in records if record.lists is not None]
    return _Sizes(
        _rounded(max(used)),
        max((own.triangles.shape[1] for own in lists), default=0),
        Capacity(*map(max, zip(*(own.capacity for own in lists), strict=True))) if lists else Capacity(),
        tuple(sorted({stage for record in records for stage in record.stages})),
    )


def _rounded(size: int) -> int:
    """Round a number of stretches up, so that most batches share their programs."""
    step = 1 << max((size - 1).bit_length() - SIZES, 0)
    return -(-size // step) * step


def _padded(record: Record, sizes: _Sizes) -> Record:
    """Return the record with arrays of the given sizes.

    Stretches that are added repeat the last one, so that their numbers are finite, and have no valid step.
    """
    stretches = len(record.steps.valid)
    rows = np.minimum(np.arange(sizes.stretches), stretches - 1)
    steps, lists = jax.tree.map(lambda a: as_array(np.asarray(a)[rows]), (record.steps, record.lists))
    valid = np.asarray(steps.valid) & (np.arange(sizes.stretches) < stretches)[:, None]
    frame = np.where(valid, steps.frame, len(record.t))
    steps = replace(steps, valid=as_array(valid), frame=as_array(frame))
    return replace(record, steps=steps, lists=_longer(lists, sizes), stages=sizes.stages)


def _longer(lists: StretchLists | None, sizes: _Sizes) -> StretchLists | None:
    """Return the lists with room for more pairs of triangles and site pairs."""
    if lists is None:
        return None
    more = sizes.triangles - lists.triangles.shape[1]
    triangles = np.pad(lists.triangles, ((0, 0), (0, more), (0, 0)))
    return replace(lists, triangles=as_array(triangles), capacity=sizes.capacity)


def _check_records(records: Any) -> None:
    """Check that records can be stacked.

    **Raises:** ValueError that names the first one that does not fit.
    """
    if not isinstance(records, Sequence) or not records:
        raise ValueError(f"records = {shown(records)} must be a list of one or more records.")
    for index, record in enumerate(records):
        _check_record(index, record)
    for index, record in enumerate(records):
        _check_alike(records[0], index, record)


def _check_record(index: int, record: Any) -> None:
    if not isinstance(record, Record):
        raise ValueError(
            f"record {index} is {shown(record)}; it must be the record of simulate(..., record=True). A run "
            "without steps has none; leave it out."
        )
    if not is_known(record):
        raise ValueError("stack_records needs records on the host: call it outside jit, grad and vmap.")
    if record.t.ndim != 1:
        raise ValueError(f"record {index} is a stack of {len(record.t)}; give the records one by one.")
    if record.linear is not None and record.linear.one_matrix:
        raise ValueError(
            f"record {index} is of a run with the direct solver, which handles one sheet at a time; run with "
            "integrator(linear='two-level')."
        )


def _check_alike(first: Record, index: int, other: Record) -> None:
    """Check that record `index` has the kind and the array sizes of the `first` record."""
    if len(first.t) != len(other.t):
        raise ValueError(
            f"records 0 and {index} have {len(first.t)} and {len(other.t)} frames; give all runs as many "
            "times, and leave out runs that ended early."
        )
    schemes = [(type(r.explicit), type(r.linear), r.inertia) for r in (first, other)]
    if schemes[0] != schemes[1]:
        raise ValueError(
            f"records 0 and {index} are of different schemes or linear solvers; run all with one integrator."
        )
    pair = [(r.scene, r.start, r.explicit, r.linear) for r in (first, other)]
    arrays, rest = zip(*(eqx.partition(part, eqx.is_array_like) for part in pair), strict=True)
    difference = size_difference(*({"scene": a[0], "start": a[1], "solver": a[2:]} for a in arrays))
    if difference or not eqx.tree_equal(*rest):
        raise ValueError(
            f"records 0 and {index} are of different kinds{difference and f': {difference}'}; stack runs of "
            "scenes with the same mesh, terms and contact level, and of starts of the same kind."
        )
