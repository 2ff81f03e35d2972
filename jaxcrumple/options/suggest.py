"""Text helpers for messages."""

import difflib
import re
from collections.abc import Iterable

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


def nearest(name: str, known: Iterable[str]) -> str:
    """End a sentence with the `known` name that is closest to `name` in spelling, or with all of them."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; choose one of {', '.join(sorted(known))}."


def one_line(text: str) -> str:
    """Replace control characters, which file names may contain, by escapes."""
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], text)
