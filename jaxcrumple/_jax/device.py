"""The device of a program: its choice before JAX starts, and what suits an accelerator."""

import os
import re
from collections.abc import Callable
from typing import Any

from jaxcrumple._jax.settings import configure_jax

# Variables of the environment that restrict JAX to one GPU, by maker.
VISIBLE = ("jax_cuda_visible_devices", "jax_rocm_visible_devices")


def on_accelerator() -> bool:
    """Return whether programs are traced for a GPU or TPU, where each kernel and each round of a loop costs
    microseconds: few large ones then replace chunks that fit in a processor's cache."""
    import jax

    return jax.default_backend() != "cpu"


def mapped(function: Callable[[Any], Any], parts: Any) -> Any:
    """Return `function` of each of the `parts` along the first axis: one after another on a CPU, where XLA
    would recompute for each what they share, and together on an accelerator."""
    import jax

    return jax.vmap(function)(parts) if on_accelerator() else jax.lax.map(function, parts)


def choose_device(name: str) -> None:
    """Let JAX compute on the device `name` in this process and in those that it starts: "cpu", "gpu" (all, of
    which a run uses the first), or "gpu:1" for one of several. Call it before JAX computes anything.

    **Raises:** ValueError for another name, or if JAX has no such device.
    """
    found = re.fullmatch(r"(cpu)|(gpu)(?::([0-9]+))?", name)
    if found is None:
        raise ValueError(
            f"device {name!r} is unknown; choose cpu, gpu, or one of several GPUs, such as gpu:1."
        )
    cpu, _, index = found.groups()
    _set("jax_platforms", cpu or "")
    for variable in VISIBLE if index is not None else ():
        _set(variable, index)
    import jax

    try:
        device, trouble = jax.devices()[0].platform, ""
    except (RuntimeError, AssertionError) as error:
        device, trouble = "", f" ({(str(error).splitlines() or ['no platform is available'])[0]})"
    if device != name.partition(":")[0]:
        raise ValueError(
            f"JAX has no device {name}{trouble or f', only {device}'}; choose another one, or install JAX "
            "for it (https://docs.jax.dev/en/latest/installation.html)."
        )


def _set(option: str, value: str) -> None:
    """Set an option of JAX here, and in the environment for the processes that this one starts."""
    os.environ[option.upper()] = value
    configure_jax(option, value)
