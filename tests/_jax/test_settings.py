"""Settings of JAX before and after its import, and public names that are imported on first use."""

import importlib
import os
import subprocess
import sys

import pytest

import jaxcrumple as jc
from jaxcrumple._jax import settings


def printed(program, **environment):
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=os.environ | environment
    )
    assert found.returncode == 0, found.stderr
    return found.stdout.split()


@pytest.mark.parametrize("package", ["jaxcrumple", "jaxcrumple.io", "jaxcrumple.measure"])
def test_every_public_name_can_be_imported(package):
    module = importlib.import_module(package)
    assert len(module.__all__) > 10
    for name in module.__all__:
        assert getattr(module, name) is not None


@pytest.mark.parametrize("words", ["--help", "run --help", "--version"])
def test_help_needs_no_jax(words):
    program = (
        "import sys; from jaxcrumple.cli.cli import app\n"
        f"try: app({words.split()})\n"
        "except SystemExit: print('jax' in sys.modules, 'pandas' in sys.modules)"
    )
    assert printed(program)[-2:] == ["False", "False"]


def test_a_refusal_needs_no_library_of_the_run(tmp_path):
    (tmp_path / "scene.toml").write_text('scene = "radial"\n[options]\nradiu = 0.1\n')
    program = (
        f"import sys; sys.argv = ['jaxcrumple', 'run', {str(tmp_path / 'scene.toml')!r}]\n"
        "from jaxcrumple.cli.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: print(end.code, *{'pandas', 'diffrax', 'h5py', 'matplotlib', "
        "'scipy.sparse', 'scipy.spatial'} & sys.modules.keys())"
    )
    assert printed(program) == ["2"]


def test_the_command_seldom_searches_for_garbage():
    """With Python's own threshold, 300 times, and twice among all objects."""
    program = (
        "import sys, gc; sys.argv = ['jaxcrumple']\n"
        "import jaxcrumple.run.config; print(*(each['collections'] for each in gc.get_stats()))"
    )
    youngest, _, full = map(int, printed(program))
    assert youngest < 100
    assert full == 0


def test_options_set_before_the_import_of_jax():
    program = (
        "from jaxcrumple._jax.settings import configure_jax\n"
        "configure_jax('jax_enable_x64', True); configure_jax('jax_compilation_cache_dir', 'xla')\n"
        "import jax; print(jax.config.jax_enable_x64, jax.config.jax_compilation_cache_dir)"
    )
    assert printed(program, JAX_ENABLE_X64="0") == ["True", "xla"]


def test_the_cache_can_be_enabled_after_a_compilation(tmp_path):
    program = (
        "import jax, os, jaxcrumple as jc\n"
        "del os.environ['JAX_COMPILATION_CACHE_DIR']\n"
        "jax.config.update('jax_compilation_cache_dir', None)\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0)\n"
        "jax.jit(lambda x: x + 1)(1.0)\n"
        f"print(jc.enable_compilation_cache({str(tmp_path / 'xla')!r}))\n"
        "before = len(os.listdir(jax.config.jax_compilation_cache_dir))\n"
        "jax.jit(lambda x: x * 3)(1.0)\n"
        "print(before, len(os.listdir(jax.config.jax_compilation_cache_dir)) > 0)"
    )
    assert printed(program, JAX_COMPILATION_CACHE_DIR="x") == [str(tmp_path / "xla"), "0", "True"]


def test_the_variable_of_jax_comes_first(monkeypatch):
    monkeypatch.setenv(settings.CACHE, "gs://bucket/programs")
    assert jc.enable_compilation_cache() == "gs://bucket/programs"


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"compiled programs cannot be kept: .*; choose another folder\.$"):
        jc.enable_compilation_cache(tmp_path / "file")
