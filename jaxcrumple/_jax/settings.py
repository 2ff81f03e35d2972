"""Settings of JAX that may precede its import, which takes a second: precision, and the compilation cache."""

import os
import sys
import tempfile
from pathlib import Path

# Variable of the environment with the folder of compiled programs.
CACHE = "JAX_COMPILATION_CACHE_DIR"


def configure_jax(option: str, value: str | bool) -> None:
    """Set an option of JAX, or the environment variable of its name if JAX is not imported yet."""
    if "jax" in sys.modules:
        sys.modules["jax"].config.update(option, value)
    else:
        os.environ[option.upper()] = str(value)


def enable_compilation_cache(folder: str | Path | None = None) -> str:
    """Keep compiled programs in a folder, so that later processes read them instead of compiling again.

    The command line does this by itself. A self-avoiding run compiles for about a minute without the cache.
    Call it at the start of a program or notebook; programs compiled before are not kept. Programs of
    `simulate` are read without tracing, unless the scene has parts that this package does not define.
    Who can write to the folder can run code in your processes.

    **Arguments:** `folder`: by default that of the variable `JAX_COMPILATION_CACHE_DIR`, else
    `jaxcrumple/xla` in `XDG_CACHE_HOME` or `~/.cache`. It may be deleted between two programs.

    **Returns:** the folder.

    **Raises:** ValueError if the folder cannot be written.
    """
    if folder is None and CACHE in os.environ:
        return os.environ[CACHE]
    try:
        place = _default() if folder is None else Path(folder).absolute()
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            pass
    except (OSError, RuntimeError) as error:
        raise ValueError(f"compiled programs cannot be kept: {error}; choose another folder.") from error
    configure_jax("jax_compilation_cache_dir", str(place))
    if "jax" in sys.modules:
        from jax.experimental.compilation_cache import compilation_cache

        # JAX decides at its first compilation whether there is a cache; this lets it decide again.
        compilation_cache.reset_cache()
    return str(place)


def _default() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base.absolute() / "jaxcrumple" / "xla"
