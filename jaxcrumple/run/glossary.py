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
    "rtol": "The tolerance of the time integration, relative to the size of the sheet. The default is "
    "1e-2; 1e-3 takes about twice as long.",
}


def explained(name: str) -> str:
    """Return what a word means.

    **Raises:** ValueError for a word that is not in the `GLOSSARY`.
    """
    if name not in GLOSSARY:
        raise ValueError(f"{name!r} is no word that runs report with{nearest(name, GLOSSARY)}")
    return GLOSSARY[name]
