"""The option --device of commands that compute."""

from typing import Annotated

import typer

from jaxcrumple._jax.device import choose_device

Device = Annotated[
    str | None,
    typer.Option(
        help="Device that computes: cpu, gpu, or one of several GPUs, such as gpu:1 (default: JAX's choice, "
        "a GPU if it finds one)."
    ),
]


def use_device(device: str | None, scheduler: str | None = None) -> None:
    """Compute on the `device` of the option, if it is given, here and in worker processes of this machine.

    **Raises:** ValueError for an unknown or missing device, or if a `scheduler` has the workers.
    """
    if device is None:
        return
    if scheduler is not None:
        raise ValueError(
            "--device is for this machine, and the workers of --scheduler may run elsewhere; set "
            "JAX_PLATFORMS where they start."
        )
    choose_device(device)
