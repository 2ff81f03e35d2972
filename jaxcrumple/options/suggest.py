"""Words that messages share."""

import difflib
import re
from collections.abc import Iterable

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


def nearest(name: str, known: Iterable[str]) -> str:
    """The end of a sentence that proposes the `known` name that is spelt most like `name`, or all of them."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; choose one of {', '.join(sorted(known))}."


def one_line(text: str) -> str:
    """Text with control characters, as file names may have, as escapes."""
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], text)
