"""Prepare the process of the command `jaxcrumple` before its imports: streams, folder, Ctrl-C, memory."""

import atexit
import gc
import os
import signal
import sys

# New objects between two searches for cyclic garbage; Python's default is 700 or 2000. Almost all that
# imports and tracing make stays, and searching it again and again takes a tenth of a start.
NEW_OBJECTS = 10_000


def prepare() -> None:
    """Prepare the process if it runs the command, not a program of the user.

    Open closed standard streams, refuse to start in a deleted folder, and let Ctrl-C end the imports without
    a traceback. `console` handles signals afterwards. Search for cyclic garbage less often, and not at exit.
    """
    if _is_command():
        gc.set_threshold(NEW_OBJECTS)
        atexit.register(gc.freeze)
        _fill_streams()
        _check_folder()
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _is_command() -> bool:
    program = os.path.basename(sys.argv[0]) if getattr(sys, "argv", None) else ""
    # While Python locates the module of its option -m, sys.argv[0] is "-m".
    return program == "jaxcrumple" or (program == "-m" and "jaxcrumple" in sys.orig_argv)


def _fill_streams() -> None:
    """Open closed standard streams as the null device. Otherwise the first files that the program opens get
    their file descriptors, and receive the output of C libraries."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name, number, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def _check_folder() -> None:
    """Refuse to start in a working directory that does not exist, where relative paths fail."""
    try:
        os.getcwd()
    except OSError as error:
        print(
            f"error: the working directory cannot be used: {error.strerror}; change to a folder that exists, "
            "and start again.",
            file=sys.stderr,
        )
        sys.exit(2)
