"""Surfaces of an edit by their numbers or by a comment; its error, and its warnings."""

import re
import warnings
from collections.abc import Sequence

from raytrace.system.elements import cemented_groups, lens_elements
from raytrace.system.lens import Lens
from raytrace.words import RaytraceError, RaytraceWarning, calling_level, did_you_mean

#: A surface by its number, the first and the last one as (3, 6) or "3-6", or a comment.
At = int | str | Sequence[int]


class BadEdit(RaytraceError, ValueError):
    """An edit that the lens does not allow, or surfaces that it does not have."""


class LeftOut(RaytraceWarning):
    """Rules, rows, operands or tolerances of surfaces that an edit removes or turns around are left out."""


class LeftAsItWas(RaytraceWarning):
    """Targets, solves or limits of an unknown unit are not scaled."""


def warn_of(category: type[RaytraceWarning], words: str, names: Sequence[str]) -> None:
    """One warning that names all that an edit leaves out, or as it was."""
    if names:
        warnings.warn(f"{words}: {'; '.join(names)}", category, stacklevel=calling_level())


def surfaces_at(lens: Lens, choice: At) -> tuple[int, int]:
    """The first and the last surface of a choice: numbers, "3-6", or a comment in any case.

    Of a comment on one surface that begins a cemented group, or an element, they are those of the group or the element,
    as in files of vendors; of a comment on several surfaces, the first and the last of these. Raises BadEdit.
    """
    last = len(lens.surfaces) - 1
    if isinstance(choice, str) and (match := re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+))?\s*", choice)):
        ends = int(match[1]), int(match[2] or match[1])
    elif isinstance(choice, str):
        return _of_comment(lens, choice)
    else:
        numbers = [choice] if isinstance(choice, int) else [int(number) for number in choice]
        if not numbers:
            raise BadEdit("no surface is chosen; expected a number, the first and the last one, or a comment")
        ends = numbers[0], numbers[-1]
    if not 0 <= ends[0] <= ends[1] <= last:
        raise BadEdit(f"surfaces {ends[0]}-{ends[1]}: this lens has surfaces 0 to {last}, the object and the image")
    return ends


def _of_comment(lens: Lens, comment: str) -> tuple[int, int]:
    words = {k: surface.comment.strip().lower() for k, surface in enumerate(lens.surfaces)}
    wanted = comment.strip().lower()
    chosen = [k for k, word in words.items() if word == wanted] or [
        k for k, word in words.items() if wanted and wanted in word
    ]
    if not chosen:
        known = list(dict.fromkeys(surface.comment for surface in lens.surfaces if surface.comment))
        listed = f"; comments: {', '.join(known)}" if known else "; this lens has none"
        raise BadEdit(f"no surface has the comment {comment!r}{did_you_mean(comment, known)}{listed}")
    if len(chosen) == 1:
        groups = [*cemented_groups(lens), *lens_elements(lens)]
        return next((group for group in groups if group[0] == chosen[0]), (chosen[0], chosen[0]))
    return min(chosen), max(chosen)
