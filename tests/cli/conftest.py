"""A finished run, a copy of it, and calls that are refused."""

import shutil

import pytest
from command_line import SMALL, command


@pytest.fixture
def refused(in_process):
    """A call that must end with exit code 2 and one line on stderr, which it returns."""

    def call(*arguments):
        code, streams = in_process(*arguments)
        assert code == 2
        assert streams.err.startswith("error: ")
        assert len(streams.err.splitlines()) == 1, streams.err
        return streams.err

    return call


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder and output of a run from the command line."""
    folder = tmp_path_factory.mktemp("cli") / "deep" / "run"
    return folder, command("run", "radial", *SMALL, "--out", folder)


@pytest.fixture
def copy(finished, tmp_path):
    """A copy of that run, to be harmed."""
    return shutil.copytree(finished[0], tmp_path / "copy")
