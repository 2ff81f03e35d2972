"""The public names, for `__init__.py` and for type checkers."""

from .atomic import RunDirectoryError
from .checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from .frames import Frame
from .run import Run, load
from .rundir import Counts, RunDirectory
from .verify import verify_runs
from .vtkhdf import sheet_fields, write_vtkhdf

__all__ = [
    "CheckpointError",
    "Counts",
    "Frame",
    "Run",
    "RunDirectory",
    "RunDirectoryError",
    "load",
    "load_checkpoint",
    "save_checkpoint",
    "sheet_fields",
    "verify_runs",
    "write_vtkhdf",
]
