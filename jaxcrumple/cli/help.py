"""Commands `jaxcrumple explain` and `jaxcrumple report`."""

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Annotated

import typer

from jaxcrumple.cli.console import say

PACKAGES = (
    "jaxcrumple", "jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "optax", "pardiso-mkl-jax",
    "embreex", "matplotlib", "h5py", "h5netcdf", "meshio",
)  # fmt: skip
# First letters of the variables of the environment that matter.
SETTINGS = ("JAX_", "XLA_", "OMP_", "MKL_", "CUDA")


def explain(
    name: Annotated[
        str | None, typer.Argument(help="A result, a cause of rejection, a stage or a warning.")
    ] = None,
) -> None:
    """Explain a word of a run's report and what to do about it; without a word, list them all."""
    from jaxcrumple.run.glossary import GLOSSARY, explained

    if name is not None:
        say(f"{name}: {explained(name)}")
        return
    for word, text in GLOSSARY.items():
        say(f"{word}: {text}")


def report(
    folder: Annotated[Path | None, typer.Argument(help="Folder of a run to report on.")] = None,
) -> None:
    """Print versions, machine and, of a run, its options and result, for a bug report."""
    for line in [*_versions(), *_machine(), *([] if folder is None else _of_run(folder))]:
        say(line)


def _versions() -> list[str]:
    lines = [f"Python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            lines.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            lines.append(f"{package} is not installed")
    return lines


def _machine() -> list[str]:
    import jax
    import psutil

    memory = psutil.virtual_memory().total / 2**30
    settings = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name[:4] in SETTINGS]
    return [
        f"{platform.platform()}, {os.cpu_count()} processors, {memory:.1f} GiB",
        f"devices: {', '.join(f'{device.platform} {device.device_kind}' for device in jax.devices())}",
        *settings,
    ]


def _of_run(folder: Path) -> list[str]:
    import json

    from jaxcrumple.io import RunDirectory

    run = RunDirectory.open(folder)
    summary = run.read_summary()
    result = summary.get("result", "unfinished")
    return [
        f"options: {json.dumps(run.config)}",
        f"result: {result}" + (f" at t = {summary['t_reached']:.6g} s" if "t_reached" in summary else ""),
    ]
