"""A short run from the command line, and what its folder holds."""

import subprocess
import sys

from jaxcrumple.io import RunDirectory
from jaxcrumple.run.config import configure

SETTINGS = ["frames=2", "contact=none", "scheme=alternating", "rtol=1e-4", "sweeps=5", "drag_rate=2300"]
SMALL = ["--nodes", "60", "--t-end", "0.02", *(word for item in SETTINGS for word in ("--set", item))]
CONFIG = configure("radial", nodes=60, t_end=0.02, settings=SETTINGS)


def command(*arguments):
    """The program in a process of its own, as a user starts it."""
    program = [sys.executable, "-c", "from jaxcrumple.cli.cli import main; main()"]
    return subprocess.run([*program, *map(str, arguments)], capture_output=True, text=True, timeout=1800)


def current_checkpoint(folder):
    return folder / RunDirectory.open(folder).manifest.checkpoint
