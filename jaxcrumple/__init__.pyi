"""The public names, for `__init__.py` and for type checkers."""

from . import measure
from ._jax.settings import enable_compilation_cache
from .calibrate.experiment import Experiment
from .calibrate.fit import Fit, Parameter, fit
from .calibrate.fold import calibrate_fold
from .calibrate.pattern import calibrate_pattern
from .contact.parameters import SelfContact
from .dataset.export import export_dataset
from .io import CheckpointError, Run, RunDirectoryError, load
from .material.material import Material
from .material.presets import PRESETS, preset
from .mesh.files import MeshWarning
from .mesh.generate import disc, hexagonal, rectangle
from .mesh.isotropy import Stiffness, patch_test
from .mesh.mesh import Mesh, MeshError
from .mesh.remesh import remeshed
from .model.loads import AbstractMotion, ElementEnergy, Gravity, LinearMotion, Prescribed
from .model.plasticity import AbstractFlowRule, SmoothstepFlow
from .model.walls import (
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
from .observers import Observer, PhaseObserver
from .options.validation import ConfigError
from .plot.draw import Picture, draw_sheet
from .plot.film import film
from .plot.picture import picture
from .plot.polydata import polydata
from .replays.record import Record
from .replays.replay import Replay, replay
from .replays.stack import stack_records
from .run.config import configure
from .run.run import resume_run, start_run
from .run.scene_file import read_scene_file, write_scene_file
from .scene import Scene, sheet
from .scenes.arch import arch
from .scenes.axial import axial, cylindrical
from .scenes.cap import cap
from .scenes.conical import conical
from .scenes.custom import custom
from .scenes.dcone import dcone, free_sector
from .scenes.fold import fold, fold_angle
from .scenes.radial import radial, unload
from .scenes.ridge import ridge, ridge_curvature
from .scenes.setup import Setup
from .scenes.snap import energy_drop, relaxed_drop
from .scenes.stamping import shell, stamping
from .simulation import SimulationError, Solution, frame_times, simulate
from .solvers.contact.reallocate import with_contacts
from .solvers.contact.report import contact_report
from .solvers.integrate import integrate
from .solvers.linear.base import AbstractLinearSolver
from .solvers.linear.solve import linear_solve
from .solvers.relax import relax
from .solvers.scheme import Integrator, integrator
from .solvers.switch import Switch
from .state import RESULTS, State, initial_state
from .sweeps.campaign import campaign
from .sweeps.cases import grid
from .sweeps.ensemble import ensemble
from .sweeps.sheets import simulate_batch
from .sweeps.sweep import sweep
from .system import elastic_tangent, energies, force, mass_matrix, potential_energy, reaction, tangent
from .viewer.page import view

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
    "Observer",
    "Parameter",
    "PhaseObserver",
    "Picture",
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
    "draw_sheet",
    "elastic_tangent",
    "enable_compilation_cache",
    "energies",
    "energy_drop",
    "ensemble",
    "export_dataset",
    "film",
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
    "measure",
    "patch_test",
    "picture",
    "polydata",
    "potential_energy",
    "preset",
    "radial",
    "reaction",
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
    "simulate_batch",
    "stack_records",
    "stamping",
    "start_run",
    "sweep",
    "tangent",
    "unload",
    "view",
    "with_contacts",
    "write_scene_file",
]
