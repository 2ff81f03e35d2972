"""What a release of a dependency may not break: warnings, wheels, and the versions that are declared."""

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

pytest_plugins = "pytester"

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
UNRAISABLE = """
class Buffer:
    def __del__(self):
        raise BufferError("memory is still in use")

def test_one():
    Buffer()
"""


def warned(module):
    """The error that a warning in a module of that name becomes, or None."""
    try:
        exec("import warnings; warnings.warn('old', DeprecationWarning)", {"__name__": module})
    except DeprecationWarning as error:
        return str(error)
    return None


@pytest.mark.parametrize("module", ["jaxcrumple", "jaxcrumple.contact.energy", "test_versions", "conftest"])
def test_a_warning_that_we_cause_is_an_error(module):
    assert warned(module) == "old"


@pytest.mark.parametrize("module", ["jax.interpreters.jaxcrumple", "numpy", "meshio._mesh", "importlib"])
def test_a_warning_within_a_third_party_is_none(module):
    assert warned(module) is None


def test_an_exception_that_nobody_can_catch_fails_no_test(pytester):
    pytester.makepyprojecttoml(PROJECT.read_text(encoding="utf-8"))
    pytester.makepyfile(test_it=UNRAISABLE)
    result = pytester.runpytest_subprocess("test_it.py")
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(
        ["*PytestUnraisableExceptionWarning*", "*BufferError: memory is still in use*"]
    )


PLACES = {
    ("3.11", "linux", "x86_64"): {"pardiso-mkl-jax", "ipctk"},
    ("3.13", "linux", "x86_64"): {"pardiso-mkl-jax", "ipctk"},
    ("3.14", "linux", "x86_64"): {"ipctk"},
    ("3.12", "linux", "aarch64"): set(),
    ("3.13", "darwin", "arm64"): {"ipctk"},
}


@pytest.mark.parametrize("place", PLACES, ids="-".join)
def test_what_has_no_wheel_is_left_out(place):
    extras = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    environment = dict(zip(("python_version", "sys_platform", "platform_machine"), place, strict=True))
    asked = [Requirement(line) for line in (*extras["direct"], *extras["test"])]
    found = {one.name for one in asked if one.marker is not None and one.marker.evaluate(environment)}
    assert found == PLACES[place]
