"""jaxcrumple: a differentiable JAX simulator of thin elastoplastic sheets."""

# ruff: noqa: E402
from jaxcrumple.cli import entry

# Prepare the process before the other imports, which take seconds.
entry.prepare()

from jaxcrumple.calibrate.experiment import Experiment
from jaxcrumple.calibrate.fit import Fit, Parameter, fit
from jaxcrumple.calibrate.fold import calibrate_fold
from jaxcrumple.calibrate.pattern import calibrate_pattern
from jaxcrumple.contact.parameters import SelfContact
from jaxcrumple.io import CheckpointError, Run, RunDirectoryError, load
from jaxcrumple.material.material import Material
from jaxcrumple.material.presets import PRESETS, preset
from jaxcrumple.mesh.files import MeshWarning
from jaxcrumple.mesh.generate import disc, hexagonal, rectangle
from jaxcrumple.mesh.isotropy import Stiffness, patch_test
from jaxcrumple.mesh.mesh import Mesh, MeshError
from jaxcrumple.mesh.remesh import remeshed
from jaxcrumple.model.loads import AbstractMotion, ElementEnergy, Gravity, LinearMotion, Prescribed
from jaxcrumple.model.plasticity import AbstractFlowRule, SmoothstepFlow
from jaxcrumple.model.walls import (
    AbstractShape,
    Ball,
    Cone,
    Cylinder,
    HoledPlate,
    PiecewiseLinear,
    Plane,
    Ramp,
    Sphere,
    Wall,
)
from jaxcrumple.options.validation import ConfigError
from jaxcrumple.replays.record import Record
from jaxcrumple.replays.replay import Replay, replay
from jaxcrumple.run.config import configure
from jaxcrumple.run.run import resume_run, start_run
from jaxcrumple.run.scene_file import read_scene_file, write_scene_file
from jaxcrumple.scene import Scene, sheet
from jaxcrumple.scenes.arch import arch
from jaxcrumple.scenes.axial import axial, cylindrical
from jaxcrumple.scenes.cap import cap
from jaxcrumple.scenes.conical import conical
from jaxcrumple.scenes.custom import custom
from jaxcrumple.scenes.dcone import dcone, free_sector
from jaxcrumple.scenes.fold import fold, fold_angle
from jaxcrumple.scenes.radial import radial, unload
from jaxcrumple.scenes.ridge import ridge, ridge_curvature
from jaxcrumple.scenes.setup import Setup
from jaxcrumple.scenes.snap import energy_drop, relaxed_drop
from jaxcrumple.scenes.stamping import shell, stamping
from jaxcrumple.simulation import SimulationError, Solution, frame_times, simulate
from jaxcrumple.solvers.contact.reallocate import with_contacts
from jaxcrumple.solvers.contact.report import contact_report
from jaxcrumple.solvers.integrate import integrate
from jaxcrumple.solvers.linear.base import AbstractLinearSolver
from jaxcrumple.solvers.linear.solve import linear_solve
from jaxcrumple.solvers.relax import relax
from jaxcrumple.solvers.scheme import Integrator, integrator
from jaxcrumple.solvers.switch import Switch
from jaxcrumple.state import RESULTS, State, initial_state
from jaxcrumple.sweeps.campaign import campaign
from jaxcrumple.sweeps.cases import grid
from jaxcrumple.sweeps.sweep import sweep
from jaxcrumple.system import elastic_tangent, energies, force, mass_matrix, potential_energy, tangent

__all__ = [
    "PRESETS",
    "RESULTS",
    "AbstractFlowRule",
    "AbstractLinearSolver",
    "AbstractMotion",
    "AbstractShape",
    "Ball",
    "CheckpointError",
    "Cone",
    "ConfigError",
    "Cylinder",
    "ElementEnergy",
    "Experiment",
    "Fit",
    "Gravity",
    "HoledPlate",
    "Integrator",
    "LinearMotion",
    "Material",
    "Mesh",
    "MeshError",
    "MeshWarning",
    "Parameter",
    "PiecewiseLinear",
    "Plane",
    "Prescribed",
    "Ramp",
    "Record",
    "Replay",
    "Run",
    "RunDirectoryError",
    "Scene",
    "SelfContact",
    "Setup",
    "SimulationError",
    "SmoothstepFlow",
    "Solution",
    "Sphere",
    "State",
    "Stiffness",
    "Switch",
    "Wall",
    "arch",
    "axial",
    "calibrate_fold",
    "calibrate_pattern",
    "campaign",
    "cap",
    "configure",
    "conical",
    "contact_report",
    "custom",
    "cylindrical",
    "dcone",
    "disc",
    "elastic_tangent",
    "energies",
    "energy_drop",
    "fit",
    "fold",
    "fold_angle",
    "force",
    "frame_times",
    "free_sector",
    "grid",
    "hexagonal",
    "initial_state",
    "integrate",
    "integrator",
    "linear_solve",
    "load",
    "mass_matrix",
    "patch_test",
    "potential_energy",
    "preset",
    "radial",
    "read_scene_file",
    "rectangle",
    "relax",
    "relaxed_drop",
    "remeshed",
    "replay",
    "resume_run",
    "ridge",
    "ridge_curvature",
    "sheet",
    "shell",
    "simulate",
    "stamping",
    "start_run",
    "sweep",
    "tangent",
    "unload",
    "with_contacts",
    "write_scene_file",
]
