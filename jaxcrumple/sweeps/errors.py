"""Errors of worker processes, in a module that the command line imports without JAX."""


class WorkersLostError(RuntimeError):
    """Worker processes or their scheduler are lost for good, or cannot run this program."""
