"""Edges of the program: one line and one exit code for whatever ends it."""

import gc
import importlib.util
import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

import jaxcrumple as jc
from jaxcrumple.cli import cli, console
from jaxcrumple.cli.console import OutputLostError, Stopped, noted, run_program, say
from jaxcrumple.run.config import configure
from jaxcrumple.sweeps.errors import WorkersLostError

PACKAGE = Path(jc.__file__).parent
ENTRY = PACKAGE / "cli" / "entry.py"
RUN = ["radial", "--nodes", "40", "--t-end", "0.02", "--set", "contact=none"]


@pytest.fixture(autouse=True)
def _own_console(monkeypatch):
    """One to each test: Rich keeps what it could not write."""
    monkeypatch.setattr(console, "console", Console())


@pytest.fixture
def ended(capsys):
    """A call of a program, that returns its exit code and what it says on standard error."""

    def call(program):
        with pytest.raises(SystemExit) as caught:
            run_program(program)
        return caught.value.code, capsys.readouterr().err

    return call


def raising(error):
    def program():
        raise error

    return program


# --- What ends a command -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), 1, "error: not enough memory; take fewer --nodes"),
        (MemoryError("Unable to allocate 7 TiB"), 1, "memory (Unable to allocate 7 TiB); take"),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory"), 1, "memory on cpu (RESOURCE_EX"),
        (
            OverflowError("math range error"),
            2,
            "too small to compute with (OverflowError: math range error, in",
        ),
        (ZeroDivisionError("division by zero"), 2, "check the powers of ten of the input"),
        (
            UnicodeEncodeError("ascii", "\udcff", 0, 1, "odd"),
            2,
            "no valid Unicode ('ascii' codec can't encode",
        ),
        (RecursionError(), 2, "nested too deeply"),
        (
            PermissionError(13, "Permission denied", "a.toml"),
            2,
            "error: a.toml: Permission denied; change its",
        ),
        (OSError(28, "No space left on device"), 2, "error: No space left on device; free some space"),
        (OSError(36, "File name too long", "aa"), 2, "error: aa: File name too long; give a shorter name"),
        (WorkersLostError("all are gone."), 1, "error: all are gone."),
        (KeyboardInterrupt(), 130, "stopped"),
        (jc.ConfigError("a\nb"), 2, "error: a\\nb"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_what_ends_a_command_is_one_line(ended, error, code, words):
    found, text = ended(raising(error))
    assert found == code
    assert words in text
    assert len(text.splitlines()) == 1, text


def test_a_refusal_of_the_library_is_one_line(ended):
    assert ended(lambda: configure("radal")) == (
        2,
        "error: scene 'radal' is unknown; did you mean 'radial'?\n",
    )


@pytest.mark.parametrize(
    ("program", "last"),
    [
        (lambda: {}["kind"], "KeyError: 'kind'"),
        # A ValueError that is no refusal: another package's, of what should have been refused before.
        (lambda: np.zeros(3).reshape(2, 2), "ValueError: cannot reshape array of size 3"),
    ],
)
def test_a_bug_is_said_to_be_one_and_keeps_its_traceback(ended, program, last):
    code, text = ended(program)
    assert code == 70
    first, *_, end = text.splitlines()
    assert first == "Traceback (most recent call last):"
    assert end.startswith("error: this is a bug of jaxcrumple") and last in end
    assert "what `jaxcrumple report` prints" in end


def test_exit_codes_are_kept(ended):
    for code in (0, 1):
        assert ended(lambda code=code: sys.exit(code)) == (code, "")
    assert ended(lambda: None) == (0, "")


def test_help_tells_the_exit_codes(in_process):
    _, streams = in_process("--help")
    text = " ".join(streams.out.split())
    for words in ("0 success", "2 refused", "70 a bug", "130 Ctrl-C", "143 SIGTERM"):
        assert words in text


# --- Signals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGINT, "stopped\n"),
        (signal.SIGTERM, "stopped by SIGTERM\n"),
        (signal.SIGHUP, "stopped by SIGHUP\n"),
    ],
)
def test_a_signal_stops_the_command(ended, number, words):
    before = signal.getsignal(number)
    assert ended(lambda: signal.raise_signal(number)) == (128 + number, words)
    assert signal.getsignal(number) is before


def test_a_signal_sent_twice_does_not_break_the_end(ended):
    """As `timeout` sends it."""

    def program():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            signal.raise_signal(signal.SIGTERM)

    assert ended(program) == (143, "stopped by SIGTERM\n")


def test_a_signal_in_a_callback_of_the_garbage_collector_is_not_lost(ended):
    """Python drops what is raised there."""

    def once(phase, _):
        gc.callbacks.remove(once)
        signal.raise_signal(signal.SIGTERM)

    def program():
        gc.callbacks.append(once)
        gc.collect()
        time.sleep(20.0)

    assert ended(program) == (143, "stopped by SIGTERM\n")


def test_a_later_signal_ends_the_process_at_once(monkeypatch):
    sent = []
    monkeypatch.setattr(console, "GRACE", 0.0)
    monkeypatch.setattr(os, "kill", lambda *what: sent.append(what))
    before = signal.getsignal(signal.SIGTERM)
    stop = console._Stop()
    with pytest.raises(Stopped, match="SIGTERM"):
        stop(signal.SIGTERM, None)
    time.sleep(0.01)
    stop(signal.SIGTERM, None)
    assert sent == [(os.getpid(), signal.SIGTERM)]
    assert signal.signal(signal.SIGTERM, before) == signal.SIG_DFL


def test_a_signal_that_is_ignored_stays_so(ended):
    """As SIGHUP under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert ended(lambda: signal.raise_signal(signal.SIGHUP)) == (0, "")
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(
    ("begun", "words"), [(True, "what was saved is kept; go on with: "), (False, "nothing")]
)
def test_a_stopped_run_says_how_to_go_on(ended, monkeypatch, tmp_path, begun, words):
    out = tmp_path / "my runs"

    def start(config, folder, observers, max_seconds):
        assert max_seconds == 90.0
        if begun:
            folder.mkdir()
            (folder / "run.json").touch()
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("jaxcrumple.run.run.start_run", start)
    arguments = ["run", *RUN, "--out", str(out), "--max-seconds", "1.5 min"]
    code, text = ended(lambda: cli.app(arguments))
    assert code == 143
    assert text.startswith(f"stopped by SIGTERM; {words}")
    command = f"jaxcrumple run radial --resume --out '{out}'\n"
    assert text.endswith(command if begun else "nothing was saved yet\n")


def test_what_replaces_a_file_is_repeated_where_its_run_goes_on():
    command = cli._resume_command("a.toml", Path("out"), {"t_end": "1 s"}, ["rtol=1e-3"])
    assert command == "jaxcrumple run a.toml --t-end '1 s' --set rtol=1e-3 --resume --out out"
    assert (
        cli._resume_command("arch", Path("out"), {"nodes": 3}, []) == "jaxcrumple run arch --resume --out out"
    )


def test_only_what_is_no_refusal_has_a_note(ended):
    def program(error):
        with noted(lambda: "go on"):
            raise error

    assert ended(lambda: program(ValueError("x")))[0] == 70
    assert ended(lambda: program(jc.ConfigError("x"))) == (2, "error: x\n")
    error = WorkersLostError("x.")
    error.add_note("a library's own")
    assert ended(lambda: program(error)) == (1, "error: x.; go on\n")


def test_a_limit_that_is_no_time_is_refused(ended):
    for limit in ("abc", "nan", "-1", "2 m"):
        code, text = ended(lambda limit=limit: cli.app(["run", *RUN, "--max-seconds", limit]))
        assert code == 2
        assert f"--max-seconds = '{limit}' is no wall time; give one such as 600 or '30 min'." in text


# --- Streams -------------------------------------------------------------------------------------


def test_a_full_output_is_one_line(ended, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert ended(lambda: say("words")) == (
            1,
            "error: standard output cannot be written: No space left on device\n",
        )
        monkeypatch.undo()
    # Also for what is written as the program ends.
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert ended(lambda: print("words"))[0] == 1
        monkeypatch.undo()


def test_an_output_that_nobody_reads_ends_the_command_in_silence(ended, monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert ended(lambda: say("words")) == (141, "")
        monkeypatch.undo()


def test_a_terminal_without_unicode_shows_escapes(ended, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    assert ended(lambda: say("5 µm of \udcff")) == (0, "")
    monkeypatch.undo()
    assert stream.buffer.getvalue() == b"5 \\xb5m of \\udcff\n"


def test_lines_are_shown_as_they_are(capsys):
    """No markup, no emoji, no line breaks, and control characters as escapes."""
    name = "a[/b]:smile:" + 200 * "x"
    say(f"{name}\n\x1b[2J")
    assert capsys.readouterr().out == f"{name}\\n\\x1b[2J\n"


def test_a_lost_output_is_no_os_error():
    """Which Typer and Rich answer by codes of their own."""
    assert not issubclass(OutputLostError, OSError)


# --- The first moments ---------------------------------------------------------------------------


def entered(program, **options):
    """A process that does what the command does first, then runs a program."""
    prepared = f"""
import importlib.util, os, signal, sys
sys.argv = ["jaxcrumple"]
spec = importlib.util.spec_from_file_location("entry", {str(ENTRY)!r})
entry = importlib.util.module_from_spec(spec)
spec.loader.exec_module(entry)
entry.prepare()
{program}
"""
    shell = options.pop("shell", 'exec "$@"')
    words = ["sh", "-c", shell, "sh", sys.executable, "-S", "-c", prepared]
    return subprocess.run(words, capture_output=True, text=True, timeout=60, **options)


def test_an_interrupt_while_importing_leaves_no_traceback():
    result = entered("os.kill(os.getpid(), signal.SIGINT); print('not reached')")
    assert result.returncode == -signal.SIGINT
    assert (result.stdout, result.stderr) == ("", "")


def test_closed_streams_are_filled():
    """The first file that is opened is none of them."""
    program = "print(); sys.exit(0 if os.open('/dev/null', 0) > 2 and sys.stdout.fileno() == 1 else 3)"
    for shell in ('exec "$@" >&-', 'exec "$@" <&- >&- 2>&-'):
        assert entered(program, shell=shell).returncode == 0


def test_a_deleted_working_directory_is_refused(tmp_path):
    (tmp_path / "gone").mkdir()
    result = entered("", shell='rmdir ../gone; exec "$@"', cwd=tmp_path / "gone")
    assert result.returncode == 2
    assert result.stderr.startswith("error: the working directory cannot be used: No such file or directory")
    assert len(result.stderr.splitlines()) == 1


def test_a_program_that_uses_the_library_is_left_alone(monkeypatch):
    spec = importlib.util.spec_from_file_location("entry", ENTRY)
    entry = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(entry)
    for name, command, is_command in (
        ("script.py", ["python", "script.py"], False),
        ("-m", ["python", "-m", "pytest"], False),
        ("-m", ["python", "-m", "jaxcrumple", "run"], True),
        ("/usr/bin/jaxcrumple", ["/usr/bin/jaxcrumple"], True),
    ):
        monkeypatch.setattr(sys, "argv", [name])
        monkeypatch.setattr(sys, "orig_argv", command)
        assert entry._is_command() == is_command


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shell", "code", "words"),
    [
        ('"$@" scenes > /dev/full', 1, "error: standard output cannot be written"),
        ('{ "$@" scenes; echo $? >&2; } | true', 0, "141"),
        ('exec "$@" scenes >&-', 0, ""),
        ('rmdir ../gone; exec "$@" scenes', 2, "error: the working directory"),
        ('PYTHONIOENCODING=ascii exec "$@" --help', 0, ""),
        ('JAX_PLATFORMS=cuda exec "$@" check arch', 2, "unset JAX_PLATFORMS"),
    ],
)
def test_the_command_itself(tmp_path, shell, code, words):
    if "cuda" in shell and jax.default_backend() != "cpu":
        pytest.skip("this machine has what is asked for")
    (tmp_path / "gone").mkdir()
    # An empty part would be the working directory, without which Python does not start.
    path = os.pathsep.join(filter(None, [str(PACKAGE.parent), os.environ.get("PYTHONPATH")]))
    program = ["sh", "-c", shell, "sh", sys.executable, "-m", "jaxcrumple"]
    environment = {**os.environ, "PYTHONPATH": path}
    place = tmp_path / "gone"
    result = subprocess.run(program, capture_output=True, text=True, timeout=300, env=environment, cwd=place)
    assert result.returncode == code, result.stderr
    assert words in result.stderr
    assert len(result.stderr.splitlines()) == (1 if words else 0), result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.5, 1.0, 1.5])
def test_ctrl_c_in_a_start_says_one_line_at_most(seconds):
    """None while modules are imported, as any program."""
    shell = f'( sleep {seconds}; kill -INT $$ ) & exec "$@" check arch'
    program = ["sh", "-c", shell, "sh", sys.executable, "-m", "jaxcrumple"]
    result = subprocess.run(program, capture_output=True, text=True, timeout=300)
    told = (console.SIGNALED + signal.SIGINT, "stopped\n")
    assert (result.returncode, result.stderr) in [(-signal.SIGINT, ""), told]


# --- Files and folders ---------------------------------------------------------------------------


def test_a_cache_that_cannot_be_written_is_left_out(monkeypatch, capsys, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    before = jax.config.jax_compilation_cache_dir
    console.keep_programs()
    assert jax.config.jax_compilation_cache_dir == before
    assert "note: no compiled programs are kept, so each start compiles again: " in capsys.readouterr().err
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("Could not determine home")))
    monkeypatch.delenv("XDG_CACHE_HOME")
    console.keep_programs()
    assert "Could not determine home" in capsys.readouterr().err


def test_long_names_are_refused(tmp_path):
    name = 300 * "a"
    with pytest.raises(jc.RunDirectoryError, match=r"File name too long; give a shorter name$"):
        jc.start_run(configure("arch", nodes=60), tmp_path / name)
    runs = {name: configure("arch", nodes=60)}
    with pytest.raises(jc.ConfigError, match=r"has a name of 300 bytes; a folder's name may have 255"):
        jc.campaign(runs, tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
