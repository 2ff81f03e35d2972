"""Explain the words with which a run reports: results, causes of rejection, stages, warnings."""

from jaxcrumple.options.suggest import nearest
from jaxcrumple.state import RESULTS

_RESULTS = {
    "success": RESULTS.success,
    "budget": RESULTS.budget,
    "collapsed": RESULTS.collapsed,
    "blocked": RESULTS.blocked,
    "intersected": RESULTS.intersected,
    "nonfinite": RESULTS.nonfinite,
}

#: What each word means, and what to do about it.
GLOSSARY = {
    **{
        name: f"A result: {RESULTS[result]}."  # type: ignore[misc]
        for name, result in _RESULTS.items()
    },
    "error": "A cause of rejection: the estimated local error was above the tolerance. In this way steps "
    "find their size. A larger rtol allows longer steps.",
    "newton": "A cause of rejection: Newton's iteration did not converge, in a step too long for the "
    "contacts or folds on its way. A shorter step follows.",
    "unstable": "A cause of rejection: the tangent has a negative eigenvalue, so the sheet is about to "
    "buckle or snap. Inertia carries it through; explicit steps may follow.",
    "fold": "A cause of rejection: a hinge would pass 180 degrees, and two triangles through each other. "
    "A shorter step follows.",
    "contact": "A cause of rejection: the step would pass through the sheet or a wall. A shorter step "
    "follows; if none is short enough, the result is blocked.",
    "quasistatic": "A stage: the sheet follows its equilibrium, without inertia (the differential-"
    "algebraic system of the paper).",
    "implicit": "A stage: motion with inertia, by implicit steps of variable size and order (BDF).",
    "explicit": "A stage: motion with inertia, by short explicit steps. It serves snaps, in which "
    "implicit steps would have to be as short.",
    "snap": "A part of the sheet jumps to another shape, within the time of an elastic wave. Explicit "
    "steps at their stability limit follow it. They take long in coarse meshes that lock, see: locks.",
    "locks": "Stretching holds more energy than bending: the edges of the mesh are too long to fold as "
    "tightly as the walls demand, and the triangles stretch instead. Energies and strains then depend on "
    "the mesh. Give more nodes (`jaxcrumple check` says how many), or end the run before.",
    "switches": "Changes of the stage, from quasistatic to implicit or explicit steps and back.",
    "inertia": "The share of time and of steps in the stages with inertia (implicit and explicit); told if a "
    "run has both these and quasistatic steps.",
    "rejected": "Step attempts that were not accepted, and were made again with a shorter step. The causes "
    "are error, newton, unstable, fold, nonfinite and contact.",
    "creases": "The length of all edges of the mesh whose damage is more than 0.05: there the sheet "
    "yielded, see: damage.",
    "damage": "The largest change since the start of p = 2 sin(theta / 2) of the hinges at a node, where "
    "theta is the angle at which a hinge rests. A change of 0.05 is 2.9 degrees.",
    "strain": "The relative change of length of the edges: largest, and root of the mean square (rms). Paper "
    "hardly stretches; strains of several per cent tell that the mesh is too coarse, see: locks.",
    "penetration": "How far the deepest node lies behind a wall. Walls push from their range on, so this "
    "is 0.",
    "walls": "Surfaces that push the sheet; a sheet is inside of spheres, cylinders and cones, and outside "
    "of balls. Their energy is in the column walls.",
    "energy": "Energies by term in J. E in the progress is the sum of all, and of gravity too, which is "
    "negative below its origin.",
    "rtol": "The tolerance of the time integration, relative to the size of the sheet. The default is "
    "1e-2; 1e-3 takes about twice as long.",
}

# Other forms of these words in reports and tables.
OTHER = {"locked": "locks", "edge strain": "strain", "wall penetration": "penetration", "E": "energy"}


def explained(name: str) -> str:
    """Return what a word means.

    **Raises:** ValueError for a word that is not in the `GLOSSARY`.
    """
    name = OTHER.get(name, name)
    if name not in GLOSSARY:
        raise ValueError(f"{name!r} is no word that runs report with{nearest(name, [*GLOSSARY, *OTHER])}")
    return GLOSSARY[name]
