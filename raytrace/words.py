"""Texts of messages: the known name nearest to an unknown one, the kind of a value; warnings and the line they name."""

import difflib
import functools
import inspect
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from numbers import Real
from pathlib import Path
from typing import TypeVar, cast

_PACKAGE = str(Path(__file__).parent)


class RaytraceError(Exception):
    """An error of this package: input that it refuses, or an answer that does not exist.

    Each is also an error of Python: ValueError, LookupError, OSError, ImportError or RuntimeError.
    """


class MissingExtra(RaytraceError, ImportError):
    """The libraries of an extra of the package are not installed."""


def missing_extra(part: str, extra: str, error: ImportError) -> MissingExtra:
    """The error of a part of the package whose import failed."""
    return MissingExtra(f"{part} needs {error.name}: install it by pip install 'raytrace[{extra}]'", name=error.name)


class RaytraceWarning(UserWarning):
    """A warning of this package, given once in a process; a filter of Python's, as "always", gives it at every line."""


warnings.filterwarnings("once", category=RaytraceWarning, append=True)

#: Options with two spellings: one value on the command line, several in Python.
SPELLINGS = (
    ("catalog", "catalogs"),
    ("depth", "depths"),
    ("field", "fields"),
    ("frequency", "frequencies"),
    ("object_distance", "object_distances"),
    ("radius", "radii"),
    ("wavelength", "wavelengths"),
)
_OTHER = {**dict(SPELLINGS), **{several: single for single, several in SPELLINGS}}

Method = TypeVar("Method", bound=Callable)


def both_spellings(method: Method) -> Method:
    """A method of keywords alone that takes both spellings of an option. Raises TypeError for unknown options."""
    names = tuple(inspect.signature(method).parameters)[1:]

    @functools.wraps(method)
    def read(self: object, *values: object, **options: object) -> object:
        if values:
            raise TypeError(f"{method.__qualname__}: {nameless(values[0], names)}")
        known = {known_option(method.__qualname__, word, names, options): value for word, value in options.items()}
        return method(self, **known)

    return cast(Method, read)


def known_option(verb: str, word: str, names: tuple[str, ...], options: Mapping, every: bool = False) -> str:
    """An option as a public function spells it. Raises TypeError for an unknown option, or one that is given twice."""
    if word in names:
        return word
    other = _OTHER.get(word)
    if other in names:
        if other in options:
            raise TypeError(f"{verb}: `{word}` and `{other}` are one option: leave one out")
        return other
    if not every:
        raise TypeError(f"{verb} has no option `{word}`{did_you_mean(word, names)} (it has {', '.join(names)})")
    return word


def former_name(before: str, now: str) -> Callable:
    """The method `before` of a class, which warns and calls the method `now`."""

    def method(self: object, *values: object, **options: object) -> object:
        message = (
            f"{type(self).__name__}.{before} is {type(self).__name__}.{now}; the former name goes with version 0.3"
        )
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(self, now)(*values, **options)

    return method


def nameless(value: object, names: Iterable[str]) -> str:
    """The message for a value without the name of its option; names: options that take a name."""
    names = [*names]
    where = f"write name=value (options: {', '.join(names)})" if names else "it takes no further value; leave it out"
    return f"{named_value(value)} is given without a name; {where}"


_flags: ContextVar[Mapping[str, str]] = ContextVar("flags")


@contextmanager
def in_command(flags: Mapping[str, str]) -> Iterator[None]:
    """Within the block, messages name options as a command spells them; flags: by parameter, {"fields": "--field"}."""
    token = _flags.set(flags)
    try:
        yield
    finally:
        _flags.reset(token)


def option(name: str, value: object = "") -> str:
    """An option as a message names it: `ray_aiming=real` in Python, --ray-aiming real in a command that has it; of a
    switch `geometric=True` and --geometric."""
    flag, text = _flags.get({}).get(name), str(value)
    if flag is None:
        return f"`{name}={text}`" if text else f"`{name}`"
    return flag if text in ("", "True") else f"{flag} {text}"


class _Options(dict[str, str]):
    def __missing__(self, key: str) -> str:
        name, _, value = key.partition("=")
        return option(name, value)


def with_options(text: str) -> str:
    """A text whose {fields} or {model=drt} are options, named as by `option`."""
    return text.format_map(_Options())


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The known word nearest to a word, as the end of a message; empty if none is near."""
    spelled = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), spelled, n=1, cutoff=0.7)
    return f"; did you mean {spelled[near[0]]}?" if near else ""


def named(part: object) -> str:
    """The class of a value as a noun with its article: "an ideal lens", of an IdealLens."""
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
