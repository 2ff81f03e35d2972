"""Settings shared by all tests: double precision, programs compiled fast, and kept from one session to the
next."""

import gc
import os
import signal
import sys
from pathlib import Path

import array_types
import jax
import pytest

array_types.install()
jax.config.update("jax_enable_x64", True)
# Tests compile for longer than they run, and trace for as long, where collecting garbage often costs a tenth.
FLAGS = ["--xla_backend_optimization_level=0"]
if jax.__version_info__ < (0, 11):
    # These save a quarter of the compile time. Later versions end the process at flags that they removed.
    FLAGS += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))
gc.set_threshold(100_000, 50, 50)


# A job in the background, or under nohup, ignores these, and so would the programs that tests start.
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, usual)


def _keep_compiled_programs() -> None:
    """Keep them where the environment says, or in the user's cache, and tell the programs that tests start.

    JAX locks a folder of bounded size, so all workers may share one.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    usual = {
        "JAX_COMPILATION_CACHE_DIR": str(home / "jaxcrumple" / "tests-shared"),
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(4 * 10**9),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
    folder, size, shortest = (os.environ.setdefault(name, value) for name, value in usual.items())
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_compilation_cache_max_size", int(size))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", float(shortest))


_keep_compiled_programs()


@pytest.fixture(scope="module", autouse=True)
def _forgotten_programs():
    """Drop compiled programs after each file: all of them in one process exhaust its memory maps."""
    yield
    from jaxcrumple._jax import program_cache

    program_cache.clear()


@pytest.fixture(autouse=True)
def _enough_memory(monkeypatch):
    """Estimates of memory are held against the same limit on all machines; a file keeps its programs."""
    monkeypatch.setattr("jaxcrumple._jax.memory.memory_limit", lambda: 64 * 10**9)
    monkeypatch.setattr("jaxcrumple._jax.program_cache.GROWTH", 4e9)


@pytest.fixture
def kept_figures(monkeypatch):
    """A function that keeps the figures which a module of pictures saves, to look at their parts."""

    def keep(module) -> list:
        kept, save = [], module.save_figure
        monkeypatch.setattr(module, "save_figure", lambda *args: (kept.append(args[0]), save(*args))[1])
        return kept

    return keep


@pytest.fixture
def in_process(monkeypatch, capsys):
    """The command line in this process, which is faster than `command`: its exit code, and its streams."""
    from jaxcrumple.cli import cli

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxcrumple", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            cli.main()
        return caught.value.code, capsys.readouterr()

    return call


@pytest.fixture
def own_figures(monkeypatch):
    """Keep the figures of a script off the screen, close them, and restore the settings that it changes."""
    import matplotlib
    import matplotlib.pyplot as plt

    monkeypatch.setattr(plt, "show", lambda: None)
    with matplotlib.rc_context({"figure.dpi": 40}):
        plt.switch_backend("Agg")
        yield
    plt.close("all")
