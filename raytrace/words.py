"""Words: the nearest known to an unknown one, what the kind of a value is called, and the line that a warning names."""

import difflib
import re
import sys
from collections.abc import Iterable
from numbers import Real
from pathlib import Path

_PACKAGE = str(Path(__file__).parent)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """What may have been meant by a word, of the known ones, as the end of a message; empty if nothing is near."""
    spelled = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), spelled, n=1, cutoff=0.7)
    return f"; did you mean {spelled[near[0]]}?" if near else ""


def named(part: object) -> str:
    """The kind of a value as a sentence calls it: "an ideal lens", of an IdealLens."""
    return with_article(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(part).__name__).lower())


def named_value(value: object) -> str:
    """A value as a message names it: itself if it is short and plain, else its class."""
    if value is None or isinstance(value, (str, Real)):
        return repr(value) if len(repr(value)) < 60 else f"{repr(value)[:57]}…"
    return with_article(type(value).__name__)


def with_article(noun: str) -> str:
    """A noun with "a" or "an" before it."""
    return ("an " if noun[0] in "aeiouAEIO" else "a ") + noun


def calling_level() -> int:
    """The `stacklevel` of a warning, so that it names the line that called the package, however deep it arises."""
    frame, level = sys._getframe(1), 1
    while frame.f_back and frame.f_code.co_filename.startswith(_PACKAGE):
        frame, level = frame.f_back, level + 1
    return level
