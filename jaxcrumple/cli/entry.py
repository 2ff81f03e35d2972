"""The first moments of the command `jaxcrumple`, before seconds of imports: streams, folder, Ctrl-C."""

import os
import signal
import sys


def prepare() -> None:
    """Where this process is the command, and no program of the user's: fill closed streams, refuse to start
    in a deleted folder, and let Ctrl-C end the imports that follow without a traceback. `console` takes over.
    """
    if _is_command():
        _fill_streams()
        _check_folder()
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _is_command() -> bool:
    program = os.path.basename(sys.argv[0]) if getattr(sys, "argv", None) else ""
    # As long as Python looks for the module of its option -m, that is all it has as the program's name.
    return program == "jaxcrumple" or (program == "-m" and "jaxcrumple" in sys.orig_argv)


def _fill_streams() -> None:
    """Open what is closed of the standard streams as the null device: else the first files that the program
    opens take their numbers, and get what C libraries print."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name, number, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def _check_folder() -> None:
    """Refuse to start where relative paths lead nowhere."""
    try:
        os.getcwd()
    except OSError as error:
        print(
            f"error: the working directory cannot be used: {error.strerror}; change to a folder that exists, "
            "and start again.",
            file=sys.stderr,
        )
        sys.exit(2)
