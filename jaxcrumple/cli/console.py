"""End the command with one line that explains its end, and an exit code."""

import errno
import os
import shlex
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Timer, main_thread
from types import FrameType
from typing import Any, NoReturn

import typer
from rich.console import Console

from jaxcrumple._jax.settings import configure_jax, enable_compilation_cache
from jaxcrumple.options.suggest import one_line
from jaxcrumple.sweeps.errors import WorkersLostError

console = Console()

# Exit codes besides 0: a run ended without success, the command was refused, a bug of the program. A signal
# gives 128 plus its number.
ENDED, REFUSED, BUG = 1, 2, 70
SIGNALED = 128
# Signals that stop the command like Ctrl-C. Programs such as `timeout` send a signal twice, so a second one
# within GRACE seconds of the first does not kill the process.
SIGNALS, GRACE = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP), 2.0
# Time in s after which a signal that a callback has dropped is sent again.
AGAIN = 0.01
LESS = "take fewer --nodes, fewer cases side by side, or a machine with more"


class Stopped(BaseException):
    """A signal stops the command. Not a KeyboardInterrupt, because libraries catch that themselves."""

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.number = number


class Hint(str):
    """A note on an exception that tells how to go on; the type distinguishes it from notes of libraries."""


class OutputLostError(Exception):
    """Writing to standard output failed. Not an OSError, because libraries catch that themselves."""

    def __init__(self, error: OSError):
        super().__init__(error.strerror or str(error))
        self.broken_pipe = error.errno == errno.EPIPE


def say(text: str, style: str | None = None) -> None:
    """Print a line to standard output unchanged, without markup or wrapping."""
    console.print(one_line(text), style=style, markup=False, emoji=False, highlight=False, soft_wrap=True)


def command(*words: Any) -> str:
    """Format a command of this program for the shell."""
    return shlex.join(["jaxcrumple", *map(str, words)])


@contextmanager
def noted(words: Callable[[], str]) -> Iterator[None]:
    """Add the note `words()`, on how to go on, to an exception raised inside. A refusal (ValueError) gets no
    note, because its own message tells the cure."""
    try:
        yield
    except (ValueError, typer.Exit):
        raise
    except BaseException as error:
        error.add_note(Hint(words()))
        raise


def check_place(path: Path, option: str) -> None:
    """Refuse a file that cannot be written, before any work starts."""
    folder = path.absolute().parent
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give {option} a file.")
    try:
        with tempfile.TemporaryFile(dir=folder):
            return
    except OSError as error:
        raise ValueError(f"cannot write to {folder}; choose another {option}.") from error


def run_program(app: Callable[[], Any]) -> NoReturn:
    """Call a Typer program, print the cause of its end, and exit."""
    configure_jax("jax_enable_x64", True)
    with _stoppable(), _guarded_output(), warnings.catch_warnings():
        warnings.showwarning = _shown_once()
        try:
            code = _called(app)
            sys.stdout.flush()
        except BaseException as error:
            code = _told(error)
    sys.exit(code)


def _shown_once() -> Callable[..., None]:
    """Return a handler that shows each distinct warning once, in one line."""
    seen: set[str] = set()

    def show(message: Warning | str, *_: Any) -> None:
        if (text := str(message)) not in seen:
            seen.add(text)
            _complain(f"warning: {text}", style="yellow")

    return show


def keep_programs() -> None:
    """Enable the persistent compilation cache, unless no folder is writable.

    The compiler's alarm about long compile times, which asks users to report a bug, is silenced.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # An unusable cache only costs time.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")
    try:
        enable_compilation_cache()
    except ValueError as error:
        _complain(
            f"note: no compiled programs are kept, so each start compiles again: {error.__cause__}",
            style=None,
        )


def _called(app: Callable[[], Any]) -> int:
    """Call the program and return its exit code."""
    try:
        app()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    return 0


def _told(error: BaseException) -> int:
    """Print to standard error what ended the program, and return the exit code."""
    text, code = explained(error)
    if code == BUG:
        _complain("".join(traceback.format_exception(error)).rstrip(), lines=True)
    # A traceback already shows the notes.
    notes = [] if code == BUG else getattr(error, "__notes__", [])
    hints = [note for note in notes if isinstance(note, Hint)]
    words = "; ".join(part for part in (text, *hints) if part)
    if words:
        _complain(words, style="yellow" if isinstance(error, Stopped) else "red")
    return code


def explained(error: BaseException) -> tuple[str, int]:
    """Return the cause of the end, with a cure if one is known, and the exit code."""
    match error:
        case Stopped() | KeyboardInterrupt():
            number = error.number if isinstance(error, Stopped) else signal.SIGINT
            return "stopped" if number == signal.SIGINT else f"stopped by {error}", SIGNALED + number
        case OutputLostError():
            if error.broken_pipe:
                return "", SIGNALED + signal.SIGPIPE
            return f"error: standard output cannot be written: {error}", ENDED
        case MemoryError():
            return f"error: not enough memory{_more(error)}; {LESS}", ENDED
        case WorkersLostError():
            return f"error: {error}", ENDED
        case UnicodeError():
            return f"error: a text or name is no valid Unicode{_more(error)}; give it in UTF-8", REFUSED
        case RecursionError():
            return "error: the input is nested too deeply; give it with fewer levels", REFUSED
        case ArithmeticError():
            what = f"({type(error).__name__}: {error}, in {_place(error)})"
            cure = "check the powers of ten of the input"
            return f"error: a number is too large or too small to compute with {what}; {cure}", REFUSED
        case OSError() if error.strerror:
            return f"error: {_file(error)}{error.strerror}; {_cure(error)}", REFUSED
        case ValueError() | ImportError() if _is_ours(error):
            return f"error: {error}", REFUSED
    # Everything above explains errors before JAX is imported.
    import jax

    if trouble := _backend_trouble():
        return f"error: JAX has no device to run on ({trouble}); unset JAX_PLATFORMS", REFUSED
    if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error):
        return f"error: not enough memory on {jax.devices()[0].platform}{_more(error)}; {LESS}", ENDED
    return (
        f"error: this is a bug of jaxcrumple, or of a library that it uses: {type(error).__name__}: {error}. "
        f"Please report it with the lines above, the command, and what `{command('report')}` prints.",
        BUG,
    )


def _backend_trouble() -> str:
    """Return why JAX has no device, e.g. JAX_PLATFORMS names a missing platform; empty if it has one."""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        lines = str(error).splitlines()
        return lines[0] if lines else "none of its platforms is available"
    return ""


def _more(error: BaseException) -> str:
    """Return the first line of an error's message in brackets; empty without a message."""
    lines = str(error).splitlines()
    return f" ({lines[0]})" if lines else ""


def _file(error: OSError) -> str:
    return "" if error.filename is None else f"{os.fsdecode(error.filename)}: "


def _cure(error: OSError) -> str:
    cures = {
        errno.ENOSPC: "free some space, or choose a folder on another disk; what was saved before is intact",
        errno.EDQUOT: "free some space, or choose a folder on another disk; what was saved before is intact",
        errno.ENAMETOOLONG: "give a shorter name",
        errno.EMFILE: "raise the limit on open files (ulimit -n)",
        errno.EACCES: "change its permissions, or choose another place",
        errno.EPERM: "change its permissions, or choose another place",
        errno.EROFS: "choose a place on a writable disk",
    }
    return cures.get(error.errno or 0, "check the path and the disk; what was saved before is intact")


def _is_ours(error: ValueError | ImportError) -> bool:
    """Return whether this package raised an error, i.e. a refusal with cause and cure. One of another package
    is a bug: this package should have refused the input."""
    return type(error).__module__.startswith("jaxcrumple") or _raiser(error).startswith("jaxcrumple")


def _raiser(error: BaseException) -> str:
    """Return the name of the module that raised the error."""
    frames = list(traceback.walk_tb(error.__traceback__))
    return str(frames[-1][0].f_globals.get("__name__")) if frames else ""


def _place(error: BaseException) -> str:
    """Return file and line of the last call in this package."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "jaxcrumple" in Path(frame.filename).parts] or frames
    return f"{Path(ours[-1].filename).name}, line {ours[-1].lineno}" if ours else "an unknown place"


def _complain(text: str, style: str | None = "red", lines: bool = False) -> None:
    """Write to standard error, if there is one."""
    error = Console(stderr=True)
    try:
        error.print(
            text if lines else one_line(text),
            style=style,
            markup=False,
            emoji=False,
            highlight=False,
            soft_wrap=True,
        )
    except (OSError, SystemExit):  # Rich raises SystemExit on a broken pipe.
        return


class _Stop:
    """Raise `Stopped` at the first signal; a signal more than GRACE seconds later kills the process.

    Python drops what is raised within a callback, such as those of its garbage collector. `dropped` is the
    hook that it then calls, and sends the signal again soon after.
    """

    def __init__(self) -> None:
        self.first: float | None = None
        self.other_hook = sys.unraisablehook

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.first is None:
            self.first = now
            raise Stopped(number)
        if now - self.first > GRACE:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

    def dropped(self, what: Any) -> None:
        if not isinstance(what.exc_value, Stopped):
            self.other_hook(what)
            return
        self.first = None
        Timer(AGAIN, signal.pthread_kill, (main_thread().ident, what.exc_value.number)).start()


@contextmanager
def _stoppable() -> Iterator[None]:
    """Let signals raise `Stopped` inside, except those that the parent process set to be ignored."""
    stop = _Stop()
    wanted = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, stop) for number in wanted}
    sys.unraisablehook = stop.dropped
    try:
        yield
    finally:
        sys.unraisablehook = stop.other_hook
        for number, handler in before.items():
            signal.signal(number, handler)


class _Output:
    """A stream that raises `OutputLostError` if writing fails."""

    def __init__(self, stream: Any):
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        try:
            return self.stream.write(text)
        except OSError as error:
            raise OutputLostError(error) from error

    def flush(self) -> None:
        try:
            self.stream.flush()
        except OSError as error:
            raise OutputLostError(error) from error


@contextmanager
def _guarded_output() -> Iterator[None]:
    """Raise `OutputLostError` inside if standard output fails; escape characters that its encoding lacks."""
    stream = sys.stdout
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="backslashreplace")
    sys.stdout = _Output(stream)
    try:
        yield
    finally:
        sys.stdout = stream
        try:
            stream.flush()
        except OSError:  # Python would report it again at exit.
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), stream.fileno())
