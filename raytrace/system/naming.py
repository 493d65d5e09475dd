"""Naming: numbers of a lens, their bounds and ranges as words name them.

thickness:5,6 curvature:1-4 a4:3 sensor     numbers of surfaces, which are counted as in the file
sensor:57.5,58 curvature_3:-0.1..0          bounds by name, an open end left out
2:15                                        least and greatest
"""

import math
import re
from collections.abc import Sequence

from raytrace.system.lens import Lens
from raytrace.system.places import Place, places
from raytrace.words import did_you_mean

#: Surfaces and configurations are counted up to this number, and so many are named at a time.
MOST = 10_000


class BadVariables(ValueError):
    """A list of variables that the lens does not have, or that cannot be read."""


class BadLimits(ValueError):
    """Limits that cannot be read, or that nothing can keep to."""


def joined(words: str | Sequence[str]) -> str:
    """Words as one text, that may come as several."""
    return words if isinstance(words, str) else " ".join(words)


def counted(word: str, numbers: str, what: str = "surface") -> list[int]:
    """The numbers of a list like "1,3-5". Raises BadVariables naming the word that it is part of."""
    found: list[int] = []
    for part in numbers.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        if not match:
            raise BadVariables(f"{word!r}: {part!r} is no {what} number; expected numbers and ranges like 1,3-5")
        first, last = (int(digits) if len(digits) < 10 else MOST + 1 for digits in (match[1], match[2] or match[1]))
        if last > MOST or len(found) + last - first > MOST:
            raise BadVariables(f"{word[:60]!r}: {part[:60]!r} reaches beyond {what} {MOST}, which no lens has")
        found += range(first, last + 1)
    return found


def place_named(lens: Lens, kind: str, number: int, word: str) -> Place:
    """Where a surface holds a number of that name; "sensor" is a thickness. Raises BadVariables."""
    if not 1 <= number <= len(lens.surfaces) - 2:
        raise BadVariables(f"{word!r}: surface {number}; this lens has surfaces 1 to {len(lens.surfaces) - 2} to vary")
    known = {"thickness": Place(("thickness",)), **places(lens.surfaces[number])}
    wanted = "thickness" if kind == "sensor" else kind
    if wanted not in known:
        meant = did_you_mean(kind, known)
        raise BadVariables(f"{word!r}: surface {number} has no {kind}; it has {', '.join(known)}{meant}")
    return known[wanted]


def sensor(lens: Lens) -> int:
    """The surface behind which the sensor stands."""
    return len(lens.surfaces) - 2


def parse_bounds(text: str) -> dict[str, tuple[float, float]]:
    """Bounds by name of a list like "sensor:57.5,58 curvature_3:-0.1..0". Raises BadVariables saying what is wrong."""
    found = {}
    for word in text.split():
        name, _, ends = word.rpartition(":")
        try:
            low, high = ends.split(".." if ".." in ends else ",")
            low, high = float(low or -math.inf), float(high or math.inf)
        except ValueError as error:
            raise BadVariables(f"{word!r}: expected a variable and its bounds, like thickness_5:8,12") from error
        if not low < high:
            raise BadVariables(f"{word!r}: {low:g} is not less than {high:g}")
        found[name] = (low, high)
    return found


def parse_range(text: str) -> tuple[float, float]:
    """Least and greatest of "2:15", or of "2" (nothing at most). Raises BadLimits saying what is wrong."""
    least, colon, most = text.partition(":")
    try:
        low, high = float(least), float(most) if colon else math.inf
    except ValueError:
        raise BadLimits(f"{text!r}: expected the least thickness in mm, or least and greatest like 2:15") from None
    if not 0 <= low < high:
        raise BadLimits(f"{text!r}: expected 0 ≤ least < greatest, found {low:g} and {high:g} mm")
    return low, high
