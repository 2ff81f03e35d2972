"""Files of a run: folder, checkpoint, ParaView film, and readers."""

from jaxcrumple.io.atomic import RunDirectoryError
from jaxcrumple.io.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from jaxcrumple.io.frames import Frame
from jaxcrumple.io.run import Run, load
from jaxcrumple.io.rundir import Counts, RunDirectory
from jaxcrumple.io.verify import verify_runs
from jaxcrumple.io.vtkhdf import sheet_fields, write_vtkhdf

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
