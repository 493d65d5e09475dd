"""How lens files spell numbers and texts, in and out, such that both come back exactly."""

import json
import re

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.io.source import LensFileError, Place, shown
from raytrace.system.lens import Lens
from raytrace.system.surface import SHAPE, Surface, is_freeform, is_posed
from raytrace.words import named

#: More characters than any number needs.
_DIGITS = 400

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d{1,4})?", re.ASCII)
_INFINITE = re.compile(r"[+-]?(inf|infinity|infinite|∞|1\.#inf)", re.ASCII | re.IGNORECASE)

#: Millimetres in a unit of length.
MILLIMETRES = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "M": 1e3, "METER": 1e3}


# -- numbers ----------------------------------------------------------------------------------------------------------


def number(text: str, what: str, place: Place) -> float:
    """A finite decimal number, Fortran's D exponent included. Raises LensFileError for anything else."""
    if len(text) > _DIGITS or not _NUMBER.fullmatch(text):
        raise LensFileError(f"{what} is {shown(text)}, expected a finite number", place)
    result = float(text.replace("D", "E").replace("d", "e"))
    if result in (float("inf"), float("-inf")):
        raise LensFileError(f"{what} is {shown(text)}, too large for a 64-bit number", place)
    return result


def integer(text: str, what: str, place: Place) -> int:
    """A whole number below a million in size, written with or without a decimal point."""
    result = number(text, what, place)
    if result != int(result) or abs(result) >= 1e6:
        raise LensFileError(f"{what} is {shown(text)}, expected a whole number", place)
    return int(result)


def is_number(text: str) -> bool:
    """True if `number` would accept the text."""
    if len(text) > _DIGITS or not _NUMBER.fullmatch(text):
        return False
    return abs(plain(text)) != float("inf")


def plain(text: str) -> float:
    """The number of a text that `is_number` accepts."""
    return float(re.sub("[dD]", "e", text))


def is_infinite(text: str) -> bool:
    """True for the spellings of infinity met in lens files."""
    return bool(_INFINITE.fullmatch(text))


def double(numbers: float | list) -> Tensor:
    """A number or numbers of a file as a tensor."""
    return torch.tensor(numbers, dtype=torch.float64)


def refuse_overflow(lens: Lens, file: str) -> None:
    """Raise LensFileError where a number left the 64-bit range when it was converted to mm.

    A lens that came out of a reader holds finite numbers only, but for the distance of the object.
    """
    for k, surface in enumerate(lens.surfaces):
        numbers = [getattr(surface, name) for name in SHAPE if name != "kind"]
        numbers += [surface.phase, surface.before, surface.after]
        numbers += [surface.semi_diameter, *([surface.thickness] if k else [])]
        numbers += [(*aperture.extent, *aperture.centre) for aperture in surface.apertures]
        if not _finite(numbers):
            raise LensFileError("a number is too large once converted to mm", Place(file, None, k))
    if not _finite([lens.aperture.value, lens.fields.x, lens.fields.y]):
        raise LensFileError("aperture or field is too large once converted to mm", Place(file))
    thickness = lens.surfaces[0].thickness
    if torch.isnan(thickness) or thickness == -torch.inf:
        raise LensFileError("the object distance is too large once converted to mm", Place(file, None, 0))


def _finite(numbers: list) -> bool:
    given = [torch.as_tensor(one, dtype=torch.float64) for one in pytree.tree_leaves(numbers) if one is not None]
    return all(bool(torch.isfinite(one).all()) for one in given)


def exact(number: Tensor | float, what: str, place: Place) -> str:
    """The shortest decimal (at most 17 digits) that reads back as the same 64-bit number.

    Raises LensFileError for a batch of numbers, nan and infinity.
    """
    return exact_list(torch.as_tensor(number, dtype=torch.float64), what, place, axes=0)[0]


def exact_list(numbers: Tensor, what: str, place: Place, *, axes: int = 1) -> list[str]:
    """`exact` of every number of a one-dimensional tensor."""
    if numbers.ndim != axes:
        shape = tuple(numbers.shape)
        raise LensFileError(f"{what} has the shape {shape}; a file holds one lens: write one of them", place)
    found = numbers.detach().double().reshape(-1)
    for number in found[~torch.isfinite(found)].tolist():
        raise LensFileError(f"{what} is {number}; only finite numbers can be written", place)
    return [repr(number) for number in found.tolist()]


def thickness(number: Tensor, infinity: str, place: Place) -> str:
    """A thickness; the object's may be infinite."""
    if place.surface == 0 and number.ndim == 0 and float(number) == torch.inf:
        return infinity
    return exact(number, "thickness", place)


#: What is said of a surface that a format has no words for.
_ELSEWHERE = "this format does not hold; a .zmx file holds most kinds"


def refuse_sag_terms(surface: Surface, place: Place) -> None:
    """Raise LensFileError for a surface with sag terms: the formats hold conics and terms of a kind."""
    if surface.sag_terms is not None:
        kind = named(surface.sag_terms)
        raise LensFileError(f"the surface departs from a conic and even terms ({kind}), which {_ELSEWHERE}", place)
    if is_freeform(surface):
        raise LensFileError(f"the surface is {surface.kind}, which {_ELSEWHERE}", place)
    if surface.phase is not None:
        raise LensFileError(f"the surface has a phase ({named(surface.phase)}), which {_ELSEWHERE}", place)
    if is_posed(surface):
        raise LensFileError(f"the surface is tilted or decentred, which {_ELSEWHERE}", place)


# -- texts: as they are where that brings them back, else quoted and escaped as in JSON -------------------------------

#: Blanks that no reader takes away inside a text, though Python calls them not printable.
BLANKS = "\u00a0\u3000"


def quoted(text: str) -> str:
    """A text for a cell or a header line: itself, or in quotes with \\n, \\t, \\" and \\u escapes."""
    plain = text == text.strip() and text and is_printable(text) and text[-1] not in ",;" and not _is_quoted(text)
    return text if plain else _escaped(text)


def plain_text(text: str) -> str:
    """The text that `quoted` wrote; any other without the blanks around it."""
    text = text.strip()
    if _is_quoted(text):
        try:
            found = json.loads(text)
        except ValueError:
            return text
        return found if isinstance(found, str) else text
    return text


def is_printable(text: str) -> bool:
    """True for a text without control characters, line separators and characters that no encoding holds."""
    return "\ufffd" not in text and text.translate(dict.fromkeys(map(ord, BLANKS), " ")).isprintable()


def words(text: str) -> list[str]:
    """Words between blanks, commas or semicolons; those in quotes as `quoted` writes them."""
    return [plain_text(word) for word in re.findall(r'"(?:[^"\\]|\\.)*"|[^\s,;]+', text)]


def word(text: str) -> str:
    """A text as one of `words`."""
    plain = words(text) == [text] and is_printable(text) and '"' not in text
    return text if plain else _escaped(text)


def _escaped(text: str) -> str:
    return "".join(c if is_printable(c) else json.dumps(c)[1:-1] for c in json.dumps(text, ensure_ascii=False))


def _is_quoted(text: str) -> bool:
    return len(text) > 1 and text[0] == text[-1] == '"'


def one_line(text: str, what: str, place: Place) -> str:
    """A text without its surrounding blanks. Raises LensFileError if it does not fit on one line of a file."""
    if not is_printable(text.replace("\t", " ")):
        raise LensFileError(f"{what} holds a line break or a control character, and cannot be written", place)
    return text.strip()
